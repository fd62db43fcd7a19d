"""Seconds of a tick with tracker and of its bare physics, on the CPU and on CUDA."""

from __future__ import annotations

import contextlib
import statistics
from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
import warp as wp

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.eval.bench.timing import NEEDS_CUDA, BenchFigure, seconds_of
from arena_newton.interfaces import Physics
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.robot.g1 import PhysicsRate

__all__ = ["RATES", "as_before", "throughput_figures", "tick_figures", "tick_times"]

RATES = {"1 ms x 20": PhysicsRate(dt=0.001, substeps=20), "5 ms x 4": PhysicsRate(dt=0.005, substeps=4)}
"""The two rates of the physics at which ticks are measured, whatever rate the weights were trained at."""


@contextlib.contextmanager
def as_before(physics: Physics) -> Iterator[None]:
    """Put the physics back into the state it had, so that the bare steps start where the full ticks do."""
    kept = physics.snapshot()
    yield
    physics.restore(kept)


def tick_times(
    worlds: int, engine: str, rate: PhysicsRate, rounds: int, checkpoint: str | None = None, count: int = 25
) -> list[tuple[float, float]]:
    """Measure both in turn, round by round.

    Args:
        worlds: Worlds of the football scene.
        engine: ``mujoco`` or ``warp``.
        rate: Rate of the physics.
        checkpoint: Weights of TWIST2; those of the package when None.

    Returns:
        Per round: seconds of a full tick, seconds of the solver's steps of a tick.
    """
    tracker = trackers.get("twist2", checkpoint)
    tracker.physics_rate = rate
    env = ArenaEnv("football", worlds=worlds, tracker=tracker, engine=engine)
    env.reset(list(range(worlds)))
    action = torch.tensor(STAND_ACTION, device=env.torch_device).repeat(worlds, 1)
    status = np.zeros(worlds, dtype=np.int32)

    def ticks(number: int) -> None:
        for _ in range(number):
            env.observe()
            status[:] = env.step(action)

    def bare(number: int) -> None:
        for _ in range(number):
            env.physics.mj_step_only()

    ticks(env.startup_ticks + 10)
    with as_before(env.physics):
        bare(2)
    pairs = []
    for _ in range(rounds):
        with as_before(env.physics):
            alone = seconds_of(partial(bare, count)) / count
        pairs.append((seconds_of(partial(ticks, count)) / count, alone))
        ended = np.flatnonzero(status)
        if len(ended):  # as in an evaluation, a world that ended starts its next episode
            env.reset([int(w) for w in ended], ended)
    return pairs


def _medians(worlds: int, engine: str, rate: str, rounds: int, checkpoint: str | None) -> tuple[float, float, str]:
    """Median seconds of a full tick and of its bare physics, and both as text."""
    pairs = tick_times(worlds, engine, RATES[rate], rounds, checkpoint)
    full, alone = (statistics.median(column) for column in zip(*pairs, strict=True))
    return full, alone, f"{1e3 * full:.2f} ms / {1e3 * alone:.2f} ms"


def tick_figures(worlds: int, rounds: int, checkpoint: str | None) -> Iterator[BenchFigure]:
    """Time of a tick as a multiple of its bare physics, on the CPU."""
    for rate, bar in (("1 ms x 20", 1.3), ("5 ms x 4", 2.0)):
        full, alone, times = _medians(worlds, "mujoco", rate, rounds, checkpoint)
        name = f"tick / bare mj_step, engine mujoco, {worlds} worlds, {rate}"
        yield BenchFigure(name, bar, "x", True, full / alone, times)


def throughput_figures(worlds: int, rounds: int, checkpoint: str | None) -> Iterator[BenchFigure]:
    """Time of a tick as a multiple of the bare solver's, and world-ticks per second, on CUDA."""
    ratio = f"tick / bare solver graph, engine warp, {worlds} worlds, "
    rate = f"world-ticks, engine warp, {worlds} worlds, football, dex3, "
    if not wp.is_cuda_available():
        yield BenchFigure(ratio + "5 ms x 4", 1.4, "x", True, None, NEEDS_CUDA)
        yield BenchFigure(rate + "5 ms x 4", 250_000, "world-ticks/s", False, None, NEEDS_CUDA)
        return
    for physics in ("5 ms x 4", "1 ms x 20"):
        full, alone, times = _medians(worlds, "warp", physics, rounds, checkpoint)
        yield BenchFigure(ratio + physics, 1.4, "x", True, full / alone, times)
        if physics == "5 ms x 4":
            yield BenchFigure(rate + physics, 250_000, "world-ticks/s", False, worlds / full)
