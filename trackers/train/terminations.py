"""When an episode ends early: one function a term, all listed with their bounds in `TERMINATIONS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from arena_newton.trackers.train.motion import Motion

__all__ = ["TERMINATIONS", "Bound"]


@dataclass(frozen=True)
class Bound:
    """One termination term."""

    value: Callable[[Motion], torch.Tensor]
    """Maps the tick to non-negative values, shape [worlds]."""
    limit: float
    """The episode ends when the value exceeds this."""


def height(m: Motion) -> torch.Tensor:
    """Error of the pelvis' height [m]."""
    return m.position_error[:, 2].abs()


def tilt(m: Motion) -> torch.Tensor:
    """Error of the pelvis' tilt [rad]."""
    return m.tilt_error


def position(m: Motion) -> torch.Tensor:
    """Error of the root's place on the ground [m]."""
    return m.position_error[:, :2].norm(dim=1)


def heading(m: Motion) -> torch.Tensor:
    """Error of the heading [rad]."""
    return m.heading_error.abs()


def nonfinite(m: Motion) -> torch.Tensor:
    """1 where the physics state is not finite."""
    return (~m.finite).float()


TERMINATIONS: dict[str, Bound] = {
    "height": Bound(height, 0.25),
    "tilt": Bound(tilt, 0.8),
    "position": Bound(position, 1.0),
    "heading": Bound(heading, 1.0),
    "nonfinite": Bound(nonfinite, 0.5),
}
