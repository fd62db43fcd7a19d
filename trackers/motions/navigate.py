"""Planar velocity command that leads the robot from its pose to a goal, batched over worlds.

The controller is proportional with a slow-down at the goal, and stands still once it has arrived: a tracker that cannot
see position (TWIST2, SONIC) needs this loop around it, and every correction of a few centimetres costs two steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from arena_newton.robot.rotations import atan2, rotate_xy, wrap_angle

__all__ = ["NavigationCommand", "NavigationLimits", "Navigator", "steer"]

TURN_FIRST, TURN_BLEND = 1.3, 0.7
"""Far from the goal, a heading error of `TURN_FIRST` stops the walk; this much less leaves it at full speed [rad]."""
ROUTE_WINDOW = 1.5
"""Stretch of a route ahead of the last position in which the robot is searched for [m]."""


@dataclass(frozen=True)
class NavigationLimits:
    """Speeds, gains and tolerances of the controller."""

    forward: float = 0.5
    """Largest speed ahead [m/s]."""
    backward: float = 0.25
    """Largest speed back [m/s]."""
    sideways: float = 0.25
    """Largest speed to either side [m/s]."""
    turn: float = 0.7
    """Largest yaw rate [rad/s]."""
    position_gain: float = 0.9
    """Speed for a distance to the goal [1/s]."""
    heading_gain: float = 1.5
    """Yaw rate for a heading error [1/s]."""
    crawl: float = 0.05
    """Smallest speed while the goal is not reached [m/s]; without it the last centimetres take seconds."""
    near: float = 0.35
    """Closer to the goal than this the robot keeps the goal's heading and moves in any direction [m]."""
    far: float = 0.8
    """Farther from the goal than this it faces where it goes [m]."""
    arrive_position: float = 0.035
    """Arrived when the smoothed position is closer than this [m] ..."""
    arrive_heading: float = 0.04
    """... and the heading error smaller than this [rad]."""
    leave_position: float = 0.07
    """A robot that holds starts again when it is farther off than this [m] ..."""
    leave_heading: float = 0.08
    """... or turned by more than this [rad]."""
    lookahead: float = 0.4
    """Distance along a route to the point that is walked to [m]."""
    smoothing: float = 0.6
    """Time constant of the position that decides about arrival [s]: the pelvis sways by 5 cm with every step."""
    learning: float = 0.5
    """Fraction of the error of a stop that was not good enough which the next approach aims against: a tracker ends its
    last steps some centimetres from where it decides to stop, always to the same side."""
    most_learned: tuple[float, float] = (0.05, 0.07)
    """Largest such correction [m, rad]."""


@dataclass
class NavigationCommand:
    """Command of the controller; rows are worlds."""

    velocity: Tensor
    """vx, vy [m/s], yaw rate [rad/s] in the heading frame, [worlds, 3]; zero where the robot holds."""
    arrived: Tensor
    """True at the goal and holding, bool, [worlds]."""
    distance: Tensor
    """Path left [m], [worlds]."""
    heading_error: Tensor
    """Goal heading minus present heading [rad], [worlds]."""
    stray: Tensor
    """Distance from the route [m], 0 without one, [worlds]."""


def steer(pose: Tensor, aim: Tensor, goal_yaw: Tensor, left: Tensor, limits: NavigationLimits) -> Tensor:
    """Velocity command towards a point, slowing down for what is left of the path.

    Args:
        pose: x, y [m], yaw [rad], shape [worlds, 3].
        aim: Point to walk to now [m], shape [worlds, 2].
        goal_yaw: Heading at the goal [rad], shape [worlds].
        left: Path left to the goal [m], shape [worlds].
        limits: Speeds and gains.

    Returns:
        vx, vy [m/s], yaw rate [rad/s] in the heading frame, shape [worlds, 3].
    """
    yaw = pose[:, 2]
    offset = aim - pose[:, :2]
    distance = torch.linalg.vector_norm(offset, dim=1)
    direction = offset / distance.clamp_min(1e-6)[:, None]
    far = ((left - limits.near) / (limits.far - limits.near)).clamp(0.0, 1.0)
    bearing = atan2(offset[:, 1], offset[:, 0])
    wanted = goal_yaw + far * wrap_angle(bearing - goal_yaw)
    error = wrap_angle(wanted - yaw)
    turn = (limits.heading_gain * error).clamp(-limits.turn, limits.turn)

    local = rotate_xy(-yaw, direction)
    x, y = local.unbind(1)
    ahead = torch.where(x >= 0, limits.forward, limits.backward)
    # Largest speed in this direction: an ellipse of the limits along and across.
    cap = 1.0 / torch.sqrt((x / ahead) ** 2 + (y / limits.sideways) ** 2).clamp_min(1e-6)
    speed = torch.minimum((limits.position_gain * left).clamp_min(limits.crawl), cap)
    # Far from the goal the robot first turns to where it goes; near it moves while turning.
    facing = ((TURN_FIRST - error.abs()) / TURN_BLEND).clamp(0.0, 1.0)
    speed = speed * (1.0 - far + far * facing)
    return torch.cat([local * speed[:, None], turn[:, None]], dim=1)


class Navigator:
    """The controller with its memory, one row per world: a goal or a route, arrival with hysteresis."""

    def __init__(self, worlds: int, device: torch.device | str = "cpu", limits: NavigationLimits | None = None):
        """Start with no goal; call `reset` and `command`."""
        self.limits = limits or NavigationLimits()
        self.holding = torch.zeros(worlds, dtype=torch.bool, device=device)
        """Worlds that have arrived and hold their position."""
        self._smooth = torch.zeros(worlds, 2, device=device)
        self._first_tick = torch.ones(worlds, dtype=torch.bool, device=device)
        self._travelled = torch.zeros(worlds, device=device)
        self._bias = torch.zeros(worlds, 3, device=device)

    def reset(self, mask: Tensor | None = None) -> None:
        """Forget the past of the worlds of `mask`, bool, shape [worlds] (all without one): a new episode."""
        every = torch.ones_like(self._first_tick) if mask is None else mask
        self.retarget(every)
        self._bias = self._bias.masked_fill(every[:, None], 0.0)

    def retarget(self, mask: Tensor) -> None:
        """Worlds of `mask`, bool, shape [worlds], get another goal or route; what their stops taught is kept."""
        self.holding = self.holding & ~mask
        self._first_tick = self._first_tick | mask
        self._travelled = self._travelled.masked_fill(mask, 0.0)

    def command(
        self, pose: Tensor, goal: Tensor, dt: float, *, route: Tensor | None = None, mask: Tensor | None = None
    ) -> NavigationCommand:
        """One step of the loop.

        Args:
            pose: Measured x, y [m], yaw [rad], shape [worlds, 3].
            goal: Wanted x, y [m], yaw [rad], shape [worlds, 3].
            dt: Time since the last call [s].
            route: Points to pass, from the start to the goal [m], shape [worlds, points, 2]; shorter routes
                repeat their last point.
            mask: Worlds whose memory advances, bool, shape [worlds]; all by default.

        Returns:
            The command of every world.
        """
        k = self.limits
        every = torch.ones_like(self._first_tick) if mask is None else mask
        here, yaw = pose[:, :2], pose[:, 2]
        blend = dt / (k.smoothing + dt)
        smooth = torch.where(self._first_tick[:, None], here, self._smooth + blend * (here - self._smooth))
        self._smooth = torch.where(every[:, None], smooth, self._smooth)
        self._first_tick = self._first_tick & ~every

        aim, left = goal[:, :2], torch.linalg.vector_norm(goal[:, :2] - here, dim=1)
        stray = torch.zeros_like(left)
        if route is not None:
            travelled, aim, left, stray = follow(torch.cat([route, goal[:, None, :2]], dim=1), here, self._travelled, k)
            self._travelled = torch.where(every, travelled, self._travelled)

        error = wrap_angle(goal[:, 2] - yaw)
        off = torch.linalg.vector_norm(goal[:, :2] - smooth, dim=1)
        stays = (off < k.leave_position) & (error.abs() < k.leave_heading)
        missed = every & self.holding & ~stays
        miss = torch.cat([rotate_xy(-yaw, smooth - goal[:, :2]), -error[:, None]], dim=1)
        learned = self._bias + k.learning * miss
        most, most_turn = k.most_learned
        learned = torch.cat([learned[:, :2].clamp(-most, most), learned[:, 2:].clamp(-most_turn, most_turn)], dim=1)
        self._bias = torch.where(missed[:, None], learned, self._bias)

        shift, turned = -rotate_xy(yaw, self._bias[:, :2]), goal[:, 2] - self._bias[:, 2]
        aimed_off = torch.linalg.vector_norm(goal[:, :2] + shift - smooth, dim=1)
        close = (aimed_off < k.arrive_position) & (wrap_angle(turned - yaw).abs() < k.arrive_heading)
        holding = torch.where(self.holding, stays, close & (left < k.near))
        self.holding = torch.where(every, holding, self.holding)
        near = (left < k.lookahead)[:, None]
        left = torch.where(near[:, 0], torch.linalg.vector_norm(goal[:, :2] + shift - here, dim=1), left)
        velocity = steer(pose, aim + near * shift, turned, left, k) * (~holding)[:, None]
        return NavigationCommand(velocity=velocity, arrived=holding, distance=left, heading_error=error, stray=stray)


def follow(
    route: Tensor, here: Tensor, travelled: Tensor, limits: NavigationLimits
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Position of a robot on its route, and the point that it should walk to.

    Args:
        route: Points from start to goal [m], shape [worlds, points, 2].
        here: Measured position [m], shape [worlds, 2].
        travelled: Path along the route at the last call [m], shape [worlds]; it never shrinks.
        limits: Look-ahead.

    Returns:
        Path along the route [m], point to walk to [m], path left [m] and distance from the route [m], shapes [worlds],
        [worlds, 2], [worlds], [worlds].
    """
    start, step = route[:, :-1], route[:, 1:] - route[:, :-1]
    length = torch.linalg.vector_norm(step, dim=2)
    passed = torch.cumsum(length, dim=1) - length
    along = ((here[:, None] - start) * step).sum(2) / length.square().clamp_min(1e-9)
    along = along.clamp(0.0, 1.0)
    gap = torch.linalg.vector_norm(start + along[..., None] * step - here[:, None], dim=2)
    position = passed + along * length
    # Only the stretch just ahead: a route may pass close to itself.
    reachable = (position >= travelled[:, None] - 1e-4) & (position <= travelled[:, None] + ROUTE_WINDOW)
    stray, nearest = torch.where(reachable, gap, torch.inf).min(dim=1)
    found = torch.gather(position, 1, nearest[:, None])[:, 0]
    progress = torch.where(torch.isinf(stray), travelled, torch.maximum(found, travelled))

    total = length.sum(dim=1)
    target = torch.minimum(progress + limits.lookahead, total)
    leg = (target[:, None] > passed + length).sum(dim=1, keepdim=True).clamp_max(length.shape[1] - 1)
    fraction = (target[:, None] - torch.gather(passed, 1, leg)) / torch.gather(length, 1, leg).clamp_min(1e-9)
    fraction = fraction.clamp(0.0, 1.0)
    pick = leg[..., None].expand(-1, -1, 2)
    aim = (torch.gather(start, 1, pick) + fraction[..., None] * torch.gather(step, 1, pick))[:, 0]
    left = total - progress
    # On the last stretch the distance itself counts, which sees sideways errors too.
    direct = torch.linalg.vector_norm(route[:, -1] - here, dim=1)
    return progress, aim, torch.where(left < limits.lookahead, direct, torch.maximum(left, direct)), stray
