"""Launches that repeat tick after tick with the same arguments: packed once, owned by who repeats them.

Checking and packing its arguments takes a launch on the CPU several times longer than a small kernel runs: 12 to 26 µs
against 3 to 6 µs for the recorded launch of a kernel with 7 to 21 arguments.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

__all__ = ["Recorded", "launch", "record"]


class Recorded:
    """Launches whose arguments are packed; calling it launches them in their order.

    Arrays are read as they are at the call, numbers and structs as they were at the recording. A `wp.Tape` does not see
    these launches.
    """

    def __init__(self) -> None:
        """Hold no launch yet; `record` fills it."""
        self.commands: list[wp.Launch] = []

    def __call__(self) -> None:
        """Launch."""
        for command in self.commands:
            command.launch()


class _Recording(threading.local):
    """What this thread is recording into, if anything."""

    into: Recorded | None = None


_recording = _Recording()


def record(launcher: Callable[..., None], *args: Any, **kwargs: Any) -> Recorded:
    """Call a launch wrapper of `kernels`, but keep its launches instead of doing them.

    Args:
        launcher: A function that only launches, such as `kernels.tick.launch_status`, and always the same kernels.
        *args: Its arguments.
        **kwargs: Its arguments.
    """
    before, _recording.into = _recording.into, Recorded()
    try:
        launcher(*args, **kwargs)
        return _recording.into
    finally:
        _recording.into = before


def launch(
    kernel: wp.Kernel, dim: int | Sequence[int], inputs: Sequence[Any], outputs: Sequence[Any], device: wp.Device = None
) -> None:
    """Do what `wp.launch` does, on the first output's device by default; inside `record`, keep the launch for later."""
    device = outputs[0].device if device is None else device
    if _recording.into is None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)
    else:
        command = wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_cmd=True)
        _recording.into.commands.append(command)
