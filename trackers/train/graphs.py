"""CUDA graphs of work that a training repeats: one launch instead of hundreds."""

from __future__ import annotations

from collections.abc import Callable

import torch

from arena_newton.trackers.train.terms.measurement import TrainingError

__all__ = ["captured"]


def captured(work: Callable[[], None], option: str, stream: torch.cuda.Stream | None = None) -> torch.cuda.CUDAGraph:
    """Capture work in a graph; it is recorded, not executed.

    It must not wait for the device, and must use the same tensors each time. `option` is the command line's switch of
    this graph, such as `tick-graph`.

    Raises:
        TrainingError: The work cannot be captured. The device's random numbers may be unusable then.
    """
    graph = torch.cuda.CUDAGraph()
    try:
        # Other threads (a process group's watchdog) may use the device meanwhile.
        with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
            work()
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise TrainingError(f"no CUDA graph could be captured; --no-{option} trains without it ({reason})") from error
    return graph
