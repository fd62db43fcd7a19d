"""SitSofa's expert: around the cartons to the open end of the gap in front of the sofa, sideways in, back, down.

The gap between coffee table and sofa is 0.59 m wide, and a robot that turns in it hits one of the two. So it turns its
back to the sofa at a gate next to the gap, and goes in sideways.

What decisions are read from: sofa, table and both cartons are in the head camera's picture from the start on. Later
the sofa is behind the robot, and its true pose is a stand-in for what the robot remembers: it never moves. How far back
and down the robot is follows from its own pose and from time, not from a contact force.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Expert, Sight
from arena_newton.policies.experts.phases import Phases, select
from arena_newton.policies.experts.planning import CLEARANCES, Floor, footprint, signed_distance
from arena_newton.policies.experts.style import Style
from arena_newton.policies.experts.walking import Walk
from arena_newton.robot.rotations import heading, rotate_xy, wrap_angle
from arena_newton.tasks.base import ROOM
from arena_newton.tasks.sit_sofa import CARTONS, SEAT
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.navigate import NavigationLimits
from arena_newton.trackers.motions.primitives import FORWARD_ARMS

__all__ = ["LONGEST", "SitSofaExpert"]

SOFA, TABLE = "/World/Sofa", "/World/CoffeeTable"
SHOULDER_PITCHES, ELBOWS = [0, 7], [3, 10]
"""Among the 14 columns of `MotionCommand.arms`."""

LIMITS = NavigationLimits(forward=0.58, turn=0.9, sideways=0.28)
"""Limits of the walk to the gate: faster than the navigator's own, for the step budget of `paper` is short."""
GATE_ASIDE = (0.26, 0.34, 0.42, 0.50, 0.60, 0.70)
"""Distances beyond the end of the seat at which the robot may turn its back to the sofa [m]. The armrest ends 0.10 m
beyond it."""
GATE_AHEAD = (0.36, 0.26, 0.16, 0.06, -0.04, -0.14, -0.24)
"""Distances in front of the seat's edge at which it may do so [m], negative next to the armrest. The best gate is the
first one of both lists; a carton in front of the gap moves it."""
GATE_CLEARANCE = CLEARANCES[-1] + 0.01
"""Distance of a gate from all obstacles [m]: with less no path leads to it."""
GATE_WITHIN = (0.12, 0.20)
"""Errors at the gate that the way sideways takes up [m, rad]."""
MOVED = 0.06
"""A carton that moved farther than this since the path was planned requires a new one [m]."""

SIDEWAYS, BACKWARD, TURN = 0.34, 0.22, 0.6
"""Largest speeds in the gap [m/s, m/s, rad/s]."""
GAIN, HEADING_GAIN = 1.5, 1.5
"""Speed for a distance, yaw rate for a heading error [1/s]."""
CRAWL = 0.06
"""Smallest speed sideways and back [m/s]; without it the last centimetres take seconds."""
ASIDE_WITHIN = 0.15
"""Distance sideways at which the way back begins [m]: it takes up the rest."""
IN_FRONT = -0.25
"""Nearer to the end of the seat than this there is no sitting down next to the armrest [m]."""
SEAT_AHEAD = 0.12
"""Pelvis in front of the edge at the end of the way back [m]: at 0.16 m the robot sits on the edge alone, at 0.08 m the
seat holds its pelvis 3 cm higher."""
BACKED = 0.02
"""Distance to the end of the way back that is good enough [m]."""
NEARER = 0.04
"""A missed seat is tried again this much nearer to the edge [m]."""

LOWER_HEIGHT, LOWER_BACK = 0.55, 0.22
"""Pelvis above the floor, and behind its position over the feet, when it touches a seat of 0.42 m [m]."""
PRESS_HEIGHT, PRESS_BACK = 0.51, 0.34
"""The same at the end [m]: into the cushion, since a tracker keeps the weight over the feet as far as it can."""
LEAN = 0.20
"""Forward lean of pelvis and of waist on the way down [rad]."""
RISE_HEIGHT, RISE_LEAN = 0.59, (0.45, 0.35)
"""Pelvis above the floor [m] and leans [rad] until the weight is over the feet again: leaving the seat earlier, the
robot falls back (as in `primitives.rise`)."""

LONGEST = {
    "approach": 16.0,
    "sideways": 7.0,
    "back": 4.0,
    "stand": 0.8,
    "lower": 2.2,
    "press": 1.0,
    "sit": 1.5,
    "rise": 1.8,
    "straighten": 1.2,
    "forward": 2.0,
}
"""Phase → longest time [s]. `stand` to `straighten` take just this time. Success ends the episode: `sit` ends only
where the seat was missed. A walk that is late is planned again."""
SITTING = ("stand", "lower", "press", "sit", "rise")
"""Phases in which the robot moves on the spot."""
NEXT = dict(zip(LONGEST, [*list(LONGEST)[1:], "back"], strict=True))
"""Phase → the one after it; the last one leads back to the edge."""

SEAT_ASIDE = (-0.50, -0.42)
"""Style: where to sit, from the end of the seat [m]. Shoulder and arm fit next to the armrest from -0.32 on; from -0.41
on the back points at the middle of the seat within 45° (the task's predicate `turn`)."""
GAP_AHEAD = (0.28, 0.33)
"""Style: distance from the edge on the way sideways [m]: half of the gap."""
PACE = (0.92, 1.0)
"""Style: fraction of the navigator's speed; the step budget allows no less."""
ARMS_UP, ELBOWS_OUT = 0.15, 0.20
"""Style: largest difference of shoulder pitch and elbow from `FORWARD_ARMS` on the way down [rad]."""


class SitSofaExpert(Expert):
    """Walks to the gate, sideways in front of the seat, back to its edge, and sits; rises and repeats after a miss."""

    task = "sit_sofa"

    def __init__(self, sight: Sight):
        """Find sofa, table and cartons."""
        super().__init__(sight)
        worlds, device, scene = sight.worlds, sight.device, sight.scene
        self._seat, self._centre = scene.marker(SEAT), sight.frame(SEAT)
        self._half = torch.tensor(self._seat.half[:2], dtype=torch.float32, device=device)
        self._turned = heading(torch.tensor([self._seat.quat], dtype=torch.float32, device=device))
        self._sofa, self._table = (
            [sight.box(scene.geom_labels[geom]) for geom in scene.geom_ids(prim)] for prim in (SOFA, TABLE)
        )
        self._cartons = [sight.box(carton) for carton in CARTONS]
        self.walk = Walk(sight, LIMITS)
        self.phase = Phases(LONGEST, worlds, device)
        """Phase of each world in the task."""
        self._named = self.phase.names()
        self._most = torch.tensor([BACKWARD, SIDEWAYS], device=device)
        self._seen = torch.zeros(worlds, len(CARTONS), 5, device=device)
        self._nearer = torch.zeros(worlds, device=device)
        self._seat_aside = torch.zeros(worlds, device=device)
        self._gap_ahead = torch.zeros(worlds, device=device)
        self._pace = torch.ones(worlds, device=device)
        self._arms = torch.tensor(FORWARD_ARMS, dtype=torch.float32, device=device).repeat(worlds, 1)

    def begin(self, mask: Tensor, style: Style) -> None:
        """Draw the style; the first command plans."""
        self.phase.begin(mask)
        self.walk.begin(mask)
        self._nearer = self._nearer.masked_fill(mask, 0.0)
        self._seat_aside = select(mask, style.uniform("seat aside", *SEAT_ASIDE), self._seat_aside)
        self._gap_ahead = select(mask, style.uniform("gap ahead", *GAP_AHEAD), self._gap_ahead)
        self._pace = select(mask, style.uniform("pace", *PACE), self._pace)
        arms = torch.tensor(FORWARD_ARMS, dtype=torch.float32, device=self._arms.device).repeat(len(mask), 1)
        arms[:, SHOULDER_PITCHES] += style.uniform("arms up", -ARMS_UP, ARMS_UP)[:, None]
        arms[:, ELBOWS] += style.uniform("elbows out", -ELBOWS_OUT, ELBOWS_OUT)[:, None]
        self._arms = select(mask, arms, self._arms)

    def _rectangles(self, boxes: list[tuple[int, Tensor, Tensor]]) -> Tensor:
        """Boxes as rectangles on the floor, shape [worlds, boxes, 5]."""
        found = []
        for body, offset, half in boxes:
            quat = self.sight.body(body)[1]
            found.append(footprint(self.sight.point(body, offset), quat, half.expand(len(quat), 3)))
        return torch.stack(found, dim=1)

    def _frame(self) -> tuple[Tensor, Tensor]:
        """Middle of the seat [m] and the heading of its x axis [rad]; a sitter looks along y."""
        quat = self.sight.body(self._seat.body_id)[1]
        return self._centre()[:, :2], wrap_angle(heading(quat) + self._turned)

    def _offset(self) -> Tensor:
        """The robot beyond the end of the seat, ahead of its edge [m], and off the sitter's heading [rad]; [W, 3]."""
        pose, (middle, yaw) = self.sight.pose, self._frame()
        local = rotate_xy(-yaw, pose[:, :2] - middle) - self._half
        return torch.cat([local, wrap_angle(pose[:, 2] - yaw - 0.5 * math.pi)[:, None]], dim=1)

    def _plan(self, mask: Tensor, cartons: Tensor) -> None:
        """Choose the gate and the path to it."""
        middle, yaw = self._frame()
        boxes = torch.cat(
            [_cover(self._rectangles(self._sofa), yaw)[:, None], self._rectangles(self._table), cartons], dim=1
        )
        aside, ahead = (torch.tensor(offsets, device=boxes.device) for offsets in (GATE_ASIDE, GATE_AHEAD))
        grid = torch.cartesian_prod(aside, ahead)
        gates = middle[:, None] + rotate_xy(
            yaw[:, None].expand(-1, len(grid)), (grid + self._half).expand(len(boxes), -1, 2)
        )
        grown = torch.cat([boxes[..., :3], boxes[..., 3:] + GATE_CLEARANCE], dim=2)
        lack = (-signed_distance(gates, grown)).clamp_min(0.0)
        # Walking is faster than going sideways, and a gate in a corner costs turns.
        price = 10.0 * lack + grid[:, 0] + 0.5 * (GATE_AHEAD[0] - grid[:, 1])
        gate = gates[torch.arange(len(gates), device=gates.device), price.argmin(dim=1)]
        goal = torch.cat([gate, (yaw + 0.5 * math.pi)[:, None]], dim=1)
        self.walk.to(mask, goal, Floor(boxes, *ROOM))
        self._seen = select(mask, cartons, self._seen)

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Command the phase, then see whether it ends."""
        walking = mask & self.phase.at("approach")
        if walking.any():
            cartons = self._rectangles(self._cartons)
            moved = (cartons - self._seen)[..., :2].abs().amax(dim=(1, 2)) > MOVED
            again = walking & (moved | (self.phase.clock == 0.0))
            if again.any():
                self._plan(again, cartons)
        walk = self.walk.command(walking, dt)
        self.phase.advance(mask, dt)
        self._named = self.phase.names()
        offset = self._offset()
        command = self._act(walk.velocity, offset)

        late = self.phase.late
        lost = mask & late & (self.phase.at("approach") | (self.phase.at("sideways") & (offset[:, 0] > IN_FRONT)))
        early = {
            "approach": lambda: (walk.distance < GATE_WITHIN[0]) & (walk.heading_error.abs() < GATE_WITHIN[1]),
            "sideways": lambda: (offset[:, 0] - self._seat_aside).abs() < ASIDE_WITHIN,
            "back": lambda: offset[:, 1] < SEAT_AHEAD - self._nearer + BACKED,
            "forward": lambda: offset[:, 1] > self._gap_ahead,
        }
        leaving = {name: self.phase.over(name, mask & ~lost, early.get(name, lambda: late)) for name in NEXT}
        self._nearer = self._nearer + NEARER * leaving["sit"]
        for name, following in NEXT.items():
            self.phase.enter(following, leaving[name])
        self.phase.enter("approach", lost)
        return command

    def phases(self) -> list[str]:
        """Names of `LONGEST`."""
        return self._named

    def _act(self, approach: Tensor, offset: Tensor) -> MotionCommand:
        """The command of each world's phase."""
        at = self.phase.at
        command = MotionCommand.neutral(self.sight.worlds, self.sight.device)
        walking = approach * (self._pace * at("approach"))[:, None]
        command.velocity = walking
        if self.phase.present("sideways", "back", "forward"):
            command.velocity = torch.where(at("sideways", "back", "forward")[:, None], self._drift(offset), walking)
        if not self.phase.present(*SITTING):
            return command
        lowering, pressing, rising = at("lower"), at("press", "sit"), at("rise")
        fraction = torch.where(at("sit"), 1.0, self.phase.fraction)

        def course(start: Tensor, touch: float, end: float, up: float) -> Tensor:
            """Course from `start` to the touch, to the end, and up again."""
            value = torch.where(lowering, start + fraction * (touch - start), start)
            value = torch.where(pressing, touch + fraction * (end - touch), value)
            return value.masked_fill(rising, up)

        command.height = course(command.height, LOWER_HEIGHT, PRESS_HEIGHT, RISE_HEIGHT)
        command.pelvis_back = course(command.pelvis_back, LOWER_BACK, PRESS_BACK, 0.0)
        bent = lowering | pressing
        command.pitch = LEAN * bent + RISE_LEAN[0] * rising
        command.waist[:, 2] = LEAN * bent + RISE_LEAN[1] * rising
        command.arms = select(bent | rising | at("stand"), self._arms, command.arms)
        return command

    def _drift(self, offset: Tensor) -> Tensor:
        """Velocity in the gap, the back to the sofa: sideways, back or forward, shape [worlds, 3]."""
        sideways, backward = self.phase.at("sideways"), self.phase.at("back")
        ahead = torch.where(backward, SEAT_AHEAD - self._nearer, self._gap_ahead) - offset[:, 1]
        wanted = GAIN * torch.stack([ahead, offset[:, 0] - self._seat_aside], dim=1)
        main = torch.stack([backward, sideways], dim=1)
        wanted = torch.where(main & (wanted.abs() < CRAWL), CRAWL * wanted.sign(), wanted)
        turn = (-HEADING_GAIN * offset[:, 2]).clamp(-TURN, TURN)
        return torch.cat([rotate_xy(-offset[:, 2], wanted.clamp(-self._most, self._most)), turn[:, None]], dim=1)


def _cover(boxes: Tensor, yaw: Tensor) -> Tensor:
    """The rectangle with this heading [rad] around several: [W, B, 5] and [W] to [W, 5]."""
    signs = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]], device=boxes.device)
    turned = boxes[..., 2, None].expand(*boxes.shape[:2], 4)
    corners = (boxes[:, :, None, :2] + rotate_xy(turned, signs * boxes[:, :, None, 3:])).flatten(1, 2)
    local = rotate_xy(-yaw[:, None].expand(corners.shape[:2]), corners)
    low, high = local.amin(dim=1), local.amax(dim=1)
    return torch.cat([rotate_xy(yaw, 0.5 * (low + high)), yaw[:, None], 0.5 * (high - low)], dim=1)
