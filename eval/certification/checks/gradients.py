"""Are gradients that are called exact those that differences estimate? Conversion, ticks, margins, the ball.

A tick of engine `warp` has no exact gradient (`docs/howto/program/gradients.md`).
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
import torch
import warp as wp

from arena_newton import policies
from arena_newton.differentiable import (
    EngineState,
    EngineStep,
    ReferenceState,
    RollingBall,
    ball_flight,
    central_differences,
    reference_step,
)
from arena_newton.differentiable.kernel_gradients import recorded
from arena_newton.eval.certification.checks.traces import world_of
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding
from arena_newton.interfaces import Recorder, World
from arena_newton.pages.tables import Table, percent
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.rollout import Rollout
from arena_newton.tasks.judge import Judge

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv
    from arena_newton.files.stored_json import JsonObject
    from arena_newton.physics.batch import Physics

__all__ = ["CHECKS", "TOLERANCE", "Agreement", "Slopes", "TickSlopes", "agreement_of", "flight_slopes"]

TOLERANCE = 0.0025
"""An exact slope may differ from its estimate by so much of it, or of the root mean square of all if that is larger."""
KINK = TOLERANCE
"""Largest difference between slopes within the step and the estimate. Beyond it the function has a kink there, or is
smaller than float32 resolves: there is no one slope to compare with."""
COMPARABLE = 0.1
"""Least fraction of the slopes that is comparable. Feet abreast are a kink of VisNavi's margin, for example."""
MOVED = (0, 1, 2, 3, 4, 5, 6, 7, 8)
"""Numbers of the action to which the conversion is differentiated: planar displacement, height, rotation."""
TURNED = (0.01, -0.02, -0.01, 0.05, 0.05, -0.04, 0.03, 0.02, 0.06)
"""Differences from standing; the rotation is about none of the axes."""
HELD = 4
"""Ticks for which the action is held."""
ACTION_STEP = 2e-3
"""Step of the differences in the numbers of an action."""
POSE_STEP = 5e-4
"""Step in positions [m], quaternions, angles [rad] and velocities."""
EVERY = 20
"""Ticks between two looks at a margin."""
TICKS = (300, 1500)
"""Longest length of the episodes in which margins are looked at, under --quick and otherwise [ticks]."""
TICK_EVERY = 100
"""Ticks between two looks at a tick of engine `mujoco`."""
TICK_STEPS = (1e-7, 1e-7, 1e-7)
"""Steps of its differences in positions [m, rad], velocities [m/s, rad/s] and targets [rad]: a contact stiffens within
1 mm, and its kinks lie closer than 1e-6 to one state of some hundred. A converged solver resolves 1e-8."""
STATE = ("xpos", "xquat", "xipos", "qpos", "qvel")
"""Arrays of the physics in which a margin is differentiated."""
BALLS = 32
"""Balls whose flights are differentiated."""
FLIGHT = 40
"""Length of a flight [ticks]."""
KICK_STEP = 0.05
"""Step of the differences in a ball's start [m/s] and, a tenth of it, [m]."""
SPEEDS = (1.0, 6.0)
"""Horizontal speeds of the balls [m/s]."""
SEED = 20260717
WORLDS = 2 * len(MOVED) + 1
"""Worlds that one estimate takes."""


class Slopes(NamedTuple):
    """Slopes of one function at several points."""

    exact: torch.Tensor
    estimated: torch.Tensor
    spread: torch.Tensor
    """Distance of slopes within the step from the estimate."""

    @property
    def size(self) -> torch.Tensor:
        """Scale of a difference: the estimate, or the root mean square of all where that is larger."""
        return self.estimated.abs().clamp_min(float(self.estimated.square().mean().sqrt()))

    @property
    def smooth(self) -> torch.Tensor:
        """True where there is no kink and something to compare."""
        return (self.spread <= KINK * self.size) & (self.size > 0.0)


class Agreement(NamedTuple):
    """Distance of exact slopes from estimated ones."""

    compared: int
    total: int
    error: float
    """The largest difference, as a part of the estimate or of the root mean square of all."""

    @property
    def holds(self) -> bool:
        """True if enough could be compared and all agree."""
        return self.compared >= COMPARABLE * self.total and self.error <= TOLERANCE


def agreement_of(slopes: Slopes) -> Agreement:
    """Compare slopes; those at a kink are left out, and all of them where none is other than 0.

    Args:
        slopes: Shape [n] each.
    """
    slopes = Slopes(*(part.double() for part in slopes))
    error = ((slopes.exact - slopes.estimated).abs() / slopes.size)[slopes.smooth]
    return Agreement(len(error), len(slopes.exact), float(error.max()) if len(error) else 0.0)


def gradients(context: Context) -> CheckFinding:
    """Compare exact and estimated slopes of conversion, ticks and margins in each task, and of the ball's flight."""
    rows, wrong, worst = [], [], 0.0
    for tracker in context.sample:
        for task in context.tasks:
            measure = functools.partial(_measured, context, task, tracker)
            ticks = TICKS[not context.options.quick]
            found = context.measured("gradients", task, tracker, {"ticks": ticks}, measure)
            for what, numbers in found.items():
                one = Agreement(*cast("Sequence[float]", numbers))  # type: ignore[arg-type]  # counts come first
                counts = (str(one.compared), str(one.total - one.compared))
                rows.append((task, tracker, what, *counts, f"{100 * one.error:.2f}"))
                worst = max(worst, one.error)
                which = f"{task} through {tracker}, {what}"
                if not one.total:
                    wrong.append(f"{which}: no slope was measured")
                elif one.error > TOLERANCE:
                    wrong.append(f"{which}: an exact slope is {100 * one.error:.2f} % from the estimate")
                elif not one.holds:
                    wrong.append(f"{which}: only {one.compared} of {one.total} slopes can be compared")
    head = ("task", "tracker", "slope of", "compared", "at a kink", "largest difference [%]")
    compared, kinks = (sum(int(row[number]) for row in rows) for number in (3, 4))
    if not compared:
        wrong.append("no slope was compared")
    summary = f"{compared:,} exact slopes are at most {100 * worst:.2f} % from the estimates, {kinks:,} are at a kink"
    notes = (
        f"The tolerance is {100 * TOLERANCE:g} % of the estimate, or of the root mean square of all of the same kind. "
        "Estimates are central differences; those of the conversion are played through the closed loop.",
        "Where slopes within the step differ by more than that there is a kink, or too little slope for float32: "
        f"nothing is compared there, and {percent(1.0 - COMPARABLE, 0)} % of the slopes at most may be left out so.",
        "The engine's solver stops at a tolerance, now and then on the other side of a constraint's edge than a "
        "converged one, whose differences these are; `tick, converged solver` compares it with itself.",
    )
    sheet = Table(head, rows, title="Exact slopes and central differences")
    return CheckFinding("fail" if wrong else "pass", summary, (sheet,), (*wrong, *notes))


def _measured(context: Context, task: str, tracker: str) -> JsonObject:
    """Agreements by what is differentiated."""
    env = cast("ArenaEnv", world_of(context, task, tracker, worlds=WORLDS))
    seeds = context.seeds(task, WORLDS)
    try:
        found = {"conversion": _conversion(env, seeds[0])}
        looks: list[MarginSlopes | TickSlopes] = [MarginSlopes()]
        if env.physics.engine == "mujoco":
            looks += [TickSlopes(TICK_EVERY), TickSlopes(TICK_EVERY, converged=True)]
        episodes = [SimpleNamespace(episode_seed=seed) for seed in seeds]
        ticks = TICKS[not context.options.quick]
        Rollout(env, policies.get("expert"), episodes, recorder=looks, max_steps=ticks).run()
        found |= {look.of: look.slopes() for look in looks}
        if env.scene.ball_restitution is not None:
            found["ball's flight"] = flight_slopes(RollingBall.of(env.scene), env.torch_device)
    finally:
        env.close()
    return {what: list(agreement_of(slopes)) for what, slopes in found.items()}


def _conversion(env: ArenaEnv, seed: int) -> Slopes:
    """Slopes of the reference after some ticks of the closed loop, against the same by `reference_step`."""
    draws = torch.Generator().manual_seed(SEED)
    weights = [torch.randn(width, generator=draws).to(env.torch_device) for width in (3, 4)]
    stand = torch.tensor(STAND_ACTION, device=env.torch_device)
    moved = torch.tensor(MOVED, device=env.torch_device)
    at = stand[moved] + torch.tensor(TURNED, device=env.torch_device)
    starts: list[ReferenceState] = []

    def value(state: ReferenceState) -> torch.Tensor:
        return state.position @ weights[0] + state.quat @ weights[1]

    def ended(points: torch.Tensor) -> torch.Tensor:
        env.reset([seed] * env.worlds)
        for _ in range(env.startup_ticks):
            env.step(stand.repeat(env.worlds, 1))
        env.observe()  # at step 0 the reference starts where the robot is
        starts.append(ReferenceState.of(env.loop.reference))
        actions = stand.repeat(env.worlds, 1)
        actions[:, moved] = points
        for _ in range(HELD):
            env.step(actions)
        return value(ReferenceState.of(env.loop.reference))

    estimated = central_differences(ended, at, ACTION_STEP, rows=env.worlds)
    env.release(range(env.worlds))
    leaf, state = at.clone().requires_grad_(), ReferenceState(*(part[:1] for part in starts[0]))
    action = stand.index_put((moved,), leaf)[None]
    for _ in range(HELD):
        _, state = reference_step(action, state, max_root_delta_deg=env.tracker.max_root_delta_deg)
    (exact,) = torch.autograd.grad(value(state).sum(), leaf)
    return Slopes(exact, estimated.gradient, estimated.bend)


class MarginSlopes(Recorder):
    """Slopes of the judge's margin in the state of running episodes, each in one random direction of it."""

    of = "margin"

    def __init__(self) -> None:
        """Know no slope yet."""
        self._found: list[Slopes] = []
        self._ticks = 0
        self._draws = torch.Generator().manual_seed(SEED)

    def tick(self, env: World) -> None:
        """See `Recorder.tick`."""
        self._ticks += 1
        acting = env.active & (env.tick >= 0)
        if self._ticks % EVERY or not acting.any():
            return
        margin, state = _margin_of(cast("ArenaEnv", env))
        found = _directional(margin, state, [POSE_STEP] * len(state), self._draws)
        rows = torch.as_tensor(np.flatnonzero(acting), device=found.exact.device)
        self._found.append(Slopes(*(part[rows] for part in found)))

    def slopes(self) -> Slopes:
        """All of them."""
        return Slopes(*(torch.cat(parts) for parts in zip(*self._found, strict=True)))


class TickSlopes(Recorder):
    """Slopes of the next tick of engine `mujoco` along running episodes, each in a random direction.

    What is differentiated is a random sum of the positions and velocities after the tick. The estimates are those of a
    converged solver (`EngineStep`). The exact slopes are those of the engine's, which stops at a tolerance and so may
    stop on the other side of a kink, or of the converged one, too.
    """

    def __init__(self, every: int, steps: Sequence[float] = TICK_STEPS, *, converged: bool = False):
        """Know no slope yet.

        Args:
            every: Ticks between two looks.
            steps: Steps of the differences in positions, velocities and targets; what has step 0 stays.
            converged: Differentiate the converged solver exactly, too.
        """
        self.of = "tick, converged solver" if converged else "tick"
        self._every, self._steps, self._converged, self._looks = every, steps, converged, 0
        self._found: list[Slopes] = []
        self._draws = torch.Generator().manual_seed(SEED)
        self._pair: tuple[EngineStep, EngineStep] | None = None

    def tick(self, env: World) -> None:
        """See `Recorder.tick`."""
        acting = env.active & (env.tick > 0)
        self._looks += bool(acting.any())
        if not acting.any() or self._looks % self._every != self._every // 2:
            return
        physics = cast("ArenaEnv", env).physics
        if self._pair is None:
            self._pair = EngineStep(physics, converged=self._converged), EngineStep(physics, converged=True)
        exact, converged = self._pair
        state = exact.state()
        weights = [torch.randn(part.shape, generator=self._draws).double() for part in (state.qpos, state.qvel)]

        def number(qpos: torch.Tensor, qvel: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
            step = exact if qpos.requires_grad else converged
            after = step(EngineState(qpos, qvel, state.carried), targets)
            return (weights[0] * after.qpos).sum(dim=1) + 0.1 * (weights[1] * after.qvel).sum(dim=1)

        at = [state.qpos, state.qvel, torch.from_numpy(physics.ctrl.numpy().copy()).double()]
        found = _directional(number, at, self._steps, self._draws)
        self._found.append(Slopes(*(part[torch.from_numpy(acting)] for part in found)))

    def slopes(self) -> Slopes:
        """All of them; where a contact begins within the step, the estimate is a jump and is set to 0."""
        exact, estimated, spread = (torch.cat(parts) for parts in zip(*self._found, strict=True))
        return Slopes(exact, torch.where(spread > estimated.abs(), 0.0, estimated), spread)


def _margin_of(env: ArenaEnv) -> tuple[Callable[..., torch.Tensor], list[torch.Tensor]]:
    """The margin of the task's judge as a function of the physics' state, and that state."""
    judge, physics = env.judge, env.physics
    state = [wp.to_torch(getattr(physics, name), requires_grad=False).clone() for name in STATE]

    def function(*tensors: torch.Tensor) -> torch.Tensor:
        def record(*arrays: wp.array) -> tuple[wp.Tape, list[wp.array]]:
            own = _own(judge)
            tape = wp.Tape()
            with tape:
                own.decide(cast("Physics", _Displaced(physics, dict(zip(STATE, arrays, strict=True)))))
            return tape, [own.margin]

        return recorded(record, *tensors)[0]

    return function, state


def _own(judge: Judge) -> Judge:
    """A judge that decides as another one does, and writes into arrays of its own."""
    own = copy.copy(judge)
    for name, value in vars(judge).items():
        if isinstance(value, wp.array) and value.shape == (judge.worlds,):
            setattr(own, name, wp.clone(value, requires_grad=name == "margin"))
    return own


class _Displaced:
    """A physics of which some arrays are others."""

    def __init__(self, physics: Physics, arrays: dict[str, wp.array]):
        self._physics, self._arrays = physics, arrays

    def __getattr__(self, name: str) -> object:
        return self._arrays[name] if name in self._arrays else getattr(self._physics, name)


def flight_slopes(ball: RollingBall, device: torch.device) -> Slopes:
    """Slopes of where balls end that fly, slide and roll, in how they start; half of them begin in the air and stay.

    Args:
        ball: What they are.
    """
    draws = torch.Generator().manual_seed(SEED)
    angle = 2.0 * torch.pi * torch.rand(BALLS, generator=draws)
    speed = SPEEDS[0] + (SPEEDS[1] - SPEEDS[0]) * torch.rand(BALLS, generator=draws)
    high = (torch.arange(BALLS) % 2).bool()
    # From there none lands: it falls 3.2 m in the time.
    height = torch.where(high, 5.0, ball.radius)
    position = torch.stack([torch.zeros(BALLS), torch.zeros(BALLS), height], dim=1)
    velocity = torch.stack([speed * angle.cos(), speed * angle.sin(), torch.zeros(BALLS)], dim=1)
    weight = torch.randn(3, generator=draws)
    level = torch.where(high[:, None], torch.ones(3), torch.tensor([1.0, 1.0, 0.0]))  # the ground holds the others

    def end(position: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        return ball_flight(position, velocity, ball, ticks=FLIGHT)[-1] @ weight.to(device)

    start = [position.to(device), velocity.to(device)]
    return _directional(end, start, [0.1 * KICK_STEP, KICK_STEP], draws, level.to(device))


def _directional(
    function: Callable[..., torch.Tensor],
    at: Sequence[torch.Tensor],
    steps: Sequence[float],
    draws: torch.Generator,
    allowed: torch.Tensor | None = None,
) -> Slopes:
    """Slopes of one number per row along a random direction of its arguments.

    Args:
        function: (tensors [rows, ...]) → values [rows].
        at: Its arguments.
        steps: How far each is moved to either side.
        draws: Of the directions.
        allowed: Factors of the directions, 0 where an argument must not move; all 1 by default.
    """
    moves = [step * torch.randn(part.shape, generator=draws).to(part) for part, step in zip(at, steps, strict=True)]
    moves = moves if allowed is None else [move * allowed for move in moves]
    leaves = [part.clone().requires_grad_() for part in at]
    grads = torch.autograd.grad(function(*leaves).sum(), leaves)
    exact = sum((grad * move).flatten(1).double().sum(1) for grad, move in zip(grads, moves, strict=True))

    def moved(side: float) -> torch.Tensor:
        return function(*(part + side * move for part, move in zip(at, moves, strict=True))).detach().double()

    values = torch.stack([moved(side) for side in (-1.0, -0.5, 0.0, 0.5, 1.0)])
    estimated = (values[-1] - values[0]) / 2.0
    spread = (2.0 * values.diff(dim=0) - estimated).abs().max(dim=0).values
    return Slopes(torch.as_tensor(exact), estimated, spread)


CHECKS = (Check("gradients", "Are exact gradients those that differences estimate, where both exist?", gradients),)
"""This module's checks."""
