"""Boxing's expert: walk to the side of the right bag, crouch to the target's height, lead the nearer fist to it.

The palm must come within 13 cm of a target in the bag's surface, and the palm frame is behind the fingers: a hand that
comes straight at the bag stops too far away. So the robot stands such that the target is on the bag's flank, in front
of a shoulder, and the hand passes next to the bag.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Expert, Sight
from arena_newton.policies.experts.planning import Floor, plan, signed_distance
from arena_newton.policies.experts.style import Style
from arena_newton.rotations import rotate_xy, wrap_angle
from arena_newton.tasks.base import ROOM
from arena_newton.tasks.boxing import PALMS, TARGET
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.kinematics import HAND_POINT
from arena_newton.trackers.motions.navigate import NavigationLimits, Navigator
from arena_newton.usd_scenes.g1.links import PALM_OFFSET

__all__ = ["BoxingExpert"]

BAGS = ("/World/Bag_1", "/World/Bag_2")
FLANKS = tuple(math.radians(a) for a in (60, -60, 75, -75, 45, -45, 90, -90))
"""Bearing of the target from the bag's axis minus that of the robot [rad]: positive is on the robot's right."""
BEST_FLANK = math.radians(60)
STAND = 0.45
"""Distance of pelvis and bag axis when striking [m]: bag radius, forearms and knees fit in between."""
READY = 0.70
"""The same when the robot turns to the bag, before the last step [m]: its hands must not touch the bag."""
OFF = 0.06
"""Distance of the palm from the target, away from the bag [m]: the hand arrives before it touches."""
BELOW = 0.12
"""Height of the target above the pelvis [m]: the shoulder is then 17 cm above the target."""
LOW, HIGH = 0.52, 0.74
"""Range of pelvis heights [m]."""
PATIENCE = 3.5
"""Time given to one strike before the robot moves by the error of its palm [s]."""
SHIFTS = 2
"""Number of such moves before it goes to another side of the target."""
CLOSER = 0.12
"""Longest such move [m]."""
LEAN = 0.25
"""Waist pitch of a strike [rad]."""
READY_WITHIN = (0.10, 0.15)
"""Errors at the ready pose that do not matter [m, rad]."""
STAND_WITHIN = (0.05, 0.10)
"""Errors in front of the bag that the arm compensates [m, rad]."""
STEP_TIME = 6.0
"""Time given to the last steps before the robot strikes from its present position [s]."""
GAIN = 0.6
"""Integral gain on the palm's error [1/s]: trackers leave the hand 5-20 cm behind."""
MOST = 0.15
"""Largest correction [m]."""

WALK, STEP, STRIKE = 0, 1, 2
PHASES = ("approach", "step up", "strike")
"""Their names, in this order."""


class BoxingExpert(Expert):
    """Three phases per world: to the ready pose, up to the bag, strike; after a miss back to the first."""

    task = "boxing"

    def __init__(self, sight: Sight):
        """Find bags, target and palms."""
        super().__init__(sight)
        worlds, device = sight.worlds, sight.device
        bags, boxes = [], []
        for bag in BAGS:
            _, centre, half = sight.box(f"{bag}/Collider")
            _, post, post_half = sight.box(f"{bag}/Post")
            bags.append(centre[:2])
            zero = torch.zeros(1, device=device)
            boxes.append(torch.cat([centre[:2], zero, half[:1], half[:1]]))
            boxes.append(torch.cat([post[:2], zero, post_half[:2]]))
        self._bags = torch.stack(bags)
        self._boxes = torch.stack(boxes).expand(worlds, -1, 5)
        self._target = sight.frame(f"{TARGET}/Frame/Bounds")
        self._palms = [sight.frame(name) for name in PALMS]
        self.navigator = Navigator(worlds, device, NavigationLimits(forward=0.45))
        self.phase = torch.zeros(worlds, dtype=torch.long, device=device)
        """`WALK`, `STEP` or `STRIKE`, shape [worlds]."""
        self._acting = self.phase
        self.right = torch.zeros(worlds, dtype=torch.bool, device=device)
        """The right hand strikes, shape [worlds]."""
        self.ready = torch.zeros(worlds, 3, device=device)
        self.stand = torch.zeros(worlds, 3, device=device)
        self._route = torch.zeros(0, device=device)
        self._tries = torch.zeros(worlds, dtype=torch.long, device=device)
        self._clock = torch.zeros(worlds, device=device)
        self._correction = torch.zeros(worlds, 3, device=device)

    def begin(self, mask: Tensor, style: Style) -> None:
        """Choose bag, stance and hand."""
        self._tries = self._tries.masked_fill(mask, 0)
        self.navigator.reset(mask)
        self._approach(mask)

    def _bag(self) -> tuple[Tensor, Tensor]:
        """The target's bag [m], and the bearing of the target from its axis [rad]; [worlds, 2] and [worlds]."""
        target = self._target()[:, :2]
        gap = torch.linalg.vector_norm(target[:, None] - self._bags, dim=2)
        bag = self._bags[gap.argmin(dim=1)]
        return bag, torch.atan2(target[:, 1] - bag[:, 1], target[:, 0] - bag[:, 0])

    def _approach(self, mask: Tensor) -> None:
        """Plan the path to the best stance; after a miss to the next best one."""
        pose = self.sight.pose
        bag, bearing = self._bag()
        flank = torch.tensor(FLANKS, device=pose.device)
        side = bearing[:, None] - flank  # [W, C]: bearing of the robot from the bag
        out = torch.stack([torch.cos(side), torch.sin(side)], dim=2)
        ready, stand = bag[:, None] + READY * out, bag[:, None] + STAND * out
        room = signed_distance(torch.cat([ready, stand], dim=1), self._boxes[:, 1::2])
        tight = (0.40 - room.view(len(pose), 2, -1).amin(dim=1)).clamp_min(0.0)
        far = torch.linalg.vector_norm(ready - pose[:, None, :2], dim=2)
        price = far + 20.0 * tight + 0.5 * (flank.abs() - BEST_FLANK).abs()
        order = price.argsort(dim=1)
        pick = torch.gather(order, 1, (self._tries // (SHIFTS + 1) % len(FLANKS))[:, None])

        def chosen(points: Tensor) -> Tensor:
            xy = torch.gather(points, 1, pick[..., None].expand(-1, 1, 2))[:, 0]
            return torch.cat([xy, wrap_angle(torch.gather(side, 1, pick) + math.pi)], dim=1)

        goal = chosen(ready)
        paths = plan(pose[:, :2], goal[:, :2], Floor(self._boxes, *ROOM))
        row = mask[:, None]
        self.ready = torch.where(row, goal, self.ready)
        self.stand = torch.where(row, chosen(stand), self.stand)
        self.right = torch.where(mask, flank[pick[:, 0]] > 0, self.right)
        old = self._route if len(self._route) else paths.points
        self._route = torch.where(mask[:, None, None], paths.points, old)
        self._begin_phase(mask, WALK)

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Walk, step up or strike."""
        pose = self.sight.pose
        stuck = mask & (self.phase == STRIKE) & (self._clock > PATIENCE)
        if stuck.any():
            self._tries = self._tries + stuck
            again = stuck & (self._tries % (SHIFTS + 1) == 0)
            self._shift(stuck & ~again)
            self._approach(again)
        self._acting = self.phase
        walking, striking = self.phase == WALK, self.phase == STRIKE
        goal = torch.where(walking[:, None], self.ready, self.stand)
        route = torch.where(walking[:, None, None], self._route, pose[:, None, :2])
        answer = self.navigator.command(pose, goal, dt, route=route, mask=mask)
        self._clock = self._clock + dt * mask

        command = MotionCommand.neutral(self.sight.worlds, self.sight.device)
        command.velocity = answer.velocity * (~striking)[:, None]
        command.hands = torch.ones_like(command.hands)
        self._strike(command, striking, mask, dt)

        near = torch.where(walking, READY_WITHIN[0], STAND_WITHIN[0])
        turn = torch.where(walking, READY_WITHIN[1], STAND_WITHIN[1])
        there = (answer.distance < near) & (answer.heading_error.abs() < turn)
        late = (self.phase == STEP) & (self._clock > STEP_TIME)
        onward = mask & ~striking & (there | answer.arrived | late)
        self.phase = self.phase + onward
        self._clock = self._clock.masked_fill(onward, 0.0)
        self.navigator.retarget(onward)
        return command

    def phases(self) -> list[str]:
        """`approach`, `step up` or `strike`."""
        return [PHASES[phase] for phase in self._acting.tolist()]

    def _shift(self, mask: Tensor) -> None:
        """Move the stance by what the palm missed: a crouch and a stretched arm push the robot back by centimetres."""
        miss = (self._wanted() - self._palm())[:, :2]
        size = torch.linalg.vector_norm(miss, dim=1, keepdim=True).clamp_min(1e-6)
        moved = self.sight.pose[:, :2] + miss * (CLOSER / size).clamp_max(1.0)
        stand = torch.cat([moved, self.stand[:, 2:]], dim=1)
        self.stand = torch.where(mask[:, None], stand, self.stand)
        self._begin_phase(mask, STEP)

    def _begin_phase(self, mask: Tensor, phase: int) -> None:
        self.phase = self.phase.masked_fill(mask, phase)
        self._clock = self._clock.masked_fill(mask, 0.0)
        self._correction = self._correction.masked_fill(mask[:, None], 0.0)
        self.navigator.retarget(mask)

    def _wanted(self) -> Tensor:
        """Wanted position of the palm [m]: next to the target, [worlds, 3]."""
        target = self._target()
        _, bearing = self._bag()
        away = torch.stack([torch.cos(bearing), torch.sin(bearing), torch.zeros_like(bearing)], dim=1)
        return target + OFF * away

    def _palm(self) -> Tensor:
        """The striking palm [m], [worlds, 3]."""
        left, right = (palm() for palm in self._palms)
        return torch.where(self.right[:, None], right, left)

    def _strike(self, command: MotionCommand, striking: Tensor, mask: Tensor, dt: float) -> None:
        """Fill in height, waist and hand point."""
        pose, wanted = self.sight.pose, self._wanted()
        error = self._local(wanted - self._palm(), pose)
        settled = striking & mask & (self._clock > 1.0)
        correction = (self._correction + GAIN * dt * error).clamp(-MOST, MOST)
        self._correction = torch.where(settled[:, None], correction, self._correction)

        root = torch.cat([pose[:, :2], self.sight.height[:, None]], dim=1)
        point = self._local(wanted - root, pose) + self._correction
        point[:, 0] += HAND_POINT - PALM_OFFSET[0]
        is_right = torch.stack([~self.right, self.right], dim=1)
        command.hand_point = torch.where(is_right[..., None], point[:, None], command.hand_point)
        command.reach = (is_right & striking[:, None]).to(command.reach.dtype)
        height = (wanted[:, 2] - BELOW).clamp(LOW, HIGH)
        command.height = torch.where(striking, height, command.height)
        turn = torch.where(self.right, 0.35, -0.35)
        waist = torch.stack([turn, torch.zeros_like(turn), torch.full_like(turn, LEAN)], dim=1)
        command.waist = torch.where(striking[:, None], waist, command.waist)

    @staticmethod
    def _local(vector: Tensor, pose: Tensor) -> Tensor:
        return torch.cat([rotate_xy(-pose[:, 2], vector[:, :2]), vector[:, 2:]], dim=1)
