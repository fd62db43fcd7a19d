"""Records of a suite: `suite.json` with the plan, journals with what was played, the one reader of both.

A suite is a folder that `python -m arena_newton.eval matrix` writes. Each cell is an ordinary results folder below it.

- `suite.json`: an object with `schema`, `name`, `source` (the suite file), `hash` (of its content) and `cells`, a list
  of objects with the fields of `SuiteCell`. It is replaced as a whole whenever a cell begins or ends.
- `suite.<n>-of-<N>.jsonl`: one line per beginning and ending of a cell, fields of `CellEvent`, written by the process
  that plays shard n of N (`1-of-1`: all). What happened is read from here, so that the folders of shards that ran
  elsewhere are merged by copying them into one.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypedDict

from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, load_run
from arena_newton.eval.records.document import SUITE_FILE
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES, Count, Mode, Positive, Task, check_schema, read_lines
from arena_newton.files.stored_json import Fit, Json, JsonObject, Name, fit, loaded, parse, read_regular, shown

__all__ = [
    "JOURNAL_PATTERN",
    "SUITE_SCHEMA",
    "CellEnding",
    "CellEvent",
    "CellState",
    "SuitePlan",
    "SuiteCell",
    "event_line",
    "journal_file",
    "load_cell",
    "read_events",
    "read_journal_events",
    "read_suite",
    "suite_json",
    "with_events",
]

JOURNAL_PATTERN = re.compile(r"suite\.([1-9][0-9]{0,3})-of-([1-9][0-9]{0,3})\.jsonl")
"""Names of the journals of a suite."""
SUITE_SCHEMA = 1
"""Newest form of `suite.json` and of a journal line."""

type CellState = Literal["waiting", "started", "done", "failed"]
"""`waiting`: nothing was played; `started`: is being played, or was killed or interrupted; `done`: every planned
episode is in its journal, episodes with errors counted; `failed`: it could not be played, `error` says why."""

_FOLDER = re.compile(r"[A-Za-z0-9+_-][A-Za-z0-9.+_#-]*(?:/[A-Za-z0-9+_-][A-Za-z0-9.+_#-]*){0,7}")

Text = Annotated[str, Fit("text of at most 512 characters", lambda value: len(value) <= 512)]
Folder = Annotated[str, Fit("a path below the suite's folder", lambda value: bool(_FOLDER.fullmatch(value)))]
Seconds = Annotated[float, Fit("seconds", lambda value: 0 <= value < 1e12)]
Digest = Annotated[
    str | None, Fit("12 hex digits", lambda value: value is None or bool(re.fullmatch(r"[0-9a-f]{12}", value)))
]


@dataclass(frozen=True, kw_only=True)
class SuiteCell:
    """One policy through one tracker on one task under one set of conditions, and how far it is."""

    id: Folder
    """Unique in a suite: `<policy>[.<trained_on>]/<tracker>/<task>/<mode>[.<rules>][.latency<K>]`."""
    policy: Name
    """Name of its entry in the suite file; of several checkpoints made by one pattern the same."""
    family: Text
    """`act`, `diffusion`, `flow`, `pi05`, or what the entry says; empty where nothing is known."""
    spec: Name
    """Value of `--policy`."""
    trained_on: tuple[Name, ...]
    """Trackers through which the demonstrations of its training were recorded; none for a policy without training."""
    trained_tasks: tuple[Name, ...]
    """Tasks of its training; none for a policy without training."""
    tracker: Name
    """The tracker that executes its actions."""
    task: Task
    mode: Mode
    rules: Name
    labels: Name
    """Protocol of the policy's actions: `v3.1` or `v4`."""
    latency: Count = 0
    """Ticks by which each chunk starts late."""
    replan: Annotated[Positive | None, Fit("a number of actions or null")] = None
    """Actions of a chunk that are executed before the next query; None: all."""
    ensemble: bool = False
    """True if all chunks that cover a tick are averaged."""
    folder: Folder
    """Results folder, below the suite's."""
    episodes: Positive
    """Planned episodes."""
    ticks: Count
    """Sum of their step budgets [ticks]."""
    config: Digest = None
    """Hash of the run's configuration as far as it is known before it begins; None in a cell that was never checked."""
    status: CellState = "waiting"
    finished: Count = 0
    """Episodes in its journal when it last began or ended."""
    successes: Count = 0
    """Number of them that succeeded."""
    errors: Count = 0
    """Number of them that ended as errors."""
    wall_s: Seconds = 0.0
    """Time that it took, attempts that were broken off included [s]."""
    device: Text = ""
    """Device on which it was played, such as `NVIDIA H200` or `cpu`."""
    error: Annotated[str | None, Fit("text or null")] = None
    """Error of a cell that is `failed`."""

    @property
    def matched(self) -> bool | None:
        """True if the executing tracker is among those of its training; None for a policy without training."""
        return self.tracker in self.trained_on if self.trained_on else None

    @property
    def merged(self) -> bool:
        """True if the policy was trained on several tasks or through several trackers at once."""
        return len(self.trained_tasks) > 1 or len(self.trained_on) > 1


type CellEnding = Literal["done", "failed", "interrupted", "killed"]
"""Ending of a call's work on a cell."""
PROGRESS_FIELDS = ("status", "finished", "successes", "errors", "wall_s", "device", "error")
"""Fields of a cell that its events decide."""


@dataclass(frozen=True, kw_only=True)
class CellEvent:
    """A line of a suite's journal: a cell began, or ended in some way."""

    schema: Positive = SUITE_SCHEMA
    cell: Folder
    event: Literal["begun", "reopened"] | CellEnding
    """`killed` is written by the next call for a cell that has begun and not ended; `reopened`: its results were set
    aside or are gone, what came before counts no more."""
    at: Annotated[str, Fit("a time", lambda value: len(value) < 64)]
    """ISO 8601, UTC."""
    config: Digest = None
    """Hash of the run's configuration before it begins."""
    device: Text = ""
    wall_s: Seconds = 0.0
    """Time since the cell began [s]."""
    finished: Count = 0
    """Episodes in its journal."""
    successes: Count = 0
    errors: Count = 0
    error: Annotated[str | None, Fit("text or null")] = None


class _Plan(TypedDict):
    """Content of `suite.json`."""

    schema: Positive
    name: str
    source: str
    hash: str
    cells: Annotated[list[JsonObject], Fit("a list of objects")]


@dataclass(frozen=True)
class SuitePlan:
    """A suite's folder, read and checked."""

    folder: Path
    name: str
    source: str
    """Path of the suite file as it was given."""
    hash: str
    """Hash of its content."""
    cells: tuple[SuiteCell, ...]
    """Cells in the order of the plan, with what the journals say."""

    def cell(self, name: str) -> SuiteCell:
        """A cell by its id.

        Raises:
            InputError: There is none.
        """
        for cell in self.cells:
            if cell.id == name:
                return cell
        raise InputError(f"{self.folder / SUITE_FILE}: has no cell {shown(name)}")


def journal_file(shard: int, shards: int) -> str:
    """Name of the journal of a shard, counted from 1."""
    return f"suite.{shard}-of-{shards}.jsonl"


def suite_json(suite: SuitePlan) -> JsonObject:
    """Content of `suite.json`."""
    return {
        "schema": SUITE_SCHEMA,
        "name": suite.name,
        "source": suite.source,
        "hash": suite.hash,
        "cells": [dataclasses.asdict(cell) for cell in suite.cells],
    }


def read_suite(folder: Path) -> SuitePlan:
    """Read a suite: the plan of `suite.json`, and how far its cells are from the journals next to it.

    Raises:
        InputError: The folder holds no suite, or its files were damaged or written by a newer version.
    """
    path = folder / SUITE_FILE
    try:
        content = parse(read_regular(path, MAX_CONFIG_BYTES))
    except FileNotFoundError:
        raise InputError(f"{folder}: holds no suite (no {SUITE_FILE})") from None
    except ValueError as error:
        raise InputError(f"{path}: not readable as JSON ({error})") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected an object")
    check_schema(str(path), content, SUITE_SCHEMA)
    fit(str(path), content, _Plan)
    cells = [loaded(f"{path}: cells[{number}]", values, SuiteCell) for number, values in enumerate(content["cells"])]
    seen: set[str] = set()
    for cell in cells:
        if cell.id in seen:
            raise InputError(f"{path}: cell {cell.id} is listed twice")
        seen.add(cell.id)
    plan = SuitePlan(folder, content["name"], content["source"], content["hash"], tuple(cells))
    return with_events(plan, read_events(folder))


def read_events(folder: Path) -> list[CellEvent]:
    """All lines of a suite's journals by time; a last line that was torn is left out.

    Raises:
        InputError: A line is damaged, or a newer version wrote it.
    """
    found: list[CellEvent] = []
    for path in sorted(folder.glob("suite.*.jsonl")):
        if JOURNAL_PATTERN.fullmatch(path.name):
            found += read_journal_events(path)[0]
    return sorted(found, key=lambda event: event.at)  # stable: lines of one file stay in order


def read_journal_events(path: Path) -> tuple[list[CellEvent], int]:
    """Lines of one journal, and the length of the part that is whole [bytes].

    Raises:
        InputError: A line other than the last is damaged, or a newer version wrote it.
    """

    def event(where: str, line: JsonObject) -> CellEvent:
        check_schema(where, line, SUITE_SCHEMA)
        return loaded(where, line, CellEvent)

    return read_lines(path, event)


def event_line(event: CellEvent) -> bytes:
    """The line of a journal."""
    return json.dumps(dataclasses.asdict(event), separators=(",", ":"), allow_nan=False).encode() + b"\n"


def with_events(suite: SuitePlan, events: Iterable[CellEvent]) -> SuitePlan:
    """The suite with what its journals say; events of cells that are no longer in the plan are passed over."""
    by_cell: dict[str, list[CellEvent]] = {}
    for event in events:
        by_cell.setdefault(event.cell, []).append(event)
    return dataclasses.replace(suite, cells=tuple(_played(cell, by_cell.get(cell.id, ())) for cell in suite.cells))


def _played(cell: SuiteCell, events: Sequence[CellEvent]) -> SuiteCell:
    """A cell after its events."""
    blank = {f.name: f.default for f in dataclasses.fields(SuiteCell) if f.name in PROGRESS_FIELDS}
    state: dict[str, Json] = dict(blank)
    for event in events:
        if event.event == "reopened":
            state = dict(blank)
            continue
        state["wall_s"] += event.wall_s
        state["device"] = event.device or state["device"]
        if state["status"] == "done" and event.event != "done":
            continue  # another shard's call that came later and found nothing to do, or was broken off
        state["status"] = event.event if event.event in ("done", "failed") else "started"
        state |= {
            "finished": event.finished,
            "successes": event.successes,
            "errors": event.errors,
            "error": event.error,
        }
    return dataclasses.replace(cell, **state)


def load_cell(suite: SuitePlan, cell: SuiteCell) -> RunRecord:
    """The results folder of a cell, checked against what the suite says of it.

    Raises:
        InputError: It holds no results, or those of another cell.
    """
    run = load_run(suite.folder / cell.folder)
    wanted = {"task": [cell.task], "mode": [cell.mode], "tracker": [cell.tracker], "rules": cell.rules}
    for key, value in wanted.items():
        if run.config.get(key) != value:
            raise InputError(
                f"{run.folder}: {key} is {shown(run.config.get(key))}, cell {cell.id} of {suite.folder / SUITE_FILE} "
                f"has {shown(value)}"
            )
    return run
