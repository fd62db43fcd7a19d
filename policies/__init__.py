"""policies of arena_newton."""
