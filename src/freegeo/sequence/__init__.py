"""Sequences of any length: chunks of frames that are predicted apart, aligned with each other and joined."""
