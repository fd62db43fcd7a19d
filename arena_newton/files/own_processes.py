"""This package's own processes: how they start, what they find, and how they ended, in words."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

__all__ = ["environment", "how_it_ended", "start_module"]

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Set to 1 for a process that shares the cores with others: its libraries would start a thread per core."""


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
    files: Sequence[int],
    variables: Mapping[str, str],
    pipes: bool = False,
    errors: int | None = None,
) -> subprocess.Popen[bytes]:
    """Start a module as a program that keeps open files; in a session of its own, as Ctrl-C is for whoever started it.

    Its input and output are nothing, or `pipes` without buffers; its errors are written where those of this process
    are, or to `errors`; its environment are the `variables`.

    Raises:
        OSError: The system lets no process start.
    """
    stream, command = subprocess.PIPE if pipes else subprocess.DEVNULL, [sys.executable, "-P", "-m", module]
    return subprocess.Popen(
        [*command, *map(str, arguments)],
        pass_fds=files,
        env=variables,
        stdin=stream,
        stdout=stream,
        stderr=errors,
        bufsize=0,
        start_new_session=True,
    )


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
