"""A tick of engine `mujoco` as a function of torch, contacts included."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import mujoco
import numpy as np
import torch

from arena_newton.differentiable.implicit import ImplicitWorld, Inputs, check, scaled
from arena_newton.errors import InputError
from arena_newton.physics.batch import Physics
from arena_newton.physics.mujoco_engine import MujocoPhysics

__all__ = ["EngineState", "EngineStep"]

_NAMES = ("qpos", "qvel", "carried", "targets", "factors")


class EngineState(NamedTuple):
    """State of all worlds between two ticks, on the CPU."""

    qpos: torch.Tensor
    """Positions in MuJoCo's layout, float64, shape [worlds, nq]."""
    qvel: torch.Tensor
    """Velocities, float64, shape [worlds, nv]."""
    carried: torch.Tensor
    """All else that a tick starts from, such as fixtures' poses, the latch and the solver's warm start: MuJoCo's
    `mjSTATE_INTEGRATION`, float64, shape [worlds, size]; constants."""


class EngineStep:
    """A tick of the worlds of engine `mujoco`, with exact gradients.

    Forward is the engine's own step, backward its implicit derivative (`implicit`). A gradient to `qpos` is tangent to
    its unit quaternions. Where the step has a kink, such as a contact's first touch, it is the slope on the side on
    which the engine was.
    """

    def __init__(self, physics: Physics, parameters: Sequence[str] = (), *, converged: bool = False):
        """Copy the models of the worlds.

        Args:
            physics: Worlds of engine `mujoco`; they are read, never stepped.
            parameters: Factors of the model that a tick takes: `mass` (with inertia), `friction`, `kp`, `kd` scale
                those of all bodies, geoms or drives, `mass:PRIM` and so on those at or under a prim, or under several
                with commas between them.
            converged: Let the solver go on until nothing changes, for finite differences: the engine's own stops at a
                tolerance, next to where it stopped in the tick before, and so ignores small changes.

        Raises:
            InputError: The engine, its model or a parameter is of a kind that has no gradient here.
        """
        if not isinstance(physics, MujocoPhysics):
            raise InputError(f"engine {physics.engine} has no gradient here: use engine mujoco")
        self._physics, self.parameters = physics, tuple(parameters)
        parts = [scaled(name, physics.scene) for name in self.parameters]
        models = list(physics.models) if len(physics.models) > 1 else [physics.mj_model] * physics.worlds
        for model in models:
            check(model)
        if converged:
            models = [copy.copy(model) for model in models]
            for model in models:
                model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 100, 100
        self._worlds = [ImplicitWorld(model, physics.scene, physics.rate.substeps, parts) for model in models]
        self._pool = ThreadPoolExecutor(physics.threads)

    def state(self) -> EngineState:
        """State of the physics as it is now.

        Raises:
            InputError: A force acts on a body from outside.
        """
        rows = self._physics.snapshot().state, self._physics.latch_locked.numpy()
        return EngineState(*self.stacked(lambda world, state, locked: world.read(state, bool(locked)), *rows))

    def __call__(self, state: EngineState, targets: torch.Tensor, factors: torch.Tensor | None = None) -> EngineState:
        """The state after a tick.

        Args:
            state: The state before: `state()`, or what an earlier tick gave.
            targets: Targets of the drives [rad], order of the actuators, shape [worlds, nu].
            factors: Factors of the model in the order of `parameters`, 1 = as built, shape [worlds, parameters].

        Raises:
            InputError: A tensor of another shape, or a factor that is not above 0.
        """
        if factors is None:
            factors = torch.ones(len(self._worlds), len(self.parameters))
        if (factors <= 0.0).any():
            raise InputError("EngineStep: a factor of the model is not above 0")
        given = (*state, targets, factors)
        model = self._physics.mj_model
        widths = model.nq, model.nv, state.carried.shape[-1], model.nu, len(self.parameters)
        for name, tensor, width in zip(_NAMES, given, widths, strict=True):
            if tensor.shape != (len(self._worlds), width):
                raise InputError(f"EngineStep: {name} of shape {list(tensor.shape)}, not {[len(self._worlds), width]}")
        return EngineState(*_Tick.apply(self, *(tensor.cpu().double() for tensor in given)))

    def jacobian(
        self, state: EngineState, targets: torch.Tensor, factors: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """All slopes of a tick, for little more than one gradient's time.

        Args:
            state: As a tick takes it.
            targets: As a tick takes them.
            factors: As a tick takes them.

        Returns:
            Slopes of the state after the tick to that before it, shape [worlds, 2 nv, 2 nv], to targets and to factors.
            A state here is its nv tangent positions, then its nv velocities.
        """
        by_state, by_targets, by_factors = self.stacked(ImplicitWorld.jacobian, _rows((*state, targets, factors)))
        return by_state, by_targets, by_factors

    @property
    def data(self) -> list[mujoco.MjData]:
        """MuJoCo's data of each world as the last tick forward left it, contact forces included."""
        return [world.data for world in self._worlds]

    def stacked(
        self, work: Callable[..., Sequence[np.ndarray]], *rows: Iterable[np.ndarray | Inputs]
    ) -> tuple[torch.Tensor, ...]:
        """Results of `work(world, *row)` of all worlds, on several threads, as rows of tensors."""
        found = list(self._pool.map(work, self._worlds, *rows))
        return tuple(torch.from_numpy(np.stack(column)) for column in zip(*found, strict=True))


class _Context(torch.autograd.function.FunctionCtx):
    step: EngineStep
    saved_tensors: tuple[torch.Tensor, ...]


class _Tick(torch.autograd.Function):
    """`ImplicitWorld.tick` of all worlds."""

    @staticmethod
    def forward(ctx: _Context, step: EngineStep, *given: torch.Tensor) -> tuple[torch.Tensor, ...]:
        ctx.step = step
        ctx.save_for_backward(*given)
        after = step.stacked(ImplicitWorld.tick, _rows(given))
        ctx.mark_non_differentiable(after[2])
        return after

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: _Context, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        at_qpos, at_qvel = (grad.numpy() for grad in grads[:2])
        return None, *ctx.step.stacked(ImplicitWorld.adjoint, _rows(ctx.saved_tensors), at_qpos, at_qvel)


def _rows(given: Sequence[torch.Tensor]) -> list[Inputs]:
    """Arguments of each world's tick."""
    return [Inputs(*row) for row in zip(*(tensor.detach().numpy() for tensor in given), strict=True)]
