"""Files of our own, written so that a reader sees the old content or the new, never a part of it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from arena_newton.foreign import create

__all__ = ["PARTIAL", "replace_atomically"]

PARTIAL = ".part"
"""Ending of a file that is being written; what a killed process leaves has it."""


@contextlib.contextmanager
def replace_atomically(path: str | Path, *, sync: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file next to `path`: renamed to it at the end of the block, removed on an error.

    The folder is made where there is none; links at the temporary name are not followed.

    Args:
        path: The file to write or to replace.
        sync: Wait until the content is on the disk, so that not even a power failure leaves a part.

    Raises:
        OSError: The file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(path.name + PARTIAL)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with create(temporary) as file:
            yield file
            file.flush()
            if sync:
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
