"""`python -m arena_newton.eval run`: episodes of a policy, their table and their report."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from arena_newton.eval.plan.options import RunOptions

if TYPE_CHECKING:
    from arena_newton.eval.play.run import Factories

__all__ = ["before_ray", "run"]


def run(options: RunOptions, factories: Factories | None = None) -> int:
    """Run; what is wrong with flags or folder is found before the libraries of physics load, which takes seconds."""
    from arena_newton.doctor import versions
    from arena_newton.eval.folders.run_folder import ResultsFolder, results_folder
    from arena_newton.eval.plan.config import resolve
    from arena_newton.eval.reports.learned_row import row_options

    config = resolve(options)
    folder = ResultsFolder(results_folder(options.out, config.shard), config, versions())
    folder.check()
    row = row_options(config.flags, folder.path)
    beside = None
    if row is not None:
        beside = ResultsFolder(results_folder(row.out), resolve(row), versions())
        beside.check()
    if config.flags.ray is not None:
        before_ray()
        from arena_newton.eval.workers import ray_run

        return ray_run.execute(folder, factories, beside)
    from arena_newton.eval.play.run import execute

    return execute(folder, factories, beside)


def before_ray() -> None:
    """Set what is read when ray is imported: under `uv run` it would start every process by another `uv run`."""
    os.environ["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"
