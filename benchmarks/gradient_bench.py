"""Exact slopes of engine `mujoco` next to finite differences: ticks in the experts' episodes."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import torch

from arena_newton import policies, tasks, trackers
from arena_newton.env import ArenaEnv
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.eval.certification.checks.gradients import TICK_STEPS, Slopes, TickSlopes
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding
from benchmarks.bench_options import GradientBenchOptions

__all__ = ["slope_figures"]

BAR = 1e-5
"""Largest 1 - cosine between exact slopes and differences over all states."""
PARTS = ("positions", "velocities", "targets")
LOOKS = 5
"""Ticks of an episode from which states are taken."""
EVERY = 30
"""Ticks between two of them: from 0.3 s of the episode on, until 2.7 s."""


def slope_figures(options: GradientBenchOptions) -> Iterator[BenchFigure]:
    """Angle between exact slopes of a tick and differences of a converged solver, by task and tracker."""
    for tracker in options.trackers:
        for task in options.tasks or tasks.names():
            yield _tick(task, tracker, options.states)


def _tick(task: str, tracker: str, states: int) -> BenchFigure:
    worlds = -(-states // LOOKS)
    gym_id = tasks.get(task).gym_id
    episodes = [SimpleNamespace(episode_seed=seeding.episode_seed(gym_id, 0, repeat)) for repeat in range(worlds)]
    looks = [TickSlopes(EVERY, steps) for steps in (torch.eye(len(PARTS)) * torch.tensor(TICK_STEPS)).tolist()]
    env = ArenaEnv(task, tracker=trackers.get(tracker), worlds=worlds, engine="mujoco", fast_physics=True)
    try:
        Rollout(env, policies.get("expert"), episodes, recorder=looks, max_steps=EVERY * LOOKS).run()
    finally:
        env.close()
    found = [look.slopes() for look in looks]
    apart = [_apart(slopes) for slopes in found]
    note = ", ".join(f"{part} {value:.0e}" for part, value in zip(PARTS, apart, strict=True))
    kinks = sum(int((~slopes.smooth).sum()) for slopes in found)
    name = f"1 - cosine of a tick's slopes, {task} through {tracker}"
    return BenchFigure(name, BAR, "", True, max(apart), f"{len(found[0].exact)} states; {note}; {kinks} at a kink")


def _apart(slopes: Slopes) -> float:
    """1 - cosine of the angle between exact and estimated slopes, those at a kink left out."""
    exact, estimated = (part[slopes.smooth].double() for part in (slopes.exact, slopes.estimated))
    return 1.0 - float(torch.nn.functional.cosine_similarity(exact, estimated, dim=0))
