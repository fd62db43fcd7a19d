"""SitSofa's expert: around the cartons to the open end of the gap in front of the sofa, sideways in, back, down.

The gap between coffee table and sofa is 0.59 m wide: a robot that turns in it hits one of the two. So it turns its back
to the sofa at the gate, next to the gap, and goes in sideways.

What decisions are read from: sofa, table and cartons are in the head camera's picture from the start on. Later the
sofa is behind the robot, and its true pose is a stand-in for what the robot remembers of it: the sofa never moves.
The end of the way back and down is judged by the robot's own pose and by time, not by a contact force.
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
from arena_newton.rotations import heading, rotate_xy, wrap_angle
from arena_newton.tasks.base import ROOM
from arena_newton.tasks.sit_sofa import CARTONS, SEAT
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.navigate import NavigationLimits
from arena_newton.trackers.motions.primitives import FORWARD_ARMS

__all__ = ["SitSofaExpert"]

SOFA, TABLE = "/World/Sofa", "/World/CoffeeTable"
SHOULDER_PITCHES, ELBOWS = [0, 7], [3, 10]
"""Among the 14 columns of `MotionCommand.arms`."""

GATE_ASIDE = (0.26, 0.34, 0.42, 0.50, 0.60, 0.70)
"""How far beyond the end of the seat the robot may turn its back to the sofa [m]. The armrest ends 0.10 m beyond it."""
GATE_AHEAD = (0.36, 0.26, 0.16, 0.06, -0.04, -0.14, -0.24)
"""How far in front of the seat's edge it may do so [m], negative next to the armrest. The best gate is the first one
of both lists; a carton in front of the gap moves it."""
GATE_CLEARANCE = CLEARANCES[-1] + 0.01
"""Distance of a gate from all obstacles [m]: with less no path leads to it."""
GATE_WITHIN = (0.12, 0.20)
"""Errors at the gate that the way sideways takes up [m, rad]."""
MOVED = 0.06
"""A carton that moved farther than this since the path was planned requires a new one [m]."""
SEAT_ASIDE = (-0.50, -0.42)
"""Where to sit, from the end of the seat [m], range of the style: shoulder and arm fit next to the armrest from -0.32
on, and farther in the back points at the middle of the seat within 45° (the task's predicate `turn`)."""
INSIDE_AHEAD = (0.28, 0.33)
"""How far in front of the edge the robot goes sideways [m], range of the style: half of the gap."""
PACE = (0.92, 1.0)
"""Fraction of the navigator's speed on the way to the gate, range of the style: the step budget allows no less."""
ARMS_UP, ELBOWS_OUT = 0.15, 0.20
"""Shoulders' pitch and elbows differ by up to this from `FORWARD_ARMS` while the robot sits down [rad]: style."""
SEAT_AHEAD = 0.12
"""Pelvis in front of the edge at the end of the way back [m]: the calves are about to touch the sofa."""
SIDEWAYS, BACKWARD, TURN = 0.34, 0.22, 0.6
"""Largest speeds in the gap [m/s, m/s, rad/s]."""
GAIN, HEADING_GAIN = 1.5, 1.5
"""Speed for a distance, yaw rate for a heading error [1/s]."""
CRAWL = 0.06
"""Smallest speed on the way sideways or back [m/s]; without it the last centimetres take seconds."""
BESIDE = 0.15
"""Distance sideways at which the way back begins [m]: it takes up the rest."""
BACKED = 0.02
"""Distance to the end of the way back that is good enough [m]."""

LONGEST = {
    "approach": 14.0,
    "sideways": 6.0,
    "back": 4.0,
    "stand": 0.8,
    "lower": 2.2,
    "press": 1.0,
    "sit": 1.5,
    "rise": 1.8,
    "straighten": 1.2,
    "forward": 2.0,
}
"""Phase → longest time [s]. `stand` to `sit` and `rise` take just this time; `sit` ends only when the seat was missed,
since success ends the episode."""

LOWER_HEIGHT, LOWER_BACK = 0.55, 0.22
"""Pelvis above the floor and behind its position over the feet when it touches the seat of 0.42 m [m]."""
PRESS_HEIGHT, PRESS_BACK = 0.51, 0.34
"""The same at the end [m]: commanded into the cushion, since a tracker keeps the weight over the feet as it can."""
LEAN = 0.20
"""Forward lean of pelvis and of waist on the way down [rad]."""
NEXT = dict(zip(LONGEST, [*list(LONGEST)[1:], "back"], strict=True))
"""Phase → the one after it; the last one goes back to the edge."""
RISE_LEAN = (0.45, 0.35)
"""The same on the way up, when the weight must come over the feet before the seat is left [rad]."""
RISE_HEIGHT = 0.59
"""Pelvis above the floor until its weight is over the feet [m]."""
RISE_BEHIND = 0.04
"""A missed seat is tried again this much nearer to the edge [m]."""


class SitSofaExpert(Expert):
    """To the gate, sideways in front of the seat, back to its edge, down; up and once more where the seat was missed."""

    task = "sit_sofa"

    def __init__(self, sight: Sight):
        """Find sofa, table and cartons."""
        super().__init__(sight)
        worlds, device, scene = sight.worlds, sight.device, sight.scene
        self._seat = scene.marker(SEAT)
        self._edge = sight.frame(SEAT)
        self._sofa = [sight.box(scene.geom_labels[geom]) for geom in scene.geom_ids(SOFA)]
        self._table = [sight.box(scene.geom_labels[geom]) for geom in scene.geom_ids(TABLE)]
        self._cartons = [sight.box(carton) for carton in CARTONS]
        self._half = torch.tensor(self._seat.half, dtype=torch.float32, device=device)
        self._forward_arms = torch.tensor(FORWARD_ARMS, dtype=torch.float32, device=device)
        limits = NavigationLimits(forward=0.58, turn=0.9, sideways=0.28, arrive_position=0.045, arrive_heading=0.06)
        self.walk = Walk(sight, limits)
        self.phase = Phases(LONGEST, worlds, device)
        """Where each world is in the task."""
        self._named: list[str] = []
        self._seen = torch.zeros(worlds, len(CARTONS), 5, device=device)
        self._seat_aside = torch.zeros(worlds, device=device)
        self._nearer = torch.zeros(worlds, device=device)
        self._inside_ahead = torch.zeros(worlds, device=device)
        self._pace = torch.ones(worlds, device=device)
        self._arms = self._forward_arms.repeat(worlds, 1)

    def begin(self, mask: Tensor, style: Style) -> None:
        """Draw the style, plan from the robot's position."""
        self.phase.begin(mask)
        self.walk.begin(mask)
        self._seat_aside = select(mask, style.uniform("seat aside", *SEAT_ASIDE), self._seat_aside)
        self._inside_ahead = select(mask, style.uniform("inside ahead", *INSIDE_AHEAD), self._inside_ahead)
        self._pace = select(mask, style.uniform("pace", *PACE), self._pace)
        arms = self._forward_arms.repeat(self.sight.worlds, 1)
        arms[:, SHOULDER_PITCHES] += style.uniform("arms up", -ARMS_UP, ARMS_UP)[:, None]
        arms[:, ELBOWS] += style.uniform("elbows", -ELBOWS_OUT, ELBOWS_OUT)[:, None]
        self._arms = select(mask, arms, self._arms)
        self._nearer = self._nearer.masked_fill(mask, 0.0)
        self._plan(mask, self._boxes(self._cartons))

    def _boxes(self, boxes: list[tuple[int, Tensor, Tensor]]) -> Tensor:
        """Boxes as rectangles on the floor, shape [worlds, boxes, 5]."""
        found = []
        for body, offset, half in boxes:
            quat = self.sight.body(body)[1]
            found.append(footprint(self.sight.point(body, offset), quat, half.expand(len(quat), 3)))
        return torch.stack(found, dim=1)

    def _frame(self) -> tuple[Tensor, Tensor]:
        """Middle of the seat [m] and its heading [rad], in which y points where a sitter looks."""
        quat = self.sight.body(self._seat.body_id)[1]
        own = torch.tensor(self._seat.quat, dtype=torch.float32, device=quat.device)
        return self._edge()[:, :2], wrap_angle(heading(quat) + heading(own[None]))

    def _world(self, aside: Tensor, ahead: Tensor) -> Tensor:
        """Points [m] given from the end of the seat outwards and from its edge to the front; [W, n] to [W, n, 2]."""
        middle, yaw = self._frame()
        local = torch.stack([self._half[0] + aside, self._half[1] + ahead], dim=-1)
        return middle[:, None] + rotate_xy(yaw[:, None].expand(aside.shape), local)

    def _place(self) -> Tensor:
        """Robots from the end of the seat and its edge [m], and headings away from straight out [rad]; [W, 3]."""
        pose = self.sight.pose
        middle, yaw = self._frame()
        local = rotate_xy(-yaw, pose[:, :2] - middle) - self._half[:2]
        return torch.cat([local, wrap_angle(pose[:, 2] - yaw - math.pi / 2)[:, None]], dim=1)

    def _plan(self, mask: Tensor, cartons: Tensor) -> None:
        """Choose the gate and the path to it."""
        worlds, device = len(cartons), cartons.device
        sofa = _cover(self._boxes(self._sofa), self._frame()[1])
        boxes = torch.cat([sofa[:, None], self._boxes(self._table), cartons], dim=1)
        aside, ahead = torch.cartesian_prod(
            torch.tensor(GATE_ASIDE, device=device), torch.tensor(GATE_AHEAD, device=device)
        ).unbind(1)
        gates = self._world(aside.expand(worlds, -1), ahead.expand(worlds, -1))
        grown = torch.cat([boxes[..., :3], boxes[..., 3:] + GATE_CLEARANCE], dim=2)
        lack = (-signed_distance(gates, grown)).clamp_min(0.0)
        price = 10.0 * lack + (aside - GATE_ASIDE[0]) + 0.5 * (GATE_AHEAD[0] - ahead)
        gate = gates[torch.arange(worlds, device=device), price.argmin(dim=1)]
        back_turned = self._frame()[1] + math.pi / 2
        self.walk.to(mask, torch.cat([gate, back_turned[:, None]], dim=1), Floor(boxes, *ROOM))
        self._seen = select(mask, cartons, self._seen)

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Advance the state machine, then command its phase."""
        cartons = self._boxes(self._cartons)
        moved = (cartons - self._seen)[..., :2].abs().amax(dim=(1, 2)) > MOVED
        again = mask & moved & self.phase.at("approach")
        if again.any():
            self._plan(again, cartons)
        walk = self.walk.command(mask & self.phase.at("approach"), dt)
        self.phase.advance(mask, dt)
        place = self._place()
        self._named = self.phase.names()
        command = self._act(walk.velocity, place)
        early = {
            "approach": (walk.distance < GATE_WITHIN[0]) & (walk.heading_error.abs() < GATE_WITHIN[1]),
            "sideways": (place[:, 0] - self._seat_aside).abs() < BESIDE,
            "back": place[:, 1] < SEAT_AHEAD - self._nearer + BACKED,
            "forward": place[:, 1] > self._inside_ahead,
        }
        late = self.phase.late
        never = torch.zeros_like(late)
        leaving = {name: mask & self.phase.at(name) & (late | early.get(name, never)) for name in NEXT}
        self._nearer = self._nearer + RISE_BEHIND * leaving["sit"]
        for name, following in NEXT.items():
            self.phase.enter(following, leaving[name])
        return command

    def phases(self) -> list[str]:
        """Names in `LONGEST`."""
        return self._named

    def _act(self, approach: Tensor, place: Tensor) -> MotionCommand:
        """The command of each world's phase."""
        at = self.phase.at
        command = MotionCommand.neutral(self.sight.worlds, self.sight.device)
        gap = at("sideways", "back", "forward")
        velocity = approach * (self._pace * at("approach"))[:, None]
        command.velocity = torch.where(gap[:, None], self._drift(place), velocity)

        lowering, pressing, rising = at("lower"), at("press", "sit"), at("rise")
        fraction = torch.where(at("sit"), 1.0, self.phase.fraction)
        down = (command.height, LOWER_HEIGHT, PRESS_HEIGHT, RISE_HEIGHT)
        back = (torch.zeros_like(fraction), LOWER_BACK, PRESS_BACK, 0.0)
        for name, (start, touch, end, up) in {"height": down, "pelvis_back": back}.items():
            value = torch.where(lowering, start + fraction * (touch - start), start)
            value = torch.where(pressing, touch + fraction * (end - touch), value)
            setattr(command, name, torch.where(rising, up, value))
        bent = lowering | pressing
        command.pitch = LEAN * bent + RISE_LEAN[0] * rising
        command.waist[:, 2] = LEAN * bent + RISE_LEAN[1] * rising
        command.arms = select(bent | rising | at("stand"), self._arms, command.arms)
        return command

    def _drift(self, place: Tensor) -> Tensor:
        """Velocity in the gap: sideways, back or forward with the back to the sofa, shape [worlds, 3]."""
        backwards = self.phase.at("back")
        ahead = torch.where(backwards, SEAT_AHEAD - self._nearer, self._inside_ahead) - place[:, 1]
        left = place[:, 0] - self._seat_aside
        wanted = GAIN * torch.stack([ahead, left], dim=1)
        most = torch.tensor([BACKWARD, SIDEWAYS], device=place.device)
        moving = torch.stack([backwards, self.phase.at("sideways")], dim=1)
        crawling = torch.where(moving & (wanted.abs() < CRAWL), CRAWL * wanted.sign(), wanted)
        planar = rotate_xy(-place[:, 2], crawling.clamp(-most, most))
        turn = (-HEADING_GAIN * place[:, 2]).clamp(-TURN, TURN)
        return torch.cat([planar, turn[:, None]], dim=1)


def _cover(boxes: Tensor, yaw: Tensor) -> Tensor:
    """The rectangle with this heading [rad] around some: [W, B, 5] and [W] to [W, 5]."""
    signs = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]], device=boxes.device)
    turned = boxes[..., 2, None].expand(*boxes.shape[:2], 4)
    corners = (boxes[:, :, None, :2] + rotate_xy(turned, signs * boxes[:, :, None, 3:])).flatten(1, 2)
    local = rotate_xy(-yaw[:, None].expand(corners.shape[:2]), corners)
    low, high = local.amin(dim=1), local.amax(dim=1)
    return torch.cat([rotate_xy(yaw, 0.5 * (low + high)), yaw[:, None], 0.5 * (high - low)], dim=1)
