"""Gradients for torch: exact ones of kernels, engine `mujoco` and a ball's flight, estimated ones of the closed loop.

`docs/howto/program/gradients.md` says what is exact, what is estimated and what has no gradient.
"""

from arena_newton.differentiable.closed_loop import Rolled, closed_loop, reset_state
from arena_newton.differentiable.engine_step import EngineState, EngineStep
from arena_newton.differentiable.estimates import (
    Differences,
    Played,
    Reach,
    central_differences,
    cross_entropy,
    play,
    reach,
)
from arena_newton.differentiable.identification import Fit, Recorded, Windows
from arena_newton.differentiable.kernel_gradients import ReferenceState, reference_step, success_margin
from arena_newton.differentiable.rolling_ball import RollingBall, ball_flight
from arena_newton.differentiable.soft_onset import soft_onset

__all__ = [
    "Differences",
    "EngineState",
    "EngineStep",
    "Fit",
    "Played",
    "Reach",
    "Recorded",
    "ReferenceState",
    "Rolled",
    "RollingBall",
    "Windows",
    "ball_flight",
    "central_differences",
    "closed_loop",
    "cross_entropy",
    "play",
    "reach",
    "reference_step",
    "reset_state",
    "soft_onset",
    "success_margin",
]
