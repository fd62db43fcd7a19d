"""Warp and torch on one CUDA stream, so that neither waits for the other."""

from __future__ import annotations

import contextlib

import torch
import warp as wp

__all__ = ["on_torch_stream"]


def on_torch_stream(device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Context in which Warp works on torch's current stream of a device; on the CPU there is nothing to do."""
    if device.type != "cuda":
        return contextlib.nullcontext()
    # Where torch already works on Warp's own stream, a second handle of it would end the first one with its life.
    if torch.cuda.current_stream(device).cuda_stream == wp.get_stream(str(device)).cuda_stream:
        return contextlib.nullcontext()
    stream: contextlib.AbstractContextManager[object] = wp.ScopedStream(wp.stream_from_torch(device))
    return stream
