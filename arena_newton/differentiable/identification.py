"""Identification of a robot: factors of a model and a latency, fitted to a recording by least squares in short windows.

A window starts from a measured state and replays the recorded targets in the engine, so that no tracker is needed and
no error grows. States are measured with noise, and 1 mm decides whether a foot touches; so each window's own start is
fitted too, next to the numbers of the model (multiple shooting without continuity; Bock, H. G. (1981): Numerical
treatment of inverse problems in chemical reaction kinetics). The steps are Levenberg and Marquardt's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch

from arena_newton.differentiable.engine_step import EngineState, EngineStep
from arena_newton.errors import InputError
from arena_newton.physics.batch import Physics

__all__ = ["FactorFit", "RobotRecording", "Windows"]

_OUTLIER = 3.0
"""Standard deviations from which on a residual counts linearly (Huber): one contact missed rules no fit."""
_ASTRAY = 1.3
"""Misfit of a window, in those of the middle one, from which on it is left out at the end: its start is in another
contact than the robot was. Noise alone moves the mean of a window's thousand squares by 5 %."""


class RobotRecording(NamedTuple):
    """A recording of a robot, float64."""

    qpos: torch.Tensor
    """Measured positions before each tick and after the last in MuJoCo's layout, shape [ticks + 1, nq]."""
    qvel: torch.Tensor
    """Measured velocities, shape [ticks + 1, nv]."""
    targets: torch.Tensor
    """Targets of the drives as they were sent [rad], shape [ticks, nu]."""
    noise: torch.Tensor
    """Standard deviations of the measurements, of nv tangent positions, then of nv velocities; inf where nothing was
    measured, shape [2 nv]."""


class FactorFit(NamedTuple):
    """A step of a fit."""

    numbers: torch.Tensor
    """Logarithms of the factors, then the latency [ticks], shape [parameters + 1]."""
    misfit: float
    """Square of the residuals per degree of freedom, each in its standard deviation: 1 where noise alone is left."""
    information: torch.Tensor
    """Fisher's information of the numbers before this step, without their spread: the roots of the diagonal of its
    inverse are the standard errors to expect, shape [parameters + 1, parameters + 1]."""

    moves: torch.Tensor
    """Tangent moves of the windows' starts from what was measured, shape [windows, 2 nv]."""
    kept: torch.Tensor
    """True for the windows that counted, shape [windows]."""


class Windows:
    """Short windows of a recording, one per world of a physics."""

    def __init__(
        self, physics: Physics, recorded: RobotRecording, parameters: Sequence[str], *, ticks: int = 10, first: int = 3
    ):
        """Cut the windows, one behind the other.

        Args:
            physics: Worlds of engine `mujoco` after a reset; they are read, never stepped.
            recorded: The recording.
            parameters: Factors of the model, named as those of `EngineStep`.
            ticks: Length of a window.
            first: Tick of the recording at which the first begins, and the longest latency.

        Raises:
            InputError: The recording is too short, or the engine or a parameter has no gradient.
        """
        worlds, model = physics.worlds, physics.mj_model
        if len(recorded.targets) < (needed := first + (ticks + 1) * worlds - 1) or first < 1:
            raise InputError(f"Windows: {len(recorded.targets)} ticks recorded, {needed} needed, and first at least 1")
        self._step, self._model, self._first = EngineStep(physics, parameters), model, first
        self._carried = self._step.state().carried
        self._begin = first + (ticks + 1) * torch.arange(worlds)
        self._seen = recorded.noise.isfinite().nonzero()[:, 0]
        self._recorded, self._ticks, self._scale = recorded, ticks, 1.0 / recorded.noise[self._seen]

    def residuals(self, numbers: torch.Tensor, moves: torch.Tensor | None = None) -> torch.Tensor:
        """Differences of the model from the measurements, in standard deviations, shape [windows, numbers of a window].

        Args:
            numbers: Logarithms of the factors, then the latency [ticks].
            moves: Tangent moves of the starts from what was measured, shape [windows, 2 nv].
        """
        return self._played(numbers, moves)[0]

    def misfit(self, numbers: torch.Tensor) -> float:
        """Loss that `fit` minimises, per number, with starts as measured: for a search without gradients."""
        return float(_loss(self.residuals(numbers)).mean())

    def fit(
        self, numbers: torch.Tensor, spread: torch.Tensor, *, iterations: int = 20, starts: bool = True
    ) -> Iterator[FactorFit]:
        """Fit until a step gains less than a thousandth.

        Starts that settled while the numbers were wrong may keep a contact that was none; where more than noise is
        left, they begin again as measured, and windows that stay astray are left out at the end.

        Args:
            numbers: Where to begin: logarithms of the factors, then the latency [ticks].
            spread: Standard deviations with which the true ones are expected about them, of the same shape.
            iterations: Most steps until then, and again afterwards.
            starts: Fit the windows' starts too, instead of taking them as measured.
        """
        best = None
        for best in self._descend(numbers, spread, iterations, starts):
            yield best
        if best is None or best.misfit < 1.1 or not starts:
            return
        moves = None
        for settled in self._descend(best.numbers, 1e-3 * spread, 4, starts):
            moves = settled.moves
        for later in self._descend(best.numbers, spread, iterations, starts, moves):
            if later.misfit < best.misfit:
                yield (best := later)
        own = _loss(self.residuals(best.numbers, best.moves)).mean(1)
        if (own > _ASTRAY * own.median()).any():
            kept = own <= _ASTRAY * own.median()
            yield from self._descend(best.numbers, spread, iterations, starts, best.moves, kept)

    def _descend(
        self,
        numbers: torch.Tensor,
        spread: torch.Tensor,
        iterations: int,
        starts: bool,
        moves: torch.Tensor | None = None,
        kept: torch.Tensor | None = None,
    ) -> Iterator[FactorFit]:
        guess, damping = numbers, 1.0
        kept = torch.ones(len(self._begin), dtype=torch.bool) if kept is None else kept
        moves = numbers.new_zeros(len(self._begin), 2 * self._model.nv) if moves is None else moves
        for _ in range(iterations):
            residual, by_start, by_number = self._played(numbers, moves, slopes=True)
            by_start = by_start if starts else by_start[..., :0]
            # Errors of the model count as noise: far from the truth the numbers' spread holds more.
            wide = spread * float(_loss(residual)[kept].mean().clamp_min(1.0)) ** -0.5
            prior, loss = (
                torch.diag(wide**-2),
                float(_loss(residual)[kept].sum() + ((numbers - guess) / wide).square().sum()),
            )
            weight = (_OUTLIER / residual.abs().clamp_min(_OUTLIER))[..., None]
            by_number = by_number * kept[:, None, None]
            own, mixed = by_start.mT @ (weight * by_start), by_start.mT @ (weight * by_number)
            by_own, full = by_start.mT @ (weight * residual[..., None]), (by_number.mT @ (weight * by_number)).sum(0)
            slope = (by_number.mT @ (weight * residual[..., None])).sum(0) + (prior @ (numbers - guess))[:, None]
            information = full - (mixed.mT @ torch.linalg.solve(own, mixed)).sum(0)
            while True:
                # The starts are eliminated window by window, the numbers solved for, the starts put in again.
                damped = own + damping * torch.diag_embed(own.diagonal(dim1=1, dim2=2))
                solved = torch.linalg.solve(damped, torch.cat([mixed, by_own], dim=2))
                matrix = (
                    full
                    + prior
                    + damping * torch.diag((full + prior).diagonal())
                    - (mixed.mT @ solved[..., :-1]).sum(0)
                )
                step = -torch.linalg.solve(matrix, slope - (mixed.mT @ solved[..., -1:]).sum(0))[:, 0].clamp(-0.5, 0.5)
                tried, moved = numbers + step, moves.clone()
                tried[-1].clamp_(0.0, self._first - 1e-6)
                if starts:
                    moved[:, self._seen] -= solved[..., -1] + solved[..., :-1] @ (tried - numbers)
                after = self.residuals(tried, moved)
                gained = loss - float(_loss(after)[kept].sum() + ((tried - guess) / wide).square().sum())
                if gained > 0.0 or damping > 1e4:
                    break
                damping *= 4.0
            if not gained > 0.0:
                return
            numbers, moves, damping = tried, moved, max(damping / 4.0, 1e-4)
            free = after[kept].numel() - len(numbers) - int(kept.sum()) * by_start.shape[2]
            yield FactorFit(numbers, float(_loss(after)[kept].sum()) / free, information, moves, kept)
            if gained < 1e-3 * loss:
                return

    def _played(
        self, numbers: torch.Tensor, moves: torch.Tensor | None, *, slopes: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Residuals, and their slopes to the starts that were measured and to the numbers."""
        nv, seen, scale, windows = self._model.nv, self._seen, self._scale[:, None], len(self._begin)
        qpos, qvel = self._recorded.qpos[self._begin], self._recorded.qvel[self._begin]
        if moves is not None:
            qpos, qvel = self._moved(qpos, moves[:, :nv]), qvel + moves[:, nv:]
        state, factors = EngineState(qpos, qvel, self._carried), numbers[:-1].exp().expand(windows, -1)
        by_start = torch.eye(2 * nv, dtype=torch.float64)[:, seen].repeat(windows, 1, 1)
        by_number, rows = numbers.new_zeros(windows, 2 * nv, len(numbers)), []
        whole = int(numbers[-1])
        for tick in range(self._ticks + 1):
            at = self._begin + tick
            apart = self._apart(self._recorded.qpos[at], state.qpos), state.qvel - self._recorded.qvel[at]
            part = torch.cat(apart, dim=1)[:, seen, None] * scale
            rows.append(
                (part[..., 0], by_start[:, seen] * scale, by_number[:, seen] * scale) if slopes else (part[..., 0],) * 3
            )
            if tick == self._ticks:
                break
            newer, older = (self._recorded.targets[at - whole - late] for late in (0, 1))
            targets = newer + (numbers[-1] - whole) * (older - newer)
            if slopes:
                by_state, by_targets, by_factors = self._step.jacobian(state, targets, factors)
                own = torch.cat([by_factors * factors[:, None], by_targets @ (older - newer)[..., None]], dim=2)
                by_start, by_number = by_state @ by_start, by_state @ by_number + own
            state = self._step(state, targets, factors)
        residual, by_start, by_number = (torch.cat(column, dim=1) for column in zip(*rows, strict=True))
        return residual, by_start, by_number

    def _moved(self, qpos: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
        found = qpos.clone()
        for row, move in zip(found.numpy(), moves.numpy(), strict=True):
            mujoco.mj_integratePos(self._model, row, move, 1.0)
        return found

    def _apart(self, measured: torch.Tensor, qpos: torch.Tensor) -> torch.Tensor:
        found = np.empty((len(qpos), self._model.nv))
        for row, one, other in zip(found, measured.numpy(), qpos.numpy(), strict=True):
            mujoco.mj_differentiatePos(self._model, row, 1.0, one, other)
        return torch.from_numpy(found)


def _loss(residuals: torch.Tensor) -> torch.Tensor:
    """Twice Huber's loss."""
    size = residuals.abs()
    return torch.where(size < _OUTLIER, size * size, 2.0 * _OUTLIER * size - _OUTLIER**2)
