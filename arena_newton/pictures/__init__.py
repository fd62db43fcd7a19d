"""Pictures: cameras, triangles, lights per world, videos and film strips."""
