"""Files and folders held against other processes; a folder of results that appears only when it is complete."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.files.own_files import PARTIAL

__all__ = ["held", "held_folder", "link", "new_folder", "scratch_folder"]

LOCK = f"{PARTIAL}.lock"
"""Ending of the file that is locked while the folder grows."""


@contextlib.contextmanager
def held(path: Path, taken: str = "", *, shared: bool = False, wait: bool = False) -> Iterator[int]:
    """A folder, or a file that is made where there is none, kept from other processes while the block lasts.

    Args:
        path: The file or folder; a link to a file is not followed, and a folder on a disk without locks is not kept.
        taken: Message where another process holds it.
        shared: Others may hold it too that say so.
        wait: Wait for the other process.

    Yields:
        The open file.

    Raises:
        InputError: Another process holds it.
        OSError: It cannot be opened, or the disk of the file has no locks.
    """
    folder = path.is_dir()
    how = os.O_RDONLY | os.O_DIRECTORY if folder else os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    file = os.open(path, how, 0o644)
    try:
        try:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise InputError(taken) from None
        except OSError:  # some network disks have no locks
            if not folder:
                raise
        if not os.fstat(file).st_nlink:  # who held it removed it after this one opened it
            raise InputError(taken)
        yield file
    finally:
        os.close(file)


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
        with held(lock, f"{flag} {out}: another process is writing it"):
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
def held_folder(out: Path, doing: str, flag: str = "--out") -> Iterator[int]:
    """A folder, made where there is none and kept from other processes while the block lasts.

    Args:
        doing: What another process does there, in the message: "trains in it".
        flag: What the message names.

    Yields:
        The open folder; a process that is handed it keeps the folder too, until it ends.

    Raises:
        InputError: Another process holds it, or it cannot be made.
    """
    with contextlib.ExitStack() as stack:
        try:
            out.mkdir(parents=True, exist_ok=True)
            folder = stack.enter_context(held(out, f"{flag} {out}: another process {doing}"))
        except OSError as error:
            raise InputError(f"{flag} {out}: cannot be made ({error.strerror})") from None
        yield folder


def link(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it to another disk."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        shutil.copyfile(source, target)
