"""The product's errors: one small hierarchy."""

__all__ = ["ArenaError", "InputError"]


class ArenaError(Exception):
    """Base of every error that arena_newton raises on purpose."""


class InputError(ArenaError):
    """The user's input (flag, file, prim, field) is wrong; the command line prints it and exits with code 2."""
