"""The product's errors: one small hierarchy."""

import contextlib
from collections.abc import Iterator
from typing import ClassVar

__all__ = ["ArenaError", "InputError", "naming"]


class ArenaError(Exception):
    """Base of every error that arena_newton raises on purpose."""

    exit_code: ClassVar[int] = 1
    """Exit code of a command line that ends with the error."""


class InputError(ArenaError):
    """The user's input (flag, file, prim, field) is wrong; the command line prints it and exits with code 2."""

    exit_code = 2


@contextlib.contextmanager
def naming(flag: str) -> Iterator[None]:
    """Put the flag that brought an input in front of what is wrong with it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{flag} {error}") from error
