"""What one tick measured, beside what the reference asked for: the arguments of reward and termination terms."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from arena_newton.trackers.train.references import Frame

__all__ = ["Motion"]


@dataclass
class Motion:
    """Measured motion of every world and its reference; lengths in metres, angles in radians, rows are worlds."""

    reference: Frame
    """Where the robot should be now."""
    root_pos: torch.Tensor
    """Shape [worlds, 3]."""
    heading: torch.Tensor
    """Shape [worlds]."""
    heading_error: torch.Tensor
    """Reference minus measured, wrapped, shape [worlds]."""
    position_error: torch.Tensor
    """Reference minus measured root position in the measured heading frame, shape [worlds, 3]."""
    velocity: torch.Tensor
    """Root velocity in the measured heading frame [m/s], shape [worlds, 3]."""
    velocity_error: torch.Tensor
    """Reference (in its own heading frame) minus measured, shape [worlds, 3]."""
    yaw_rate_error: torch.Tensor
    """[rad/s], shape [worlds]."""
    tilt_error: torch.Tensor
    """Angle between the two vertical directions as the bodies see them, shape [worlds]."""
    gravity: torch.Tensor
    """Direction of gravity in the body's frame, shape [worlds, 3]."""
    ang_vel: torch.Tensor
    """Body frame [rad/s], shape [worlds, 3]."""
    joint_pos: torch.Tensor
    """Shape [worlds, 29]."""
    joint_vel: torch.Tensor
    """Shape [worlds, 29]."""
    joint_acc: torch.Tensor
    """[rad/s²], shape [worlds, 29]."""
    torque: torch.Tensor
    """[N·m], shape [worlds, 29]."""
    joint_range: torch.Tensor
    """Lower and upper joint angle, shape [29, 2]."""
    keys: torch.Tensor
    """Key links in the measured heading frame on the ground below the pelvis, shape [worlds, links, 3]."""
    foot_vel: torch.Tensor
    """World frame [m/s], zero on an episode's first tick, shape [worlds, 2, 3]."""
    action: torch.Tensor
    """Raw action of this tick, shape [worlds, 29]."""
    last_action: torch.Tensor
    """Raw action of the tick before, shape [worlds, 29]."""
    since_push: torch.Tensor
    """Time since the last push [s], long for an episode without one, shape [worlds]."""
    finite: torch.Tensor
    """Whether the measured state is finite, bool, shape [worlds]."""
    first: torch.Tensor = field(repr=False)
    """Whether this is an episode's first tick, bool, shape [worlds]."""
