"""Estimated gradients of the whole closed loop: tracker, contacts and rule included, by batched central differences.

They ask nothing of engine, tracker or policy. What has one number at its end can be played in twice as many worlds as
it has parameters, all from one episode seed: the worlds then differ by what was moved and by nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import torch
import warp as wp

from arena_newton.differentiable.kernel_gradients import ReferenceState
from arena_newton.errors import InputError
from arena_newton.kernels import tick as codes
from arena_newton.robot.canonical import STAND_ACTION

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv

__all__ = ["Differences", "Played", "Reach", "central_differences", "cross_entropy", "play", "reach"]


class Differences(NamedTuple):
    """A gradient estimated by differences, and what it is worth."""

    gradient: torch.Tensor
    """(f(x + h) − f(x − h)) / 2h for each parameter, shape of the parameters."""
    bend: torch.Tensor
    """Half the difference of the two one-sided slopes: how far the slope changes within the step. Where it is as
    large as the gradient there is a kink, a jump or chaos, and the gradient says nothing."""
    value: float
    """f(x)."""


def central_differences(
    function: Callable[[torch.Tensor], torch.Tensor], at: torch.Tensor, step: float | torch.Tensor, *, rows: int
) -> Differences:
    """Gradient of one number by central differences, in batches of equal size.

    Args:
        function: (points [rows, ...]) → values [rows]; every row must be judged alike, as worlds with the same seed.
        at: The parameters, any shape.
        step: How far each is moved to either side, one number or one per parameter.
        rows: Points that `function` takes at once, such as the worlds of an environment; the last batch is filled up
            with `at`.

    Raises:
        InputError: The function's answer has another shape.
    """
    flat = at.detach().flatten()
    count = flat.numel()
    steps = torch.as_tensor(step, dtype=flat.dtype, device=flat.device).expand(at.shape).flatten()
    shift = torch.diag(steps)
    points = torch.cat([flat[None], flat + shift, flat - shift])
    values = []
    for begin in range(0, len(points), rows):
        batch = points[begin : begin + rows]
        full = torch.cat([batch, flat.expand(rows - len(batch), -1)])
        with torch.no_grad():
            answer = function(full.reshape(rows, *at.shape))
        if answer.shape != (rows,):
            raise InputError(f"central_differences: values of shape {list(answer.shape)} for {rows} rows")
        values.append(answer[: len(batch)].to(torch.float64))
    value = torch.cat(values)
    ahead, behind = value[1 : 1 + count], value[1 + count :]
    width = 2.0 * steps.to(torch.float64)
    gradient, bend = (ahead - behind) / width, (ahead - 2.0 * value[0] + behind) / width
    return Differences(
        gradient.to(flat.dtype).reshape(at.shape), bend.abs().to(flat.dtype).reshape(at.shape), float(value[0])
    )


class Reach(NamedTuple):
    """A slope beside differences at two scales; all of the parameters' shape."""

    slope: torch.Tensor
    """The local slope that was given."""
    near: torch.Tensor
    """Central differences at the smaller scale."""
    far: torch.Tensor
    """Central differences at the larger scale."""
    holds: torch.Tensor
    """True where both differences agree with the slope: bool. Never where one is not finite, as where a world fell."""


def reach(
    function: Callable[[torch.Tensor], torch.Tensor],
    at: torch.Tensor,
    slope: torch.Tensor,
    scales: tuple[float | torch.Tensor, float | torch.Tensor],
    *,
    rows: int,
    tolerance: float = 0.25,
) -> Reach:
    """Differences at the scales of a decision beside an exact slope, which they may contradict.

    Through an impact a slope may be exact and mean nothing, because the outcome is a sawtooth of the moment of touch.

    Args:
        function: As `central_differences` takes it.
        at: The parameters at which the slope is.
        slope: The exact gradient, shape of the parameters.
        scales: Two steps to either side in the units of the parameters, as `central_differences` takes them.
        rows: Points that `function` takes at once.
        tolerance: Difference that is no contradiction, as a fraction of the larger of slope and difference.
    """
    near, far = (central_differences(function, at, scale, rows=rows).gradient for scale in scales)
    holds = torch.ones_like(slope, dtype=torch.bool)
    for one in (near, far):
        holds &= one.isfinite() & ((one - slope).abs() <= tolerance * torch.maximum(one.abs(), slope.abs()))
    return Reach(slope, near, far, holds)


def cross_entropy(
    function: Callable[[torch.Tensor], torch.Tensor], mean: torch.Tensor, width: torch.Tensor | float, *, draws: int
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Minimise one number without gradients by the cross-entropy method: what a descent along a gradient has to beat.

    Each generation is drawn from independent normal distributions, which then take mean and spread of its best sixth
    (Rubinstein, R. and Kroese, D. (2004): The Cross-Entropy Method).

    Args:
        function: (points [draws, ...]) → values [draws].
        mean: Mean of the first generation, any shape.
        width: Its standard deviation, one number or one per parameter.
        draws: Points of a generation.

    Yields:
        The mean of the best of a generation, and the values of all, without end.
    """
    while True:
        points = mean + width * torch.randn(draws, *mean.shape, dtype=mean.dtype, device=mean.device)
        with torch.no_grad():
            values = function(points)
        best = points[values.argsort()[: max(2, draws // 6)]]
        mean, width = best.mean(0), best.std(0)
        yield mean, values


class Played(NamedTuple):
    """Outcome of one sequence of actions per world."""

    margin: torch.Tensor
    """Margin to success after each tick [m], shape [ticks, worlds]; −inf from the tick on in which a world fell or
    failed."""
    start: ReferenceState
    """The reference at step 0, before the first action, with which `reference_step` repeats the conversion."""
    xpos: torch.Tensor
    """Positions of the bodies after each tick [m], shape [ticks, worlds, bodies, 3]."""
    xquat: torch.Tensor
    """Their orientations, wxyz, shape [ticks, worlds, bodies, 4]."""

    @property
    def best(self) -> torch.Tensor:
        """The largest margin that each world reached [m], shape [worlds].

        At least 0 is a success, if it lasted as long as the rule asks.
        """
        return self.margin.max(dim=0).values


def play(env: ArenaEnv, actions: torch.Tensor, *, seed: int) -> Played:
    """Plays a sequence of actions per world through tracker and physics, every world from the same episode seed.

    Args:
        env: The worlds; all of them start again, and stand still afterwards.
        actions: Canonical actions from step 0 on, shape [worlds, ticks, 40].
        seed: Episode seed.

    Raises:
        InputError: Another number of sequences than of worlds.
    """
    if actions.ndim != 3 or len(actions) != env.worlds:
        raise InputError(f"play: actions of shape {list(actions.shape)} for {env.worlds} worlds")
    actions = actions.detach().to(env.torch_device, torch.float32)
    env.reset([seed] * env.worlds)
    stand = actions.new_tensor(STAND_ACTION).expand(env.worlds, -1)
    for _ in range(env.startup_ticks):
        env.step(stand)
    env.observe()  # at step 0 the reference starts where the robot is
    start = ReferenceState.of(env.loop.reference)
    live = torch.ones(env.worlds, dtype=torch.bool, device=actions.device)
    rows: list[tuple[torch.Tensor, ...]] = []
    for tick in range(actions.shape[1]):
        status = torch.as_tensor(env.step(actions[:, tick]), device=actions.device)
        live = live & ((status == codes.RUNNING) | (status == codes.SUCCESS))
        arrays = env.judge.margin, env.physics.xpos, env.physics.xquat
        margin, *poses = (wp.to_torch(array, requires_grad=False).clone() for array in arrays)
        rows.append((torch.where(live, margin, -torch.inf), *poses))
    env.release(range(env.worlds))
    margin, xpos, xquat = (torch.stack(column) for column in zip(*rows, strict=True))
    return Played(margin, start, xpos, xquat)
