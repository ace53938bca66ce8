"""Test-time adaptation: recipe, view sets, teacher targets, losses, adapter, trainer."""
