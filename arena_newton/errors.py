"""The product's errors: one small hierarchy."""

import contextlib
from collections.abc import Iterable, Iterator
from typing import ClassVar

__all__ = ["ArenaError", "InputError", "UnknownName", "check_once", "naming"]


class ArenaError(Exception):
    """Base of every error that arena_newton raises on purpose."""

    exit_code: ClassVar[int] = 1
    """Exit code of a command line that ends with the error."""


class InputError(ArenaError):
    """The user's input (flag, file, prim, field) is wrong; the command line prints it and exits with code 2."""

    exit_code = 2


class UnknownName(InputError):
    """A name that nobody offers in this process; in another one a program may have registered it."""


@contextlib.contextmanager
def naming(flag: str) -> Iterator[None]:
    """Put the flag that brought an input in front of what is wrong with it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{flag} {error}") from error


def check_once(where: str, values: Iterable[object]) -> None:
    """Refuse values, behind a flag or a key of a file, of which one is given twice.

    Raises:
        InputError: One is.
    """
    found = set()
    for value in values:
        if value in found:
            raise InputError(f"{where} {value}: given twice")
        found.add(value)
