"""Seconds of a tick with tracker, of its bare physics, and of the tracker's network alone."""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch
import warp as wp

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.interfaces import Physics
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.robot.g1 import PhysicsRate
from arena_newton.trackers.front_end import NetworkTracker
from arena_newton.trackers.inference.blocks import BlockRunner

__all__ = ["RATES", "network_seconds", "tick_times"]

RATES = {"1 ms x 20": PhysicsRate(dt=0.001, substeps=20), "5 ms x 4": PhysicsRate(dt=0.005, substeps=4)}
"""The two rates of the physics at which ticks are measured, whatever rate the weights were trained at."""


@contextlib.contextmanager
def _as_before(physics: Physics) -> Iterator[None]:
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
        rounds: Rounds.
        checkpoint: Weights of TWIST2; those of the package when None.
        count: Ticks of a round.

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

    def sync() -> None:
        if env.device.is_cuda:
            wp.synchronize_device(env.device)

    def timed(work: Callable[[int], None]) -> float:
        sync()
        began = time.perf_counter()
        work(count)
        sync()
        return (time.perf_counter() - began) / count

    ticks(env.startup_ticks + 10)
    with _as_before(env.physics):
        bare(2)
    pairs = []
    for _ in range(rounds):
        with _as_before(env.physics):
            alone = timed(bare)
        pairs.append((timed(ticks), alone))
        ended = np.flatnonzero(status)
        if len(ended):  # as in an evaluation, a world that ended starts its next episode
            env.reset([int(w) for w in ended], ended)
    return pairs


def network_seconds(checkpoint: str | None = None, rounds: int = 20, count: int = 100) -> float:
    """Median time of TWIST2's network for one world on the CPU, as it runs in a tick, without its observation [s].

    No tick takes less than this and its physics.

    Args:
        checkpoint: Weights of TWIST2; those of the package when None.
        rounds: Rounds, of which the median is taken.
        count: Runs of a round.
    """
    tracker = trackers.get("twist2", checkpoint)
    assert isinstance(tracker, NetworkTracker)
    runner = BlockRunner(tracker.network, tracker.front_end.obs_width, 1)
    runner.input.normal_(generator=torch.Generator().manual_seed(0))
    for _ in range(count):  # the first run compiles
        runner.run()
    measured = []
    for _ in range(rounds):
        began = time.perf_counter()
        for _ in range(count):
            runner.run()
        measured.append((time.perf_counter() - began) / count)
    return statistics.median(measured)
