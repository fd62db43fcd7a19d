"""The two-desk scene and its author."""
