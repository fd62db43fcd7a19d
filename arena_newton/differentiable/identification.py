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
_ASTRAY = 3.5
"""Standard deviations of noise by which the misfit of a window is above the middle one's if its start is in another
contact than the robot was."""
_GAINS = (300.0, 10.0, 3.0, 0.1)
"""Least gains of a step of the four descents, in squares of a standard error."""


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
    surprise: float
    """Standard deviations by which noise alone has a smaller misfit; one above 2.5 tells a wrong minimum (or model)."""
    information: torch.Tensor
    """Fisher's information of the numbers before this step, with what was known of them at first: the roots of the
    diagonal of its inverse are the standard errors to expect, shape [parameters + 1, parameters + 1]."""
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
        """Fit the numbers with starts as measured, then both, until a step gains less than a third of a standard error.

        A start that settles while the numbers are wrong may keep a contact that was none, and no slope leads out of it.
        So a window that is astray begins again, as measured or where the window before it ended, whichever is nearer,
        and does not count while its start settles; then it counts again. What is still astray at the end is left out.

        Args:
            numbers: Where to begin: logarithms of the factors, then the latency [ticks].
            spread: Standard deviations with which the true ones are expected about them, of the same shape, or what an
                earlier fit knew of them, `FactorFit.information`.
            iterations: Most steps of each of four descents; the first is left out where an earlier fit is known.
            starts: Fit the windows' starts too, instead of taking them as measured.
        """
        prior, every = torch.diag(spread**-2) if spread.ndim == 1 else spread, [*enumerate(_GAINS)]
        moves = numbers.new_zeros(len(self._begin), 2 * self._model.nv)
        found = FactorFit(numbers, torch.inf, torch.inf, prior, moves, torch.ones(len(moves), dtype=torch.bool))
        for part, gain in every[spread.ndim - 1 :] if starts else [(0, _GAINS[-1])]:
            begun = self._sorted(found) if part > 0 else found
            for found in self._descend(begun, numbers, prior, iterations, gain, starts=part > 0):
                yield found

    def _sorted(self, found: FactorFit) -> FactorFit:
        """The fit with windows astray told from the others, and begun again."""
        losses, moves = _loss(self.residuals(found.numbers, found.moves)).mean(1), found.moves
        count = len(self._seen) * (self._ticks + 1)  # squares of noise have the variance 2
        kept = losses <= (1.0 + _ASTRAY * (2.0 / count) ** 0.5) * losses.median()
        for again in (torch.zeros_like(moves), self._onward(found)):
            other = _loss(self.residuals(found.numbers, again)).mean(1)
            nearer = ~kept & (other < losses)
            losses, moves = torch.where(nearer, other, losses), torch.where(nearer[:, None], again, moves)
        return found._replace(moves=moves, kept=kept)

    def _descend(
        self, begun: FactorFit, guess: torch.Tensor, prior: torch.Tensor, iterations: int, least: float, *, starts: bool
    ) -> Iterator[FactorFit]:
        """Steps from a fit on; those of windows that do not count settle their starts alone."""
        (numbers, *_, moves, kept), damping = begun, 1.0
        for _ in range(iterations):
            residual, by_start, by_number, _ = self._played(numbers, moves, slopes=True)
            by_start = by_start if starts else by_start[..., :0]
            # Errors of the model count as noise: far from the truth what was known of the numbers holds more.
            own_loss = _loss(residual)
            known = prior * float(own_loss[kept].mean().clamp_min(1.0))

            def loss_of(numbers: torch.Tensor, own: torch.Tensor, known: torch.Tensor = known) -> float:
                return float(own[kept].sum() + (numbers - guess) @ known @ (numbers - guess))

            weight = (_OUTLIER / residual.abs().clamp_min(_OUTLIER))[..., None]
            by_number = by_number * kept[:, None, None]
            own, mixed = by_start.mT @ (weight * by_start), by_start.mT @ (weight * by_number)
            by_own, full = by_start.mT @ (weight * residual[..., None]), (by_number.mT @ (weight * by_number)).sum(0)
            slope = (by_number.mT @ (weight * residual[..., None])).sum(0) + (known @ (numbers - guess))[:, None]
            information = prior + full - (mixed.mT @ torch.linalg.solve(own, mixed)).sum(0)
            while True:
                # The starts are eliminated window by window, the numbers solved for, the starts put in again.
                damped = own + damping * torch.diag_embed(own.diagonal(dim1=1, dim2=2))
                solved = torch.linalg.solve(damped, torch.cat([mixed, by_own], dim=2))
                matrix = full + known + damping * torch.diag((full + known).diagonal())
                matrix -= (mixed.mT @ solved[..., :-1]).sum(0)
                step = -torch.linalg.solve(matrix, slope - (mixed.mT @ solved[..., -1:]).sum(0))[:, 0].clamp(-0.5, 0.5)
                tried, moved = numbers + step, moves.clone()
                tried[-1].clamp_(0.0, self._first - 1e-6)
                if starts:
                    moved[:, self._seen] -= solved[..., -1] + solved[..., :-1] @ (tried - numbers)
                after = _loss(self.residuals(tried, moved))
                worse = ~kept & (after.sum(1) > own_loss.sum(1))
                moved[worse], after[worse] = moves[worse], own_loss[worse]
                gained = loss_of(numbers, own_loss) - loss_of(tried, after)
                if gained > 0.0 or damping > 1e4:
                    break
                damping *= 4.0
            settled = float((own_loss - after).sum(1)[~kept].sum())
            if not gained > 0.0:
                return
            numbers, moves, damping = tried, moved, max(damping / 4.0, 1e-4)
            free = after[kept].numel() - len(numbers) - int(kept.sum()) * by_start.shape[2]
            misfit = float(after[kept].sum()) / free
            surprise = (misfit - 1.0) * (free / 2.0) ** 0.5  # squares of noise have the variance 2
            yield FactorFit(numbers, misfit, surprise, information, moves, kept)
            if gained < least * max(misfit, 1.0) and settled <= 0.1 * float(own_loss[~kept].sum()):
                return

    def _onward(self, found: FactorFit) -> torch.Tensor:
        """Moves with which each window but the first begins where the one before it ended."""
        nv, moves = self._model.nv, torch.zeros_like(found.moves)
        ended, at = self._played(found.numbers, found.moves)[3], self._begin[1:]
        moves[1:, :nv] = self._apart(self._recorded.qpos[at], ended.qpos[:-1])
        moves[1:, nv:] = ended.qvel[:-1] - self._recorded.qvel[at]
        unseen = torch.ones(2 * nv, dtype=torch.bool).index_fill(0, self._seen, False)
        return moves.masked_fill(unseen, 0.0)

    def _played(
        self, numbers: torch.Tensor, moves: torch.Tensor | None, *, slopes: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, EngineState]:
        """Residuals, their slopes to the starts that were measured and to the numbers; where the next windows begin."""
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
            sent = (at - whole).clamp_max(len(self._recorded.targets) - 1)  # behind the last window nothing may be left
            newer, older = self._recorded.targets[sent], self._recorded.targets[sent - 1]
            targets = newer + (numbers[-1] - whole) * (older - newer)
            if slopes and tick < self._ticks:
                by_state, by_targets, by_factors = self._step.jacobian(state, targets, factors)
                own = torch.cat([by_factors * factors[:, None], by_targets @ (older - newer)[..., None]], dim=2)
                by_start, by_number = by_state @ by_start, by_state @ by_number + own
            state = self._step(state, targets, factors)
        residual, by_start, by_number = (torch.cat(column, dim=1) for column in zip(*rows, strict=True))
        return residual, by_start, by_number, state

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
