"""Files for other tools: point clouds, meshes, cameras and depth maps."""
