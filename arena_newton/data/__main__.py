"""Command line of datasets: ``python -m arena_newton.data {clean,build,verify,merge,split,inspect,stats} ...``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from arena_newton.cli.command_line import exit_code
from arena_newton.cli.command_table import HELP, CommandRow, call, overview
from arena_newton.data.datasets.data_options import (
    BuildOptions,
    CleanOptions,
    InspectOptions,
    MergeOptions,
    SplitOptions,
    StatsOptions,
    VerifyOptions,
)
from arena_newton.errors import InputError

__all__ = ["COMMANDS", "main"]


COMMANDS = {
    "clean": CommandRow(
        takes="<recordings> [<recordings> ...] --out <folder>",
        purpose="drop rows that a stalled or jumping source spoiled",
        options=CleanOptions,
        work="datasets.cleaning:clean",
    ),
    "build": CommandRow(
        takes="<recordings> [<recordings> ...] --out <dataset>",
        purpose="make a LeRobot v3.0 dataset of recorded episodes",
        options=BuildOptions,
        work="datasets.lerobot_dataset:build",
        extras={"data": ()},
    ),
    "verify": CommandRow(
        takes="<dataset> [--recordings <recordings> ...]",
        purpose="check a dataset number by number and frame by frame, and against its recordings",
        options=VerifyOptions,
        work="checks.verification:verify",
        extras={"data": ()},
    ),
    "merge": CommandRow(
        takes="<dataset> <dataset> [<dataset> ...] --out <dataset>",
        purpose="make one dataset of several; pictures are copied as they are",
        options=MergeOptions,
        work="datasets.sets:merge",
        extras={"data": ()},
    ),
    "split": CommandRow(
        takes="<datasets or recordings ...> --out-train <folder> --out-held-out <folder>",
        purpose="hold out episodes by their seeds",
        options=SplitOptions,
        work="datasets.sets:split",
    ),
    "stats": CommandRow(
        takes="<datasets or recordings ...>",
        purpose="print figures of episodes, and those unlike the others",
        options=StatsOptions,
        work="checks.episode_figures:stats",
    ),
    "inspect": CommandRow(
        takes="<datasets or recordings ...> --out <page.html>",
        purpose="show episodes as one page: figures, phases, curves, film strips",
        options=InspectOptions,
        work="checks.inspection:inspect",
    ),
}
"""By name, in the order of a dataset's life."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with the arguments of the process by default.

    Returns:
        Exit code: 0 done, 1 a check failed, 2 bad input, 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    return exit_code(lambda: _run(arguments))


def _run(arguments: list[str]) -> int:
    if not arguments or arguments[0] in HELP:
        print(overview("data", COMMANDS), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    name = arguments.pop(0)
    if name not in COMMANDS:
        raise InputError(f"{name}: unknown command, known are {' '.join(COMMANDS)}")
    return call("data", name, COMMANDS[name], arguments)


if __name__ == "__main__":
    sys.exit(main())
