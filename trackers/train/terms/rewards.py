"""Reward terms: one function per term, all listed with their weights in `REWARDS`.

Weights are per second of simulated time; the environment multiplies them by the tick. A term with a scale s is the
closeness exp(-e² / s²) of a squared error e², so that its weight is what perfect tracking of its quantity earns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

from arena_newton.errors import InputError
from arena_newton.trackers.motions.kinematics import SOLE_HEIGHT
from arena_newton.trackers.train.references import FEET
from arena_newton.trackers.train.terms.measurement import TickMeasurement

__all__ = ["REWARDS", "TERMINATION_REWARD", "Term", "configured", "maximum"]

TERMINATION_REWARD = -3.0
"""Reward of an episode's early end, once."""
LEGS = slice(0, 12)
"""The legs among the joints, MuJoCo order."""
_CONTACT_HEIGHT = SOLE_HEIGHT + 0.01
"""A foot whose frame is lower than this is on the ground [m]."""
_SOFT_RANGE = 0.95
"""Fraction of a joint's range that costs nothing."""


@dataclass(frozen=True)
class Term:
    """One reward term."""

    function: Callable[[TickMeasurement], torch.Tensor]
    """Maps the tick to values, or to squared errors where there is a scale, shape [worlds]."""
    weight: float
    """Reward per second for a value of 1."""
    scale: float | None = None
    """Error whose closeness is 1/e, in the error's unit; without one the function's value counts as it is."""

    def value(self, m: TickMeasurement) -> torch.Tensor:
        """Values of a tick, shape [worlds]."""
        value = self.function(m)
        return value if self.scale is None else torch.exp(-value / self.scale**2)


def joint_position(m: TickMeasurement) -> torch.Tensor:
    """Mean squared error of the joint angles [rad²]."""
    return (m.state.joint_pos - m.reference.joint_pos).square().mean(1)


def joint_velocity(m: TickMeasurement) -> torch.Tensor:
    """Mean squared error of the joint velocities [rad²/s²]."""
    return (m.state.joint_vel - m.reference.joint_vel).square().mean(1)


def key_links(m: TickMeasurement) -> torch.Tensor:
    """Mean squared distance of the nine key links in the heading frame [m²]."""
    return (m.keys - m.reference.keys).square().sum(2).mean(1)


def velocity(m: TickMeasurement) -> torch.Tensor:
    """Squared error of the planar root velocity [m²/s²]."""
    return m.velocity_error[:, :2].square().sum(1)


def yaw_rate(m: TickMeasurement) -> torch.Tensor:
    """Squared error of the yaw rate [rad²/s²]."""
    return m.yaw_rate_error.square()


def heading(m: TickMeasurement) -> torch.Tensor:
    """Squared error of the heading [rad²]."""
    return m.heading_error.square()


def tilt(m: TickMeasurement) -> torch.Tensor:
    """Squared error of the pelvis' tilt [rad²]."""
    return m.tilt_error.square()


def height(m: TickMeasurement) -> torch.Tensor:
    """Squared error of the pelvis' height [m²]."""
    return m.position_error[:, 2].square()


def position(m: TickMeasurement) -> torch.Tensor:
    """Squared error of the root's position on the ground [m²]."""
    return m.position_error[:, :2].square().sum(1)


def foot_height(m: TickMeasurement) -> torch.Tensor:
    """Mean squared error of the feet's heights [m²]."""
    return (m.keys[:, FEET, 2] - m.reference.keys[:, FEET, 2]).square().mean(1)


def legs(m: TickMeasurement) -> torch.Tensor:
    """Mean squared error of the legs' joint angles [rad²]: a mean over all joints hides them among the arms."""
    return (m.state.joint_pos - m.reference.joint_pos)[:, LEGS].square().mean(1)


def feet(m: TickMeasurement) -> torch.Tensor:
    """Mean squared distance of the feet in the heading frame [m²].

    Among nine links a foot that stays on the ground through a short kick costs next to nothing.
    """
    return (m.keys[:, FEET] - m.reference.keys[:, FEET]).square().sum(2).mean(1)


def alive(m: TickMeasurement) -> torch.Tensor:
    """One per tick."""
    return torch.ones_like(m.heading)


def action_rate(m: TickMeasurement) -> torch.Tensor:
    """Sum of squared changes of the raw action."""
    return (m.action - m.last_action).square().sum(1)


def foot_slip(m: TickMeasurement) -> torch.Tensor:
    """Horizontal speed of feet on the ground [m/s]."""
    grounded = (m.keys[:, FEET, 2] < _CONTACT_HEIGHT).float()
    return (grounded * m.foot_vel[..., :2].norm(dim=2)).sum(1)


def torque(m: TickMeasurement) -> torch.Tensor:
    """Sum of squared torques [N²m²]."""
    return m.state.torque.square().sum(1)


def acceleration(m: TickMeasurement) -> torch.Tensor:
    """Sum of squared joint accelerations [rad²/s⁴]."""
    return m.state.joint_acc.square().sum(1).clamp_max(1e8)


def joint_limit(m: TickMeasurement) -> torch.Tensor:
    """Sum of excursions beyond `_SOFT_RANGE` of the joint ranges [rad]."""
    bounds = m.state.joint_range
    centre, half = bounds.mean(1), 0.5 * _SOFT_RANGE * (bounds[:, 1] - bounds[:, 0])
    return ((m.state.joint_pos - centre).abs() - half).clamp_min(0.0).sum(1)


REWARDS: dict[str, Term] = {
    "joint_position": Term(joint_position, 1.5, scale=0.2),
    "joint_velocity": Term(joint_velocity, 0.3, scale=2.0),
    "key_links": Term(key_links, 1.5, scale=0.1),
    "velocity": Term(velocity, 1.5, scale=0.25),
    "yaw_rate": Term(yaw_rate, 0.5, scale=0.5),
    "heading": Term(heading, 0.5, scale=0.35),
    "tilt": Term(tilt, 1.0, scale=0.15),
    "height": Term(height, 1.0, scale=0.05),
    "position": Term(position, 0.75, scale=0.25),
    "foot_height": Term(foot_height, 0.6, scale=0.04),
    "legs": Term(legs, 1.5, scale=0.08),
    "feet": Term(feet, 1.5, scale=0.08),
    "alive": Term(alive, 0.5),
    "action_rate": Term(action_rate, -0.03),
    "foot_slip": Term(foot_slip, -0.15),
    "torque": Term(torque, -1e-5),
    "acceleration": Term(acceleration, -4e-8),
    "joint_limit": Term(joint_limit, -5.0),
}


def configured(weights: Mapping[str, float], scales: Mapping[str, float]) -> dict[str, Term]:
    """`REWARDS` with other weights and scales, by term.

    Raises:
        InputError: A term is unknown, or has no scale.
    """
    for flag, given, known in (
        ("--rewards", weights, list(REWARDS)),
        ("--reward-scales", scales, [name for name, term in REWARDS.items() if term.scale is not None]),
    ):
        if unknown := sorted(set(given) - set(known)):
            raise InputError(f"{flag} {unknown[0]}: no such term; known are {', '.join(known)}")
    return {
        name: dataclasses.replace(term, weight=weights.get(name, term.weight), scale=scales.get(name, term.scale))
        for name, term in REWARDS.items()
    }


def maximum(rewards: Mapping[str, Term]) -> float:
    """Reward per second of perfect tracking without penalties."""
    return sum(term.weight for term in rewards.values() if term.weight > 0.0)
