"""Shards joined into one results folder: journals of equal configuration, their recordings, the reports of all."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from arena_newton.cli.flags import flag_name
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import Results, RunRecord, due_episodes, is_complete, load_run
from arena_newton.eval.folders.run_folder import RECORDING_FLAGS, comparable, setting
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records.chain import broken_links, outcome_of
from arena_newton.eval.records.document import CONFIG_FILE, SUITE_FILE, Document, Status, plan_numbers
from arena_newton.eval.records.identity import differing_key, moving_versions
from arena_newton.eval.records.journal import (
    EVIDENCE,
    JOURNAL_FILE,
    EpisodeRecord,
    StorageError,
    chained_line,
    read_journal,
    write_atomic,
)
from arena_newton.eval.records.sharding import Shard, dealt, read_shard
from arena_newton.eval.reports import report
from arena_newton.files.own_files import PARTIAL, file_label, replace_atomically
from arena_newton.files.stored_json import Json, JsonObject, shown
from arena_newton.files.text import counted, plain_text

__all__ = ["MergedRun", "merge"]

_NAMED = 20
"""Shards, episodes or files that a message names."""
_NAME = r"[A-Za-z0-9_][A-Za-z0-9._-]*"
_MEDIA = re.compile(rf"(?:videos|strips|actions(?:/{_NAME})?|episodes(?:/videos)?)/{_NAME}")
"""Paths of recordings, as runs write them."""
_BLOCK = 1 << 20


@dataclass(frozen=True)
class MergedRun:
    """Result of a merge."""

    run: RunRecord
    results: Results
    notes: tuple[str, ...]
    """Notes for a reader besides the table."""


@dataclass(frozen=True)
class _Kept:
    """The episode that is kept of one number."""

    record: EpisodeRecord
    folder: Path
    """Folder that it is from."""
    others: tuple[Path, ...] = ()
    """Folders where the same came of it."""


def merge(folders: Sequence[Path], out: Path, *, partial: bool = False, accept_versions: bool = False) -> MergedRun:
    """Join results folders of one configuration into a new one; they are only read.

    The journal has one line per episode in the plan's order. It is written next to `out` and renamed when it is
    complete, so that `out` is there as a whole or not at all.

    Args:
        folders: Shards, or folders of the whole plan.
        partial: Join what there is although episodes are missing.
        accept_versions: Join although other versions of the libraries played them.

    Raises:
        InputError: A folder is damaged, two differ in configuration, versions, environment or in an episode that both
            played, episodes are missing, or `out` holds something.
        StorageError: `out` cannot be written.
    """
    _check_out(out, folders)
    for folder in folders:
        if (folder / SUITE_FILE).is_file():
            raise InputError(f"merge {folder}: is a suite, whose parts are joined by copying one folder over the other")
    for folder in folders:
        _check_links(folder / JOURNAL_FILE)
    runs = sorted((load_run(folder) for folder in folders), key=_order)
    for other in runs[1:]:
        _check_alike(runs[0], other, accept_versions)
    _check_environments(runs)
    kept, notes = _joined(runs)
    whole = _whole(runs, kept)
    if not whole:
        planned = runs[0].document["planned"]
        some = f"{counted(planned - len(kept), 'episode')} of {planned:,}"
        if runs[0].config.get("keep") is not None:
            some = f"successes of at most {counted(planned, 'episode')}"
        text = f"{some} missing: {_missing(runs, kept)}"
        if not partial:
            raise InputError(f"merge: {text}; finish them, or join what there is with --partial")
        notes.append(f"Joined with {text}.")
    document = _document(runs, out, whole=whole)
    temporary = Path(os.path.abspath(out) + PARTIAL)
    if temporary.exists() or temporary.is_symlink():
        raise InputError(f"{temporary}: was left by a merge that was killed, or one is writing it; remove it")
    try:
        temporary.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
    except OSError as error:
        raise InputError(f"--out {out}: cannot be created ({error.strerror})") from None
    try:
        lost = [name for part in kept for name in _copied(part, runs[0].document["options"], temporary)]
        if lost:
            notes.append(f"Recordings that the journals name and no folder has: {_listed(lost)}.")
        write_atomic(temporary / JOURNAL_FILE, _chained([part.record for part in kept]))
        write_atomic(temporary / CONFIG_FILE, json.dumps(document, indent=2) + "\n")
        results = report.write_reports(load_run(temporary))
        try:
            os.replace(temporary, out)
        except OSError as error:
            raise StorageError(f"{out}: cannot be written ({error.strerror}); the shards are as they were") from None
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return MergedRun(load_run(out), results, tuple(notes))


def _check_out(out: Path, folders: Sequence[Path]) -> None:
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise InputError(f"--out {out}: is a {'link' if out.is_symlink() else 'file'}; name a new folder")
    try:
        if out.exists() and any(out.iterdir()):
            raise InputError(f"--out {out}: is not empty; name a new folder")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be read ({error.strerror})") from None
    inside = next((folder for folder in folders if out.resolve().is_relative_to(folder.resolve())), None)
    if inside is not None:
        raise InputError(f"--out {out}: is in {inside}, which stays as it is; name a new folder beside it")


def _check_links(journal: Path) -> None:
    """Refuse a journal of which a line was changed: the merged lines are linked again, which would hide it."""
    if journal.exists():
        for fault in broken_links(journal, read_journal(journal)[0]):
            raise InputError(fault)


def _shard(run: RunRecord) -> Shard | None:
    return read_shard(run.document.get("shard", ""))


def _order(run: RunRecord) -> tuple[int, int, str]:
    """Folders in an order that does not depend on that of the command line: whole plans, then shards by number."""
    shard = _shard(run) or Shard(0, 0)
    return shard.count, shard.number, str(run.folder)


def _check_alike(first: RunRecord, other: RunRecord, accept_versions: bool) -> None:
    """Refuse two folders that are not of one configuration, or whose episodes were not played alike."""

    def refuse(key: str, was: object, now: object, more: str = "") -> InputError:
        return _differ(first.folder, other.folder, key, was, now, more)

    difference = differing_key(first.config, other.config)
    if difference is not None:
        raise refuse(*difference, "; folders of different configurations are not joined")
    names = ("config_hash", "planned", "rule_set", "gym_ids", "variant_changes")
    of_first, of_other = ({name: run.document.get(name) for name in names} for run in (first, other))
    difference = differing_key(of_first, of_other)
    if difference is not None:
        raise refuse(*difference)
    for name in RECORDING_FLAGS:
        values = [_plain(run.document["options"].get(name, getattr(RunOptions, name))) for run in (first, other)]
        if values[0] != values[1]:
            raise refuse(flag_name(name), *values)
    versions = [moving_versions(run.document.get("versions", {})) for run in (first, other)]
    difference = differing_key(*versions)
    if difference is not None and not accept_versions:
        raise refuse(*difference, "; results may differ; join both with --accept-versions")


def _check_environments(runs: Sequence[RunRecord]) -> None:
    """Refuse folders whose environments describe themselves otherwise; a shard may lack some of them."""
    known: dict[str, tuple[JsonObject, Path]] = {}
    for run in runs:
        for group, facts in run.document.get("environments", {}).items():
            was, where = known.setdefault(group, (facts, run.folder))
            difference = differing_key(comparable(was), comparable(facts))
            if difference is not None:
                raise _differ(where, run.folder, f"{group}: {difference[0]}", *difference[1:])


def _differ(first: Path, other: Path, key: str, was: object, now: object, more: str = "") -> InputError:
    shown_was, shown_now = (plain_text(setting(value), 100) for value in (was, now))
    return InputError(f"{other}: {plain_text(key, 100)} is {shown_now}, in {first} {shown_was}{more}")


def _plain(value: Json) -> Json:
    return list(value) if isinstance(value, tuple) else value


def _joined(runs: Sequence[RunRecord]) -> tuple[list[_Kept], list[str]]:
    """Episodes that count, one of each, in the plan's order, and notes on those that several folders have.

    Raises:
        InputError: Two folders played an episode, and something else came of it.
    """
    found: dict[int, list[_Kept]] = {}
    for run in runs:
        for record in run.records:
            found.setdefault(record.index, []).append(_Kept(record, run.folder))
    kept: list[_Kept] = []
    twice, repaired = 0, 0
    for _, parts in sorted(found.items()):
        # As in a journal: an error says nothing of the episode, and what was played after it counts.
        ended = [part for part in parts if part.record.outcome != "error"]
        for other in ended[1:]:
            _check_same(ended[0], other.record, other.folder)
        twice += len(ended) > 1
        repaired += 0 < len(ended) < len(parts)
        best = max(ended or parts, key=lambda part: len(part.record.media or {}))  # of equals the first
        others = tuple(part.folder for part in ended if part is not best)
        kept.append(_Kept(best.record, best.folder, others))
    notes = [f"{counted(twice, 'episode')} in several folders, each alike."] if twice else []
    if repaired:
        notes.append(
            f"{counted(repaired, 'episode')} ended as an error in one folder and not in another, which counts."
        )
    return kept, notes


def _whole(runs: Sequence[RunRecord], kept: Sequence[_Kept]) -> bool:
    """True if the plan is played: every episode, or as many successes as were to be kept."""
    document: Document = dict(runs[0].document)  # type: ignore[assignment]  # a copy of one
    document.pop("shard", None)
    return is_complete(RunRecord(runs[0].folder, document, [part.record for part in kept]))


def _check_same(known: _Kept, record: EpisodeRecord, folder: Path) -> None:
    difference = differing_key(outcome_of(known.record), outcome_of(record), ignored=EVIDENCE)
    if difference is None:
        return
    key, was, now = difference
    words = f"{record.task} {record.tracker} {record.mode} seed {record.group_seed} repeat {record.repeat}"
    raise InputError(
        f"episode {record.index} ({words}): {plain_text(key, 60)} is {shown(was)} in {known.folder}, {shown(now)} in "
        f"{folder}; leave one of the folders out"
    )


def _chained(records: Sequence[EpisodeRecord]) -> str:
    """Text of a journal of these lines."""
    lines = [b""]
    for record in records:
        lines.append(chained_line(record, lines[-1])[1])
    return b"".join(lines).decode()


def _missing(runs: Sequence[RunRecord], kept: Sequence[_Kept]) -> str:
    """Unfinished and missing shards, in words."""
    known = {part.record.index for part in kept}
    count = max((shard.count for shard in map(_shard, runs) if shard), default=0)
    keys = list(plan_numbers(runs[0].folder / CONFIG_FILE, runs[0].config)) if count else []
    found = []
    for run in runs:
        shard = _shard(run)
        if is_complete(run) or (shard and known.issuperset(dealt(keys, shard))):  # others may have what it lacks
            continue
        name = f"{run.folder} (shard {shard})" if shard else str(run.folder)
        found.append(f"{name} has {len(run.records):,} of {counted(due_episodes(run.document), 'episode')}")
    given = {_shard(run) for run in runs}
    absent = [Shard(number, count) for number in range(1, count + 1)]
    absent = [shard for shard in absent if shard not in given and not known.issuperset(dealt(keys, shard))]
    if absent:
        found.append(f"{'shards' if len(absent) > 1 else 'shard'} {_listed(absent)} {_be(absent)} not named")
    return ", ".join(found[:_NAMED]) + (", ..." if len(found) > _NAMED else "")


def _be(values: Sequence[object]) -> str:
    return "are" if len(values) > 1 else "is"


def _listed(values: Sequence[object]) -> str:
    return " ".join(map(str, values[:_NAMED])) + (f" and {len(values) - _NAMED:,} more" if len(values) > _NAMED else "")


def _document(runs: Sequence[RunRecord], out: Path, *, whole: bool) -> Document:
    """config.json of all: the first folder's, with the environments and versions of the others."""
    document: Document = dict(runs[0].document)  # type: ignore[assignment]  # a copy of one
    document.pop("shard", None)
    kept = all(run.document["options"].get("actions", True) for run in runs)
    document["options"] = runs[0].document["options"] | {"shard": None, "out": str(out), "actions": kept}
    environments: dict[str, JsonObject] = {}
    for run in runs:
        environments = run.document.get("environments", {}) | environments
    order = {" ".join(key[:3]): number for key, number in plan_numbers(out / CONFIG_FILE, runs[0].config).items()}
    document["environments"] = dict(sorted(environments.items(), key=lambda named: order.get(named[0], 0)))
    sets: list[dict[str, str | None]] = []
    for run in runs:
        for versions in (run.document.get("versions", {}), *run.document.get("later_versions", ())):
            if moving_versions(versions) not in map(moving_versions, sets):
                sets.append(versions)
    document["versions"] = sets[0]
    document.pop("later_versions", None)
    if sets[1:]:
        document["later_versions"] = sets[1:]
    states = [run.status for run in runs if run.status is not None]
    status: Status = {
        "state": "success" if whole else "partial",
        "started_at": min((status["started_at"] for status in states), default=""),
        "finished_at": max((status["finished_at"] or "" for status in states), default="") or None,
        "error": None,
    }
    document["status"] = status
    return document


def _files(part: _Kept, options: Mapping[str, Json]) -> Iterator[tuple[str, bool]]:
    """Recordings of an episode, below its folder, and whether each must be there.

    Raises:
        InputError: The journal names one that no run writes.
    """
    record = part.record
    for name, path in (record.media or {}).items():
        if not _MEDIA.fullmatch(path):
            where = f"{part.folder / JOURNAL_FILE}: episode {record.index}"
            raise InputError(f"{where}: {plain_text(name, 60)} is {shown(path)}, expected a recording of the folder")
        yield path, True
    if record.actions is None:  # of a version that did not name the file
        yield f"actions/{record.task}_{record.mode}_s{record.group_seed}_r{record.repeat}.npz", False
    label = f"{record.task}__{record.mode}__seed{record.group_seed}__repeat{record.repeat}.viser"
    trackers = options.get("tracker")
    several = isinstance(trackers, list) and len(trackers) > 1
    yield f"failures/{f'{file_label(record.tracker)}__' if several else ''}{label}", False


def _copied(part: _Kept, options: Mapping[str, Json], target: Path) -> list[str]:
    """Copy the recordings of an episode, from the first folder that has each; returns those that none has."""
    lost = []
    for path, due in _files(part, options):
        for folder in (part.folder, *part.others):
            file = _opened(folder, path)
            if file is not None:
                break
        else:
            lost += [path] if due else []
            continue
        with file:
            try:
                with replace_atomically(target / path, sync=True) as copy:
                    shutil.copyfileobj(file, copy, _BLOCK)
            except OSError as error:
                full = error.errno in (errno.ENOSPC, errno.EDQUOT)
                cause = "disk full" if full else f"cannot be copied ({error.strerror})"
                raise StorageError(f"{file.name} -> {target / path}: {cause}; the shards are as they were") from None
    return lost


def _opened(run: Path, path: str) -> BinaryIO | None:
    """A recording below a results folder, to be read; None where there is none.

    Raises:
        InputError: It, or its folder, is a link or no regular file.
    """
    source = run / path
    for folder in (source.parent, source.parent.parent):
        if folder != run and folder.is_symlink() and folder.is_relative_to(run):
            raise InputError(f"{folder}: is a link; a run writes inside its own folder only")

    def unfollowed(name: str, flags: int) -> int:
        return os.open(name, flags | os.O_NOFOLLOW | os.O_NONBLOCK)

    try:
        file = open(source, "rb", opener=unfollowed)  # noqa: SIM115 (the caller closes it)
    except FileNotFoundError:
        return None
    except OSError as error:
        cause = "is a link" if error.errno == errno.ELOOP else f"cannot be read ({error.strerror})"
        raise InputError(f"{source}: {cause}") from None
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise InputError(f"{source}: is not a regular file")
    return file
