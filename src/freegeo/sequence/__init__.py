"""Many frames: chunks that are predicted one at a time, aligned, and joined to one reconstruction."""
