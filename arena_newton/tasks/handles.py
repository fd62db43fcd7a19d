"""Handles of a built scene: poses fixed to bodies, boxes that rules read, addresses of robot and latch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["ROBOT", "BodyFrame", "Latch", "Marker", "RobotHandles"]

ROBOT = "/World/Robot"
"""Prim of the robot in every scene."""


@dataclass(frozen=True)
class BodyFrame:
    """A pose fixed to a MuJoCo body (body 0 is the world)."""

    body_id: int
    """MuJoCo body index."""
    pos: tuple[float, float, float]
    """Position in the body's frame [m]."""
    quat: tuple[float, float, float, float]
    """Orientation in the body's frame, wxyz."""


@dataclass(frozen=True)
class Marker(BodyFrame):
    """An oriented box that a rule reads."""

    half: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Half extents [m]."""
    round: bool = False
    """It marks the upright cylinder inscribed in the box (`arena:round`), for rules that tell the two apart."""


@dataclass(frozen=True)
class Latch:
    """Latch that locks a door's leaf until its handle is pressed."""

    equality: int
    """MuJoCo equality constraint that holds the leaf while it is active."""
    handle_qpos: int
    """Address of the handle's hinge in qpos."""
    release_angle: float
    """The latch releases once the handle is at or below this angle [rad]."""


@dataclass(frozen=True)
class RobotHandles:
    """Addresses of the robot in the MuJoCo model."""

    root_body: int
    root_qpos: int
    """First of the 7 root coordinates in qpos."""
    root_qvel: int
    """First of the 6 root velocities in qvel."""
    joint_qpos: np.ndarray
    """int32 [29], MuJoCo (TWIST2) order."""
    joint_qvel: np.ndarray
    """int32 [29], MuJoCo (TWIST2) order."""
    joint_ctrl: np.ndarray
    """int32 [29], MuJoCo (TWIST2) order."""
    hand_qpos: np.ndarray
    """int32 [14] left then right, or empty with fixed hands."""
    hand_ctrl: np.ndarray
    """int32 [14] left then right, or empty with fixed hands."""
    bodies: tuple[int, ...] = ()
    """MuJoCo body ids of every link."""
    critical_bodies: tuple[int, ...] = ()
    """Links that count for the fall rule's contact test."""
    feet: tuple[int, ...] = ()
    """Links that carry the soles, left and right."""
