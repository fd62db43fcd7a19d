"""Every command under one name: ``arena-newton eval``, or ``python -m arena_newton eval``, which is the same.

A command is a module that is imported when it is called, so that the overview answers at once. Modules are named here
and not imported at the top: this is the entry to all rooms, and no room imports those above it.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from arena_newton import __version__
from arena_newton.cli.command_line import exit_code
from arena_newton.errors import InputError

__all__ = ["COMMANDS", "Command", "main"]

PROG = "arena-newton"


@dataclass(frozen=True)
class Command:
    """One command, with flags and subcommands of its own."""

    words: str
    """Words as typed, such as `trackers evaluate`."""
    module: str
    """Module whose `main` takes the arguments and returns the exit code."""
    purpose: str
    """One line of the overview."""


COMMANDS = (
    Command("doctor", "arena_newton.doctor", "versions, devices, engines, kernel cache, and what to repair"),
    Command("data", "arena_newton.data.__main__", "demonstrations: clean, build, verify, merge, split, inspect, stats"),
    Command("eval", "arena_newton.eval.__main__", "evaluate:"),
    Command("policies check", "arena_newton.policies.policy_check", "try what the interface promises on a policy"),
    Command("policies serve", "arena_newton.policies.serve.__main__", "serve a policy: openpi, vla-eval, HTTP"),
    Command("policies teleop", "arena_newton.policies.teleop.__main__", "a person drives: browser, redis"),
    Command("policies train", "arena_newton.policies.train.__main__", "train a policy on demonstrations; teachable"),
    Command("rules", "arena_newton.rule_sets", "print both rule sets"),
    Command("scenes", "arena_newton.usd_scenes.__main__", "validate, list, preview or begin (new) USD scenes"),
    Command("train", "arena_newton.trackers.train.__main__", "short for trackers train"),
    Command("trackers check", "arena_newton.trackers.tracker_check", "try what the interface promises on a tracker"),
    Command("trackers evaluate", "arena_newton.trackers.evaluate", "measure trackers side by side"),
    Command("trackers train", "arena_newton.trackers.train.__main__", "train a tracker, export weights, draw curves"),
    Command("trackers motions", "arena_newton.trackers.motions.__main__", "convert, inspect, render, generate motions"),
)


DOCTORS = {"--tracker": "trackers check", "--policy": "policies check"}
"""Flag of `doctor` → the command that it stands for: the world below cannot examine what is above it."""


def _overview(within: str) -> str:
    shown = [c for c in COMMANDS if f"{c.words} ".startswith(f"{within} ".lstrip())]
    width = max(len(c.words) for c in shown)
    names = " ".join(importlib.import_module("arena_newton.eval.__main__").COMMANDS)
    purposes = {c.words: f"{c.purpose} {names}" if c.words == "eval" else c.purpose for c in shown}
    lines = [f"  {PROG} {words:<{width}}  {purpose}" for words, purpose in purposes.items()]
    words = f"{within} COMMAND".strip()
    return "\n".join(
        [
            f"usage: {PROG} {words} [flags], or: python -m arena_newton {words} [flags]",
            "",
            "commands:",
            *lines,
            "",
            "Each explains its flags with --help.",
            "",
        ]
    )


def _examining(arguments: list[str]) -> list[str]:
    """`doctor --tracker NAME ...` as the command that it stands for; everything else as it is."""
    flag, equals, name = arguments[1].partition("=") if arguments[:1] == ["doctor"] and arguments[1:] else ("", "", "")
    if flag not in DOCTORS:
        return arguments
    rest = [name, *arguments[2:]] if equals else arguments[2:]
    if not rest or not rest[0] or rest[0].startswith("-"):
        raise InputError(f"doctor {flag}: name the {flag[2:]} behind it")
    return [*DOCTORS[flag].split(), *rest]


def _run(arguments: list[str]) -> int:
    if arguments == ["--version"]:
        print(__version__)
        return 0
    arguments = _examining(arguments)
    found = [c for c in COMMANDS if arguments[: len(c.words.split())] == c.words.split()]
    if found:
        command = max(found, key=lambda c: len(c.words))
        rest = arguments[len(command.words.split()) :]
        code: int = importlib.import_module(command.module).main(rest)
        return code
    wants_help = bool(arguments) and arguments[-1] in ("-h", "--help")
    group = " ".join(arguments[:-1] if wants_help else arguments)
    if group and not any(c.words.startswith(f"{group} ") for c in COMMANDS):
        raise InputError(f"{group}: no such command; {PROG} --help lists them")
    print(_overview(group), end="", file=sys.stdout if wants_help else sys.stderr)
    return 0 if wants_help else 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; those of the process by default.

    Returns:
        Exit code of the command: 0 done, 1 failed, 2 bad input, 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    code = 0

    def work() -> None:
        nonlocal code
        code = _run(arguments)

    try:
        return exit_code(work) or code
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    sys.exit(main())
