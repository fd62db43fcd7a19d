"""`python -m arena_newton.eval report`: tables and pages of results folders from their journals."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.cli.flags import Several
from arena_newton.errors import InputError
from arena_newton.eval.commands.run import run as evaluate

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["ReportOptions", "run"]


@dataclass(frozen=True)
class ReportOptions:
    """Write tables and reports of a results folder again from its journal; of several folders print one table."""

    table: bool = False
    """Print a table of successes per task, tracker and mode as Markdown, and write nothing."""
    json: bool = False
    """Print results.json instead of the table."""
    by: Several[str] = ()
    """With --table: successes by what mode dynamics, or another with ranges, drew: friction, state_latency ..."""
    own_tracker: str | None = None
    """Tracker through which --failures first plays the actions of a swapped run: the one that the
    policy was trained with, into <out>/own; the report then says how many failures succeed so."""


def run(folders: Sequence[Path], options: ReportOptions, factories: Factories | None = None) -> int:
    """Write or print what is asked for.

    Raises:
        InputError: A folder or a flag is unfit.
    """
    from arena_newton.eval.folders.results import load_run
    from arena_newton.eval.reports import report
    from arena_newton.eval.tables import drawn_table, run_table

    if options.table or len(folders) > 1:
        for flag, given in (("--json", options.json), ("--own-tracker", options.own_tracker)):
            if given:
                raise InputError(f"{flag}: is of one folder, without --table")
        if options.by:
            print(drawn_table.drawn_table([load_run(folder) for folder in folders], options.by), end="")
            return 0
        print(run_table.joint_table([load_run(folder) for folder in folders]), end="")
        return 0
    if options.by:
        raise InputError(f"--by {' '.join(options.by)}: belongs to --table")
    (folder,) = folders
    if options.own_tracker is not None:
        from arena_newton.eval.play.own_tracker import own_options

        failed = evaluate(own_options(folder, options.own_tracker), factories)
        if failed:
            return failed
    record = load_run(folder)
    results = report.write_reports(record)
    if options.json:
        print(json.dumps(results, indent=2))
        return 0
    print(report.table(results))
    for note in report.notes(record, results):
        print(note)
    print(f"report: {folder / 'report.html'}")
    return 0
