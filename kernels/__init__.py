"""Arithmetic of the benchmark as Warp functions, kernels and one launch wrapper each; imports Warp alone."""
