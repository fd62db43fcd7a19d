"""Exit code and one line of a command line whose work fails."""

import atexit
import contextlib
import errno
import faulthandler
import gc
import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from arena_newton import leave
from arena_newton.errors import ArenaError
from arena_newton.files.text import plain_text

__all__ = ["INTERRUPTED", "exit_code", "program"]

COLLECTED = (50_000, 10, 10)
"""Thresholds of the garbage collector. Imports and kernels make a million objects that stay; with Python's own first
threshold, 700, it looks through them again and again while they are made: a fourth of a command's start."""

LIBRARIES = {
    "torch": "torch",
    "lerobot": "LeRobot",
    "warp": "Warp, Newton and MuJoCo",
    "newton": "Warp, Newton and MuJoCo",
    "mujoco": "Warp, Newton and MuJoCo",
    "rsl_rl": "rsl-rl",
    "pxr": "USD",
    "matplotlib": "matplotlib",
    "scipy": "SciPy",
    "pyarrow": "pyarrow",
}
"""Package that takes seconds to import → what the command line says that it loads."""
QUIET = frozenset({"-h", "--help", "--json"})
"""Flags of a command that says nothing of what it loads: its answer is text for a reader or for a program."""

REFUSALS = {
    errno.ENOSPC: "no space left on the device; what was finished is kept",
    errno.EDQUOT: "no space left in the quota; what was finished is kept",
    errno.EROFS: "cannot be written, the file system is read-only",
    **dict.fromkeys((errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EISDIR), ""),
}
"""Errors of the operating system that are not the program's fault, with their message; empty: the system's own."""

INTERRUPTED = 130
"""Exit code after Ctrl-C."""
NO_HOME = "Could not determine home directory."
"""Message of `pathlib` for a path such as `~nobody/x`."""


def program(words: str, module: str) -> str:
    """A command's name for help and messages, as the process was started: by the one command line or by its module."""
    if Path(sys.argv[0]).name == "arena-newton":
        return f"arena-newton {words}"
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return f"python -m arena_newton {words}" if spec and spec.name == "arena_newton.__main__" else f"python -m {module}"


class _Announcing:
    """Says on the error stream, at the first import of each large library, that it is loaded now."""

    def __init__(self) -> None:
        """Announce each of `LIBRARIES` that is not loaded yet once."""
        self._announced = {LIBRARIES[name] for name in LIBRARIES if name in sys.modules}

    def find_spec(self, name: str, path: Sequence[str] | None, target: object = None) -> None:
        """Find nothing; what only asks whether a library is installed, and does not import it, goes unsaid."""
        title = LIBRARIES.get(name)
        if title is None or title in self._announced or sys._getframe(2).f_code.co_name != "_find_and_load_unlocked":
            return
        self._announced.add(title)
        with contextlib.suppress(OSError, ValueError, AttributeError):  # the error stream may be closed
            print(f"loading {title} ...", file=sys.stderr, flush=True)


def _begin_command() -> None:
    """Prepare the streams of a process that is a command of this package, not one that calls it.

    Text that their character set lacks becomes `?`, a pipe receives each line as it is printed, and large libraries
    are announced.
    """
    main = sys.modules["__main__"]
    if not (getattr(main, "__package__", None) or Path(sys.argv[0]).stem).startswith(("arena_newton", "arena-newton")):
        return
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace", line_buffering=True)
    if not QUIET.intersection(sys.argv) and not any(isinstance(finder, _Announcing) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Announcing())


def exit_code(work: Callable[[], int | None]) -> int:
    """Do the work; an error is one line on the error stream.

    Args:
        work: Returns an exit code, or None for 0.

    Returns:
        What the work returned: 0 done, or a code of its own; after an error its `exit_code`: 1 failed, 2 bad input; 130
        interrupted. Whoever closes the output has seen enough: 0.
    """
    _begin_command()
    if signal.getsignal(signal.SIGINT) is leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)
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
    except OSError as error:  # nobody below knew the flag: a disk, or a path that cannot even be looked for
        if error.errno not in REFUSALS:
            raise
        name = "" if error.filename is None else f"{plain_text(os.fsdecode(error.filename), 100)}: "
        print(f"error: {name}{REFUSALS[error.errno] or error.strerror}", file=sys.stderr)
        return 2
