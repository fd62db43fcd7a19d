"""Distances of a task's `Interaction`, measured in running worlds: of robot and hands to the things to touch."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from arena_newton.interfaces import World
from arena_newton.robot.rotations import atan2, heading, quat_apply, quat_conjugate, quat_multiply, wrap_angle
from arena_newton.tasks.judge import bounding_box

__all__ = ["InteractionView"]


class InteractionView:
    """Distances of root and effectors to the object of a task; rows are worlds."""

    def __init__(self, env: World):
        """Bind the worlds of a task that has an `Interaction`.

        Raises:
            InputError: A prim is missing in the scene.
        """
        assert env.spec.interaction is not None
        self.spec = env.spec.interaction
        self.worlds, self._device, scene = env.worlds, env.torch_device, env.scene
        box = self.spec.box
        self.box = bounding_box(scene, box) if scene.has_body(box) else scene.marker(box)
        self._xpos, self._xquat = wp.to_torch(env.physics.xpos), wp.to_torch(env.physics.xquat)
        address = scene.robot.root_qpos
        self.root = wp.to_torch(env.physics.qpos)[:, address : address + 7]
        """The robot's root: position [m] and orientation wxyz, a live view, shape [worlds, 7]."""
        frames = [scene.frame(name) for name in self.spec.effectors]
        self._bodies = torch.tensor([frame.body_id for frame in frames], device=self._device)
        origins, turns, tips = (
            torch.tensor(rows, dtype=torch.float32, device=self._device)
            for rows in (
                [frame.pos for frame in frames],
                [frame.quat for frame in frames],
                [self.spec.tip] * len(frames),
            )
        )
        self._offsets = origins + quat_apply(turns, tips)

    @property
    def centre(self) -> Tensor:
        """Centre of the object's box [m], shape [worlds, 3]."""
        body = self.box.body_id
        centre: Tensor = self._xpos[:, body] + quat_apply(self._xquat[:, body], self._rows(self.box.pos))
        return centre

    @property
    def distance(self) -> Tensor:
        """Distance of the root to the box, seen from above [m], 0 over it, shape [worlds]."""
        return self._to_box(self.root[:, None, :3], level=True)[:, 0]

    @property
    def bearing(self) -> Tensor:
        """Angle between the robot's heading and the box's centre [rad], at least 0, shape [worlds].

        Where the box is touched with the back: between the back and the nearest point of the box, which may be wide.
        """
        way = (self._nearest() if self.spec.behind else self.centre[:, :2]) - self.root[:, :2]
        angle = wrap_angle(atan2(way[:, 1], way[:, 0]) - heading(self.root[:, 3:7])).abs()
        return math.pi - angle if self.spec.behind else angle

    @property
    def reach(self) -> Tensor:
        """Distance of the nearest effector to the box [m], 0 in it, shape [worlds]."""
        carried = self._offsets.expand(self.worlds, -1, 3)
        points = self._xpos[:, self._bodies] + quat_apply(self._xquat[:, self._bodies], carried)
        return self._to_box(points, level=self.spec.level).amin(dim=1)

    def _nearest(self) -> Tensor:
        """The point of the box that is nearest to the root, seen from above [m], shape [worlds, 2]."""
        turn = quat_multiply(self._xquat[:, self.box.body_id], self._rows(self.box.quat))
        local = quat_apply(quat_conjugate(turn), self.root[:, :3] - self.centre)
        half = self._rows(self.box.half)
        return (self.centre + quat_apply(turn, torch.minimum(torch.maximum(local, -half), half)))[:, :2]

    def _rows(self, values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self._device).expand(self.worlds, len(values))

    def _to_box(self, points: Tensor, *, level: bool) -> Tensor:
        """Distance of points [worlds, n, 3] to the box [m], 0 inside, shape [worlds, n]."""
        turn = quat_multiply(self._xquat[:, self.box.body_id], self._rows(self.box.quat))
        back = quat_conjugate(turn)[:, None].expand(*points.shape[:2], 4)
        local = quat_apply(back, points - self.centre[:, None])
        outside = (local.abs() - self._rows(self.box.half)[:, None]).clamp_min(0.0)
        distance: Tensor = torch.linalg.vector_norm(outside[..., :2] if level else outside, dim=2)
        return distance
