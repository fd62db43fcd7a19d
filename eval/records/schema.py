"""Annotations that the files of a results folder share: names that are known here, and numbers in range.

Everything that is derived from a journal (tables, pages, the original's files) is written by names that are stored in
it, and whoever reads a report may have been sent the folder. A value that fits its type here has a known name or a
number in range.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.files.stored_json import Fit, Json, JsonObject, Known, parse, read_regular, shown
from arena_newton.rules import modes

__all__ = ["MAX_CONFIG_BYTES", "MAX_COUNT", "MAX_EPISODES", "MAX_JOURNAL_BYTES", "MAX_SEED", "Count", "Mode"]
__all__ += ["Positive", "Seed", "Task", "check_schema", "read_lines"]

MAX_CONFIG_BYTES = 16 << 20
MAX_JOURNAL_BYTES = 512 << 20
"""Room for 400,000 episodes at a little more than 1 kB each."""
MAX_COUNT = 10**7
"""Steps, repeats, episodes."""
MAX_SEED = 2**64
MAX_EPISODES = 200_000
"""Episodes of one plan; the benchmark's largest has 1,680."""

Task = Annotated[str, Known(tasks.names)]
Mode = Annotated[str, Known(modes.names, modes.is_composed)]
Count = Annotated[int, Fit("a number of at least 0", lambda value: 0 <= value <= MAX_COUNT)]
Positive = Annotated[int, Fit("a number of at least 1", lambda value: 1 <= value <= MAX_COUNT)]
Seed = Annotated[int, Fit("a number of at least 0", lambda value: 0 <= value <= MAX_SEED)]


def check_schema(where: str, content: Mapping[str, Json], newest: int) -> None:
    """Refuse a form that this version does not know.

    Raises:
        InputError: A newer version wrote it.
    """
    schema = content.get("schema", 1)
    if type(schema) is int and schema > newest:
        raise InputError(
            f"{where}: schema {shown(schema)} was written by a newer version of arena_newton, this one reads up to "
            f"{newest}"
        )


def read_lines[T](path: Path, record: Callable[[str, JsonObject], T]) -> tuple[list[T], int]:
    """Lines of a journal; `record` makes one of where it is and its object.

    Returns:
        The records in file order, and the length of the part that is whole [bytes]. A last line that lacks its line
        end, as `kill -9` or a full disk leaves it, is not part of it.

    Raises:
        InputError: A line other than the last is not a JSON object, or no record is made of a line.
    """
    try:
        data = read_regular(path, MAX_JOURNAL_BYTES)
    except FileNotFoundError:
        return [], 0
    found: list[T] = []
    start = 0
    while (end := data.find(b"\n", start)) >= 0:
        where = f"{path}: line {len(found) + 1}"
        try:
            line = parse(data[start:end])
            if not isinstance(line, dict):
                raise ValueError
        except ValueError:
            if end + 1 == len(data):
                break
            raise InputError(f"{where} is not a JSON object; the journal was changed by hand") from None
        found.append(record(where, line))
        start = end + 1
    return found, start
