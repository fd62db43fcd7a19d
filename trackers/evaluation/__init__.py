"""Measurement of how well a tracker follows references: the suite, its worlds, its measures and its tables."""
