"""Kernels, compiled and loaded side by side before an environment is built."""
