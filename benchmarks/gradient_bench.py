"""Exact slopes of engine `mujoco` next to finite differences: ticks and closed loops of the experts' episodes.

Beside them: a loop next to the episode that it replays, and how far slopes through a kick reach.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import cast

import mujoco
import numpy as np
import torch

from arena_newton import policies, tasks, trackers
from arena_newton.differentiable import Rolled, closed_loop, reach, reset_state, soft_onset
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.bench.timing import BenchFigure, Figures, chosen
from arena_newton.eval.certification.checks.gradients import Slopes, TickSlopes
from arena_newton.interfaces import Recorder, World
from arena_newton.physics.mujoco_engine import MujocoPhysics
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.g1 import TICK
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding
from benchmarks.bench_options import GradientBenchOptions
from benchmarks.featherstone_bench import featherstone_figures
from benchmarks.flight_bench import flight_figures

__all__ = ["slope_figures"]

BAR = 1e-5
"""Largest 1 - cosine between exact slopes and differences over all states."""
PARTS = ("positions", "velocities", "targets")
LOOKS = 5
"""Ticks of an episode from which states are taken."""
EVERY = 100
"""Ticks between two of them: from 1 s of the episode on, until 9 s; hands grip things by then."""


LOOPS = {10: 1e-3, 50: 1e-2, 200: 1e-2}
"""Lengths of closed loops [ticks], and the largest relative error of a slope at each."""
KICKS = ("football",)
"""Tasks of which a loop until the touch is measured, too."""
LONGEST = 600
"""Ticks of an episode, at most."""
TOUCHED = 0.1
"""Horizontal speed that tells a touch of what lies [m/s]."""
LONGEST_KICK = 400
"""Ticks within which the kick happens whose reach is measured."""
BEHIND = 25
"""Ticks from the kick to the ball's place that is differentiated."""
SPED = 50
"""Ticks before the touch in which the robot is sped up."""
REACH_SCALES = (1e-3, 1e-2)
"""Scales of the ball's start [m] and of the speed [m/s]."""
MOVED = ("its start x", "its start y", "the kick's speed")
REPLAY_BAR = 1e-4
"""Largest distance of a loop from the episode that it replays [m, rad]."""
TRANSITION_EVERY = 20
"""Ticks between two states at which MuJoCo's finite differences are compared."""
FACTORS = ("friction", "mass", "mass:/World/Robot/torso_link", "kp", "kd")
FACTOR_TICKS = 100
NUDGE = 1e-12
"""Standard deviation by which joints start elsewhere in an episode that the engine itself plays again [rad]."""


def slope_figures(options: GradientBenchOptions) -> Iterator[BenchFigure]:
    """Figures that `--what` names, by tracker and task; differences are those of a converged solver."""
    every = options.tasks or tasks.names()
    items: dict[str, Figures] = {
        "ticks": lambda: (
            _tick(task, tracker, options.states, options.step) for tracker in options.trackers for task in every
        ),
        "loops": lambda: (
            _loop(task, tracker, ticks, bar, factors, options.step)
            for tracker in options.trackers
            for task in options.loops
            for ticks, bar, factors in _lengths(task)
        ),
        "replay": lambda: (
            _replay(task, tracker, repeat)
            for tracker in options.trackers
            for task in options.loops
            for repeat in range(options.episodes)
        ),
        "reach": reach_figures,
        "flights": flight_figures,
        "transition": transition_figures,
        "featherstone": lambda: featherstone_figures(options.limit),
    }
    for figures in chosen(options.what, items).values():
        yield from figures()


def _lengths(task: str) -> Iterator[tuple[int | None, float, Sequence[str]]]:
    """Length of each closed loop, None until the touch, with its bar and its factors of the model."""
    yield from ((ticks, bar, ()) for ticks, bar in LOOPS.items())
    if task in KICKS:
        yield None, 1e-2, ()
    yield FACTOR_TICKS, 1e-2, FACTORS


def _world(task: str, tracker: str) -> ArenaEnv:
    follows = trackers.get(tracker)
    return ArenaEnv(task, tracker=follows, worlds=1, engine="mujoco", rules="released", fast_physics=True)


def _tick(task: str, tracker: str, states: int, step: float) -> BenchFigure:
    worlds = -(-states // LOOKS)
    gym_id = tasks.get(task).gym_id
    episodes = [SimpleNamespace(episode_seed=seeding.episode_seed(gym_id, 0, repeat)) for repeat in range(worlds)]
    looks = [TickSlopes(EVERY, steps) for steps in (step * torch.eye(len(PARTS), dtype=torch.float64)).tolist()]
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


def _loop(
    task: str, tracker: str, ticks: int | None, bar: float, factors: Sequence[str] = (), step: float = 1e-6
) -> BenchFigure:
    """Largest relative error of slopes of the pelvis' last position to actions, start and speeds, or to factors.

    Where central differences are off by more than the bar and slopes to either side differ by more, too, there is a
    kink within the step, and the nearer side counts; the note has all four numbers.
    """
    env = _world(task, tracker)
    for model in env.physics.models:
        model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 100, 100
    robot, seeds = env.scene.robot, [seeding.episode_seed(tasks.get(task).gym_id, 0, 0)]
    start, draws = reset_state(env, seeds), torch.Generator().manual_seed(0)
    with torch.no_grad():
        rolled = closed_loop(env, policies.get("expert"), seeds, LONGEST if ticks is None else ticks)
    length = "until the touch" if ticks is None else f"over {ticks} ticks"
    ticks = touch_of(env, rolled) - 1 if ticks is None else ticks
    actions = rolled.actions[:ticks].transpose(0, 1)
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
    errors, kinks = {}, ""
    for which, (part, direction) in directions.items():

        @torch.no_grad()
        def moved(way: float, part: int = part, direction: torch.Tensor = direction) -> float:
            return float(number(*(a + way * step * direction if k == part else a for k, a in enumerate(at))))

        slope, ends = float((gradients[part] * direction).sum()), [moved(side) for side in (1.0, -1.0)]
        estimated = (ends[0] - ends[1]) / (2.0 * step)
        errors[which] = _off(slope, estimated)
        if errors[which] > bar:
            sides = _one_sided(moved(0.0), [moved(0.5), moved(-0.5)], ends, step)
            kinks += f"; {which} central {errors[which]:.1e} ({estimated:+.6f}), exact {slope:+.6f}, "
            kinks += "one side {:+.6f}, other {:+.6f}".format(*sides)
            if _off(*sides) > bar:  # a kink: the function has two slopes there
                errors[which] = min(_off(slope, side) for side in sides)
    env.close()
    name = f"relative error {length}, {task} through {tracker}{', factors' if factors else ''}"
    note = f"{ticks} ticks; " + ", ".join(f"{which} {error:.0e}" for which, error in errors.items()) + kinks
    return BenchFigure(name, bar, "", True, max(errors.values()), note)


def _off(slope: float, estimated: float) -> float:
    """Relative error of a slope."""
    return abs(slope - estimated) / max(abs(estimated), 1e-9)


def _one_sided(here: float, halves: Sequence[float], ends: Sequence[float], step: float) -> list[float]:
    """Slopes ahead and behind to second order, from values at none, half and all of a step to either side."""
    return [
        side * (4.0 * half - end - 3.0 * here) / step for side, half, end in zip((1.0, -1.0), halves, ends, strict=True)
    ]


def touch_of(env: ArenaEnv, rolled: Rolled) -> int:
    """The tick after which the thing that lay moves, in the first world."""
    address = env.scene.joint_qvel(env.spec.target)
    moves = rolled.qvel[:, 0, address : address + 2].norm(dim=1) > TOUCHED
    if not moves.any():
        raise InputError(f"{env.spec.name}: the expert touches nothing within {len(moves) - 1} ticks")
    return int(moves.int().argmax())


class _Path(Recorder):
    """Positions and actions of the episode in the first world."""

    def __init__(self) -> None:
        self.qpos: list[np.ndarray] = []
        self.actions: list[torch.Tensor] = []

    def tick(self, env: World) -> None:
        if env.active[0] and env.tick[0] >= 0:
            world = cast("ArenaEnv", env)
            self.qpos.append(cast("MujocoPhysics", world.physics).data[0].qpos.copy())
            self.actions.append(world.loop.action[0].clone())


def _replay(task: str, tracker: str, repeat: int = 0) -> BenchFigure:
    """Largest distance of a closed loop from the expert's whole episode, whose actions it repeats.

    Beside it that of the engine's own ticks, from joints that start 1e-12 rad elsewhere: all but the engine rounds to
    float32 there, and a kick multiplies it.
    """
    env = _world(task, tracker)
    seed, path = seeding.episode_seed(tasks.get(task).gym_id, 0, repeat), _Path()
    episodes = [SimpleNamespace(episode_seed=seed)]
    Rollout(env, policies.get("expert"), episodes, recorder=path, max_steps=LONGEST).run()
    actions, recorded = torch.stack(path.actions), torch.from_numpy(np.stack(path.qpos))
    with torch.no_grad():
        rolled = closed_loop(env, actions.double()[None], [seed], len(actions))
    apart = (rolled.qpos[1:, 0] - recorded).abs()
    nudged = (_nudged(env, seed, actions) - recorded).abs()
    root = env.scene.robot.root_qpos
    note = f"episode {repeat}, {len(apart)} ticks; pelvis {float(apart[:, root : root + 3].max()):.0e} m"
    if task in KICKS:
        touch = touch_of(env, rolled) - 1
        note += f"; the ball, touched after {touch + 1}, "
        note += f"{float(apart[:, env.scene.joint_qpos(env.spec.target) :][:, :3].max()):.0e} m"
        note += f"; before the touch {float(apart[:touch].max()):.0e}"
    note += f"; the engine's own, nudged, {float(nudged.max()):.0e}"
    env.close()
    name = f"distance from the replayed episode, {task} through {tracker}"
    return BenchFigure(name, REPLAY_BAR, "m, rad", True, float(apart.max()), note)


def _nudged(env: ArenaEnv, seed: int, actions: torch.Tensor) -> torch.Tensor:
    """Positions after each tick of an episode that the environment itself plays, from joints that `NUDGE` moved."""
    env.reset([seed])
    data, joints = cast("MujocoPhysics", env.physics).data[0], env.scene.robot.joint_qpos
    data.qpos[joints] += NUDGE * np.random.default_rng(0).standard_normal(len(joints))
    for _ in range(env.startup_ticks):
        env.step(torch.from_numpy(STAND_ACTION)[None])
    env.observe()  # at step 0 the reference starts where the robot is
    rows = []
    for action in actions:
        env.step(action[None])
        rows.append(data.qpos.copy())
    env.release([0])
    return torch.from_numpy(np.stack(rows))


def reach_figures() -> Iterator[BenchFigure]:
    """Slopes of the ball's path behind a kick to where it starts and to the speed of the kick, beside differences.

    With contacts as they are, and with those of `soft_onset`; of these all three are to hold.
    """
    for soft in (False, True):
        env = _world("football", "twist2")
        seeds = [seeding.episode_seed(env.spec.gym_id, 0, 0)]
        with torch.no_grad():
            rolled = closed_loop(env, policies.get("expert"), seeds, LONGEST_KICK)
        touch = touch_of(env, rolled)
        actions = rolled.actions[: touch + BEHIND].transpose(0, 1)
        if soft:
            soft_onset(env, env.spec.target)
        yield _reach(env, seeds, actions, touch, soft)
        env.close()


def _reach(env: ArenaEnv, seeds: Sequence[int], actions: torch.Tensor, touch: int, soft: bool) -> BenchFigure:
    """Number of the slopes that hold."""
    start, ball = reset_state(env, seeds), env.scene.joint_qpos(env.spec.target)
    faster = torch.zeros_like(actions)
    faster[:, touch - SPED : touch, 0] = TICK

    def end(points: torch.Tensor) -> torch.Tensor:
        qpos = start.qpos.index_add(1, torch.tensor([ball, ball + 1]), points[:, :2])
        plan, moved = actions + points[0, 2] * faster, start._replace(qpos=qpos)
        rolled = closed_loop(env, plan, seeds, plan.shape[1], start=moved, checkpoint=25)
        return rolled.qpos[-1, :, ball + 1]

    at = torch.zeros(3, dtype=torch.float64)
    leaf = at.clone().requires_grad_()
    (slope,) = torch.autograd.grad(end(leaf[None])[0], leaf)
    found = reach(end, at, slope, REACH_SCALES, rows=1)
    rows = zip(MOVED, *(part.tolist() for part in found), strict=True)
    note = "; ".join(f"{name} {exact:+.2f} ({near:+.2f}, {far:+.2f})" for name, exact, near, far, _ in rows)
    name = f"slopes through a kick that hold over 1 cm, {'soft onset' if soft else 'contacts as they are'}"
    return BenchFigure(name, 3.0 if soft else None, "of 3", False, float(found.holds.sum()), note)


class _Transitions(Recorder):
    """Distances of `mjd_transitionFD` at states of an episode from itself with a converged solver."""

    def __init__(self) -> None:
        self.apart: list[float] = []

    def tick(self, env: World) -> None:
        if env.tick[0] < 0 or env.tick[0] % TRANSITION_EVERY != TRANSITION_EVERY - 1:
            return
        physics = cast("MujocoPhysics", cast("ArenaEnv", env).physics)
        found = []
        for converged in (False, True):
            model, data = copy.copy(physics.mj_model), copy.copy(physics.data[0])
            if converged:
                model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 100, 100
            found.append(np.empty((2 * model.nv, 2 * model.nv)))
            mujoco.mjd_transitionFD(model, data, 1e-6, True, found[-1], None, None, None)
        self.apart.append(float(np.linalg.norm(found[0] - found[1]) / np.linalg.norm(found[1])))


def transition_figures() -> Iterator[BenchFigure]:
    """Distance of MuJoCo's own finite differences of a step from those of a converged solver: the solver starts warm.

    Of the matrix from state to next state, as a part of its Frobenius norm, in Football's episode until the touch.
    """
    env, looks = _world("football", "twist2"), _Transitions()
    episodes = [SimpleNamespace(episode_seed=seeding.episode_seed(env.spec.gym_id, 0, 0))]
    Rollout(env, policies.get("expert"), episodes, recorder=looks, max_steps=LONGEST_KICK).run()
    columns = 2 * (2 * env.physics.mj_model.nv)
    env.close()
    note = f"median {np.median(looks.apart):.0e}, {len(looks.apart)} states; {columns} steps each"
    yield BenchFigure("mjd_transitionFD's distance from a converged solver's", None, "", True, max(looks.apart), note)
