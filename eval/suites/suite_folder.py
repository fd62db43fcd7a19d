"""The folder of a suite: its locks, its journal, `suite.json`, and what its cells hold."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypedDict

from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, load_run
from arena_newton.eval.folders.run_folder import timestamp
from arena_newton.eval.plan.config import RunConfig
from arena_newton.eval.records.document import CONFIG_FILE, SUITE_FILE
from arena_newton.eval.records.identity import differing_key, moving_versions
from arena_newton.eval.records.journal import LockedLines, write_atomic
from arena_newton.eval.suites.suite_file import SuiteFile
from arena_newton.eval.suites.suite_records import (
    JOURNAL_PATTERN,
    CellEvent,
    SuiteCell,
    SuitePlan,
    event_line,
    journal_file,
    read_events,
    read_journal_events,
    read_suite,
    suite_json,
    with_events,
)
from arena_newton.files.new_folder import held

__all__ = ["LOCK_FILE", "REPLACED", "SuiteFolder"]

LOCK_FILE = "suite.lock"
"""Held by whoever plays the suite: by shards together, by a call without --shard alone."""
REPLACED = ".replaced"
"""Folder of results that were set aside; no cell has a name with a dot in front."""


class Counts(TypedDict):
    """Episodes of a cell, as a journal line has them."""

    finished: int
    successes: int
    errors: int


class SuiteFolder:
    """The folder that a call plays a suite into; it is read and written inside `locked`."""

    def __init__(self, path: Path, suite: SuiteFile, shard: int, shards: int):
        """Name the folder and the part of the suite; nothing is read or written."""
        self.path, self.suite, self.shard, self.shards = path, suite, shard, shards
        self.plan: SuitePlan
        """The suite as this call has it, with what all journals say."""
        self.gone: list[str] = []
        """Cells that were played and are in the suite file no more."""
        self._journal: LockedLines

    @contextlib.contextmanager
    def locked(self, cells: Sequence[SuiteCell]) -> Iterator[None]:
        """Hold the folder for the suite's cells, in the order of the plan.

        Raises:
            InputError: Another process plays the suite, or the folder holds something else.
            StorageError: It cannot be written.
        """
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"--out {self.path}: is a file")
        known = {SUITE_FILE, LOCK_FILE}
        found = sorted(self.path.iterdir()) if self.path.exists() else []
        foreign = [file.name for file in found if file.name not in known and not JOURNAL_PATTERN.fullmatch(file.name)]
        if foreign and not (self.path / SUITE_FILE).exists():
            raise InputError(f"--out {self.path}: is not empty and holds no suite; choose another folder")
        before = read_suite(self.path) if (self.path / SUITE_FILE).exists() else None
        with contextlib.ExitStack() as stack:
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                taken = f"{self.path}: another process plays this suite"
                stack.enter_context(held(self.path / LOCK_FILE, taken, shared=self.shards > 1))
                self._check_other_shards()
            except OSError as error:
                raise InputError(f"--out {self.path}: cannot be written ({error.strerror})") from None
            journal = self.path / journal_file(self.shard, self.shards)
            self._journal = stack.enter_context(LockedLines(journal, lambda path: read_journal_events(path)[1]))
            self._take_over(cells, before)
            yield

    def _check_other_shards(self) -> None:
        """Refuse to play next to shards of another number: both would play the same cells."""
        for path in self.path.glob("suite.*.jsonl"):
            name = JOURNAL_PATTERN.fullmatch(path.name)
            if name is None or int(name[2]) == self.shards or path.is_symlink():
                continue
            with held(path, f"{self.path}: is being played as shard {name[1]}/{name[2]}"):
                pass

    def _take_over(self, cells: Sequence[SuiteCell], before: SuitePlan | None) -> None:
        """Take the plan, what is known of its cells, and close what an earlier call of this shard left open."""
        known = {} if before is None else {cell.id: cell for cell in before.cells}
        self.plan = SuitePlan(
            self.path, self.suite.name, str(self.suite.path), self.suite.hash, tuple(_knowing(cells, known))
        )
        names = {cell.id for cell in cells}
        self.gone = [cell.id for cell in known.values() if cell.id not in names and cell.status != "waiting"]
        last = {event.cell: event for event in read_journal_events(self._journal.path)[0]}
        for event in last.values():
            if event.event == "begun":
                self.add(_killed(event, self._load(event.cell)), save=False)
        self._refresh()

    def add(self, event: CellEvent, *, save: bool = True) -> None:
        """Journal that a cell began or ended, and write `suite.json`."""
        self._journal.append_line(event_line(event), "finished cells are kept")
        if save:
            self.save()

    def _refresh(self) -> None:
        self.plan = with_events(self.plan, read_events(self.path))

    def save(self) -> None:
        """Write `suite.json` with what all journals say; other shards wait meanwhile."""
        with held(self.path, wait=True):
            if (self.path / SUITE_FILE).exists():
                stored = {cell.id: cell for cell in read_suite(self.path).cells}
                self.plan = dataclasses.replace(self.plan, cells=tuple(_knowing(self.plan.cells, stored)))
            self._refresh()
            write_atomic(self.path / SUITE_FILE, json.dumps(suite_json(self.plan), indent=1) + "\n")

    def configured(self, hashes: Mapping[str, str]) -> None:
        """Keep the configuration hashes of the cells that were checked, and write `suite.json`."""
        cells = (dataclasses.replace(c, config=hashes.get(c.id, c.config)) for c in self.plan.cells)
        self.plan = dataclasses.replace(self.plan, cells=tuple(cells))
        self.save()

    def cell_path(self, name: str) -> Path:
        """Results folder of a cell."""
        return self.path / name

    def _load(self, name: str) -> RunRecord | None:
        path = self.cell_path(name)
        return load_run(path) if (path / CONFIG_FILE).exists() else None

    def stored(self, name: str) -> RunRecord | None:
        """Contents of a cell's folder; None where it has no results.

        Raises:
            InputError: It was changed by hand, or is a link.
        """
        for part in (self.cell_path(name), *self.cell_path(name).parents):
            if part == self.path:
                break
            if part.is_symlink():
                raise InputError(f"{part}: is a link; a suite writes inside its own folder only")
        return self._load(name)

    def counts(self, name: str) -> Counts:
        """Finished episodes of a cell, of them successes and errors."""
        return _counts(self._load(name))

    def difference(
        self,
        run: RunRecord,
        config: RunConfig,
        installed: Mapping[str, str | None],
        unknown: Sequence[str],
        of_code: Sequence[str],
    ) -> tuple[str, object, object, bool] | None:
        """First difference between what a cell was played as and what it would be now.

        Returns:
            Key, value then, value now, and whether it is one of code and libraries alone; None when there is none.
        """
        identity = config.identity()
        found = differing_key(run.config, identity, (*unknown, *of_code))
        if found is not None:
            return (*found, False)
        found = differing_key(run.config, identity, unknown)
        if found is None:
            versions = moving_versions(run.document.get("versions", {}))
            found = differing_key(versions, moving_versions(installed))
        return None if found is None else (*found, True)

    def set_aside(self, name: str) -> Path:
        """Move the results of a cell out of the plan, and open the cell again.

        Returns:
            Where they are now.
        """
        number = 1
        while (target := self.path / REPLACED / f"{name}.{number}").exists():
            number += 1
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            self.cell_path(name).rename(target)
        except OSError as error:
            raise InputError(f"{self.cell_path(name)}: cannot be moved to {target} ({error.strerror})") from None
        self.reopen(name)
        return target

    def reopen(self, name: str) -> None:
        """Journal that what was played of a cell counts no more."""
        self.add(CellEvent(cell=name, event="reopened", at=timestamp()))


def _knowing(cells: Sequence[SuiteCell], known: Mapping[str, SuiteCell]) -> Iterator[SuiteCell]:
    """Cells with what another call found out of them: what their checkpoints say, and their configuration."""
    for cell in cells:
        other = known.get(cell.id)
        if other is None or other.spec != cell.spec or cell.config is not None:
            yield cell
            continue
        facts = {key: getattr(cell, key) or getattr(other, key) for key in ("family", "trained_on", "trained_tasks")}
        labels = other.labels if other.config is not None else cell.labels
        yield dataclasses.replace(cell, config=other.config, labels=labels, **facts)


def _counts(run: RunRecord | None) -> Counts:
    outcomes = [] if run is None else [record.outcome for record in run.records]
    return {
        "finished": len(outcomes),
        "successes": outcomes.count("success"),
        "errors": outcomes.count("error"),
    }


def _killed(begun: CellEvent, run: RunRecord | None) -> CellEvent:
    """The end of a cell whose call was killed: it lasted until its last episode."""
    ends = [] if run is None else [record.finished_at or "" for record in run.records]
    last = max(ends, default="")
    wall = 0.0
    if last > begun.at:
        with contextlib.suppress(ValueError):
            at = [datetime.datetime.fromisoformat(text) for text in (begun.at, last)]
            wall = (at[1] - at[0]).total_seconds()
    return CellEvent(cell=begun.cell, event="killed", at=timestamp(), device=begun.device, wall_s=wall, **_counts(run))
