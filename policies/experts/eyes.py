"""View of the head camera: points within its borders and not hidden behind upright cylinders.

An expert that decides from this shows a learner nothing that the picture does not: it looks before it acts. A few
torch operations stand in for a picture; `tests/policies/test_expert_boxing.py` compares them with rendered ones.
"""

from __future__ import annotations

import torch
from pxr import Usd, UsdGeom
from torch import Tensor

from arena_newton.errors import InputError
from arena_newton.policies.experts.base import Sight
from arena_newton.robot.rotations import quat_apply, quat_conjugate, quat_multiply

__all__ = ["Eyes", "hidden", "silhouette"]

CAMERA = "front_cam"
"""The head camera's prim under the robot, whose pictures policies get."""
ROBOT = "/World/Robot"
MARGIN = 0.97
"""Part of the picture's half width and height that counts as in view: a thing cut by the border is hard to tell."""


class Eyes:
    """The head camera as a test of points, rows are worlds."""

    def __init__(self, sight: Sight):
        """Read lens and mount of the camera from the scene.

        Raises:
            InputError: The robot has no head camera.
        """
        self.sight = sight
        frame = sight.scene.frame(CAMERA)
        robot = sight.scene.stage.GetPrimAtPath(ROBOT)
        lens = next((UsdGeom.Camera(prim) for prim in Usd.PrimRange(robot) if prim.GetName() == CAMERA), None)
        if not lens:
            raise InputError(f"{sight.scene.path}: prim {CAMERA} under {ROBOT} is not a Camera")
        focal = float(lens.GetFocalLengthAttr().Get())
        self._body = frame.body_id
        self._offset = torch.tensor(frame.pos, dtype=torch.float32, device=sight.device)
        self._quat = torch.tensor(frame.quat, dtype=torch.float32, device=sight.device)
        self._tangents = tuple(
            MARGIN * 0.5 * float(aperture.Get()) / focal
            for aperture in (lens.GetHorizontalApertureAttr(), lens.GetVerticalApertureAttr())
        )

    @property
    def position(self) -> Tensor:
        """The camera's position [m], shape [worlds, 3]."""
        return self.sight.point(self._body, self._offset)

    def in_view(self, points: Tensor) -> Tensor:
        """True for points within the picture's borders.

        Args:
            points: x, y, z [m], shape [worlds, points, 3].

        Returns:
            bool, shape [worlds, points].
        """
        _, quat = self.sight.body(self._body)
        back = quat_conjugate(quat_multiply(quat, self._quat.expand_as(quat)))
        # A camera looks along its local -z, y is up (UsdGeom).
        x, y, z = quat_apply(back[:, None].expand(*points.shape[:2], 4), points - self.position[:, None]).unbind(2)
        wide, high = self._tangents
        return (z < 0.0) & (x.abs() < -wide * z) & (y.abs() < -high * z)

    def sees(self, points: Tensor, cylinders: Tensor) -> Tensor:
        """True for points in view that nothing hides.

        Args:
            points: x, y, z [m], shape [worlds, points, 3].
            cylinders: Upright ones that hide what is behind them, higher than every line of sight: x, y of the axis
                and radius [m], shape [worlds, cylinders, 3].

        Returns:
            bool, shape [worlds, points].
        """
        return self.in_view(points) & ~hidden(self.position[:, :2], points[..., :2], cylinders)


def hidden(eye: Tensor, points: Tensor, cylinders: Tensor) -> Tensor:
    """True if the line from an eye to a point cuts a cylinder, seen from above.

    Args:
        eye: x, y [m], shape [worlds, 2].
        points: x, y [m], shape [worlds, points, 2].
        cylinders: x, y, radius [m], shape [worlds, cylinders, 3].

    Returns:
        bool, shape [worlds, points].
    """
    step = (points - eye[:, None])[:, :, None]  # [W, P, 1, 2]
    to_axis = (cylinders[..., :2] - eye[:, None])[:, None]  # [W, 1, C, 2]
    along = ((to_axis * step).sum(3) / step.square().sum(3).clamp_min(1e-9)).clamp(0.0, 1.0)
    gap = torch.linalg.vector_norm(to_axis - along[..., None] * step, dim=3)
    return (gap < cylinders[:, None, :, 2]).any(dim=2)


def silhouette(eye: Tensor, centre: Tensor, radius: float, count: int) -> Tensor:
    """Points on the near side of a ball as an eye sees it, from its left to its right border.

    Args:
        eye: x, y, z [m], shape [worlds, 3].
        centre: Of the ball [m], shape [worlds, 3].
        radius: Of the ball [m].
        count: Number of points; each stands for an upright stripe of the same width.

    Returns:
        x, y, z [m], shape [worlds, count, 3].
    """
    way = (centre - eye)[:, :2]
    way = way / torch.linalg.vector_norm(way, dim=1, keepdim=True).clamp_min(1e-6)
    level = torch.zeros_like(way[:, :1])
    ahead, right = torch.cat([way, level], dim=1), torch.cat([way[:, 1:], -way[:, :1], level], dim=1)
    across = (torch.arange(count, device=eye.device) + 0.5) / count * 2.0 - 1.0
    near = torch.sqrt(1.0 - across.square())
    return centre[:, None] + radius * (across[:, None] * right[:, None] - near[:, None] * ahead[:, None])
