"""Command line of datasets: ``python -m arena_newton.data {clean,build,verify,merge,split,inspect,stats} ...``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from arena_newton.cli.command_line import exit_code, program
from arena_newton.cli.extras import require
from arena_newton.cli.flags import folders_named, parse_flags
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

__all__ = ["COMMANDS", "DataCommand", "main"]

PROG = program("data", "arena_newton.data")


@dataclass(frozen=True)
class DataCommand:
    """One command: what it is given after its folders, and who does it."""

    words: str
    """Usage, such as `build <recordings> [<recordings> ...]`."""
    purpose: str
    options: type
    """Dataclass of its flags."""
    work: str
    """`room.module:function`; takes the folders and the flags, returns an exit code."""
    extra: str | None = None
    """Extra that it needs."""


COMMANDS: dict[str, DataCommand] = {
    "clean": DataCommand(
        words="clean <recordings> [<recordings> ...] --out <folder>",
        purpose="drop rows that a stalled or jumping source spoiled",
        options=CleanOptions,
        work="datasets.cleaning:clean",
    ),
    "build": DataCommand(
        words="build <recordings> [<recordings> ...] --out <dataset>",
        purpose="make a LeRobot v3.0 dataset of recorded episodes",
        options=BuildOptions,
        work="datasets.lerobot_dataset:build",
        extra="data",
    ),
    "verify": DataCommand(
        words="verify <dataset> [--recordings <recordings> ...]",
        purpose="check a dataset number by number and frame by frame, and against its recordings",
        options=VerifyOptions,
        work="checks.verification:verify",
        extra="data",
    ),
    "merge": DataCommand(
        words="merge <dataset> <dataset> [<dataset> ...] --out <dataset>",
        purpose="make one dataset of several; pictures are copied as they are",
        options=MergeOptions,
        work="datasets.sets:merge",
        extra="data",
    ),
    "split": DataCommand(
        words="split <datasets or recordings ...> --out-train <folder> --out-held-out <folder>",
        purpose="hold out episodes by their seeds",
        options=SplitOptions,
        work="datasets.sets:split",
    ),
    "stats": DataCommand(
        words="stats <datasets or recordings ...>",
        purpose="print figures of episodes, and those unlike the others",
        options=StatsOptions,
        work="checks.episode_figures:stats",
    ),
    "inspect": DataCommand(
        words="inspect <datasets or recordings ...> --out <page.html>",
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
    if not arguments or arguments[0] in ("-h", "--help"):
        width = max(len(command.words) for command in COMMANDS.values())
        lines = [f"  {PROG} {command.words:<{width}}  {command.purpose}" for command in COMMANDS.values()]
        print("\n".join(["commands:", *lines]), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    name = arguments.pop(0)
    if name not in COMMANDS:
        raise InputError(f"{name}: unknown command, known are {' '.join(COMMANDS)}")
    command = COMMANDS[name]
    if any(argument in ("-h", "--help") for argument in arguments):
        parse_flags(command.options, ["--help"], f"{PROG} {command.words}")
    folders = folders_named(arguments, name, PROG)
    options = parse_flags(command.options, arguments, f"{PROG} {name}")
    if command.extra is not None:
        require(command.extra, f"data {name}")
    module, _, function = command.work.partition(":")
    code: int = getattr(importlib.import_module(f"arena_newton.data.{module}"), function)(folders, options)
    return code


if __name__ == "__main__":
    sys.exit(main())
