"""Shortest paths around boxes on the floor: a visibility graph, batched over worlds in torch.

Every box is grown by the clearance that the robot's centre must keep; paths lead over the grown corners. Narrow and
wide clearances are tried together, and a short detour is taken for a wider one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from arena_newton.robot.rotations import atan2, rotate_xy

__all__ = ["BLOCKED", "Floor", "Paths", "footprint", "plan", "signed_distance"]

CLEARANCES = (0.50, 0.43, 0.36, 0.30)
"""Distances between obstacles and the robot's centre [m]: half its width is 0.25 with swinging arms, and a gait
deviates by 5 cm."""
DETOUR = 8.0
"""Additional path length that a wider clearance is worth [m per m]."""
BLOCKED = 1e6
"""Length of a path that does not exist [m]."""


@dataclass(frozen=True)
class Floor:
    """Area in which the robot may walk."""

    boxes: Tensor
    """Obstacles as rectangles: x, y [m], yaw [rad], half length, half width [m], shape [worlds, boxes, 5]."""
    low: tuple[float, float] = (-torch.inf, -torch.inf)
    """Corner of the room [m]."""
    high: tuple[float, float] = (torch.inf, torch.inf)
    """The opposite corner [m]."""


@dataclass(frozen=True)
class Paths:
    """Planned paths, one per world."""

    points: Tensor
    """Points from the start to the goal [m], shape [worlds, points, 2]; the last one is repeated."""
    length: Tensor
    """[m], `BLOCKED` or more where there is none (the path is then straight), shape [worlds]."""
    clearance: Tensor
    """Distance that it keeps from obstacles [m], 0 where there is no path, shape [worlds]."""


def footprint(pos: Tensor, quat: Tensor, half: Tensor) -> Tensor:
    """Rectangles on the floor that cover boxes in any orientation: x, y, yaw, half length, half width, shape [..., 5].

    Exact for upright boxes. The rectangle is parallel to the box axis that is longest seen from above. Given are
    centres [m], orientations wxyz and half sizes [m], shapes [..., 3], [..., 4] and [..., 3].
    """
    w, x, y, z = quat.unbind(-1)
    top = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1)
    side = torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1)
    axes = torch.stack([top * half, side * half], dim=-1)  # the three half axes seen from above, [..., 3, 2]
    longest = torch.linalg.vector_norm(axes, dim=-1).argmax(dim=-1)
    along = torch.gather(axes, -2, longest[..., None, None].expand(*longest.shape, 1, 2))[..., 0, :]
    yaw = atan2(along[..., 1], along[..., 0])
    extent = rotate_xy(-yaw[..., None].expand(*yaw.shape, 3), axes).abs().sum(dim=-2)
    return torch.cat([pos[..., :2], yaw[..., None], extent], dim=-1)


def _local(points: Tensor, boxes: Tensor) -> Tensor:
    """Points in the frames of boxes: [W, N, 2] and [W, B, 5] to [W, N, B, 2]."""
    offset = points[:, :, None] - boxes[:, None, :, :2]
    return rotate_xy(-boxes[:, None, :, 2].expand(offset.shape[:-1]), offset)


def signed_distance(points: Tensor, boxes: Tensor) -> Tensor:
    """Distance to the nearest box [m], negative inside; shapes [W, N, 2] and [W, B, 5] to [W, N]."""
    d = _local(points, boxes).abs() - boxes[:, None, :, 3:]
    outside = torch.linalg.vector_norm(d.clamp_min(0.0), dim=-1)
    return (outside + d.amax(dim=-1).clamp_max(0.0)).amin(dim=-1)


def _blocked(points: Tensor, boxes: Tensor, grow: Tensor) -> Tensor:
    """True if the straight line between two points cuts a grown box; [W, N, 2] to bool [W, N, N]."""
    local = _local(points, boxes)
    start, step = local[:, :, None], local[:, None] - local[:, :, None]  # [W, N, N, B, 2]
    half = (boxes[:, None, None, :, 3:] + grow[:, None, None, None, None]).clamp_min(1e-6)
    # Clip the line with the slabs |x| < half length and |y| < half width.
    safe = torch.where(step.abs() < 1e-9, torch.full_like(step, 1e-9), step)
    a, b = (-half - start) / safe, (half - start) / safe
    enter = torch.minimum(a, b).amax(dim=-1).clamp_min(0.0)
    leave = torch.maximum(a, b).amin(dim=-1).clamp_max(1.0)
    return (enter < leave - 1e-6).any(dim=-1)


def _freed(point: Tensor, boxes: Tensor, grow: Tensor) -> Tensor:
    """A point moved out of grown boxes, each in turn in the shortest direction; [W, 2]."""
    for b in range(boxes.shape[1]):
        box = boxes[:, b : b + 1]
        local = _local(point[:, None], box)[:, 0, 0]
        half = box[:, 0, 3:] + grow[:, None] + 1e-3
        inside = (local.abs() < half).all(dim=1)
        lack = half - local.abs()
        axis = lack.argmin(dim=1, keepdim=True)
        side = torch.where(torch.gather(local, 1, axis) < 0, -1.0, 1.0)
        moved = local.scatter(1, axis, side * torch.gather(half, 1, axis))
        moved = box[:, 0, :2] + rotate_xy(box[:, 0, 2], moved)
        point = torch.where(inside[:, None], moved, point)
    return point


def plan(start: Tensor, goal: Tensor, floor: Floor, clearances: tuple[float, ...] = CLEARANCES) -> Paths:
    """Paths from start to goal.

    A start or goal too near a box is first moved away from it; the path still ends at the goal itself. Start and goal
    are in m, shape [worlds, 2]; `clearances` [m] are those to try.
    """
    worlds, tries = len(start), len(clearances)
    boxes = floor.boxes.repeat(tries, 1, 1)
    grow = torch.tensor(clearances, device=start.device).repeat_interleave(worlds)
    first, last = start.repeat(tries, 1), goal.repeat(tries, 1)
    begin, end = _freed(first, boxes, grow), _freed(last, boxes, grow)

    signs = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]], device=start.device)
    offset = signs * (boxes[:, :, None, 3:] + grow[:, None, None, None] + 2e-3)
    corners = boxes[:, :, None, :2] + rotate_xy(boxes[:, :, None, 2].expand(offset.shape[:-1]), offset)
    nodes = torch.cat([begin[:, None], end[:, None], corners.flatten(1, 2)], dim=1)

    low = torch.tensor(floor.low, device=start.device) + grow[:, None, None]
    high = torch.tensor(floor.high, device=start.device) - grow[:, None, None]
    outside = ((nodes < low) | (nodes > high)).any(dim=2)
    outside[:, :2] = False
    cost = torch.linalg.vector_norm(nodes[:, :, None] - nodes[:, None], dim=-1)
    cost = cost.masked_fill(_blocked(nodes, boxes, grow) | outside[:, :, None] | outside[:, None], BLOCKED)

    # Bellman-Ford from the goal: a shortest path among convex boxes has few corners.
    most = boxes.shape[1] * 2 + 1
    rest = cost[:, :, 1].clone()
    rest[:, 1] = 0.0
    for _ in range(most):
        rest = torch.minimum(rest, (cost + rest[:, None]).amin(dim=2))
    at = torch.zeros(len(nodes), dtype=torch.long, device=start.device)
    points = [first, begin]
    rows = torch.arange(len(nodes), device=start.device)
    for _ in range(most):
        onward = cost[rows, at] + rest
        onward[rows, at] = torch.inf
        following = onward.argmin(dim=1)
        at = torch.where(at == 1, at, following)
        points.append(nodes[rows, at])
    found = rest[:, 0] < BLOCKED
    path = torch.stack([*points, last], dim=1)
    path = torch.where(found[:, None, None], path, last[:, None])
    path[:, 0] = first

    length = torch.linalg.vector_norm(path[:, 1:] - path[:, :-1], dim=2).sum(dim=1)
    length = torch.where(found, length, BLOCKED)
    cost_of_try = (length - DETOUR * grow).view(tries, worlds)
    best = cost_of_try.argmin(dim=0) * worlds + torch.arange(worlds, device=start.device)
    return Paths(path[best], length[best], torch.where(found, grow, 0.0)[best])
