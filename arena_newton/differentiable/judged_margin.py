"""Margin of an environment's own judge as a function of torch: the value is the judge's, backward is its kernel's."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from arena_newton.differentiable.engine_step import EngineState, EngineStep
from arena_newton.differentiable.implicit import ImplicitWorld

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv

__all__ = ["Judgement"]

_FORCES = ("contact_force", "pair_force", "latch_locked")
_STATE = ("qpos", "qvel", "xpos", "xquat")


class Judgement:
    """Margins of the worlds at a tick, and the forces that they depend on."""

    def __init__(self, env: ArenaEnv, live: np.ndarray):
        """Take what the judge has just found; worlds that are not `live` have the margin −inf."""
        self._physics, self._judge = env.physics, env.judge
        self._forces = {name: wp.clone(getattr(env.physics, name)) for name in _FORCES}
        margin = wp.to_torch(env.judge.margin, requires_grad=False).double()
        self.value = torch.where(torch.from_numpy(live), margin, -torch.inf)

    def margin(self, step: EngineStep, state: EngineState) -> torch.Tensor:
        """Margin of the state of that tick [m], float64, shape [worlds].

        Contact forces have no gradient: where a force decides, the slope is 0.
        """
        margin: torch.Tensor = _Margin.apply(self, step, *state)
        return margin

    def slopes(self, step: EngineStep, state: EngineState, grad: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradients to qpos and qvel from one to the margin."""
        rows = state.qpos.numpy(), state.carried.numpy()
        poses = step.stacked(ImplicitWorld.poses, *rows)
        physics, judge = copy.copy(self._physics), copy.copy(self._judge)
        arrays = [wp.from_torch(part.float(), requires_grad=True) for part in (state.qpos, state.qvel, *poses)]
        for name, array in (*zip(_STATE, arrays, strict=True), *self._forces.items()):
            setattr(physics, name, array)
        for name in ("margin", "success", "event"):
            setattr(judge, name, wp.zeros_like(getattr(judge, name), requires_grad=name == "margin"))
        counters = judge.counters[judge.predicates.shape[1] :]
        kept = [wp.clone(counter) for counter in counters]
        with wp.Tape() as tape:
            judge.decide(physics)
        tape.backward(grads={judge.margin: wp.from_torch(grad.float().contiguous())})
        for counter, before in zip(counters, kept, strict=True):
            wp.copy(counter, before)
        at_qpos, at_qvel, *at_poses = (wp.to_torch(array.grad).double() for array in arrays)
        (by_poses,) = step.stacked(ImplicitWorld.poses_adjoint, *rows, *(part.numpy() for part in at_poses))
        return at_qpos + by_poses, at_qvel


class _Context(torch.autograd.function.FunctionCtx):
    judgement: Judgement
    step: EngineStep
    saved_tensors: tuple[torch.Tensor, ...]


class _Margin(torch.autograd.Function):
    """`Judgement.margin`."""

    @staticmethod
    def forward(ctx: _Context, judgement: Judgement, step: EngineStep, *state: torch.Tensor) -> torch.Tensor:
        ctx.judgement, ctx.step = judgement, step
        ctx.save_for_backward(*state)
        return judgement.value

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: _Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        return None, None, *ctx.judgement.slopes(ctx.step, EngineState(*ctx.saved_tensors), grad), None
