"""`python -m arena_newton.eval run`: episodes of a policy, their table and their report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from arena_newton.eval.plan.options import RunOptions

if TYPE_CHECKING:
    from arena_newton.eval.play.run import Factories

__all__ = ["run"]


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
    if config.flags.dealt:
        from arena_newton.eval.workers import dealing

        return dealing.execute(folder, factories, beside)
    from arena_newton.eval.play.run import execute

    return execute(folder, factories, beside)
