"""Environment of this package's own processes."""

from __future__ import annotations

import os
import sys
from pathlib import Path

__all__ = ["environment"]

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
