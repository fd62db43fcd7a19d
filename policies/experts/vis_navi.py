"""VisNavi's expert: plan around the obstacles at their current positions, walk, stand in the marked area.

Some obstacles still roll when the episode begins; one that moves, or that the robot pushes, requires a new plan.

What its decisions are read from: the true poses, from the first tick on. The first picture of the head camera shows
nearly all of it: at the start of each of the protocol's 60 base episodes at least 8 % of every obstacle's surface is in
view and not hidden (in execution mode all but one block, which stands behind another far from the path), and at least 4
pixels of a 224 x 224 picture are the yellow of sign or area (median 57), also in the 5 where an obstacle hides the
sign. In 13 the sign has fewer than 10 pixels, the bar of `certify --checks visible`; its 20 episodes see it by tick 50.
"""

from __future__ import annotations

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Expert, Sight
from arena_newton.policies.experts.phases import select
from arena_newton.policies.experts.planning import BLOCKED, Floor, footprint, plan, signed_distance
from arena_newton.policies.experts.style import Style
from arena_newton.policies.experts.walking import paced
from arena_newton.robot.rotations import atan2, heading, rotate_xy
from arena_newton.tasks.base import ROOM
from arena_newton.tasks.vis_navi import SIGN
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.navigate import NavigationLimits, Navigator

__all__ = ["VisNaviExpert"]

OBSTACLES = ("Beam_a", "Beam_b", "Beam_c", "Block_a", "Block_b", "Block_c")
FEET = 0.2
"""Margin inside the area for both feet and the deviation of a stop [m]."""
APART = 0.42
"""Distance that the goal should keep from obstacles and sign [m]."""
MOVED = 0.06
"""An obstacle that moved farther than this since the plan was made requires a new one [m]."""
STRAY = 0.35
"""Distance from its path beyond which a robot does so too [m]."""
CORNER = 0.05
"""Points of a path closer to each other than this count as one [m]."""
LONGEST = 25.0
"""Longest time on one path [s], twice what 6 m take; then it plans again from where it is ..."""
HELD = 3.0
"""... as it does after standing this long [s] without success, now to the best place whatever the style."""
PACE = (0.85, 1.0)
"""Speed against the limit, drawn between these."""
WIDER = 0.05
"""Obstacles count as larger by up to this on all sides, drawn [m]."""
OFFSET = 0.5
"""The place that an episode favours is off the area's middle by up to this fraction of where feet have room, drawn."""
FORWARD = 0.55
"""Walking speed at full pace [m/s]."""


class VisNaviExpert(Expert):
    """Walks to the best position in the marked area on the shortest path with room to both sides."""

    task = "vis_navi"

    def __init__(self, sight: Sight):
        """Find obstacles, sign and area."""
        super().__init__(sight)
        self._obstacles = [sight.box(f"/World/{name}") for name in OBSTACLES]
        self._sign = sight.box(f"{SIGN}/Frame/Body")
        self._zone = sight.scene.marker(f"{SIGN}/Frame/Zone")
        self._centre = sight.frame(f"{SIGN}/Frame/Zone")
        worlds, device = sight.worlds, sight.device
        self.navigator = Navigator(worlds, device, NavigationLimits(forward=FORWARD))
        self.goal = torch.zeros(worlds, 3, device=device)
        """Pose to stand at: x, y [m], yaw [rad], shape [worlds, 3]."""
        self._route = torch.zeros(0, device=device)
        self._stray = torch.zeros(worlds, device=device)
        self._leg = torch.zeros(worlds, dtype=torch.long, device=device)
        self._seen = torch.zeros(worlds, len(OBSTACLES), 5, device=device)
        self._clock, self._held, self._wider = (torch.zeros(worlds, device=device) for _ in range(3))
        self._pace = torch.ones(worlds, device=device)
        self._favoured = torch.zeros(worlds, 2, device=device)

    def boxes(self) -> Tensor:
        """Present obstacles as rectangles on the floor, shape [worlds, obstacles, 5]."""
        return torch.stack([self._footprint(*box) for box in self._obstacles], dim=1)

    def _footprint(self, body: int, offset: Tensor, half: Tensor) -> Tensor:
        _, quat = self.sight.body(body)
        return footprint(self.sight.point(body, offset), quat, half.expand(len(quat), 3))

    def begin(self, mask: Tensor, style: Style) -> None:
        """Draw pace, margin and favoured place; plan from the robot's position."""
        self.navigator.reset(mask)
        self._pace = select(mask, style.uniform("pace", *PACE), self._pace)
        self._wider = select(mask, style.uniform("wider", 0.0, WIDER), self._wider)
        place = torch.stack([style.uniform(f"place {axis}", -OFFSET, OFFSET) for axis in "xy"], dim=1)
        self._favoured = select(mask, place, self._favoured)
        self._plan(mask, self.boxes())

    def _plan(self, mask: Tensor, boxes: Tensor) -> None:
        pose = self.sight.pose
        zone, quat = self._centre(), self.sight.body(self._zone.body_id)[1]
        every = torch.cat([boxes, self._footprint(*self._sign)[:, None]], dim=1)
        spot = self._spot(zone[:, :2], heading(quat), every)
        # The sign is in the area itself: it only counts for the choice of the goal.
        grown = torch.cat([boxes[..., :3], boxes[..., 3:] + self._wider[:, None, None]], dim=2)
        paths = plan(pose[:, :2], spot, Floor(grown, *ROOM))
        last = spot - torch.where((paths.length < BLOCKED)[:, None], _before_last(paths.points), pose[:, :2])
        goal = torch.cat([spot, atan2(last[:, 1], last[:, 0])[:, None]], dim=1)
        old = self._route if len(self._route) else paths.points
        self._route = torch.where(mask[:, None, None], paths.points, old)
        self.goal = torch.where(mask[:, None], goal, self.goal)
        self._seen = torch.where(mask[:, None, None], boxes, self._seen)
        self._stray = self._stray.masked_fill(mask, 0.0)
        self._leg = self._leg.masked_fill(mask, 0)
        self._clock, self._held = self._clock.masked_fill(mask, 0.0), self._held.masked_fill(mask, 0.0)
        self.navigator.retarget(mask)

    def _spot(self, centre: Tensor, yaw: Tensor, boxes: Tensor) -> Tensor:
        """The best position in the area: clear of obstacles, near the favoured one; [worlds, 2]."""
        half = torch.tensor(self._zone.half[:2], device=centre.device) - FEET
        steps = torch.linspace(-1.0, 1.0, 9, device=centre.device)
        grid = torch.cartesian_prod(steps, steps) * half
        spots = centre[:, None] + rotate_xy(yaw[:, None].expand(-1, len(grid)), grid.expand(len(centre), -1, 2))
        lack = (APART - signed_distance(spots, boxes)).clamp_min(0.0)
        price = 3.0 * lack + torch.linalg.vector_norm(grid - self._favoured[:, None] * half, dim=2)
        best = price.argmin(dim=1)
        return spots[torch.arange(len(spots), device=spots.device), best]

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Follow the path; plan again where an obstacle was pushed or the robot strayed."""
        boxes, pose = self.boxes(), self.sight.pose
        stale = (boxes - self._seen)[..., :2].abs().amax(dim=(1, 2)) > MOVED
        tired = self._held > HELD
        again = mask & (stale | (self._stray > STRAY) | (self._clock > LONGEST) | tired)
        if again.any():
            self._favoured = self._favoured.masked_fill((again & tired)[:, None], 0.0)
            self._plan(again, boxes)
        answer = self.navigator.command(pose, self.goal, dt, route=self._route, mask=mask)
        self._stray = torch.where(mask, answer.stray, self._stray)
        self._leg = torch.where(mask, torch.maximum(self._leg, self._nearest_leg(pose[:, :2])), self._leg)
        self._clock = self._clock + dt * mask
        self._held = self._held + dt * (mask & answer.arrived)
        command = MotionCommand.neutral(self.sight.worlds, self.sight.device)
        command.velocity = paced(answer.velocity, self._pace)
        return command

    def _legs(self) -> Tensor:
        """True for pieces of the path that have a length, bool, [worlds, points − 1]."""
        return torch.linalg.vector_norm(self._route[:, 1:] - self._route[:, :-1], dim=2) > CORNER

    def _nearest_leg(self, here: Tensor) -> Tensor:
        """Number of the path's leg nearest to a position, those without a length not counted; [worlds]."""
        start, step = self._route[:, :-1], self._route[:, 1:] - self._route[:, :-1]
        along = ((here[:, None] - start) * step).sum(2) / step.square().sum(2).clamp_min(1e-9)
        gap = torch.linalg.vector_norm(start + along.clamp(0.0, 1.0)[..., None] * step - here[:, None], dim=2)
        legs = self._legs()
        nearest = gap.masked_fill(~legs, torch.inf).argmin(dim=1, keepdim=True)
        return (torch.gather(legs.cumsum(dim=1), 1, nearest)[:, 0] - 1).clamp_min(0)

    def phases(self) -> list[str]:
        """`waypoint 1`, `waypoint 2` … while it walks to a corner of its path, `goal` on the last leg, then `hold`."""
        last = self._legs().sum(dim=1) - 1
        return [
            "hold" if holding else "goal" if leg >= end else f"waypoint {leg + 1}"
            for leg, end, holding in zip(
                self._leg.tolist(), last.tolist(), self.navigator.holding.tolist(), strict=True
            )
        ]


def _before_last(points: Tensor) -> Tensor:
    """The point from which each path reaches its last one; [W, K, 2] to [W, 2]."""
    away = torch.linalg.vector_norm(points - points[:, -1:], dim=2) > CORNER
    index = torch.arange(points.shape[1], device=points.device).expand_as(away)
    pick = torch.where(away, index, 0).amax(dim=1)
    return points[torch.arange(len(points), device=points.device), pick]
