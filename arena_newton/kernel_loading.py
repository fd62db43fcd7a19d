"""Kernels of a new environment, compiled and loaded side by side while the environment is built.

A module is compiled when the first of its kernels is launched, one after the other: 50 to 60 s of a first run on a new
machine. Here the modules that every environment of its kind launches are loaded by threads, which the compilers
leave free, while the main thread builds and loads the rest: kernels that are made for one model, and the task's own.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import warp as wp

__all__ = ["CAMERA_MODULES", "ENGINE_MODULES", "TICK_MODULES", "kernel_modules", "loading"]

TICK_MODULES = (
    "newton._src.solvers.mujoco.kernels",
    "newton._src.geometry.inertia",
    "arena_newton.kernels.canonical",
    "arena_newton.kernels.fall",
    "arena_newton.kernels.reset",
    "arena_newton.kernels.tick",
)
"""Modules whose kernels every environment launches; a test compares all three lists with what was loaded."""
ENGINE_MODULES = {
    "mujoco": (),
    "warp": (
        "mujoco_warp._src.smooth",
        "mujoco_warp._src.set_const",
        "mujoco_warp._src.forward",
        "mujoco_warp._src.derivative",
        "mujoco_warp._src.passive",
        "mujoco_warp._src.solver",
        "mujoco_warp._src.support",
        "mujoco_warp._src.constraint",
        "arena_newton.kernels.contact",
    ),
}
"""Those of an engine."""
CAMERA_MODULES = (
    "newton._src.sensors.sensor_camera_render.camera_utils",
    "newton._src.geometry.bvh",
    "arena_newton.kernels.lighting",
    "arena_newton.kernels.newton_state",
)
"""Those of a camera."""
MOST_THREADS = 16
"""Compilers at once, at most; otherwise one per core that the process may use."""

_loaded: set[tuple[str, str]] = set()
"""Device and module of what was loaded by earlier environments."""


def kernel_modules(engine: str, *, camera: bool) -> tuple[str, ...]:
    """Names of the modules that an environment of an engine launches, with or without a camera."""
    return (*TICK_MODULES, *ENGINE_MODULES[engine], *(CAMERA_MODULES if camera else ()))


@contextlib.contextmanager
def loading(engine: str, device: str, *, camera: bool) -> Iterator[None]:
    """Load the modules of an environment while the block builds it; all of them are loaded at its end.

    A launch in the block whose module is being loaded waits for it, so that none is compiled twice. A module that
    cannot be compiled raises where it is launched, as without this.

    Args:
        engine: `mujoco` or `warp`.
        device: Warp device, such as `cpu` or `cuda:0`.
        camera: Whether the environment has a camera.
    """
    names = [name for name in kernel_modules(engine, camera=camera) if (device, name) not in _loaded]
    _loaded.update((device, name) for name in names)
    modules = [wp.get_module(importlib.import_module(name).__name__) for name in names]
    threads = min(MOST_THREADS, len(os.sched_getaffinity(0)))
    if not modules or threads < 2:
        yield
        return
    with ThreadPoolExecutor(threads, thread_name_prefix="kernels") as pool:
        for module in modules:
            _one_at_a_time(module)
        try:
            work = [pool.submit(_load, module, device) for module in modules]
            yield
            for one in work:
                one.result()
        finally:
            for one in work:
                one.cancel()
            pool.shutdown(wait=True)
            for module in modules:
                vars(module).pop("load", None)


def _load(module: wp.Module, device: str) -> None:
    with contextlib.suppress(Exception):  # the launch that needs it says what is wrong
        wp.force_load(device, modules=[module], max_workers=0)


def _one_at_a_time(module: wp.Module) -> None:
    """Let one thread load a module while others wait, until the attribute is removed again."""
    lock, plain = threading.Lock(), module.load

    def load(*args: object, **kwargs: object) -> object:
        with lock:
            return plain(*args, **kwargs)

    vars(module)["load"] = load
