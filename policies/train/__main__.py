"""Command line: ``python -m arena_newton.policies.train [flags]`` and ``teachable``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from arena_newton.cli.command_line import exit_code, program
from arena_newton.cli.extras import require
from arena_newton.cli.flags import parse_flags
from arena_newton.policies.train.policy_options import (
    PolicyTrainOptions,
    TeachableOptions,
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
    if arguments[:1] == ["teachable"]:
        return exit_code(lambda: _teachable(arguments[1:]))
    return exit_code(lambda: _train(arguments))


def _train(arguments: list[str]) -> None:
    options = parse_flags(PolicyTrainOptions, arguments, PROG)
    check_numbers(options)  # before the libraries are loaded
    require("data", "policies train", ("pyarrow",))
    if options.policy != "act":
        require("policies", f"policies train --policy {options.policy}")
    from arena_newton.policies.train.training import train

    flags = (one.partition("=")[0] for one in arguments if one.startswith("--"))
    train(options, named={flag[2:].replace("-", "_").removeprefix("no_") for flag in flags})


def _teachable(arguments: list[str]) -> int | None:
    options = parse_flags(TeachableOptions, arguments, f"{PROG} teachable")
    check_teachable(options)
    from arena_newton.policies.train.teachable import teachable

    return teachable(options)


if __name__ == "__main__":
    sys.exit(main())
