"""Launches repeated tick after tick with the same arguments, recorded once.

Checking and packing its arguments takes a launch on the CPU several times longer than a small kernel runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

__all__ = ["launch_again"]

_LIMIT = 256
"""Recorded launches that are kept; they keep their arrays alive."""
_recorded: dict[tuple[Any, ...], Any] = {}


def launch_again(kernel: Any, *, dim: Any, inputs: Sequence[Any], outputs: Sequence[Any], device: Any) -> None:
    """Do what `wp.launch` does, from a recording where one was made with the very same arrays and numbers.

    Launches on CUDA, with vectors among the numbers, and of arrays that ask for gradients are plain ones: a `wp.Tape`
    sees no recorded launch.

    Args:
        kernel: Kernel.
        dim: Threads, a number or a tuple.
        inputs: Arrays and numbers; no structs, whose fields could change under the recording.
        outputs: Arrays.
        device: Warp device.
    """
    key = (kernel, dim, *inputs, *outputs)  # the arrays decide on the device
    try:
        command = _recorded.get(key)
    except TypeError:  # a vector among the numbers has no hash
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)
        return
    if command is not None:
        command.launch()
        return
    differentiable = any(getattr(value, "requires_grad", False) for value in (*inputs, *outputs))
    if differentiable or wp.get_device(device).is_cuda:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)
        return
    if len(_recorded) >= _LIMIT:
        _recorded.clear()
    command = wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_cmd=True)
    _recorded[key] = command
    command.launch()
