"""Exact slopes of engine `mujoco` next to finite differences: ticks and closed loops of the experts' episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import SimpleNamespace

import torch

from arena_newton import policies, tasks, trackers
from arena_newton.differentiable import closed_loop, reset_state
from arena_newton.env import ArenaEnv
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.eval.certification.checks.gradients import TICK_STEPS, Slopes, TickSlopes
from arena_newton.robot.canonical import ACTION
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


LOOPS = {10: 1e-3, 50: 1e-2, 200: 1e-2}
"""Lengths of closed loops [ticks], and the largest relative error of a slope at each."""
FACTORS = ("friction", "mass", "mass:/World/Robot/torso_link", "kp", "kd")
FACTOR_TICKS = 100
STEP = 1e-6
"""Step of the differences of a closed loop."""


def slope_figures(options: GradientBenchOptions) -> Iterator[BenchFigure]:
    """Ticks by task and tracker, then closed loops of the experts, against differences of a converged solver."""
    for tracker in options.trackers:
        for task in options.tasks or tasks.names():
            yield _tick(task, tracker, options.states)
    for tracker in options.trackers:
        for task in options.loops:
            for ticks, bar in LOOPS.items():
                yield _loop(task, tracker, ticks, bar)
            yield _loop(task, tracker, FACTOR_TICKS, 1e-2, FACTORS)


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


def _loop(task: str, tracker: str, ticks: int, bar: float, factors: Sequence[str] = ()) -> BenchFigure:
    """Largest relative error of slopes of the pelvis' last position to actions, start and speeds, or to factors."""
    name = f"relative error over {ticks} ticks, {task} through {tracker}{', factors' if factors else ''}"
    env = ArenaEnv(task, tracker=trackers.get(tracker), worlds=1, engine="mujoco", rules="released", fast_physics=True)
    for model in env.physics.models:
        model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 100, 100
    robot, seeds = env.scene.robot, [seeding.episode_seed(tasks.get(task).gym_id, 0, 0)]
    start, draws = reset_state(env, seeds), torch.Generator().manual_seed(0)
    with torch.no_grad():
        actions = closed_loop(env, policies.get("expert"), seeds, ticks).actions.transpose(0, 1)
    weights = torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64)

    def number(actions: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor, given: torch.Tensor) -> torch.Tensor:
        moved = start._replace(qpos=qpos, qvel=qvel)
        rolled = closed_loop(env, actions, seeds, ticks, parameters=factors, factors=given, start=moved, checkpoint=25)
        return rolled.qpos[-1, 0, robot.root_qpos : robot.root_qpos + 3] @ weights

    at = [actions, start.qpos, start.qvel, torch.ones(1, len(factors), dtype=torch.float64)]
    leaves = [part.clone().requires_grad_() for part in at]
    gradients = torch.autograd.grad(number(*leaves), leaves, allow_unused=True)
    directions = {"actions": (0, torch.randn(actions.shape, generator=draws).double())}
    directions["actions"][1][..., ACTION["hands"]] = 0.0
    directions["start"] = 1, torch.zeros_like(start.qpos)
    directions["start"][1][:, robot.joint_qpos] = torch.randn(1, len(robot.joint_qpos), generator=draws).double()
    directions["speeds"] = 2, torch.randn(start.qvel.shape, generator=draws).double()
    if factors:
        directions = {one: (3, torch.eye(len(factors)).double()[k : k + 1]) for k, one in enumerate(factors)}
    errors = {}
    for which, (part, direction) in directions.items():
        with torch.no_grad():
            ends = [
                number(*(a + side * STEP * direction if k == part else a for k, a in enumerate(at)))
                for side in (1.0, -1.0)
            ]
        estimated = float(ends[0] - ends[1]) / (2.0 * STEP)
        slope = float((gradients[part] * direction).sum())
        errors[which] = abs(slope - estimated) / max(abs(estimated), 1e-9)
    env.close()
    note = ", ".join(f"{which} {error:.0e}" for which, error in errors.items())
    return BenchFigure(name, bar, "", True, max(errors.values()), note)
