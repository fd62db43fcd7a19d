"""Command line of teleoperation: ``python -m arena_newton.policies.teleop {browser,redis} ...``."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Sequence

from arena_newton.cli.command_table import CommandRow, run_table
from arena_newton.policies.teleop.teleop_options import BrowserOptions, RedisOptions

__all__ = ["COMMANDS", "main"]

COMMANDS = {
    "browser": CommandRow(
        "drive the robot from a page in the browser",
        work="driving_command:drive_by_browser",
        options=BrowserOptions,
        extras={"teleop": ("viser", "websockets")},
    ),
    "redis": CommandRow(
        "drive it through a Redis server, as the original's PICO sender does",
        work="redis_command:drive_by_redis",
        options=RedisOptions,
        extras={"teleop": ("redis",)},
    ),
}
"""Commands by name."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with the arguments of the process by default.

    Returns:
        Exit code: 0 done, 1 failed, 2 bad input, 130 interrupted.
    """
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):  # a shell starts programs in the background deaf to Ctrl-C
            signal.signal(number, signal.default_int_handler)
    return run_table("policies.teleop", COMMANDS, argv)


if __name__ == "__main__":
    sys.exit(main())
