"""Command line of teleoperation: ``python -m arena_newton.policies.teleop {browser,redis} ...``."""

from __future__ import annotations

import importlib
import signal
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass

from arena_newton.cli.command_line import exit_code, program
from arena_newton.cli.extras import require
from arena_newton.cli.flags import parse_flags
from arena_newton.errors import InputError
from arena_newton.policies.protocols.ports import bind
from arena_newton.policies.teleop.teleop_options import BrowserOptions, RedisOptions

__all__ = ["COMMANDS", "TeleopCommand", "main"]

PROG = program("policies teleop", "arena_newton.policies.teleop")


@dataclass(frozen=True)
class TeleopCommand:
    """One command."""

    options: type
    """Dataclass of its flags."""
    modules: tuple[str, ...]
    """Modules of the extra `teleop` that it needs."""
    work: str
    """`module:function` in this folder; takes the flags, returns an exit code."""


COMMANDS = {
    "browser": TeleopCommand(BrowserOptions, ("viser", "websockets"), "driving_command:drive_by_browser"),
    "redis": TeleopCommand(RedisOptions, ("redis",), "redis_command:drive_by_redis"),
}
"""By name."""
OVERVIEW = f"""commands:
  {PROG} browser [flags]  drive the robot from a page in the browser
  {PROG} redis [flags]    drive it through a Redis server, as the original's PICO sender does
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with the arguments of the process by default.

    Returns:
        Exit code: 0 done, 1 failed, 2 bad input, 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):  # a shell starts programs in the background deaf to Ctrl-C
            signal.signal(number, signal.default_int_handler)
    return exit_code(lambda: _run(arguments))


def _run(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(OVERVIEW, end="", file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    name = arguments.pop(0)
    if name not in COMMANDS:
        raise InputError(f"{name}: unknown command, known are {' '.join(COMMANDS)}")
    command = COMMANDS[name]
    options = parse_flags(command.options, arguments, f"{PROG} {name}")
    require("teleop", f"teleop {name}", command.modules)
    if isinstance(options, BrowserOptions):  # libraries take seconds to load, a taken port shows at once
        bind(options.port, "--port").close()
        if not options.no_view:
            bind(options.port_of_view(), "--view-port").close()
    module, _, function = command.work.partition(":")
    code: int = getattr(importlib.import_module(f"arena_newton.policies.teleop.{module}"), function)(options)
    return code


if __name__ == "__main__":
    sys.exit(main())
