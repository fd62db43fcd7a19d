"""Seconds of a process' start, libraries apart, to the first tick of `--policy learned`: with and without kernels."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import warp as wp

from arena_newton import policies
from arena_newton.cli.quiet import quiet_warp
from arena_newton.errors import ArenaError
from arena_newton.eval.bench.timing import BenchFigure, RepeatedEpisodes
from arena_newton.files.own_processes import environment
from arena_newton.kernel_cache import kernel_loading

__all__ = ["first_tick", "start_figures"]

COLD, WARM = 70.0, 4.0
"""Most seconds from the loaded libraries to the first tick on a GPU machine, without and with kernels in the cache."""
LIBRARIES = "interpreter and libraries"
"""Name of the part that is not judged: nothing here makes it faster."""
LOADED = "import time, torch, warp, newton, mujoco_warp; newton.solvers.SolverMuJoCo; began = time.perf_counter()"
"""First words of each process: loads what is not judged, then begins the clock; Newton imports a solver once named."""
TIMEOUT = 900.0
"""Longest start that is waited for [s]."""


def first_tick(worlds: int, threads: int, began: float) -> None:
    """Load the policy that ships, build its environment, play a tick, and print the seconds of each part as JSON.

    Args:
        threads: Threads that load kernels; 1: one module after the other. 0: as many as usual.
        began: `time.perf_counter()` as the libraries had been loaded.
    """
    parts = {"own modules": time.perf_counter() - began}

    def part(name: str) -> None:
        parts[name] = time.perf_counter() - began - sum(parts.values())

    quiet_warp()
    if threads:
        kernel_loading.MOST_THREADS = threads
    policy = policies.get("learned")
    policy.check()
    part("policy")
    cuda = bool(wp.is_cuda_available())
    side = RepeatedEpisodes("boxing", policy, worlds, cuda=cuda)
    part("environment")
    side.play(1)
    wp.synchronize()
    part("first look, query and tick")
    print(json.dumps(parts))


def start_figures() -> Iterator[BenchFigure]:
    """A start with an empty cache, the next one with the full cache, and one that compiles module by module."""
    cuda = bool(wp.is_cuda_available())
    where, worlds = ("CUDA", 60) if cuda else ("CPU", 2)
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        cold, warm, serial = _start(one, worlds, 0), _start(one, worlds, 0), _start(other, worlds, 1)
    name = f"first tick, boxing, {worlds} worlds, learned, {where}, kernels"
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
    """Seconds from the loaded libraries to the first tick."""
    return sum(value for part, value in parts.items() if part != LIBRARIES)


def _start(cache: str, worlds: int, threads: int) -> dict[str, float]:
    """Seconds of the parts of a process, from its start to its first tick."""
    code = (
        f"{LOADED}; from arena_newton.eval.bench.bench_start import first_tick; first_tick({worlds}, {threads}, began)"
    )
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
