"""Launches that repeat tick after tick with the same arguments: packed once, owned by who repeats them.

Checking and packing its arguments takes a launch on the CPU several times longer than a small kernel runs: 12 to 26 µs
for a kernel with 7 to 21 arguments. Warp's own recorded launch takes 5 to 8 µs there, because it fills a structure with
the packed arguments at every call; here that is done once too, which leaves about 1 µs.
"""

from __future__ import annotations

import ctypes
import functools
import inspect
import itertools
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

__all__ = ["Recorded", "launch", "launch_divided", "launcher", "record"]

OUTPUTS = ("counter", "success", "margin", "event")
"""Names of arguments from which on those of a kernel are outputs."""
PARTS = 2
"""Parts of a divided launch per thread, so that a slow core delays nobody."""


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
    fields = tuple((argument.label, type(value)) for argument, value in zip(arguments, values, strict=True))
    return functools.partial(forward, ctypes.byref(bounds), ctypes.byref(_structure(fields)(*values)))


@functools.cache
def _structure(fields: tuple[tuple[str, type], ...]) -> type[ctypes.Structure]:
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})


class _Recording(threading.local):
    """Launches that this thread is recording, if any."""

    into: Recorded | None = None


_recording = _Recording()


def record(launcher: Callable[..., None], *args: Any, **kwargs: Any) -> Recorded:
    """Call a launch wrapper of `kernels`, but keep its launches instead of doing them.

    Args:
        launcher: A function that only launches, such as `kernels.tick.launch_status`, and always the same kernels.
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


def launch_divided(
    kernel: wp.Kernel, dim: Sequence[int], axis: int, inputs: Sequence[Any], outputs: Sequence[Any], threads: int
) -> None:
    """Do what `launch` does; on the CPU some threads each take the next part of one dimension.

    Args:
        kernel: Its first argument, which is not in `inputs`, is the first index of the part.
        dim: Of the whole launch.
        axis: The dimension; different indices must write different elements.
        inputs: The other inputs.
        outputs: Its outputs.
        threads: Threads on the CPU.
    """
    if threads == 1 or dim[axis] == 1 or not outputs[0].device.is_cpu:
        launch(kernel, dim, [0, *inputs], outputs)
        return
    count = min(PARTS * threads, dim[axis])
    starts = [dim[axis] * part // count for part in range(count + 1)]
    # Packed in this thread: two that load a module at once would both compile it.
    parts = [
        record(launch, kernel, (*dim[:axis], end - first, *dim[axis + 1 :]), [first, *inputs], outputs)
        for first, end in itertools.pairwise(starts)
    ]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(Recorded.__call__, parts))


def launcher(kernel: wp.Kernel, **defaults: object) -> Callable[..., None]:
    """The launch wrapper of a kernel that has one thread per world and whose outputs are `OUTPUTS`.

    Its arguments are the kernel's, by position up to the first that is no array, and by name; flags become 0 and 1.

    Args:
        kernel: The kernel, whose docstring is the wrapper's.
        **defaults: Values of arguments that may be left out.
    """
    arguments, kind = [], inspect.Parameter.POSITIONAL_OR_KEYWORD
    for argument in kernel.adj.args:
        if not getattr(argument.type, "ndim", 0):  # no array
            kind = inspect.Parameter.KEYWORD_ONLY
        default = defaults.get(argument.label, inspect.Parameter.empty)
        arguments.append(inspect.Parameter(argument.label, kind, default=default))
    signature = inspect.Signature(arguments)
    first_output = min(number for number, argument in enumerate(arguments) if argument.name in OUTPUTS)

    def wrapper(*state: wp.array, **named: object) -> None:
        bound = signature.bind(*state, **named)
        bound.apply_defaults()
        values = [int(value) if isinstance(value, bool) else value for value in bound.arguments.values()]
        outputs = values[first_output:]
        launch(kernel, outputs[0].shape[0], values[:first_output], outputs)

    wrapper.__name__ = wrapper.__qualname__ = f"launch_{kernel.func.__name__.removesuffix('_kernel')}"
    wrapper.__doc__, wrapper.__module__ = kernel.func.__doc__, kernel.func.__module__
    wrapper.__signature__ = signature  # type: ignore[attr-defined]  # `inspect` reads it
    return wrapper
