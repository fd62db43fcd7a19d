"""Films of looks in a dataset: copied as they were recorded, with a list of what their bytes mean."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path

from arena_newton.data.readers.looks import LOOKS_FOLDER, Looks, described_looks, film_path
from arena_newton.files.own_files import replace_atomically

__all__ = ["file_hash", "write_looks"]


def write_looks(root: Path, films: Sequence[tuple[Looks, Path] | None]) -> None:
    """Copy the films of a dataset's episodes, None for an episode without looks; nothing where none has any.

    Raises:
        OSError: A file cannot be written.
    """
    if not any(films):
        return
    (root / LOOKS_FOLDER).mkdir()
    listed: list[tuple[Looks, str] | None] = []
    for number, film in enumerate(films):
        if film is not None:
            shutil.copyfile(film[1], film_path(root, number))
        listed.append(None if film is None else (film[0], file_hash(film[1])))
    with replace_atomically(root / LOOKS_FOLDER / "looks.json") as file:
        file.write(described_looks(listed))


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
