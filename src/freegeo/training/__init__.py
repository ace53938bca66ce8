"""Training of the embedded model `freegeo-tiny` on generated rooms. Only `freegeo.cli` imports this package."""
