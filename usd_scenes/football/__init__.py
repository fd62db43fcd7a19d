"""The football scene and its author."""
