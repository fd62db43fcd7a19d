"""Walking in an expert: to a pose around boxes on the floor, and along a line."""

from __future__ import annotations

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Sight
from arena_newton.policies.experts.phases import select
from arena_newton.policies.experts.planning import Floor, plan
from arena_newton.robot.rotations import rotate_xy, wrap_angle
from arena_newton.trackers.motions.navigate import NavigationCommand, NavigationLimits, Navigator

__all__ = ["BEYOND", "Walk", "along", "beyond", "paced", "passing"]

BEYOND = 0.06
"""Distance beyond a position to which a robot is led that goes on there while it still walks [m]: a policy that learns
from demonstrations knows no phase and no clock, and would wait for the last centimetres for ever
(docs/howto/train/experts.md)."""

HEADING_GAIN = 1.5
"""Yaw rate for a heading error on a line [1/s]."""
SIDE_GAIN = 1.2
"""Sideways speed for a distance from a line [1/s]."""


class Walk:
    """Goal and route of each world, and the navigator that follows them."""

    def __init__(self, sight: Sight, limits: NavigationLimits | None = None):
        """Make one without goals: call `to` before `command`."""
        self.sight = sight
        self.navigator = Navigator(sight.worlds, sight.device, limits)
        self.goal = torch.zeros(sight.worlds, 3, device=sight.device)
        """x, y [m], yaw [rad] to stand at, shape [worlds, 3]."""
        self._route = torch.zeros(0, device=sight.device)
        none = torch.zeros(sight.worlds, device=sight.device)
        self._idle = NavigationCommand(torch.zeros_like(self.goal), none > 0, none, none, none)

    def begin(self, mask: Tensor) -> None:
        """Episodes begin in the worlds of `mask`, bool, shape [worlds]."""
        self.navigator.reset(mask)

    def to(self, mask: Tensor, goal: Tensor, floor: Floor | None = None) -> None:
        """Worlds of `mask`, bool, shape [worlds], get another goal.

        Args:
            mask: Worlds.
            goal: x, y [m], yaw [rad], shape [worlds, 3].
            floor: Obstacles to walk around, by a path planned from where the robot is; without it the way is straight.
        """
        if not mask.any():
            return
        here = self.sight.pose[:, :2]
        self.goal = select(mask, goal, self.goal)
        points = here[:, None] if floor is None else plan(here, goal[:, :2], floor).points
        longest = max(points.shape[1], self._route.shape[1] if self._route.ndim == 3 else 0)
        old = self._route if self._route.ndim == 3 else points
        self._route = select(mask, _padded(points, longest), _padded(old, longest))
        self.navigator.retarget(mask)

    def command(self, mask: Tensor, dt: float, *, others: bool = False) -> NavigationCommand:
        """One step of the loop for the worlds of `mask`, bool, shape [worlds], dt [s] after the last one.

        The command of another world has a meaning only where `others` is set: the one to its present goal.
        """
        if not (others or mask.any()):
            return self._idle
        return self.navigator.command(self.sight.pose, self.goal, dt, route=self._route, mask=mask)


def paced(velocity: Tensor, pace: Tensor) -> Tensor:
    """A velocity [worlds, 3] whose two speeds, not its yaw rate, are multiplied by a pace, shape [worlds]."""
    return velocity * torch.stack([pace, pace, torch.ones_like(pace)], dim=1)


def passing(answer: NavigationCommand, within: tuple[float, float]) -> Tensor:
    """Worlds that hold at their goal, or are off it by less than these errors [m, rad]; bool, shape [worlds]."""
    close = (answer.distance < within[0]) & (answer.heading_error.abs() < within[1])
    return close | answer.arrived


def beyond(pose: Tensor) -> Tensor:
    """Poses that are `BEYOND` farther ahead than others; x, y [m], yaw [rad], shape [worlds, 3]."""
    ahead = torch.stack([torch.cos(pose[:, 2]), torch.sin(pose[:, 2])], dim=1)
    return torch.cat([pose[:, :2] + BEYOND * ahead, pose[:, 2:]], dim=1)


def _padded(points: Tensor, length: int) -> Tensor:
    """Routes of that many points: the last one is repeated; [W, K, 2] to [W, length, 2]."""
    return torch.cat([points, points[:, -1:].expand(-1, length - points.shape[1], 2)], dim=1)


def along(
    pose: Tensor, point: Tensor, yaw: Tensor, forward: Tensor, *, side: float = 0.15, turn: float = 0.6
) -> Tensor:
    """Velocity that walks along a line and holds its heading.

    Args:
        pose: x, y [m], yaw [rad] of the robot, shape [worlds, 3].
        point: A point of the line [m], shape [worlds, 2].
        yaw: Heading to hold, the direction of the line [rad], shape [worlds].
        forward: Speed along the line [m/s], shape [worlds]; negative walks backwards.
        side: Largest speed to either side [m/s].
        turn: Largest yaw rate [rad/s].

    Returns:
        vx, vy [m/s], yaw rate [rad/s], shape [worlds, 3].
    """
    off = rotate_xy(-yaw, pose[:, :2] - point)[:, 1]
    error = wrap_angle(yaw - pose[:, 2])
    lateral = (-SIDE_GAIN * off).clamp(-side, side)
    planar = rotate_xy(error, torch.stack([forward, lateral], dim=1))
    return torch.cat([planar, (HEADING_GAIN * error).clamp(-turn, turn)[:, None]], dim=1)
