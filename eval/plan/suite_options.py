"""Flags of `eval matrix`, as a user gives them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

__all__ = ["MatrixOptions"]


@dataclass(frozen=True)
class MatrixOptions:
    """Play every cell of a suite: policies x trackers x tasks x modes x rules, as one plan that can be continued.

    SUITE is a TOML file, or the name of one that comes with the package (paper, tiny). All cells are checked before the
    first is played. The same command continues where an earlier one stopped.
    """

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
    """Device of all cells instead of the suite's: cpu, cuda, cuda:1."""
    ray: tuple[str, ...] | None = None
    """Let processes of a Ray cluster play the cells, several at once: its address, such as 10.0.0.1:6379, or auto; with
    no address, a Ray of its own on this machine."""
    ray_actors: int | None = None
    """With --ray: processes that play at once; as many as the cluster has room for when not given."""
    ray_cpus: int | None = None
    """With --ray: cores of each of them; 4, or all of the smallest node where it has fewer, when not given."""
    ray_gpus: float | None = None
    """With --ray: GPUs of each of them, such as 0.5 for two on one GPU; 1 when not given, none on engine mujoco."""
    ray_minutes: float = 60.0
    """With --ray: a slice of a cell, at most two batches of worlds, that takes longer is stopped and played again."""
    ray_attempts: int = 3
    """With --ray: an episode whose process died so often while it played nothing else ends as an error."""
    verbose: Annotated[bool, tyro.conf.arg(aliases=["-v"])] = False
    """Print what each run prints, and with --dry-run every cell."""
