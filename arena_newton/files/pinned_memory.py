"""Memory of the host that a GPU reaches itself."""

import contextlib

import torch

__all__ = ["pin", "unpin"]


def pin(memory: torch.Tensor, device: torch.device) -> bool:
    """Let a GPU reach memory of the host itself; False where it cannot be pinned: it is copied all the same.

    Args:
        memory: Contiguous, on the host; must be given to `unpin` before it is freed.
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
