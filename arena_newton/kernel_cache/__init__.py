"""Compiled kernels: loaded side by side while an environment is built."""
