"""The journal of a run: one fsynced JSON line per finished episode, from which everything else is derived."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import stat
from pathlib import Path
from typing import Any

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.records import MAX_JOURNAL_BYTES, check_record, counted, parse, read_regular
from arena_newton.foreign import create

__all__ = ["Journal", "StorageError", "read_journal", "write_atomic"]


class StorageError(ArenaError):
    """The results folder cannot be written (full disk, no permission); what was journalled before is whole."""


def _explain(error: OSError, path: Path, kept: str) -> StorageError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StorageError(f"{path}: disk full; {kept}")
    return StorageError(f"{path}: cannot be written ({error.strerror}); {kept}")


def read_journal(path: Path) -> tuple[list[dict[str, Any]], int]:
    """Read a journal.

    Returns:
        The records in file order, and the length of the part that is whole [bytes]. A last line that lacks its line
        end, as ``kill -9`` or a full disk leaves it, is no part of it.

    Raises:
        InputError: a line other than the last is no JSON object, or a line is no record of an episode.
    """
    try:
        data = read_regular(path, MAX_JOURNAL_BYTES)
    except FileNotFoundError:
        return [], 0
    records: list[dict[str, Any]] = []
    start = 0
    number = 0
    while start < len(data):
        number += 1
        end = data.find(b"\n", start)
        if end < 0:
            break
        try:
            record = parse(data[start:end])
            if not isinstance(record, dict):
                raise ValueError
        except ValueError:
            if end + 1 == len(data):
                break
            raise InputError(f"{path}: line {number} is no JSON object; the journal was changed by hand") from None
        records.append(check_record(f"{path}: line {number}", record))
        start = end + 1
    return records, start


class Journal:
    """Append-only journal, locked against a second writer.

    Opening cuts a torn last line. ``append`` returns after the line is on disk; when the disk is full it takes the
    partial line back, so that the file stays whole.
    """

    def __init__(self, path: Path):
        """Open or create the journal at ``path``.

        Raises:
            InputError: another process writes it, or it is damaged.
            StorageError: it cannot be created.
        """
        self.path = path
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise InputError(f"{path}: is a link; a run writes inside its own folder only") from None
            raise _explain(error, path, "nothing was run") from None
        if not stat.S_ISREG(os.fstat(self._file).st_mode):
            os.close(self._file)
            raise InputError(f"{path}: is no regular file")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._file)
            raise InputError(f"{path}: another run is writing this journal") from None
        try:
            self.records, self._size = read_journal(path)
            self.torn_bytes = os.fstat(self._file).st_size - self._size
            if self.torn_bytes:
                os.ftruncate(self._file, self._size)
                os.fsync(self._file)
            folder = os.open(path.parent, os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)
        except BaseException:
            os.close(self._file)
            raise

    def append(self, record: dict[str, Any]) -> None:
        """Write one record and wait until it is on disk."""
        line = json.dumps(record, separators=(",", ":"), allow_nan=False).encode() + b"\n"
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
            kept = len({record["index"] for record in self.records})
            raise _explain(error, self.path, f"kept: {counted(kept, 'episode')}") from None
        self._size += len(line)
        self.records.append(record)

    def close(self) -> None:
        """Release the file and its lock."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def __enter__(self) -> Journal:
        """Use as a context."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Close."""
        self.close()


def write_atomic(path: Path, text: str) -> None:
    """Write a text file so that a reader sees the old content or the new, never a part; links are not followed."""
    temporary = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with create(temporary) as file:
            file.write(text.encode("utf-8"))
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise _explain(error, path, "the journal is kept") from None
