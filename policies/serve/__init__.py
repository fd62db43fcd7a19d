"""A policy answers over the network, in the formats of several benchmarks."""
