"""The file `entry.toml` of an entry of the leaderboard, read and held to its fields."""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal
from unicodedata import category, normalize

from arena_newton.errors import InputError
from arena_newton.eval.audit.folder_audit import CONSISTENT, LEVELS, SELF_REPORTED
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES
from arena_newton.files.stored_json import MAX_TEXT, Fit, Json, Known, Name, is_name, loaded, read_regular
from arena_newton.files.text import is_printable, plain, plain_text

__all__ = ["BUNDLE_FILE", "ENTRY_FILE", "SIMULATOR", "UNTRAINED", "BoardEntry", "as_read", "entry_text", "read_entry"]

ENTRY_FILE = "entry.toml"
BUNDLE_FILE = "bundle.zip"
"""Runs of an entry, next to its file."""
SIMULATOR = "arena_newton"
"""Simulator of every run in a bundle."""
UNTRAINED = "none"
"""Training data of a policy that was not trained."""


def as_read(name: str) -> str:
    """Name as readers tell it from others: without case, widths, accents and further spaces (NFKD)."""
    letters = (c for c in normalize("NFKD", name.casefold()) if category(c) != "Mn")
    return " ".join("".join(letters).casefold().split())


def _told_apart(value: Json) -> bool:
    """True if a value is a name without letters of other alphabets but π, of π0.5, which looks like none of Latin."""
    return isinstance(value, str) and is_name(value) and bool(re.fullmatch(r"[ -~π]+", as_read(value)))


_DATE = re.compile(r"\d{4}-(?:0[1-9]|1[0-2])(?:-(?:0[1-9]|[12]\d|3[01]))?")
Date = Annotated[str, Fit("a day or month, as 2026-11-26", lambda v: bool(_DATE.fullmatch(v)))]
Hash = Annotated[str, Fit("64 hex digits, or nothing", lambda v: bool(re.fullmatch("(?:[0-9a-f]{64})?", v)))]
Level = Annotated[str, Known(lambda: tuple(LEVELS))]
Visible = Annotated[
    str, Fit("a name that can be read", lambda v: is_name(v) and v == plain(v) and "Cf" not in map(category, v))
]
"""Name without characters that no one sees: with one it would look like another's."""
Distinct = Annotated[str, Fit("a name of Latin letters (and π), digits and ASCII punctuation", _told_apart)]
"""Name by which entries are told apart: letters of other alphabets would make it look like another's."""
Text = Annotated[str, Fit("text", lambda v: len(v) < MAX_TEXT and is_printable(v))]


@dataclass(frozen=True)
class BoardEntry:
    """Statements of an entry about itself, a key of `entry.toml` each."""

    name: Distinct
    """Policy as the board names it."""
    authors: Visible
    date: Date
    source: Name
    """Address of code or publication, or the command that plays it."""
    simulator: Distinct
    training_data: Literal["none", "scripted", "teleoperated", "other"]
    """Demonstrations by whom; `none`: nothing was trained."""
    training: Name
    """Data and training in a sentence."""
    trackers: Annotated[tuple[Distinct, ...], Fit("names of Latin letters, digits and ASCII punctuation")]
    """Trackers that executed the policy."""
    hardware: Name
    """Machine of the evaluation."""
    level: Level
    """Level to which it was checked; a build refuses one that is higher than its evidence gives."""
    numbers: Name = "bundle"
    """Source of its numbers: `bundle`, `paper`, `published`, or the path of a `cells.csv` next to the entry's file."""
    rows: tuple[Name, ...] = ()
    """Policies of the paper, of the published rows or of the `cells.csv` whose numbers these are."""
    checkpoint: Text = ""
    """Hash of the policy's weights, as its runs give it."""
    bundle: Hash = ""
    """SHA-256 of `bundle.zip`."""
    head: Text = ""
    """Head of its journals (docs/howto/evaluate/auditing.md)."""
    checked: Text = ""
    """Command and day of the audit, by the maintainer who drew its episodes."""

    @property
    def own(self) -> bool:
        """True if the numbers are of runs of this benchmark in a bundle."""
        return self.numbers == "bundle"


def read_entry(folder: Path) -> BoardEntry:
    """Read the entry of a folder.

    Raises:
        InputError: The file is missing or no TOML, a key is missing, unknown or unfit, or its level needs what it does
            not name; the message names file and key.
    """
    path = folder / ENTRY_FILE
    try:
        content: dict[str, Json] = tomllib.loads(read_regular(path, MAX_CONFIG_BYTES).decode("utf-8-sig"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (ValueError, RecursionError) as error:  # of text, TOML, a number of 5,000 digits, and arrays within arrays
        raise InputError(f"{path}: not readable as TOML ({plain_text(error, 200)})") from None
    known = [one.name for one in dataclasses.fields(BoardEntry)]
    for key in content:
        if key not in known:
            raise InputError(f"{path}: {plain_text(key, 60)} is not a key of an entry, known are {' '.join(known)}")
    entry = loaded(str(path), content, BoardEntry)
    needed = {"trackers": True, "rows": not entry.own, "bundle": entry.own or entry.level != SELF_REPORTED}
    needed["checked"] = entry.level not in (SELF_REPORTED, CONSISTENT)
    for key, wanted in needed.items():
        if wanted and not getattr(entry, key):
            raise InputError(f"{path}: {key} is empty; level {entry.level} with numbers from {entry.numbers} needs it")
    return entry


def entry_text(known: Mapping[str, object], before: BoardEntry | None = None) -> str:
    """Text of an entry's file: known keys, and those that its author fills in, empty or as they were before."""
    left = ("numbers", "rows") if before is None or before.own else ()
    written = [one.name for one in dataclasses.fields(BoardEntry) if one.name not in left]
    values: dict[str, object] = {name: "" if before is None else getattr(before, name) for name in written}
    values |= known
    return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())
