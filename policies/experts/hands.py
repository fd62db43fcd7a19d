"""Leading both hands of a robot whose tracker obeys only roughly: integrals on measured palms and wrists.

A tracker leaves a commanded palm 2-20 cm and a hand 5-15 deg off, always to the same side: what is missing is added to
the command, slowly. The generator solves shoulder and elbow for a palm (`MotionCommand.hand_point`); the wrist's three
angles are found here in closed form from the measured forearm.
"""

from __future__ import annotations

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Sight
from arena_newton.policies.experts.phases import select
from arena_newton.robot.g1 import ARMS, MUJOCO_JOINTS
from arena_newton.robot.rotations import atan2, matrix_from_quat, quat_conjugate, quat_multiply, rotate_xy
from arena_newton.trackers.motions.kinematics import HAND_POINT

__all__ = ["WRISTS", "Palms", "Wrists", "wrist_angles"]

SIDES = ("left", "right")
WRISTS = torch.tensor([[4, 5, 6], [11, 12, 13]])
"""Wrist roll, pitch, yaw of both hands among the 14 columns of `MotionCommand.arms`."""


class Palms:
    """Both palms: where they are, and the commands that bring them where they must be."""

    def __init__(self, sight: Sight, gain: float = 1.0, most: float = 0.15):
        """Look up the hands.

        Args:
            sight: The view of the worlds.
            gain: Of the integral on the palm's error [1/s].
            most: Largest correction in each direction [m].
        """
        self.sight, self.gain, self.most = sight, gain, most
        self.bodies = [sight.scene.link(f"{side}_wrist_yaw_link") for side in SIDES]
        """Left and right wrist yaw link."""
        self._ahead = torch.tensor([HAND_POINT, 0.0, 0.0], device=sight.device)
        self.correction = torch.zeros(sight.worlds, 2, 3, device=sight.device)
        """Correction added to the command of left and right palm [m], pelvis' heading frame, shape [worlds, 2, 3]."""

    def reset(self, mask: Tensor) -> None:
        """Forget the corrections in the worlds of `mask`, bool, shape [worlds]."""
        self.correction = select(mask, torch.zeros_like(self.correction), self.correction)

    def measured(self) -> Tensor:
        """Left and right palm (`HAND_POINT` ahead of the wrist) in the world [m], shape [worlds, 2, 3]."""
        return self.sight.once(
            "palms", lambda: torch.stack([self.sight.point(body, self._ahead) for body in self.bodies], dim=1)
        )

    def local(self, points: Tensor) -> Tensor:
        """World points [m], shape [worlds, n, 3], in the pelvis' heading frame: the frame of `hand_point`."""
        return self.turned(points - self.sight.root_position[:, None])

    def turned(self, vectors: Tensor) -> Tensor:
        """World vectors, shape [worlds, n, 3], in the pelvis' heading frame."""
        yaw = -self.sight.pose[:, 2:3].expand(vectors.shape[:2])
        return torch.cat([rotate_xy(yaw, vectors[..., :2]), vectors[..., 2:]], dim=-1)

    def lead(self, wanted: Tensor, learn: Tensor, dt: float) -> Tensor:
        """`hand_point` that brings the palms to places in the world.

        Args:
            wanted: Left and right palm [m], world, shape [worlds, 2, 3].
            learn: Hands whose correction advances, bool, shape [worlds, 2]; off while something holds the hand.
            dt: Time since the last call [s].

        Returns:
            Points in the pelvis' heading frame [m], shape [worlds, 2, 3].
        """
        if learn.any():
            error = self.turned(wanted - self.measured())
            learned = (self.correction + self.gain * dt * error).clamp(-self.most, self.most)
            self.correction = torch.where(learn[..., None], learned, self.correction)
        return self.local(wanted) + self.correction


def wrist_angles(forearm: Tensor, hand: Tensor) -> Tensor:
    """Roll, pitch, yaw of a wrist [rad] that give a hand its orientation on this forearm; R = Rx Ry Rz.

    Args:
        forearm: Orientation of the elbow link, wxyz, shape [..., 4].
        hand: Wanted orientation of the wrist yaw link, wxyz, shape [..., 4].

    Returns:
        Angles, shape [..., 3].
    """
    m = matrix_from_quat(quat_multiply(quat_conjugate(forearm), hand))
    roll = atan2(-m[..., 1, 2], m[..., 2, 2])
    pitch = torch.asin(m[..., 0, 2].clamp(-1.0, 1.0))
    yaw = atan2(-m[..., 0, 1], m[..., 0, 0])
    return torch.stack([roll, pitch, yaw], dim=-1)


class Wrists:
    """Both hands' orientations: closed form from the measured forearm, plus an integral on the measured wrist."""

    def __init__(self, sight: Sight, gain: float = 1.0, most: float = 0.7):
        """Look up forearms and joints.

        Args:
            sight: The view of the worlds.
            gain: Of the integral on each angle's error [1/s].
            most: Largest correction of an angle [rad].
        """
        self.sight, self.gain, self.most = sight, gain, most
        self._forearms = [sight.scene.link(f"{side}_elbow_link") for side in SIDES]
        names = [[f"{side}_wrist_{axis}_joint" for axis in ("roll", "pitch", "yaw")] for side in SIDES]
        self._joints = torch.tensor([[MUJOCO_JOINTS.index(n) for n in row] for row in names], device=sight.device)
        assert (self._joints.cpu() == WRISTS + ARMS[0]).all()
        self.correction = torch.zeros(sight.worlds, 2, 3, device=sight.device)
        """Correction added to the angles of left and right wrist [rad], shape [worlds, 2, 3]."""

    def reset(self, mask: Tensor) -> None:
        """Forget the corrections in the worlds of `mask`, bool, shape [worlds]."""
        self.correction = select(mask, torch.zeros_like(self.correction), self.correction)

    def lead(self, wanted: Tensor, learn: Tensor, dt: float) -> Tensor:
        """Wrist angles for the columns `WRISTS` of `MotionCommand.arms`.

        Args:
            wanted: Orientations of left and right hand (wrist yaw link) in the world, wxyz, shape [worlds, 2, 4].
            learn: Hands whose correction advances, bool, shape [worlds, 2].
            dt: Time since the last call [s].

        Returns:
            Roll, pitch, yaw [rad], shape [worlds, 2, 3].
        """
        forearms = torch.stack([self.sight.body(body)[1] for body in self._forearms], dim=1)
        angles = wrist_angles(forearms, wanted)
        if learn.any():
            error = angles - self.sight.joints[:, self._joints]
            learned = (self.correction + self.gain * dt * error).clamp(-self.most, self.most)
            self.correction = torch.where(learn[..., None], learned, self.correction)
        return angles + self.correction
