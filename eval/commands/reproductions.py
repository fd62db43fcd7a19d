"""`python -m arena_newton.eval reproductions`: the paper's numbers next to ours, each with a mark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

__all__ = ["ReproductionsOptions", "run"]


@dataclass(frozen=True)
class ReproductionsOptions:
    """Print every success rate of the paper next to ours, with the mark that the interval of their difference allows.

    Folders are suites, results folders, or files cells.csv of `eval tables`.
    """

    out: str | None = None
    """Folder for reproductions.md; without it the page is printed alone."""


def run(folders: Sequence[Path], options: ReproductionsOptions) -> int:
    """Print the page, and write it.

    Raises:
        InputError: A folder is unfit.
        StorageError: The page cannot be written.
    """
    from arena_newton.cli.flags import user_path
    from arena_newton.errors import InputError
    from arena_newton.eval.records.journal import write_atomic
    from arena_newton.eval.tables.evaluated_cells import read_cells
    from arena_newton.eval.tables.reproduced_numbers import reproductions

    cells = read_cells(folders)
    if cells.changed:
        raise InputError(f"reproductions: {' '.join(cells.changed)} No number of the paper can be compared with it")
    text = reproductions(cells.cells)
    print(text, end="")
    if options.out is not None:
        write_atomic(user_path(options.out) / "reproductions.md", text)
    return 0
