"""This package's own processes: how they start, what they find, and how they ended, in words."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

__all__ = ["end", "environment", "how_it_ended", "start_module"]

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Set to 1 for a process that shares the cores with others: its libraries would start a thread per core."""

PR_SET_PDEATHSIG = 1
"""Request of Linux's `prctl`: a signal for the process when its parent ends."""
_LIBC = ctypes.CDLL(None)  # found before a fork, after which no library is loaded


def environment(*, one_thread: bool = False) -> dict[str, str]:
    """Environment in which `python -P -m arena_newton…` finds what this process finds.

    Args:
        one_thread: Libraries of the process start no threads.
    """
    # A source tree takes itself out of this process' own path: before another version, which may be installed too.
    paths, root = [path for path in sys.path if path], Path(__file__).resolve().parents[2]
    if root not in [Path(path).resolve() for path in paths]:
        paths.insert(0, str(root))
    found = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    return found | dict.fromkeys(ONE_THREAD, "1") if one_thread else found


def start_module(
    module: str,
    *arguments: object,
    variables: Mapping[str, str],
    files: Sequence[int] = (),
    output: int = subprocess.DEVNULL,
    errors: int | None = None,
    apart: bool = True,
    tied: bool = False,
) -> subprocess.Popen[bytes]:
    """Start a module as a program.

    Args:
        files: Open files that it keeps.
        output: Where it writes: nowhere, or an open file; `subprocess.PIPE` stands for its input too, without buffers.
        errors: Where it writes errors, by default where this process does.
        apart: It is in a session of its own, as Ctrl-C is for whoever started it.
        tied: It is told to end (SIGTERM) when this process is killed; of Linux only.

    Raises:
        OSError: The system lets no process start.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *map(str, arguments)],
        pass_fds=files,
        env=variables,
        stdin=subprocess.PIPE if output == subprocess.PIPE else subprocess.DEVNULL,
        stdout=output,
        stderr=errors,
        bufsize=0,
        start_new_session=apart,
        preexec_fn=_end_with_parent if tied else None,
    )


def _end_with_parent() -> None:
    """Ask for SIGTERM when the parent of this process ends, whatever ends it."""
    with contextlib.suppress(AttributeError):
        _LIBC.prctl(PR_SET_PDEATHSIG, int(signal.SIGTERM))


def end(process: subprocess.Popen[bytes], patience: float, how: int = 0) -> None:
    """End a process by a signal, or wait for its end (0), and kill it where it lasts longer [s]."""
    process.send_signal(how)
    try:
        process.wait(patience)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def how_it_ended(process: subprocess.Popen[bytes], patience: float) -> str:
    """Ending of a process in words, waiting so long for it [s]."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(patience)
    code = process.returncode
    if code is None:
        return "it closed its output"
    if code >= 0:
        return f"exit code {code}"
    return f"{signal.Signals(-code).name}{'; out of memory?' if -code == signal.SIGKILL else ''}"
