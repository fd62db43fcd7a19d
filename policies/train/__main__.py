"""Command line: ``python -m arena_newton.policies.train [flags]``, ``bench`` and ``teachable``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from arena_newton.cli.command_line import exit_code, program
from arena_newton.cli.extras import require
from arena_newton.cli.flags import parse_flags
from arena_newton.policies.train.policy_options import (
    PolicyTrainOptions,
    TeachableOptions,
    TrainingBenchOptions,
    check_numbers,
    check_teachable,
)

__all__ = ["main"]

PROG = program("policies train", "arena_newton.policies.train")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; those of the process by default.

    Returns:
        Exit code: 0 done, 1 training failed, 2 bad input, 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    commands = {"bench": _bench, "teachable": _teachable}
    if arguments and arguments[0] in commands:
        return exit_code(lambda: commands[arguments[0]](arguments[1:]))
    return exit_code(lambda: _train(arguments))


def _train(arguments: list[str]) -> None:
    options = parse_flags(PolicyTrainOptions, arguments, PROG)
    check_numbers(options)  # before the libraries are loaded
    _require(options.policy)
    from arena_newton.policies.train.training import train

    flags = (one.partition("=")[0] for one in arguments if one.startswith("--"))
    train(options, named={flag[2:].replace("-", "_").removeprefix("no_") for flag in flags})


def _bench(arguments: list[str]) -> None:
    options = parse_flags(TrainingBenchOptions, arguments, f"{PROG} bench")
    check_numbers(options)
    _require(options.policy)
    from arena_newton.policies.train.training_bench import bench

    bench(options)


def _teachable(arguments: list[str]) -> int | None:
    options = parse_flags(TeachableOptions, arguments, f"{PROG} teachable")
    check_teachable(options)
    from arena_newton.policies.train.teachable import teachable

    return teachable(options)


def _require(family: str) -> None:
    """Check the libraries that a family's training needs."""
    require("data", "policies train", ("pyarrow",))
    if family != "act":
        require("policies", f"policies train --policy {family}")


if __name__ == "__main__":
    sys.exit(main())
