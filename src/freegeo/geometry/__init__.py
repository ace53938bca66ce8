"""Pure, batched tensor functions for cameras, rotations, similarity transforms, depth maps and image resizing."""
