"""Launches repeated tick after tick with the same arguments, recorded once.

Checking and packing its arguments takes a launch on the CPU several times longer than a small kernel runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

__all__ = ["launch_again"]

_LIMIT = 64
"""Recordings that one array keeps."""
_KEPT_AT = "_recorded_launches"


def launch_again(kernel: Any, *, dim: Any, inputs: Sequence[Any], outputs: Sequence[Any], device: Any) -> None:
    """Do what `wp.launch` does, from a recording where one was made with the very same arrays and numbers.

    Launches on CUDA, with vectors among the numbers, and of arrays that ask for gradients are plain ones: a `wp.Tape`
    sees no recorded launch. A recording belongs to the launch's first output and goes with it.

    Args:
        kernel: Kernel.
        dim: Threads, a number or a tuple.
        inputs: Arrays and numbers; no structs, whose fields could change under the recording.
        outputs: Arrays.
        device: Warp device.
    """
    for value in (*inputs, *outputs):
        if getattr(value, "requires_grad", False):
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)
            return
    key = (kernel, dim, *inputs, *outputs)  # the arrays decide on the device
    recorded: dict[tuple[Any, ...], Any] = outputs[0].__dict__.setdefault(_KEPT_AT, {})
    try:
        command = recorded.get(key)
    except TypeError:  # a vector among the numbers has no hash
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)
        return
    if command is None:
        if wp.get_device(device).is_cuda:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)
            return
        if len(recorded) >= _LIMIT:
            recorded.clear()
        command = recorded[key] = wp.launch(
            kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_cmd=True
        )
    command.launch()
