"""The box-to-shelf scene and its author."""
