"""``python -m arena_newton trackers check NAME``: try what the interface promises on a tracker that is known by name.

``doctor --tracker NAME`` is the same.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

from arena_newton.cli.command_line import exit_code, program
from arena_newton.errors import InputError
from arena_newton.trackers import check_spec

__all__ = ["main"]

PROG = program("trackers check", "arena_newton trackers check")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"trackers check: {message}; see {PROG} --help")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog=PROG, description="Try every promise of the tracker interface on one tracker.")
    add = parser.add_argument
    add("name", metavar="NAME", help="a built-in tracker, or one that an installed package offers")
    add("--checkpoint", default=None, metavar="PATH", help="its weights, where it comes without")
    add("--worlds", type=int, default=3, metavar="N", help="worlds in the larger batch (3)")
    add("--device", default="cpu", help="cpu, cuda or cuda:N (cpu)")
    add(
        "--stand",
        action="store_true",
        help="also stand, turn and walk for two seconds in the lab: signs, frames, scales",
    )
    return parser


def _check(argv: Sequence[str]) -> int:
    args = _parser().parse_args(argv)
    if args.worlds < 2:
        raise InputError(f"--worlds {args.worlds}: masks need at least 2")
    check_spec(args.name)  # before the libraries are loaded

    from arena_newton.cli.quiet import quiet_warp
    from arena_newton.physics.devices import resolve_engine
    from arena_newton.testing import check_tracker
    from arena_newton.testing.findings import table
    from arena_newton.trackers.base import get

    quiet_warp()
    resolve_engine("warp", args.device)
    results = check_tracker(get(args.name, args.checkpoint), worlds=args.worlds, device=args.device, raises=False)
    print(table(f"tracker {args.name}", results))
    if args.stand:
        from arena_newton.trackers.evaluation.stand_check import stand

        stood = stand(get(args.name, args.checkpoint), device=args.device)
        print(table(f"tracker {args.name}, {len(stood)} measures of standing", stood))
        results += stood
    return int(not all(result.ok for result in results))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        Exit code: 0 every promise is kept, 1 one is broken, 2 bad input.
    """
    return exit_code(lambda: _check(sys.argv[1:] if argv is None else argv))


if __name__ == "__main__":
    sys.exit(main())
