"""Kernels of a new environment, compiled and loaded side by side while the environment is built.

A module is compiled when the first of its kernels is launched, one after the other: 85 s of a first run on a new
machine. Here threads load them, which the compilers leave free, while the main thread builds:

- modules that every environment of its kind launches, from the beginning;
- those that mujoco_warp makes for one model, as soon as there is a model: `kernel_rehearsal` finds out which;
- linear algebra that some of these link: `kernel_links`.

Modules of libraries whose gradients nobody takes are compiled without their adjoints.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import threading
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import mujoco_warp
import warp as wp

from arena_newton.kernel_cache.kernel_links import Routines
from arena_newton.kernel_cache.kernel_rehearsal import rehearsed, replaced, walk_solver

__all__ = [
    "CAMERA_MODULES",
    "ENGINE_MODULES",
    "FORWARD_MODULES",
    "TICK_MODULES",
    "begin_device",
    "forward_only",
    "kernel_modules",
    "loading",
]

TICK_MODULES = (
    "newton._src.solvers.mujoco.kernels",
    "newton._src.geometry.inertia",
    "arena_newton.kernels.canonical",
    "arena_newton.kernels.rules.fall",
    "arena_newton.kernels.rules.predicates",
    "arena_newton.kernels.reset",
    "arena_newton.kernels.tick",
)
"""Modules whose kernels every environment launches; a test compares the lists with what was loaded."""
ENGINE_MODULES = {
    "mujoco": (),
    "warp": (
        "mujoco_warp._src.forward",
        "mujoco_warp._src.smooth",
        "mujoco_warp._src.set_const",
        "mujoco_warp._src.derivative",
        "mujoco_warp._src.passive",
        "mujoco_warp._src.solver",
        "mujoco_warp._src.support",
        "mujoco_warp._src.constraint",
        "arena_newton.kernels.contact",
        "arena_newton.kernels.newton_state",
    ),
}
"""Those of an engine."""
CAMERA_MODULES = (
    "newton._src.sensors.sensor_camera_render.camera_utils",
    "newton._src.geometry.bvh",
    "arena_newton.kernels.pictures.lighting",
    "arena_newton.kernels.newton_state",
    "arena_newton.kernels.pictures.raster",
)
"""Those of a camera."""
SUITE_MODULES = {"HOI": ("arena_newton.kernels.rules.success_hoi",), "HSI": ("arena_newton.kernels.rules.success_hsi",)}
"""Those of the judges of a suite's tasks."""
FORWARD_MODULES = ("newton._src.solvers.mujoco.kernels", "mujoco_warp._src.set_const")
"""Modules of libraries that would be compiled with adjoints; their solver has no gradients."""
MOST_THREADS = 16
"""Compilers at once, at most; otherwise one per core that the process may use. 1: nothing is loaded ahead."""

_loaded: set[tuple[str, str]] = set()
"""Device and module of what was loaded by earlier environments."""
_loading = threading.Lock()
"""Held by the environment that loads ahead; one that is built by another thread meanwhile loads as it launches."""


def kernel_modules(engine: str, *, camera: bool, suite: str | None = None) -> tuple[str, ...]:
    """Names of the modules that an environment of an engine launches, with or without a camera.

    Args:
        engine: `mujoco` or `warp`.
        camera: Whether the environment has a camera.
        suite: Suite of its task, `HOI` or `HSI`.
    """
    names = (*TICK_MODULES, *SUITE_MODULES.get(suite or "", ()), *ENGINE_MODULES[engine])
    return tuple(dict.fromkeys((*names, *(CAMERA_MODULES if camera else ()))))


def forward_only() -> None:
    """Leave the adjoints out of `FORWARD_MODULES`, unless they are loaded already."""
    for name in FORWARD_MODULES:
        module = wp.get_module(importlib.import_module(name).__name__)
        if module.options["enable_backward"] and not module.execs:
            wp.set_module_options({"enable_backward": False}, module=module)


def begin_device(device: wp.Device) -> None:
    """Give a CUDA device its context and stream now, by this thread alone.

    Warp does so at the first use and without a lock: threads that ask at once make a stream each, in a table that is
    not made for it, and a graph is later captured on one that the table has lost ("unknown stream").
    """
    if device.is_cuda:
        wp.get_stream(device)


@contextlib.contextmanager
def loading(engine: str, device: str, *, camera: bool, suite: str | None = None) -> Iterator[None]:
    """Load the modules of an environment while the block builds it; all of them are loaded at its end.

    A launch in the block whose module is being loaded waits for it, so that none is compiled twice. A module that
    cannot be compiled raises where it is launched, as without this.

    Args:
        engine: `mujoco` or `warp`.
        device: Warp device, such as `cpu` or `cuda:0`.
        camera: Whether the environment has a camera.
        suite: Suite of its task, `HOI` or `HSI`.
    """
    forward_only()
    names = kernel_modules(engine, camera=camera, suite=suite)
    names = tuple(name for name in names if (device, name) not in _loaded)
    threads = min(MOST_THREADS, len(os.sched_getaffinity(0)))
    if threads < 2 or not (names or engine == "warp") or not _loading.acquire(blocking=False):
        yield
        return
    try:
        begin_device(wp.get_device(device))
        _loaded.update((device, name) for name in names)
        with _Loader(threads) as loader:
            for name in names:
                loader.start(wp.get_module(importlib.import_module(name).__name__), wp.get_device(device), None)
            with loader.rehearsing() if engine == "warp" else contextlib.nullcontext():
                yield
            loader.finish()
    finally:
        _loading.release()


class _Loader:
    """Threads that load modules. While it is open, two threads never load one module at once."""

    def __init__(self, threads: int):
        """Use so many threads."""
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="kernels")
        self._linkers = ThreadPoolExecutor(threads, thread_name_prefix="links")
        self._routines = Routines(self._linkers)
        self._locks: dict[wp.Module, threading.Lock] = defaultdict(threading.Lock)
        self._work: dict[tuple[wp.Module, str, int], Future[None]] = {}

    def __enter__(self) -> _Loader:
        plain = wp.Module.load

        @functools.wraps(plain)
        def load(
            module: wp.Module, device: object, block_dim: int | None = None, *args: object, **kw: object
        ) -> object:
            with self._locks[module]:
                if not module.execs:
                    with contextlib.suppress(Exception):  # the load itself says what is wrong
                        self._routines.make(
                            module, wp.get_device(device), _block(module, wp.get_device(device), block_dim)
                        )
                return plain(module, device, block_dim, *args, **kw)

        self._patch = replaced(wp.Module, "load", load)
        self._patch.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        try:
            for one in self._work.values():
                one.cancel()
            self._pool.shutdown(wait=True)
            self._linkers.shutdown(wait=True, cancel_futures=True)
        finally:  # a Ctrl-C ends the waiting
            self._patch.__exit__(None, None, None)

    def start(self, module: wp.Module, device: wp.Device, block_dim: int | None) -> None:
        """Load a module by a thread, unless this one did before."""
        block = _block(module, device, block_dim)
        key = (module, str(device), block)
        if key not in self._work:
            self._work[key] = self._pool.submit(_load, module, device, block)

    def finish(self) -> None:
        """Wait for everything that was started."""
        for one in self._work.values():
            one.result()

    @contextlib.contextmanager
    def rehearsing(self) -> Iterator[None]:
        """Start with the modules of a mujoco_warp model when the block first computes its constants."""
        builder, plain = threading.get_ident(), mujoco_warp.set_const_fixed
        seen: list[mujoco_warp.Model] = []

        @functools.wraps(plain)
        def set_const_fixed(m: mujoco_warp.Model, d: mujoco_warp.Data) -> None:
            if threading.get_ident() == builder and not any(m is one for one in seen):
                seen.append(m)
                with contextlib.suppress(Exception), rehearsed(self.start, m, d):  # the launches find out themselves
                    walk_solver(m, d, plain)
            plain(m, d)

        with replaced(mujoco_warp, "set_const_fixed", set_const_fixed):
            yield


def _block(module: wp.Module, device: wp.Device, block_dim: int | None) -> int:
    """Threads of a block where a launch names none."""
    default: int = 1 if device.is_cpu else module.options["block_dim"]
    return default if block_dim is None else block_dim


def _load(module: wp.Module, device: wp.Device, block_dim: int) -> None:
    with contextlib.suppress(Exception):  # the launch that needs it says what is wrong
        wp.force_load(device, modules=[module], block_dim=block_dim, max_workers=0)
