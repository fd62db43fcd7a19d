"""Flags of a command from a dataclass: tyro parses them, a complaint is one line."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import io
import itertools
import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import tyro

from arena_newton.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = [
    "Device",
    "Engine",
    "Several",
    "bounds",
    "check_bounds",
    "check_least",
    "check_number",
    "shell_command",
    "flag_name",
    "folders_named",
    "parse_flags",
    "shared",
    "typed",
    "user_path",
    "words",
]

_T = TypeVar("_T")
Several = Annotated[
    tuple[_T, ...], tyro.conf.arg(help_behavior_hint=lambda shown: f"(default: {shown})" if shown else "")
]
"""Values of a flag that takes at least one; help shows no default where it is none of them."""
Device = Annotated[
    _T,
    tyro.conf.arg(
        help="Device of simulation and networks: cpu, cuda, cuda:1.",
        help_behavior_hint=lambda shown: f"(default: {'the best there is' if shown in ('None', 'auto') else shown})",
    ),
]
"""Device of a command; None and `auto`: the best there is."""
Engine = Annotated[
    str, tyro.conf.arg(help="Physics engine: mujoco (CPU), warp (CUDA or CPU), auto (warp where there is CUDA).")
]


def flag_name(field: str) -> str:
    """A flag as it is typed, from the name of its field."""
    return f"--{field.replace('_', '-')}"


def typed(field: str, value: object) -> list[str]:
    """A flag as it is typed with its value: nothing for None, `--no-x` for False, each of several values."""
    name = flag_name(field)
    if isinstance(value, bool):
        return [name if value else f"--no-{name[2:]}"]
    return [] if value is None else [name, *map(str, value if isinstance(value, list | tuple) else (value,))]


def words(options: DataclassInstance) -> list[str]:
    """Options as they are typed: those that have another value than the default."""
    given = [(one, getattr(options, one.name)) for one in dataclasses.fields(options)]
    return [word for one, value in given if value != one.default for word in typed(one.name, value)]


def shell_command(module: str, *words: object) -> str:
    """A command as it is typed into a shell."""
    return shlex.join(["python", "-m", module, *map(str, words)])


def shared[T: DataclassInstance](options: DataclassInstance, kind: type[T], **others: object) -> T:
    """Options of another kind: the flags that both have, and others."""
    names = {one.name for one in dataclasses.fields(options)} & {one.name for one in dataclasses.fields(kind)}
    return kind(**{name: getattr(options, name) for name in names} | others)


def check_least(options: DataclassInstance, least: int, *names: str) -> None:
    """Refuse numbers of these fields that are smaller.

    Raises:
        InputError: One is; None is not.
    """
    for name in names:
        value = getattr(options, name)
        if value is not None and value < least:
            raise InputError(f"{flag_name(name)} {value}: expected at least {least}")


def bounds(low: float, high: float = math.inf) -> dict[str, tuple[float, float]]:
    """Metadata of a flag whose number, or each of whose numbers by name, is finite and within these bounds."""
    return {"bounds": (low, high)}


def check_bounds(options: DataclassInstance) -> None:
    """Refuse numbers outside the bounds of their fields.

    Raises:
        InputError: One is; None is not.
    """
    for one in dataclasses.fields(options):
        given = getattr(options, one.name)
        for name, number in given.items() if isinstance(given, Mapping) else [("", given)]:
            if "bounds" in one.metadata and number is not None:
                check_number(f"{flag_name(one.name)} {name}".rstrip(), number, *one.metadata["bounds"])


def check_number(flag: str, value: float, low: float, high: float = math.inf) -> None:
    """Refuse a number outside its bounds.

    Raises:
        InputError: It is, or is not finite.
    """
    if not (low <= value <= high and math.isfinite(value)):
        until = f"from {low:g} to {high:g}" if math.isfinite(high) else f"of at least {low:g}"
        raise InputError(f"{flag} {value}: expected a number {until}")


def parse_flags[T](kind: type[T], arguments: list[str], prog: str, default: T | None = None) -> T:
    """Parse flags with tyro; a complaint becomes one line of our own.

    Args:
        kind: Dataclass of the flags, each with a default.
        arguments: What was typed after the command.
        prog: The command, as help and complaints name it.
        default: Values of flags that are not given; the dataclass' own by default.

    Raises:
        InputError: A flag is unknown or its value unfit.
        SystemExit: Help was asked for and printed.
    """
    lists = {flag_name(one.name) for one in dataclasses.fields(kind) if str(one.type).startswith("Several[")}  # type: ignore[arg-type]
    for flag, after in itertools.pairwise([*arguments, "--"]):  # as an empty variable of a shell leaves it
        if flag in lists and after.startswith("--"):
            raise InputError(f"{flag}: cannot read it without a value")
    missing = tyro.MISSING_NONPROP if default is None else default
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # what it draws there becomes one line
            return tyro.cli(kind, args=arguments, prog=prog, default=missing)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise InputError(_complaint(kind, arguments, prog)) from None


def _complaint(kind: type, arguments: Sequence[str], prog: str) -> str:
    """Fault of arguments that tyro refuses: each flag with its values is given to it alone.

    tyro shows its own complaints as a drawing for a terminal; all flags of this command line have defaults.
    """
    groups: list[list[str]] = []
    for argument in arguments:
        if not groups or argument[:1] == "-" and not argument[1:2].isdigit():
            groups.append([])
        groups[-1].append(argument)
    for flag, *values in groups:
        flag, equals, joined = flag.partition("=")
        alone = [flag, *([joined] if equals else []), *values]
        try:
            with contextlib.redirect_stderr(io.StringIO()):
                _, unknown = tyro.cli(kind, args=alone, prog=prog, return_unknown_args=True)
        except SystemExit:
            return f"{flag}: cannot read {' '.join(alone[1:]) or 'it without a value'}"
        if unknown:
            known = [flag_name(field.name) for field in dataclasses.fields(kind)]
            near = difflib.get_close_matches(unknown[0], known, 1)
            hint = f", did you mean {near[0]}?" if near else f"; see {prog} --help"
            return f"{unknown[0]}: unknown argument{hint}"
    return f"these arguments cannot be read together: {' '.join(arguments)}; see {prog} --help"


def user_path(given: str) -> Path:
    """A path as it was typed, whose leading `~` or `~name` is a home folder.

    Raises:
        InputError: There is no user of that name.
    """
    try:
        return Path(given).expanduser()
    except RuntimeError:
        raise InputError(f"{given}: no home folder of that user is known here") from None


def folders_named(
    arguments: list[str],
    command: str,
    prog: str,
    *,
    noun: str = "a folder",
    shown: str = "<folder>",
    most: int | None = None,
) -> list[Path]:
    """Take the folders or files that a command begins with out of its arguments, each once.

    Args:
        arguments: What was typed after the command; they are removed from it.
        command: The command, such as `report`.
        prog: How the program is called.
        noun: What the message of a missing one asks for.
        shown: How its line shows one.
        most: How many it takes; None: as many as there are.

    Raises:
        InputError: None is named, or one twice.
    """
    found: list[Path] = []
    while arguments and not arguments[0].startswith("-") and len(found) != most:
        found.append(user_path(arguments.pop(0)))
    if not found:
        raise InputError(f"{command}: name {noun}: {prog} {command} {shown}")
    for number, folder in enumerate(found):
        if folder.resolve() in [other.resolve() for other in found[:number]]:
            raise InputError(f"{command} {folder}: is named twice")
    return found
