"""Flags of `eval matrix`, as a user gives them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from arena_newton.eval.plan.options import Workers

__all__ = ["MatrixOptions"]


@dataclass(frozen=True)
class _Cells:
    """Cells of a suite, and how they are played."""

    out: str | None = None
    """Folder of the suite; results/<name of the suite> when none is named."""
    only: str | None = None
    """Play only these cells, such as 'policy=act task=boxing,vis_navi matched=true'."""
    limit: int | None = None
    """Play at most so many cells in this call."""
    shard: str = "1/1"
    """Play part n of N, such as 1/4: each part has cells of every task, together they are the suite. slurm: the part of
    this task of a Slurm array; slurm/4 where the array has not all 4."""
    dry_run: bool = False
    """Print the matrix and its size, and play nothing."""
    keep_going: bool = False
    """Skip a cell that cannot be played, go on with the others and list it at the end."""
    accept_changes: bool = False
    """Cells that were played under other conditions are played again; what they hold is moved to <out>/.replaced."""
    accept_code: bool = False
    """Keep finished cells that were played by other versions of the code or its libraries."""
    retry_errors: bool = False
    """Run episodes again that ended with an error."""
    device: str | None = None
    """Device of all cells, as of `run`, instead of the suite's."""


@dataclass(frozen=True)
class MatrixOptions(Workers, _Cells):
    """Play every cell of a suite: policies x trackers x tasks x modes x rules, as one plan that can be continued.

    SUITE is a TOML file, or the name of one that comes with the package (paper, tiny). All cells are checked before the
    first is played. The same command continues where an earlier one stopped.
    """

    verbose: Annotated[bool, tyro.conf.arg(aliases=["-v"])] = False
    """Print what each run prints, and with --dry-run every cell."""
