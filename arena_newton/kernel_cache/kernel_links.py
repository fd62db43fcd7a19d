"""Linear algebra that kernels link (Cholesky factors and triangular solves of tiles), compiled ahead and side by side.

Warp compiles it while it writes a kernel's code, under the one lock of all code writing: 1.5 to 4 s a routine, six
routines for the robot, in which no other thread can begin with its module. Here a kernel's code is written once for
nothing, only to hear which routines it asks for; they are compiled by threads into Warp's cache on disk, where the real
writing finds them.
"""

from __future__ import annotations

import inspect
import threading
from concurrent.futures import Executor, Future
from pathlib import Path
from types import SimpleNamespace

import warp as wp
from warp._src import build, codegen, context

from arena_newton.kernel_cache.kernel_rehearsal import replaced

__all__ = ["Routines", "asked"]

LINKED = "cholesky"
"""Word in the source of every kernel of mujoco_warp that links such routines."""
BUILDER = build.build_lto_solver
"""Warp's own, which other threads may be listening to instead."""


class Routines:
    """Routines that were asked for; each is compiled once."""

    def __init__(self, threads: Executor):
        """Compile with `threads`, which nothing may occupy that waits for a routine."""
        self._threads = threads
        self._lock = threading.Lock()
        self._made: dict[tuple[object, ...], Future[object]] = {}

    def make(self, module: wp.Module, device: wp.Device, block_dim: int) -> None:
        """Compile the routines that a module links, unless the module itself is in the cache; wait for them.

        Raises:
            Exception: Anything that Warp raises: the module's own load says what is wrong.
        """
        if not device.is_cuda or not any(LINKED in kernel.adj.source for kernel in module.kernels.values()):
            return
        if Path(wp.config.kernel_cache_dir, module.get_module_identifier(block_dim)).exists():
            return
        work = [self._one(arguments) for arguments in asked(module, block_dim, device.get_cuda_compile_arch())]
        for one in work:
            one.result()

    def _one(self, arguments: dict[str, object]) -> Future[object]:
        key = tuple(arguments.values())
        with self._lock:
            if key not in self._made:
                self._made[key] = self._threads.submit(_compile, arguments)
            return self._made[key]


def asked(module: wp.Module, block_dim: int, arch: int) -> list[dict[str, object]]:
    """Arguments of `build_lto_solver` in Warp, but for the builder, for every routine that a module links.

    Args:
        module: A module of kernels.
        block_dim: Threads of a block.
        arch: Architecture of the GPU, such as 90.
    """
    found: list[dict[str, object]] = []
    parameters = inspect.signature(BUILDER)

    def listen(*args: object, **kwargs: object) -> tuple[str, bytes]:
        arguments = dict(parameters.bind(*args, **kwargs).arguments)
        del arguments["builder"]
        found.append(arguments)
        return "none", b""

    with codegen._codegen_lock, replaced(build, "build_lto_solver", listen):
        module.get_module_hash(block_dim)
        options = module.resolved_options[block_dim] | {"output_arch": arch}
        context.ModuleBuilder(module, options, hasher=module.hashers[block_dim], target="cuda")
    return found


def _compile(arguments: dict[str, object]) -> object:
    nobody = SimpleNamespace(ltoirs={}, ltoirs_decl={}, fatbins={})
    return BUILDER(**arguments, builder=nobody)
