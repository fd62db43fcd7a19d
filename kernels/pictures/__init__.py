"""Kernels of the cameras: triangles, shadows, lighting."""
