"""Bundles: the files of results folders that an audit needs, in one archive, packed and unpacked within limits."""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arena_newton.errors import InputError
from arena_newton.eval.audit.draws import drawn
from arena_newton.eval.audit.folder_audit import audited, runs_in
from arena_newton.eval.folders.results import RunRecord
from arena_newton.eval.leaderboard.entry_file import SIMULATOR
from arena_newton.eval.leaderboard.evidence import AuditStatement, earned_level
from arena_newton.eval.records.chain import joint_head
from arena_newton.eval.records.document import CONFIG_FILE, SUITE_FILE
from arena_newton.eval.records.journal import BY_CONTENT, JOURNAL_FILE
from arena_newton.eval.reports.wording import media_of
from arena_newton.eval.suites.suite_records import read_suite
from arena_newton.eval.tables.episode_table import cells_of
from arena_newton.files.stored_json import read_regular
from arena_newton.files.untrusted_files import create, read_arrays, zip_members

__all__ = ["MAX_BUNDLE_BYTES", "made_bundle", "strays", "strips_of", "unpack"]

MAX_BUNDLE_BYTES = 64 << 20
MAX_UNPACKED_BYTES = 512 << 20
MAX_FILES = 10_000
_WORD = r"[A-Za-z0-9_+][A-Za-z0-9_.+=#-]{0,199}"
_MEMBER = re.compile(
    rf"(?:{_WORD}/){{0,4}}(?:config\.json|episodes\.jsonl|suite\.json|suite\.{_WORD}\.jsonl"
    rf"|actions/(?:{_WORD}/)?{_WORD}\.npz|strips/{_WORD}\.(?:jpg|png))"
)
"""Paths that a bundle may hold: all of them inside the folder into which it is unpacked."""


def made_bundle(
    folder: Path, actions: int, strips: int, stated: Mapping[str, AuditStatement]
) -> tuple[bytes, dict[str, object]]:
    """Archive of the runs in a folder, the same bytes for the same files, and what `entry.toml` says of it.

    Args:
        folder: A results folder, a suite, or a folder of several.
        actions: Episodes of all runs together whose actions come along; the head draws them, not the owner.
        strips: Film strips of each run that come along, at most one of a task and outcome, failures first.
        stated: What an audit says of the runs, by head: the actions of the episodes that it played come along instead.

    Returns:
        The archive, and the keys of the entry's file that follow from it.

    Raises:
        InputError: There is no run, an audit finds a contradiction, or the bundle would be too large.
    """
    names = [path for pattern in (SUITE_FILE, "suite.*.jsonl") for path in sorted(folder.glob(pattern))]
    audits, columns = [audited(inside) for inside in runs_in(folder)], set[Path]()
    chosen = drawn(audits, actions, 0, at_hand=True)
    if stated.keys() & {audit.head for audit in audits}:
        played = [{*stated[audit.head].played} - {*audit.lacking} if audit.head in stated else () for audit in audits]
        chosen = [[one for one in a.run.records if one.index in some] for a, some in zip(audits, played, strict=True)]
    for audit, records in zip(audits, chosen, strict=True):
        if audit.faults:
            raise InputError(f"{audit.faults[0]}; all contradictions: eval audit {folder}")
        inside = audit.run.folder
        names += [inside / CONFIG_FILE, inside / JOURNAL_FILE]
        paths = {inside / str((record.media or {})["actions"]): record.schema for record in records if record.steps}
        columns |= {path for path, schema in paths.items() if schema >= BY_CONTENT}
        names += paths
        names += [path for _, path in strips_of(audit.run)][:strips]
    stream, size = io.BytesIO(), 0
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for path in names:
            name, data = path.relative_to(folder).as_posix(), read_regular(path, MAX_UNPACKED_BYTES)
            data = _by_columns(path, data) if path in columns else data
            size += len(data)
            if not _MEMBER.fullmatch(name):
                raise InputError(f"{path}: a bundle holds plain names of letters, digits and _ . + = # - alone")
            member = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            member.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(member, data)
    if stream.tell() > MAX_BUNDLE_BYTES or size > MAX_UNPACKED_BYTES or len(names) > MAX_FILES:
        raise InputError(f"{folder}: its bundle has {stream.tell():,} bytes, expected at most {MAX_BUNDLE_BYTES:,}")
    cells = [cell for audit in audits for cell in cells_of(audit.run)]
    known: dict[str, object] = {
        "simulator": SIMULATOR,
        "trackers": sorted({cell.tracker for cell in cells}),
        "level": earned_level(audits, stated)[0],
        "checkpoint": " ".join(sorted({cell.weights for cell in cells} - {""})),
        "bundle": hashlib.sha256(stream.getvalue()).hexdigest(),
        "head": joint_head([audit.results.get("head") for audit in audits]) or "",
    }
    return stream.getvalue(), known


def _by_columns(path: Path, data: bytes) -> bytes:
    """Arrays of an NPZ file unpacked and in columns, which the archive packs a tenth smaller; their hash stays."""
    stream = io.BytesIO()
    columns: dict[str, Any] = {
        name: np.asarray(array, order="F") for name, array in read_arrays(path, content=data).items()
    }
    np.savez(stream, **columns)
    return stream.getvalue()


def strips_of(run: RunRecord) -> Iterator[tuple[str, Path]]:
    """Caption and file of the first film strip of each task and outcome, failures first; only files that are there."""
    seen = set()
    for record in sorted(run.records, key=lambda one: (one.outcome == "success", one.index)):
        path = media_of(record).get("world strip") or media_of(record).get("ego strip")
        if path is not None and (record.task, record.outcome) not in seen and (run.folder / path).is_file():
            seen.add((record.task, record.outcome))
            where = f"{record.task} {record.tracker} {record.mode}, seed {record.group_seed} repeat {record.repeat}"
            yield f"{where}: {record.outcome}", run.folder / path


def unpack(path: Path, digest: str, into: Path) -> str | None:
    """Unpack a bundle into an empty folder, if it is the one with this hash.

    Args:
        path: The archive.
        digest: Its SHA-256.
        into: The folder.

    Returns:
        The contradiction as a sentence where it has another hash, and is not unpacked.

    Raises:
        InputError: It is missing, or no bundle.
    """
    try:
        data = read_regular(path, MAX_BUNDLE_BYTES)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; the entry names its bundle {digest}") from None
    if (found := hashlib.sha256(data).hexdigest()) != digest:
        return f"{path}: SHA-256 is {found}, its entry says {digest}"
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = zip_members(archive, str(path), MAX_FILES)
            if sum(one.file_size for one in members) > MAX_UNPACKED_BYTES:
                raise InputError(f"{path}: unpacks to more than {MAX_UNPACKED_BYTES:,} bytes")
            for one in members:
                if not _MEMBER.fullmatch(one.filename):
                    raise InputError(f"{path}: {one.filename[:60]!r} is no file of a bundle")
                (into / one.filename).parent.mkdir(parents=True, exist_ok=True)
                with create(into / one.filename) as file, archive.open(one) as packed:
                    file.write(packed.read(one.file_size))  # no more, whatever its stream holds
    except InputError:
        raise
    except Exception as error:  # a damaged archive fails anywhere inside zipfile
        raise InputError(f"{path}: not readable as an archive ({error})") from None
    return None


def strays(root: Path, runs: Sequence[RunRecord]) -> list[str]:
    """Files of an unpacked bundle that none of its runs has, by their names in it; of a suite, runs are its cells'."""
    known = {root / SUITE_FILE}
    if (root / SUITE_FILE).is_file():
        known |= set(root.glob("suite.*.jsonl"))
        cells = {root / cell.folder for cell in read_suite(root).cells}
        runs = [run for run in runs if run.folder in cells]
    for run in runs:
        media = {path for record in run.records for path in (record.media or {}).values()}
        known |= {run.folder / name for name in (CONFIG_FILE, JOURNAL_FILE, *media)}
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file() and path not in known)
