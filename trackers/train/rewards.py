"""Reward terms: one function a term, all listed with their weights in `REWARDS`.

Weights are per second of simulated time; the environment multiplies them by the tick. Tracking terms are
exp(-e² / s²) of an error e, so that each weight is what perfect tracking of its quantity earns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from arena_newton.trackers.motions.kinematics import SOLE_HEIGHT
from arena_newton.trackers.train.motion import Motion
from arena_newton.trackers.train.references import FEET

__all__ = ["REWARDS", "TERMINATION_REWARD", "Term"]

TERMINATION_REWARD = -3.0
"""Reward of an episode's early end, once."""
LEGS = slice(0, 12)
"""The legs among the joints, MuJoCo order."""
_CONTACT_HEIGHT = SOLE_HEIGHT + 0.01
"""A foot whose frame is lower than this stands on the ground [m]."""


@dataclass(frozen=True)
class Term:
    """One reward term."""

    value: Callable[[Motion], torch.Tensor]
    """Maps the tick to values, shape [worlds]."""
    weight: float
    """Reward per second for a value of 1."""


def _closeness(square: torch.Tensor, scale: float) -> torch.Tensor:
    return torch.exp(-square / scale**2)


def joint_position(m: Motion) -> torch.Tensor:
    """Closeness of joint angles, RMS against 0.2 rad."""
    return _closeness((m.joint_pos - m.reference.joint_pos).square().mean(1), 0.2)


def joint_velocity(m: Motion) -> torch.Tensor:
    """Closeness of joint velocities, RMS against 2 rad/s."""
    return _closeness((m.joint_vel - m.reference.joint_vel).square().mean(1), 2.0)


def key_links(m: Motion) -> torch.Tensor:
    """Closeness of nine links in the heading frame, RMS distance against 0.1 m."""
    return _closeness((m.keys - m.reference.keys).square().sum(2).mean(1), 0.1)


def velocity(m: Motion) -> torch.Tensor:
    """Closeness of the planar root velocity, against 0.25 m/s."""
    return _closeness(m.velocity_error[:, :2].square().sum(1), 0.25)


def yaw_rate(m: Motion) -> torch.Tensor:
    """Closeness of the yaw rate, against 0.5 rad/s."""
    return _closeness(m.yaw_rate_error.square(), 0.5)


def heading(m: Motion) -> torch.Tensor:
    """Closeness of the heading, against 0.35 rad."""
    return _closeness(m.heading_error.square(), 0.35)


def tilt(m: Motion) -> torch.Tensor:
    """Closeness of the pelvis' tilt, against 0.15 rad."""
    return _closeness(m.tilt_error.square(), 0.15)


def height(m: Motion) -> torch.Tensor:
    """Closeness of the pelvis' height, against 0.05 m."""
    return _closeness(m.position_error[:, 2].square(), 0.05)


def position(m: Motion) -> torch.Tensor:
    """Closeness of the root's place on the ground, against 0.25 m."""
    return _closeness(m.position_error[:, :2].square().sum(1), 0.25)


def foot_height(m: Motion) -> torch.Tensor:
    """Closeness of the feet's heights, RMS against 0.04 m."""
    return _closeness((m.keys[:, FEET, 2] - m.reference.keys[:, FEET, 2]).square().mean(1), 0.04)


def legs(m: Motion) -> torch.Tensor:
    """Closeness of the legs' joint angles, RMS against 0.08 rad: a mean over all joints hides them among the arms."""
    return _closeness((m.joint_pos - m.reference.joint_pos)[:, LEGS].square().mean(1), 0.08)


def feet(m: Motion) -> torch.Tensor:
    """Closeness of the feet in the heading frame, RMS distance against 0.08 m.

    Among nine links a foot that stays on the ground through a short kick costs next to nothing.
    """
    return _closeness((m.keys[:, FEET] - m.reference.keys[:, FEET]).square().sum(2).mean(1), 0.08)


def alive(m: Motion) -> torch.Tensor:
    """One a tick."""
    return torch.ones_like(m.heading)


def action_rate(m: Motion) -> torch.Tensor:
    """Sum of squared changes of the raw action."""
    return (m.action - m.last_action).square().sum(1)


def foot_slip(m: Motion) -> torch.Tensor:
    """Horizontal speed of feet on the ground [m/s]."""
    grounded = (m.keys[:, FEET, 2] < _CONTACT_HEIGHT).float()
    return (grounded * m.foot_vel[..., :2].norm(dim=2)).sum(1)


def torque(m: Motion) -> torch.Tensor:
    """Sum of squared torques [N²m²]."""
    return m.torque.square().sum(1)


def acceleration(m: Motion) -> torch.Tensor:
    """Sum of squared joint accelerations [rad²/s⁴]."""
    return m.joint_acc.square().sum(1).clamp_max(1e8)


def joint_limit(m: Motion) -> torch.Tensor:
    """Sum of excursions beyond 95 % of the joint ranges [rad]."""
    centre, half = m.joint_range.mean(1), 0.475 * (m.joint_range[:, 1] - m.joint_range[:, 0])
    return ((m.joint_pos - centre).abs() - half).clamp_min(0.0).sum(1)


REWARDS: dict[str, Term] = {
    "joint_position": Term(joint_position, 1.5),
    "joint_velocity": Term(joint_velocity, 0.3),
    "key_links": Term(key_links, 1.5),
    "velocity": Term(velocity, 1.5),
    "yaw_rate": Term(yaw_rate, 0.5),
    "heading": Term(heading, 0.5),
    "tilt": Term(tilt, 1.0),
    "height": Term(height, 1.0),
    "position": Term(position, 0.75),
    "foot_height": Term(foot_height, 0.6),
    "legs": Term(legs, 1.5),
    "feet": Term(feet, 1.5),
    "alive": Term(alive, 0.5),
    "action_rate": Term(action_rate, -0.03),
    "foot_slip": Term(foot_slip, -0.15),
    "torque": Term(torque, -1e-5),
    "acceleration": Term(acceleration, -4e-8),
    "joint_limit": Term(joint_limit, -5.0),
}
