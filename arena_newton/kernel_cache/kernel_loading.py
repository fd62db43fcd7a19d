"""Kernels of a new environment, compiled and loaded side by side before it is built.

Warp compiles a module when the first of its kernels is launched, one after the other. Those that every environment of
its kind launches are known by name and loaded together; those that mujoco_warp makes for one model are left to their
first launch. Modules of libraries whose gradients nobody takes are compiled without their adjoints.
"""

from __future__ import annotations

import importlib
import os
import threading

import warp as wp

__all__ = [
    "CAMERA_MODULES",
    "ENGINE_MODULES",
    "FORWARD_MODULES",
    "TICK_MODULES",
    "forward_only",
    "kernel_modules",
    "load_kernels",
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
"""Compilers at once, at most; otherwise one per core that the process may use."""

_loaded: set[tuple[str, str]] = set()
"""Device and module of what was loaded by earlier environments."""
_loading = threading.Lock()
"""Held by the thread that loads, so that none is compiled twice."""


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


def load_kernels(engine: str, device: str, *, camera: bool, suite: str | None = None) -> None:
    """Load the modules of an environment, unless an earlier one did.

    Args:
        engine: `mujoco` or `warp`.
        device: Warp device, such as `cpu` or `cuda:0`.
        camera: Whether the environment has a camera.
        suite: Suite of its task, `HOI` or `HSI`.
    """
    forward_only()
    with _loading:
        new = {(device, name) for name in kernel_modules(engine, camera=camera, suite=suite)} - _loaded
        if not new:
            return
        if wp.get_device(device).is_cuda:
            wp.get_stream(device)  # made at the first use without a lock: threads that ask at once would make one each
        modules = [wp.get_module(importlib.import_module(name).__name__) for _, name in sorted(new)]
        wp.force_load(device, modules=modules, max_workers=min(MOST_THREADS, len(os.sched_getaffinity(0))))
        _loaded.update(new)
