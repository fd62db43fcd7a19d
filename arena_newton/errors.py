"""The product's errors: one small hierarchy."""

import contextlib
from collections.abc import Iterator

__all__ = ["ArenaError", "InputError", "naming"]


class ArenaError(Exception):
    """Base of every error that arena_newton raises on purpose."""


class InputError(ArenaError):
    """The user's input (flag, file, prim, field) is wrong; the command line prints it and exits with code 2."""


@contextlib.contextmanager
def naming(flag: str) -> Iterator[None]:
    """Put the flag that brought an input before what is wrong with it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{flag} {error}") from error
