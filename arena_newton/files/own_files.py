"""Files of our own, written so that a reader sees the old content or the new, never a part of it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from arena_newton.files.untrusted_files import create

__all__ = ["MAX_LABEL", "PARTIAL", "file_label", "replace_atomically", "write_json"]

PARTIAL = ".part"
"""Ending of a file that is being written; what a killed process leaves has it."""
MAX_LABEL = 120
"""Characters of a label; with seed, repeat and episode a file name stays below 255."""


def file_label(name: str) -> str:
    """Name of a tracker or policy as part of a file name; a long one is cut and ends with its hash."""
    label = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("_") or "policy"
    if len(label) <= MAX_LABEL:
        return label
    return f"{label[: MAX_LABEL - 9]}_{hashlib.sha256(name.encode()).hexdigest()[:8]}"


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


def write_json(path: Path, value: object, *, sort: bool = False) -> None:
    """Write a value as indented JSON, with keys in order where `sort` says so.

    Raises:
        OSError: The file cannot be written.
    """
    with replace_atomically(path) as file:
        file.write(json.dumps(value, indent=4, sort_keys=sort, ensure_ascii=False).encode())
