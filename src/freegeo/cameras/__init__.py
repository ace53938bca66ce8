"""Known cameras: reading, checking, converting."""
