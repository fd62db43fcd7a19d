"""Measurement of one tick and its reference: the argument of reward, termination and critic terms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch

from arena_newton.errors import ArenaError
from arena_newton.robot import rotations
from arena_newton.robot.rotations import atan2
from arena_newton.trackers.train.references import Frame

if TYPE_CHECKING:
    from arena_newton.trackers.train.simulation import Simulation

__all__ = ["TickMeasurement", "TrainingError"]


class TrainingError(ArenaError):
    """Training cannot continue."""


@dataclass
class TickMeasurement:
    """The state of every world and its reference: lengths in metres, angles in radians, rows are worlds.

    A derived quantity is computed where a term first asks for it, and once: a new one is one property.
    """

    state: Simulation
    """The measured state: `root_pos`, `joint_pos`, `torque`, …; its views change with the next tick."""
    reference: Frame
    """Wanted state of the robot now."""
    foot_vel: torch.Tensor
    """World frame [m/s], zero on an episode's first tick, shape [worlds, 2, 3]."""
    action: torch.Tensor
    """Raw action of this tick, shape [worlds, 29]."""
    last_action: torch.Tensor
    """Raw action of the previous tick, shape [worlds, 29]."""
    since_push: torch.Tensor
    """Time since the last push [s], long for an episode without one, shape [worlds]."""

    @cached_property
    def finite(self) -> torch.Tensor:
        """True if the measured state is finite, bool, shape [worlds]."""
        return torch.isfinite(self.state.qpos).all(1) & torch.isfinite(self.state.qvel).all(1)

    @cached_property
    def heading(self) -> torch.Tensor:
        """Shape [worlds]."""
        return rotations.heading(self.state.root_quat)

    @cached_property
    def reference_heading(self) -> torch.Tensor:
        """Shape [worlds]."""
        return rotations.heading(self.reference.root_quat)

    @cached_property
    def heading_error(self) -> torch.Tensor:
        """Reference minus measured, wrapped, shape [worlds]."""
        return rotations.wrap_angle(self.reference_heading - self.heading)

    @cached_property
    def position_error(self) -> torch.Tensor:
        """Reference minus measured root position in the measured heading frame, shape [worlds, 3]."""
        return self.in_heading_frame(self.reference.root_pos - self.state.root_pos)

    @cached_property
    def velocity(self) -> torch.Tensor:
        """Root velocity in the measured heading frame [m/s], shape [worlds, 3]."""
        return self.in_heading_frame(self.state.root_vel)

    @cached_property
    def velocity_error(self) -> torch.Tensor:
        """Reference (in its own heading frame) minus measured, shape [worlds, 3]."""
        return rotations.turn(-self.reference_heading, self.reference.lin_vel) - self.velocity

    @cached_property
    def gravity(self) -> torch.Tensor:
        """Direction of gravity in the body's frame, shape [worlds, 3]."""
        return rotations.gravity_in_body(self.state.root_quat)

    @cached_property
    def reference_gravity(self) -> torch.Tensor:
        """Direction of gravity in the reference body's frame, shape [worlds, 3]."""
        return rotations.gravity_in_body(self.reference.root_quat)

    @cached_property
    def yaw_rate_error(self) -> torch.Tensor:
        """[rad/s], shape [worlds]."""
        asked, measured = self.reference.ang_vel * self.reference_gravity, self.state.root_ang_vel * self.gravity
        return -(asked.sum(1) - measured.sum(1))

    @cached_property
    def tilt_error(self) -> torch.Tensor:
        """Angle between the two vertical directions as the bodies see them, shape [worlds]."""
        sine = torch.linalg.cross(self.gravity, self.reference_gravity).norm(dim=1)
        return atan2(sine, (self.gravity * self.reference_gravity).sum(1))

    @cached_property
    def keys(self) -> torch.Tensor:
        """Key links in the measured heading frame on the ground below the pelvis, shape [worlds, links, 3]."""
        return self.in_heading_frame(self.state.key_links())

    def in_heading_frame(self, vector: torch.Tensor) -> torch.Tensor:
        """World vectors seen from the measured heading, shape [worlds, 3] or [worlds, n, 3]."""
        return rotations.turn(-self.heading if vector.dim() == 2 else -self.heading[:, None], vector)
