"""What a command line answers when its work fails."""

import atexit
import contextlib
import errno
import faulthandler
import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path

from arena_newton.errors import ArenaError
from arena_newton.text import plain_text

__all__ = ["INTERRUPTED", "exit_code", "program"]

COLLECTED = (50_000, 10, 10)
"""Thresholds of the garbage collector. Imports and kernels make a million objects that stay; with Python's own first
threshold, 700, it looks through them again and again while they are made: a fourth of a command's start."""

INTERRUPTED = 130
"""Exit code after Ctrl-C."""
NO_HOME = "Could not determine home directory."
"""What `pathlib` says of a path such as `~nobody/x`."""


def program(words: str, module: str) -> str:
    """A command's name for help and messages, as the process was started: by the one command line or by its module."""
    if Path(sys.argv[0]).name == "arena-newton":
        return f"arena-newton {words}"
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return f"python -m arena_newton {words}" if spec and spec.name == "arena_newton.__main__" else f"python -m {module}"


def exit_code(work: Callable[[], int | None]) -> int:
    """Do the work; an error is one line on the error stream.

    Args:
        work: Returns an exit code, or None for 0.

    Returns:
        What the work returned: 0 done, or a code of its own; after an error its `exit_code`: 1 failed, 2 bad input; 130
        interrupted. Whoever closes the output has seen enough: 0.
    """
    gc.set_threshold(*COLLECTED)
    # An interpreter that ends looks for garbage three times among the millions of objects that compiled kernels leave,
    # which takes seconds after the last line is printed; what is frozen is not looked at. Once, however often called.
    atexit.unregister(gc.freeze)
    atexit.register(gc.freeze)
    # Kernels and drivers are native code: a crash in it names the Python lines of all threads, or nobody can mend it.
    if not faulthandler.is_enabled() and sys.__stderr__ is not None:
        with contextlib.suppress(OSError, ValueError):  # the error stream may be closed
            faulthandler.enable(sys.__stderr__)
    try:
        return work() or 0
    except ArenaError as error:
        print(f"error: {plain_text(error)}", file=sys.stderr)
        return error.exit_code
    except RuntimeError as error:
        if str(error) != NO_HOME:
            raise
        print("error: a path begins with ~ and the name of a user that is not known here", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a path of the user's that cannot even be looked for; pathlib passes these on
        if error.errno not in (errno.ENAMETOOLONG, errno.EACCES) or error.filename is None:
            raise
        print(f"error: {plain_text(error.filename, 100)}: {error.strerror}", file=sys.stderr)
        return 2
