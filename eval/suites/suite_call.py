"""One call of `eval matrix`: its suite file and flags, checked, and the cells that it is about.

No library of physics or pictures is loaded: a wrong file, a dry run and an absent checkpoint answer at once.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from arena_newton.cli.flags import check_least, shell_command, words
from arena_newton.errors import InputError
from arena_newton.eval.plan.flag_checks import check_workers
from arena_newton.eval.records.document import SUITE_FILE
from arena_newton.eval.records.sharding import parse_shard
from arena_newton.eval.suites.matrix_cells import (
    check_policies,
    dealt,
    expand_cells,
    matrix_table,
    parse_only,
    selected,
)
from arena_newton.eval.suites.suite_file import SuiteFile, read_suite_file, suite_path
from arena_newton.eval.suites.suite_options import MatrixOptions
from arena_newton.eval.suites.suite_records import SuiteCell, read_suite
from arena_newton.files.text import counted

__all__ = ["SuiteCall", "plan_call"]


@dataclass(frozen=True)
class SuiteCall:
    """Cells and options of a call."""

    suite: SuiteFile
    options: MatrixOptions
    cells: tuple[SuiteCell, ...]
    """All cells of the suite, in the order in which they are played."""
    chosen: tuple[str, ...]
    """Ids of those that the call is about."""
    out: Path
    shard: tuple[int, int]
    """Number, from 1, and count."""
    again: str
    """The command that continues it."""
    problem: InputError | None = None
    """Error for which a dry run's cells could not be played."""

    def table(self) -> str:
        """The matrix of the chosen cells, with what is done of it."""
        cells = [cell for cell in self.cells if cell.id in set(self.chosen)]
        if (self.out / SUITE_FILE).exists():
            played = {cell.id: cell.status for cell in read_suite(self.out).cells}
            cells = [dataclasses.replace(cell, status=played.get(cell.id, "waiting")) for cell in cells]
        return matrix_table(cells, each=self.options.verbose)


def plan_call(given: str, options: MatrixOptions) -> SuiteCall:
    """Read and check a suite file and the flags of a call.

    Raises:
        InputError: One is wrong, or a checkpoint is absent.
    """
    suite = read_suite_file(suite_path(given))
    only, shard = parse_only(options.only), parse_shard(options.shard)
    options = dataclasses.replace(options, shard=str(shard))
    check_workers(options)
    check_least(options, 1, "limit")
    cells = expand_cells(suite)
    if shard.count > max(len(cells), 1):
        raise InputError(f"--shard {shard}: the suite has {counted(len(cells), 'cell')}, expected no more shards")
    chosen = {cell.id for cell in dealt(cells, shard.number, shard.count)}
    chosen &= {cell.id for cell in (selected(cells, only) if only else cells)}
    checked, problem = {}, None
    try:
        checked = {c.id: c for c in check_policies(suite, [cell for cell in cells if cell.id in chosen])}
    except InputError as error:
        if not options.dry_run:  # which shows the matrix first
            raise
        problem = error
    return SuiteCall(
        suite=suite,
        options=options,
        cells=tuple(checked.get(cell.id, cell) for cell in cells),
        chosen=tuple(cell.id for cell in cells if cell.id in chosen),
        out=_out(options, suite),
        shard=(shard.number, shard.count),
        again=_again(given, options),
        problem=problem,
    )


def _out(options: MatrixOptions, suite: SuiteFile) -> Path:
    if options.out is None:
        return Path("results") / suite.name
    if not options.out.strip():
        raise InputError("--out: is empty, name a folder")
    return Path(options.out).expanduser()


def _again(given: str, options: MatrixOptions) -> str:
    """The command that continues."""
    once = ("limit", "dry_run", "accept_changes", "accept_code", "retry_errors", "verbose")
    again = dataclasses.replace(options, **{name: getattr(MatrixOptions, name) for name in once})
    return shell_command("arena_newton.eval", "matrix", given, *words(again))
