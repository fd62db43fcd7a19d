"""The solver's functions walked once without a launch, to learn which kernels it makes for a model.

mujoco_warp makes most of its kernels for one model, each in a module of its own, at the first call of the function that
launches it: nobody can name them before. A rehearsal calls those functions on the model with everything held back that
would compile or write, so that all of those modules are known, and can be compiled side by side, before the first real
launch.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import threading
from collections.abc import Callable, Iterator

import mujoco_warp
import warp as wp

from arena_newton.kernel_cache.solver_options import collide_boxes_as_mujoco

__all__ = ["Note", "rehearsed", "replaced", "walk_solver"]

Note = Callable[[wp.Module, wp.Device, int | None], None]
"""Takes a module that a launch needs, its device and its block dimension (None: the module's own)."""

ROUTINES = ("array_scan", "radix_sort_pairs", "segmented_sort_pairs")
"""Functions of `wp.utils` that compute without a kernel: a sort would take what no launch has written for addresses."""
SUGGESTED_BLOCK = (256, 1)
"""Answer to who asks for the best block size: it sizes a grid and chooses no kernel."""


@contextlib.contextmanager
def replaced(owner: object, name: str, value: object) -> Iterator[None]:
    """Give an attribute of a module or class another value in the block."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


@contextlib.contextmanager
def rehearsed(note: Note, *protected: object) -> Iterator[None]:
    """Hold back this thread's launches in the block, and tell of their modules instead.

    Other threads launch as always. Bodies of conditional graphs are called once.

    Args:
        note: Called instead of loading a module.
        *protected: Arrays and structs of arrays that stay as they are; arrays made in the block can be written.
    """
    rehearsing = threading.get_ident()
    kept = [_span(array) for value in protected for array in _arrays(value)]

    def here() -> bool:
        return threading.get_ident() == rehearsing

    def written(array: wp.array) -> bool:
        return array.ptr is None or not any(low <= array.ptr < high for low, high in kept)

    load, suggest = wp.Module.load, wp.get_suggested_block_size
    capture_while, capture_if, copy = wp.capture_while, wp.capture_if, wp.copy

    @functools.wraps(load)
    def noted_load(
        module: wp.Module, device: object, block_dim: int | None = None, *args: object, **kw: object
    ) -> object:
        if not here():
            return load(module, device, block_dim, *args, **kw)
        note(module, wp.get_device(device), block_dim)
        return None  # a launch without a loaded module does nothing

    @functools.wraps(suggest)
    def noted_suggest(kernel: wp.Kernel, device: object = None) -> tuple[int, int]:
        chosen = wp.get_device(device)
        if not here() or not chosen.is_cuda:
            answer: tuple[int, int] = suggest(kernel, device)
            return answer
        note(kernel.module, chosen, None)
        return SUGGESTED_BLOCK

    @functools.wraps(capture_while)
    def once(condition: wp.array, while_body: Callable[..., None], stream: object = None, **kw: object) -> None:
        if here():
            while_body(**kw)
        else:
            capture_while(condition, while_body, stream, **kw)

    @functools.wraps(capture_if)
    def both(
        condition: wp.array,
        on_true: Callable[..., None] | None = None,
        on_false: Callable[..., None] | None = None,
        stream: object = None,
        **kw: object,
    ) -> None:
        if not here():
            capture_if(condition, on_true, on_false, stream, **kw)
            return
        for branch in (on_true, on_false):
            if branch is not None:
                branch(**kw)

    @functools.wraps(copy)
    def own_copy(dest: wp.array, *args: object, **kw: object) -> None:
        if not here() or written(dest):
            copy(dest, *args, **kw)

    def own_method(name: str) -> Callable[..., object]:
        plain = getattr(wp.array, name)

        @functools.wraps(plain)
        def method(array: wp.array, *args: object) -> object:
            return plain(array, *args) if not here() or written(array) else None

        return method

    def own_routine(name: str) -> Callable[..., None]:
        plain = getattr(wp.utils, name)

        @functools.wraps(plain)
        def routine(*args: object, **kw: object) -> None:
            if not here():
                plain(*args, **kw)

        return routine

    with contextlib.ExitStack() as stack:
        for owner, name, held in (
            (wp.Module, "load", noted_load),
            (wp, "get_suggested_block_size", noted_suggest),
            (wp, "capture_while", once),
            (wp, "capture_if", both),
            (wp, "copy", own_copy),
            *((wp.array, name, own_method(name)) for name in ("zero_", "fill_", "assign")),
            *((wp.utils, name, own_routine(name)) for name in ROUTINES),
        ):
            stack.enter_context(replaced(owner, name, held))
        yield


def walk_solver(
    m: mujoco_warp.Model, d: mujoco_warp.Data, set_const_fixed: Callable[[mujoco_warp.Model, mujoco_warp.Data], None]
) -> None:
    """Call what engine `warp` calls of mujoco_warp from the building of a scene to its first tick.

    Args:
        m: The model, as Newton made it.
        d: Its data.
        set_const_fixed: mujoco_warp's own function of this name.
    """
    m = dataclasses.replace(m, opt=dataclasses.replace(m.opt, warn_overflow=0))
    collide_boxes_as_mujoco(m)
    with wp.ScopedDevice(d.qpos.device):
        set_const_fixed(m, d)
        mujoco_warp.set_const_0(m, d)
        mujoco_warp.reset_data(m, d, wp.zeros(d.nworld, dtype=wp.bool))
        mujoco_warp.step(m, d)


def _arrays(value: object) -> Iterator[wp.array]:
    """All arrays in a struct of structs."""
    if isinstance(value, wp.array):
        yield value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from _arrays(getattr(value, field.name, None))
    elif isinstance(value, list | tuple):
        for one in value:
            yield from _arrays(one)


def _span(array: wp.array) -> tuple[int, int]:
    """First address of an array and the one behind it; (0, 0) for an empty one."""
    if array.ptr is None:
        return 0, 0
    last = sum((n - 1) * stride for n, stride in zip(array.shape, array.strides, strict=True) if n)
    return array.ptr, array.ptr + last + wp.types.type_size_in_bytes(array.dtype)
