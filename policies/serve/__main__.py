"""A policy answers over the network: ``python -m arena_newton.policies.serve --policy SPEC --protocol openpi``."""

from __future__ import annotations

import importlib
import signal
import sys
import threading
from collections.abc import Sequence

from arena_newton.cli.command_line import exit_code, program
from arena_newton.cli.extras import require
from arena_newton.cli.flags import parse_flags
from arena_newton.policies.base import check_spec
from arena_newton.policies.protocols.ports import bind
from arena_newton.policies.serve.serve_options import ServeOptions

__all__ = ["main"]

PROG = program("policies serve", "arena_newton.policies.serve")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with the arguments of the process by default.

    Returns:
        Exit code: 0 ended by Ctrl-C, 1 failed, 2 bad input, 130 interrupted before it served.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):  # a shell starts programs in the background deaf to Ctrl-C
            signal.signal(number, signal.default_int_handler)
    return exit_code(lambda: _run(arguments))


def _run(arguments: list[str]) -> int:
    options = parse_flags(ServeOptions, arguments, PROG)
    options.check()
    check_spec(options.policy)
    require("serve", "policies serve")
    bind(options.port, "--port", options.host).close()  # libraries take seconds to load, a taken port shows at once
    work = importlib.import_module("arena_newton.policies.serve.serve_command")
    code: int = work.serve_policy(options)
    return code


if __name__ == "__main__":
    sys.exit(main())
