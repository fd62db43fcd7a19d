"""``python -m arena_newton policies check SPEC``: try what the interface promises on a policy that is known by name.

``doctor --policy SPEC`` is the same. A policy that reads the world itself (it has an `attach` of its own) is tried in
real worlds of a task, every other one on made-up observations.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

from arena_newton import tasks
from arena_newton.cli.command_line import exit_code, program
from arena_newton.errors import InputError
from arena_newton.policies import check_spec

__all__ = ["main"]

PROG = program("policies check", "arena_newton policies check")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"policies check: {message}; see {PROG} --help")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog=PROG, description="Try every promise of the policy interface on one policy.")
    add = parser.add_argument
    add("spec", metavar="SPEC", help="a policy as --policy of eval takes it: stand, replay:<file>, remote:<url>, ...")
    add("--task", default="football", metavar="TASK", help=f"{' '.join(tasks.names())} (football)")
    add("--seeds", type=int, nargs="+", default=None, metavar="SEED", help="episode seeds, if it knows only some")
    return parser


def _check(argv: Sequence[str]) -> int:
    args = _parser().parse_args(argv)
    tasks.get(args.task)
    check_spec(args.spec)  # before the libraries are loaded
    if args.seeds is not None and (len(args.seeds) < 2 or len(set(args.seeds)) < len(args.seeds)):
        raise InputError(f"--seeds {' '.join(map(str, args.seeds))}: masks need at least 2 different ones")

    from arena_newton.cli.quiet import quiet_warp
    from arena_newton.env import ArenaEnv
    from arena_newton.pictures.settings import policy_cameras
    from arena_newton.policies.base import get, is_privileged
    from arena_newton.testing import check_policy
    from arena_newton.testing.findings import table
    from arena_newton.testing.policy_conformance import SEEDS
    from arena_newton.trackers.pd import PdTracker

    quiet_warp()
    policy = get(args.spec)

    def make_worlds(worlds: int) -> ArenaEnv:
        cameras, tracker = policy_cameras(policy), PdTracker()
        return ArenaEnv(args.task, tracker=tracker, worlds=worlds, engine="mujoco", cameras=cameras, rules="released")

    seeds = SEEDS if args.seeds is None else tuple(args.seeds)
    made = make_worlds if is_privileged(policy) else None
    results = check_policy(policy, task=args.task, seeds=seeds, make_worlds=made, raises=False)
    print(table(f"policy {args.spec.partition(':')[0]}", results))
    return int(not all(result.ok for result in results))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        Exit code: 0 every promise is kept, 1 one is broken, 2 bad input.
    """
    return exit_code(lambda: _check(sys.argv[1:] if argv is None else argv))


if __name__ == "__main__":
    sys.exit(main())
