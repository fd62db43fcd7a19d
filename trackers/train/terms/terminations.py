"""Early endings of an episode: one function per term, all listed with their bounds in `TERMINATIONS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from arena_newton.trackers.train.references import FEET
from arena_newton.trackers.train.terms.measurement import TickMeasurement

__all__ = ["TERMINATIONS", "Bound"]

RECOVERY = 1.5
"""Time after a push in which the feet may leave their reference [s]."""


@dataclass(frozen=True)
class Bound:
    """One termination term."""

    value: Callable[[TickMeasurement], torch.Tensor]
    """Maps the tick to non-negative values, shape [worlds]."""
    limit: float
    """The episode ends when the value exceeds this."""


def height(m: TickMeasurement) -> torch.Tensor:
    """Error of the pelvis' height [m]."""
    return m.position_error[:, 2].abs()


def tilt(m: TickMeasurement) -> torch.Tensor:
    """Error of the pelvis' tilt [rad]."""
    return m.tilt_error


def position(m: TickMeasurement) -> torch.Tensor:
    """Error of the root's position on the ground [m]."""
    return m.position_error[:, :2].norm(dim=1)


def heading(m: TickMeasurement) -> torch.Tensor:
    """Error of the heading [rad]."""
    return m.heading_error.abs()


def feet(m: TickMeasurement) -> torch.Tensor:
    """Distance of the farther foot from its reference in the heading frame [m]; 0 while a push may ask for steps."""
    error = (m.keys[:, FEET] - m.reference.keys[:, FEET]).norm(dim=2).amax(1)
    return torch.where(m.since_push > RECOVERY, error, 0.0)


def nonfinite(m: TickMeasurement) -> torch.Tensor:
    """1 where the physics state is not finite."""
    return (~m.finite).float()


TERMINATIONS: dict[str, Bound] = {
    "height": Bound(height, 0.25),
    "tilt": Bound(tilt, 0.8),
    "position": Bound(position, 1.0),
    "heading": Bound(heading, 1.0),
    "feet": Bound(feet, 0.2),
    "nonfinite": Bound(nonfinite, 0.5),
}
