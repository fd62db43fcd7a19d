"""Launches that repeat tick after tick with the same arguments: packed once, owned by who repeats them.

Checking and packing its arguments takes a launch on the CPU several times longer than a small kernel runs: 12 to 26 µs
for a kernel with 7 to 21 arguments. Warp's own recorded launch takes 5 to 8 µs there, because it fills a structure with
the packed arguments at every call; here that is done once too, which leaves about 1 µs.
"""

from __future__ import annotations

import ctypes
import functools
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
        self._calls: list[Callable[[], object]] = []

    def add(self, command: wp.Launch) -> None:
        """Launch it after those that are held already."""
        self.commands.append(command)
        self._calls.append(_prepared(command) or command.launch)

    def __call__(self) -> None:
        """Launch."""
        for call in self._calls:
            call()


def _prepared(command: wp.Launch) -> Callable[[], object] | None:
    """The call of a recorded launch's machine code, as `wp.Launch.launch` makes it on the CPU; None for other launches.

    The code takes the number of threads and one structure of all arguments. Where Warp's launch does not look as in the
    versions that are pinned, it is left to Warp.
    """
    try:
        bounds, *values = command.params
        arguments, forward = command.kernel.adj.args, command.hooks.forward
        plain = command.device.is_cpu and not command.adjoint and command.block_dim == 1
    except (AttributeError, TypeError, ValueError):
        return None
    if not plain or len(arguments) != len(values):
        return None
    fields = [(argument.label, type(value)) for argument, value in zip(arguments, values, strict=True)]
    structure = type("Arguments", (ctypes.Structure,), {"_fields_": fields})(*values)
    return functools.partial(forward, ctypes.byref(bounds), ctypes.byref(structure))


class _Recording(threading.local):
    """Launches that this thread is recording, if any."""

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
        _recording.into.add(command)
