"""Known cameras: reading, checking, undistorting and converting (docs/cameras.md)."""
