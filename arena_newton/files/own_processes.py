"""Environment of this package's own processes, and memory that a GPU reaches itself."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

import torch

__all__ = ["environment", "pin", "unpin"]

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


def pin(memory: torch.Tensor, device: torch.device) -> bool:
    """Let a GPU reach memory of the host itself; False where it cannot be pinned: it is copied all the same.

    Args:
        memory: Contiguous, on the host; must be given to `unpin` before it is freed.
        device: The GPU.
    """
    with torch.cuda.device(device):
        if int(torch.cuda.cudart().cudaHostRegister(memory.data_ptr(), memory.nbytes, 0)) == 0:
            return True
        with contextlib.suppress(RuntimeError):  # CUDA keeps the error for whatever is launched next
            torch.zeros(1, device=device)
    return False


def unpin(memory: torch.Tensor) -> None:
    """Undo `pin`."""
    torch.cuda.cudart().cudaHostUnregister(memory.data_ptr())
