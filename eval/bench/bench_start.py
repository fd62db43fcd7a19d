"""Seconds from the building of a process' first environment to its first tick: with and without kernels in the cache.

The bars judge what the first measurement was ("cold start: 49 to 51 s to build the first environment, 52 s to the first
tick"): it begins with the environment. The seconds that interpreter and libraries take before that stand beside.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import torch
import warp as wp

from arena_newton import trackers
from arena_newton.cli.quiet import quiet_warp
from arena_newton.env import ArenaEnv
from arena_newton.errors import ArenaError
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.files.own_processes import environment
from arena_newton.kernel_cache import kernel_loading
from arena_newton.pictures.settings import CameraConfig
from arena_newton.robot.canonical import STAND_ACTION

__all__ = ["first_tick", "start_figures"]

COLD, WARM = 70.0, 8.0
"""Seconds from the building of the environment to its first tick on a GPU machine, without and with kernels in the
cache; on an H100 with 16 cores 61 and 3.7."""
LIBRARIES = "interpreter and libraries"
"""Name of the part before the environment."""
TIMEOUT = 900.0
"""Longest start that is waited for [s]."""


def first_tick(task: str, worlds: int, threads: int) -> None:
    """Build an environment with a camera, look once, play a tick, and print the seconds of each part as JSON.

    Args:
        threads: Threads that load kernels; 1: one module after the other. 0: as many as usual.
    """
    quiet_warp()
    if threads:
        kernel_loading.MOST_THREADS = threads
    cuda = bool(wp.is_cuda_available())
    engine, device = ("warp", "cuda:0") if cuda else ("mujoco", "cpu")
    began = time.perf_counter()
    env = ArenaEnv(
        task, tracker=trackers.get("twist2"), worlds=worlds, engine=engine, device=device, camera=CameraConfig()
    )
    parts = {"environment": time.perf_counter() - began}
    env.reset(list(range(worlds)))
    env.observe(image=True)
    env.step(torch.tensor(STAND_ACTION, device=env.torch_device).repeat(worlds, 1))
    wp.synchronize_device(env.device)
    parts["first look and tick"] = time.perf_counter() - began - parts["environment"]
    print(json.dumps(parts))


def start_figures() -> Iterator[BenchFigure]:
    """A start with an empty cache, the next one with the full cache, and one that compiles module by module."""
    cuda = bool(wp.is_cuda_available())
    where, worlds = ("CUDA", 60) if cuda else ("CPU", 2)
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        cold, warm, serial = _start(one, worlds, 0), _start(one, worlds, 0), _start(other, worlds, 1)
    name = f"first tick, boxing, {worlds} worlds, camera, {where}, kernels"
    ratio = f"; one module after the other {_judged(serial):.1f} s = {_judged(serial) / _judged(cold):.2f} x"
    for kind, bar, parts, more in (("compiled", COLD, cold, ratio), ("cached", WARM, warm, "")):
        seconds = _judged(parts)
        text = ", ".join(f"{part} {value:.1f} s" for part, value in parts.items() if part != LIBRARIES)
        note = f"{text}; before it, not in the figure: {LIBRARIES} {parts[LIBRARIES]:.1f} s"
        note += f", from the start of the process {sum(parts.values()):.1f} s{more}"
        if not cuda:
            note = f"{seconds:.1f} s, judged on CUDA only: {note}"
        yield BenchFigure(f"{name} {kind}", bar, "s", True, seconds if cuda else None, note)


def _judged(parts: dict[str, float]) -> float:
    """Seconds from the building of the environment to its first tick."""
    return sum(value for part, value in parts.items() if part != LIBRARIES)


def _start(cache: str, worlds: int, threads: int) -> dict[str, float]:
    """Seconds of the parts of a process, from its start to its first tick."""
    code = f"from arena_newton.eval.bench.bench_start import first_tick; first_tick('boxing', {worlds}, {threads})"
    variables = environment() | {"WARP_CACHE_PATH": cache, "CUDA_CACHE_PATH": f"{cache}/cuda"}
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], env=variables, capture_output=True, text=True, timeout=TIMEOUT
    )
    seconds = time.perf_counter() - began
    if done.returncode:
        raise ArenaError(f"the first tick was not reached: {' '.join(done.stderr.split())[-300:]}")
    parts: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return {LIBRARIES: max(0.0, seconds - sum(parts.values()))} | parts
