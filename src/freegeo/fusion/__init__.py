"""From depth maps with cameras to surfaces and points."""
