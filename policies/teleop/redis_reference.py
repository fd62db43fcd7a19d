"""Canonical actions of a sender's reference: TWIST2's mimic command, or a retargeted person's root and joints.

Displacements and headings count from the episode's first frame, as in the labels of the original's datasets. A sender
that jumps is limited: see `Limits`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import torch

from arena_newton.errors import InputError
from arena_newton.policies.teleop import redis_keys as keys
from arena_newton.robot.canonical import ACTION, MIMIC, MIMIC_WIDTH, STAND_ACTION
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, TICK
from arena_newton.robot.rotations import (
    heading,
    matrix_from_quat,
    quat_apply,
    quat_conjugate,
    quat_from_euler,
    quat_from_yaw,
    quat_multiply,
    rotation_vector,
)

__all__ = ["GmrReference", "Limits", "MimicReference", "Reference", "references"]

_CANONICAL = np.array(CANONICAL_TO_MUJOCO)


class Limits:
    """Largest change of a reference in one tick; a sender that jumps is then followed at these rates."""

    TURN = math.radians(26.0)
    """Turn of the root: what the original's SONIC scripts allow (its TWIST2 scripts allow any) [rad]."""
    STEP = 0.2
    """A longer displacement of the root is a new origin of the sender's and moves nothing: where the original's root
    diagnostics begin [m]."""
    JOINT = 20.0 * TICK
    """Turn of a joint: 20 rad/s, the speed of the robot's slowest motors [rad]."""
    HEIGHT = (0.1, 1.5)
    """Height of the root; a frame outside is refused [m]."""
    ANGLE = 2.0 * math.pi
    """Largest joint position; a frame beyond is refused [rad]."""


class Reference(ABC):
    """Turns the frames of one kind of sender into actions."""

    backend: ClassVar[str]
    """Name of the interface, a key of `redis_keys.BACKENDS`."""
    keys: ClassVar[tuple[str, ...]]
    """Keys of a frame, in the order in which `read` takes their values."""

    def __init__(self) -> None:
        """Begin an episode."""
        self.begin()

    def begin(self) -> None:
        """The next frame is the first of an episode."""
        self._action: np.ndarray | None = None
        self._quat = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        self.limited = ""
        """Parts of the last frame beyond `Limits`; empty: none."""

    @abstractmethod
    def read(self, values: list[bytes]) -> np.ndarray:
        """Numbers of a frame, float64.

        Raises:
            InputError: A value is missing or unfit; nothing of the frame is used.
        """

    @abstractmethod
    def _pose(self, frame: np.ndarray, new: bool) -> tuple[np.ndarray, float, torch.Tensor, np.ndarray]:
        """The reference at this tick.

        Returns:
            Displacement since the last tick [m], shape [2], in the frame of the root; height [m]; orientation in the
            episode's frame wxyz; joints [rad], canonical order.
        """

    def action(self, frame: np.ndarray, hands: np.ndarray | None, *, new: bool) -> np.ndarray:
        """The action of a tick.

        Args:
            frame: The newest frame, of `read`.
            hands: Closed hands, 0 or 1, shape [2]; None: as they were.
            new: Whether the frame came since the last tick.

        Returns:
            Canonical action, float32, shape [40].
        """
        first, self.limited = self._action is None, ""
        before = STAND_ACTION if self._action is None else self._action
        step, height, quat, joints = self._pose(frame, new)
        if not first:
            quat = self._turned(quat)
            was = before[ACTION["joint_pos"]]
            reached = np.clip(joints, was - Limits.JOINT, was + Limits.JOINT)
            if np.any(np.abs(reached - joints) > 1e-6):
                self.limited = "joints"
            joints = reached
        if np.linalg.norm(step) > Limits.STEP:
            self.limited, step = "position", np.zeros(2)
        action = np.empty_like(STAND_ACTION)
        action[ACTION["root_xy_delta"]] = 0.0 if first else step
        action[ACTION["root_z"]] = height
        action[ACTION["root_rot6d"]] = matrix_from_quat(quat)[:, :2].reshape(6).numpy()
        action[ACTION["joint_pos"]] = joints
        action[ACTION["hands"]] = before[ACTION["hands"]] if hands is None else hands
        self._action, self._quat = action, quat
        return action.copy()

    def _turned(self, quat: torch.Tensor) -> torch.Tensor:
        """The orientation, at most `Limits.TURN` away from the last one."""
        turn = rotation_vector(quat_multiply(quat_conjugate(self._quat), quat))
        angle = float(torch.linalg.vector_norm(turn))
        if angle <= Limits.TURN:
            return quat
        self.limited = "turn"
        half = 0.5 * Limits.TURN
        part = torch.cat([torch.tensor([math.cos(half)], dtype=turn.dtype), turn / angle * math.sin(half)])
        return quat_multiply(self._quat, part)


def _check(key: str, height: float, joints: np.ndarray) -> None:
    low, high = Limits.HEIGHT
    if not low <= height <= high:
        raise InputError(f"{key}: height {height:.3g} m, expected {low} to {high}")
    if np.abs(joints).max() > Limits.ANGLE:
        raise InputError(f"{key}: a joint at {np.abs(joints).max():.3g} rad, expected at most {Limits.ANGLE:.3g}")


class MimicReference(Reference):
    """TWIST2's 35 numbers: velocities are held for a tick of 20 ms, the heading is their integral."""

    backend = "twist2"
    keys = (keys.ACTION_BODY,)

    def begin(self) -> None:
        """See `Reference.begin`."""
        super().begin()
        self._yaw: float | None = None

    def read(self, values: list[bytes]) -> np.ndarray:
        """See `Reference.read`."""
        frame = keys.numbers(keys.ACTION_BODY, values[0], MIMIC_WIDTH)
        _check(keys.ACTION_BODY, float(frame[MIMIC["root_z"]][0]), frame[MIMIC["joint_pos"]])
        return frame

    def _pose(self, frame: np.ndarray, new: bool) -> tuple[np.ndarray, float, torch.Tensor, np.ndarray]:
        """See `Reference`; the first frame turns nothing."""
        turn = float(frame[MIMIC["yaw_rate"]][0]) * TICK
        if abs(turn) > Limits.TURN:
            self.limited, turn = "turn", math.copysign(Limits.TURN, turn)
        self._yaw = 0.0 if self._yaw is None else self._yaw + turn
        roll, pitch = frame[MIMIC["roll_pitch"]]
        quat = quat_from_euler(torch.tensor([self._yaw, pitch, roll], dtype=torch.float64))
        joints = frame[MIMIC["joint_pos"]][_CANONICAL]
        return frame[MIMIC["velocity_xy"]] * TICK, float(frame[MIMIC["root_z"]][0]), quat, joints


class GmrReference(Reference):
    """Root pose and joints of the retargeted person, as the original's SONIC takes them."""

    backend = "sonic_joint29"
    keys = (keys.GMR_BODY_POS, keys.GMR_BODY_QUAT, keys.GMR_JOINT_POS)

    def begin(self) -> None:
        """See `Reference.begin`."""
        super().begin()
        self._origin: torch.Tensor | None = None
        """Inverse of the first frame's heading."""
        self._position: torch.Tensor | None = None

    def read(self, values: list[bytes]) -> np.ndarray:
        """See `Reference.read`."""
        counts = 3, 4, keys.JOINTS
        position, quat, joints = (keys.numbers(*of) for of in zip(self.keys, values, counts, strict=True))
        norm = float(np.linalg.norm(quat))
        if not 0.5 < norm < 2.0:
            raise InputError(f"{keys.GMR_BODY_QUAT}: a quaternion of length {norm:.3g}, expected 1")
        _check(keys.GMR_BODY_POS, float(position[2]), joints)
        return np.concatenate([position, quat / norm, joints])

    def _pose(self, frame: np.ndarray, new: bool) -> tuple[np.ndarray, float, torch.Tensor, np.ndarray]:
        """See `Reference`; a frame that is shown again moves nothing."""
        position, body = torch.from_numpy(frame[:3].copy()), torch.from_numpy(frame[3:7].copy())
        if self._origin is None:
            self._origin = quat_conjugate(quat_from_yaw(heading(body)))
        quat = quat_multiply(self._origin, body)
        moved = torch.zeros(3, dtype=torch.float64)
        if self._position is not None and new:
            moved = quat_apply(quat_conjugate(quat), quat_apply(self._origin, position - self._position))
        self._position = position
        return moved[:2].numpy(), float(frame[2]), quat, frame[7:]


def references(tracker: str) -> Reference:
    """The kind of reference that a tracker was driven with in the original; those that it did not know get TWIST2's."""
    return GmrReference() if tracker == "sonic" else MimicReference()
