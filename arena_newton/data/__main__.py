"""Command line of datasets: ``python -m arena_newton.data {clean,build,verify,merge,split,inspect,stats} ...``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from arena_newton.cli.command_table import CommandRow, run_table
from arena_newton.data.datasets.data_options import (
    BuildOptions,
    CleanOptions,
    InspectOptions,
    MergeOptions,
    SplitOptions,
    StatsOptions,
    VerifyOptions,
)

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
"""Commands by name, in the order of a dataset's life."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code is 1 where a check failed."""
    return run_table("data", COMMANDS, argv)


if __name__ == "__main__":
    sys.exit(main())
