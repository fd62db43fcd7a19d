"""Checks of the benchmark, one module for each group: a measurement and what it has to be."""
