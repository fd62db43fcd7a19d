"""The journal of a run: one fsynced JSON line per finished episode, from which everything else is derived."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import os
import re
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Protocol, Self

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.records.episode_signals import EpisodeSignals
from arena_newton.eval.records.schema import Count, Mode, Positive, Seed, Task, check_schema, read_lines
from arena_newton.files.new_folder import held
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.stored_json import Fit, Json, JsonObject, Name, is_name, loaded
from arena_newton.files.text import counted
from arena_newton.interfaces import EpisodeEvent

__all__ = [
    "BY_CONTENT",
    "CHAINED",
    "EVIDENCE",
    "JOURNAL_FILE",
    "SCHEMA",
    "ContradictionError",
    "EpisodeLines",
    "EpisodeRecord",
    "Journal",
    "LockedLines",
    "StorageError",
    "chained_line",
    "contradiction",
    "read_journal",
    "write_atomic",
]

JOURNAL_FILE = "episodes.jsonl"
SCHEMA = 4
"""Newest form of a journal line. 1: without phases, predicates, progress and events, and without this key; 2: without
`previous` and `actions`; 3: `actions` is the hash of the file, without `final_state` and `shown`."""
CHAINED = 3
"""First form whose lines are linked."""
BY_CONTENT = 4
"""First form whose `actions` are hashed by content: another zlib packs the same numbers into another file."""

EVIDENCE = ("actions", "final_state", "shown")
"""Keys of hashes by which an episode can be checked."""
OUTCOMES = ("success", "fall", "timeout", "error")
PlanNumber = Annotated[Count, Fit("a number of the plan")]
Ticks = Annotated[Count, Fit("a number of ticks")]
Outcome = Annotated[str, Fit(" ".join(OUTCOMES), lambda value: value in OUTCOMES)]
Cause = Annotated[str | None, Fit("a name", lambda value: value in (None, "") or is_name(value))]

FileHash = Annotated[
    str | None, Fit("64 hex digits or null", lambda value: value is None or bool(re.fullmatch("[0-9a-f]{64}", value)))
]
Fraction = Annotated[float, Fit("a number from 0 to 1", lambda value: 0 <= value <= 1)]


@dataclass(frozen=True, kw_only=True)
class EpisodeRecord:
    """A line of the journal: how one episode of the plan ended. Its fields are the keys, in this order.

    A field with a default may be missing in a line. Annotations say what a stored value must be (`schema.Fit`).
    """

    schema: Positive = 1
    """Form of the line; see `SCHEMA`."""
    index: PlanNumber
    """Number in the plan, from 0."""
    task: Task
    tracker: Name
    policy: Name
    """Spec of the policy, a local path shortened to its file name."""
    privileged: bool = False
    """The policy takes the world itself (`Policy.attach`): it knows more of an episode than state and picture show.
    Absent in the line of one that does not."""
    mode: Mode
    rules: Name = ""
    engine: Name = ""
    group_seed: Seed
    repeat: Count
    episode_seed: Seed
    object_seed: Seed
    max_steps: Ticks
    """Step budget."""
    hashes: Annotated[dict[Name, Name | None], Fit("hashes by name")] = field(default_factory=dict)
    """Hashes of configuration, rules, checkpoint, policy, variant, the libraries' versions and the environment."""
    outcome: Outcome
    reason: Cause = ""
    """Finer cause, such as `startup_fall`."""
    steps: Ticks
    """Ticks from the policy's first action."""
    margin: float | None = None
    """Signed distance to success at the end [m or the task's unit]; None where it is not finite."""
    startup_fall: bool = False
    overflow: bool = False
    """A contact or constraint buffer overflowed in this episode's world."""
    error: str | None = None
    """Message of an `error`."""
    durations: Annotated[dict[Name, float] | None, Fit("numbers by name")] = None
    """`wall_s` and `sim_s` [s]."""
    started_at: Annotated[str | None, Fit("text")] = None
    """ISO 8601, UTC."""
    finished_at: Annotated[str | None, Fit("text")] = None
    media: Annotated[dict[Name, str] | None, Fit("paths by name")] = None
    """Recordings, below the results folder."""
    video: Annotated[str | None, Fit("a path")] = None
    """The head camera's video; empty without one."""
    phases: Annotated[tuple[tuple[Name, Ticks], ...], Fit("pairs of a name and a tick")] = ()
    """The policy's phases: name and first tick, each time one begins."""
    predicates: Annotated[dict[Name, Ticks | None], Fit("ticks by name")] = field(default_factory=dict)
    """Predicate of the task, in its order → first tick at which it held; None where it never did."""
    progress: Fraction | None = None
    """Fraction of the task's predicates that have held; None in a line of schema 1."""
    events: Annotated[tuple[EpisodeEvent, ...], Fit("objects with kind, tick and detail")] = ()
    """Single events of the episode, in the order of its ticks."""
    signals: Annotated[EpisodeSignals | None, Fit("the signals of an episode")] = None
    """Signals that tell why it failed; None, and absent in the line, without `eval run --failures`."""
    extra: Annotated[dict[Name, float], Fit("numbers by name")] = field(default_factory=dict)
    """Metrics of recorders (`Factories.recorders`) by name; absent in the line where there are none."""
    actions: FileHash = None
    """SHA-256 of the arrays in the file of its actions, `media.actions` (`untrusted_files.array_digest`); None, and
    absent in the line, as the next two, where no actions are kept."""
    final_state: FileHash = None
    """SHA-256 of positions and velocities of its world as it ended."""
    shown: FileHash = None
    """SHA-256 of state and pictures that the policy was shown at its queries, in their order."""
    previous: FileHash = None
    """SHA-256 of the line before in the journal, with its line end; of nothing in the first line. Absent in a line of
    schema 1 or 2."""

    @property
    def shown_policy(self) -> str:
        """Name of the policy in tables, which mark one that takes the world itself."""
        return f"{self.policy} (privileged)" if self.privileged else self.policy

    def to_json(self) -> JsonObject:
        """The line as a JSON object."""
        values = {key.name: getattr(self, key.name) for key in dataclasses.fields(self)}
        values["events"] = [dataclasses.asdict(event) for event in self.events]
        if self.signals is not None:
            values["signals"] = dataclasses.asdict(self.signals)
        absent = {"privileged": not self.privileged, "extra": not self.extra}
        absent |= {name: values[name] is None for name in ("signals", *EVIDENCE, "previous")}
        return {key: value for key, value in values.items() if not absent.get(key)}

    @classmethod
    def from_json(cls, where: str, line: Mapping[str, Json]) -> EpisodeRecord:
        """The record of a line; keys that this version does not know are left out. Messages say `where` it is.

        Raises:
            InputError: It is not a record of an episode, or a newer version wrote it.
        """
        check_schema(where, line, SCHEMA)
        return loaded(where, line, cls)


def chained_line(record: EpisodeRecord, before: bytes) -> tuple[EpisodeRecord, bytes]:
    """Link a record to the line before it in the journal, which is empty before the first; one of schema 1 or 2 is not.

    Returns:
        The record with its `previous`, and its line with the line end.
    """
    link = hashlib.sha256(before).hexdigest() if record.schema >= CHAINED else None
    linked = dataclasses.replace(record, previous=link)
    return linked, json.dumps(linked.to_json(), separators=(",", ":"), allow_nan=False).encode() + b"\n"


class ContradictionError(InputError):
    """A line of a journal contradicts itself."""


def contradiction(record: EpisodeRecord) -> str | None:
    """Contradiction within a line, so that it was not written as the episode ended; None where all fits."""
    last = next(reversed(record.predicates.values()), None) if record.predicates else record.steps
    fell = next((event.tick for event in record.events if event.kind == "fall"), None)
    if record.outcome == "success":
        if record.margin is not None and record.margin < 0.0:
            return f"a success with a margin of {record.margin:g}"
        if record.progress is not None and record.progress < 1.0:
            return f"a success with a progress of {record.progress:g}"
        if last != record.steps:
            return f"a success at step {record.steps}, whose last predicate held first at {last}"
    elif record.outcome == "timeout" and record.reason == "timeout" and record.steps != record.max_steps:
        return f"a timeout after {record.steps} of {record.max_steps} steps"
    elif record.outcome == "fall" and record.schema > 1 and fell is None:
        return "a fall without the event fall"
    if not record.steps and record.outcome != "error" and not record.startup_fall:
        return f"a {record.outcome} at step 0, before the policy's first action"
    if record.outcome != "fall" and fell is not None and max(fell, 0) < record.steps:  # a start-up has no steps
        return f"a {record.outcome} at step {record.steps} after a fall at {fell}"
    return None


class StorageError(ArenaError):
    """The results folder cannot be written (full disk, no permission); what was journalled before is whole."""

    exit_code = 2


def _explain(error: OSError, path: Path, kept: str) -> StorageError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StorageError(f"{path}: disk full; {kept}")
    return StorageError(f"{path}: cannot be written ({error.strerror}); {kept}")


def read_journal(path: Path) -> tuple[list[EpisodeRecord], int]:
    """Read a journal: its records in file order, and the length of the part that is whole [bytes].

    Raises:
        InputError: As `schema.read_lines`, or a line is not a record of an episode.
    """
    return read_lines(path, EpisodeRecord.from_json)


class LockedLines:
    """Append-only file of lines, locked against a second writer.

    Opening cuts a torn last line. `append_line` returns after the line is on disk; when the disk is full it takes the
    partial line back, so that the file stays whole.
    """

    def __init__(self, path: Path, whole: Callable[[Path], int]):
        """Open or create the file at `path`; `whole` reads it and gives the length of its whole lines [bytes].

        Raises:
            InputError: Another process writes it, or it is damaged.
            StorageError: It cannot be created.
        """
        self.path = path
        with contextlib.ExitStack() as opening:
            try:
                file = opening.enter_context(held(path, f"{path}: another run is writing this journal"))
            except OSError as error:
                if error.errno == errno.ELOOP:
                    raise InputError(f"{path}: is a link; a run writes inside its own folder only") from None
                raise _explain(error, path, "nothing was run") from None
            if not stat.S_ISREG(os.fstat(file).st_mode):
                raise InputError(f"{path}: is not a regular file")
            self._file, self._size = file, whole(path)
            self.torn_bytes = os.fstat(file).st_size - self._size
            if self.torn_bytes:
                os.ftruncate(file, self._size)
                os.fsync(file)
            folder = os.open(path.parent, os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)
            self._held = opening.pop_all()

    def append_line(self, line: bytes, kept: str) -> None:
        """Write one line, its end included, and wait until it is on disk; `kept` says what an error leaves.

        Raises:
            StorageError: It cannot be written.
        """
        try:
            written = 0
            while written < len(line):
                written += os.pwrite(self._file, line[written:], self._size + written)
            os.fsync(self._file)
        except OSError as error:
            try:
                os.ftruncate(self._file, self._size)
            except OSError:
                pass  # the torn line is cut by the next opening
            raise _explain(error, self.path, kept) from None
        self._size += len(line)

    def close(self) -> None:
        """Release the file and its lock."""
        self._held.close()
        self._file = -1

    def __enter__(self) -> Self:
        """Use as a context."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Close."""
        self.close()


class Journal(LockedLines):
    """The journal of a run."""

    def __init__(self, path: Path):
        """Open or create the journal at `path`.

        Raises:
            InputError: Another process writes it, or it is damaged.
            StorageError: It cannot be created.
        """
        self.records: list[EpisodeRecord] = []
        self._last = b""
        """Last line, its end included."""
        super().__init__(path, self._read)

    def _read(self, path: Path) -> int:
        self.records, size = read_journal(path)
        with path.open("rb") as file:
            self._last = b"".join(line + b"\n" for line in file.read(size).split(b"\n")[-2:-1])
        return size

    def append(self, record: EpisodeRecord) -> None:
        """Write one record, linked to the last line, and wait until it is on disk."""
        linked, line = chained_line(record, self._last)
        kept = len({record.index for record in self.records})
        self.append_line(line, f"kept: {counted(kept, 'episode')}")
        self.records.append(linked)
        self._last = line


class EpisodeLines(Protocol):
    """Sink of finished episodes: the journal, or what passes them on to it."""

    records: list[EpisodeRecord]

    def append(self, record: EpisodeRecord) -> None:
        """Take the record of an episode that ended."""


def write_atomic(path: Path, content: str | bytes, kept: str = "the journal is kept") -> None:
    """Write a file so that a reader sees the old content or the new, never a part; links are not followed.

    The message of an error ends with what is `kept`.

    Raises:
        StorageError: It cannot be written.
    """
    try:
        with replace_atomically(path, sync=True) as file:
            file.write(content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise _explain(error, path, kept) from None
