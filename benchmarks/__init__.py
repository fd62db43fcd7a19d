"""Developers' measurements of speed, of this product and next to other programs: `python -m benchmarks --help`."""
