"""A folder of results that appears under its name only when it is complete."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.files.own_files import PARTIAL

__all__ = ["held_folder", "link", "new_folder", "scratch_folder"]

LOCK = f"{PARTIAL}.lock"
"""Ending of the file that is locked while the folder grows."""


@contextlib.contextmanager
def new_folder(out: Path, flag: str = "--out") -> Iterator[Path]:
    """An empty folder `<out>.part` to write in; it gets its name at the end of the block, and is removed on an error.

    What a killed process left of it is removed by the next one.

    Raises:
        InputError: `out` exists, another process writes it, or it cannot be written: the disk may be full.
    """
    with scratch_folder(out, flag) as part:
        yield part
        os.rename(part, out)


@contextlib.contextmanager
def scratch_folder(out: Path, flag: str = "--out") -> Iterator[Path]:
    """An empty folder `<out>.part`, which is removed at the end of the block.

    What a killed process left of it is removed by the next one.

    Raises:
        InputError: `out` exists, another process writes it, or it cannot be written: the disk may be full.
    """
    if not out.name or out.name in (".", ".."):
        raise InputError(f"{flag} {out}: is no name of a folder")
    if out.exists() or out.is_symlink():
        raise InputError(f"{flag} {out}: exists; remove it or name another folder")
    part, lock = out.with_name(out.name + PARTIAL), out.with_name(out.name + LOCK)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if part.is_symlink() or part.exists() and not lock.exists():
            raise InputError(f"{flag} {out}: {part} is in the way, and it is not what a killed command left")
        with os.fdopen(os.open(lock, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o644), "w") as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(f"{flag} {out}: another process is writing it") from None
            if part.exists():
                shutil.rmtree(part)
            part.mkdir()
            try:
                yield part
            finally:
                shutil.rmtree(part, ignore_errors=True)
                lock.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{flag} {out}: cannot be written ({error})") from error


@contextlib.contextmanager
def held_folder(out: Path, doing: str, flag: str = "--out") -> Iterator[None]:
    """A folder, made where there is none and kept from other processes while the block lasts.

    Args:
        out: The folder.
        doing: What another process does there, in the message: "trains in it".
        flag: What the message names.

    Raises:
        InputError: Another process holds it, or it cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise InputError(f"{flag} {out}: cannot be made ({error.strerror})") from None
    try:
        with contextlib.suppress(OSError):  # some network disks have no locks
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(f"{flag} {out}: another process {doing}") from None
        yield
    finally:
        os.close(folder)


def link(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it to another disk."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        shutil.copyfile(source, target)
