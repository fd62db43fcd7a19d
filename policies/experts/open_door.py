"""OpenDoor's expert: press the lever from above with the right fist, then lean the walk into the leaf and go through.

A tracker leaves the hand 5 to 20 cm from where it is commanded: an integral removes what is missing while the robot
steps in with the arm raised, and while the fist sinks to the lever without a pause. The lever is pressed 9 cm from its
pivot. The push is limited by balance: feet set 8 cm behind the pelvis lean the robot into the leaf.

Read from the head camera's picture: door, lever and their distance, in view at the spawn pose wherever the door is
drawn (1.1 to 2.3 m ahead); that the lever is down or the leaf ajar; the fist above or below the lever. The true
positions are a stand-in for these.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Expert, Sight
from arena_newton.policies.experts.hands import Palms
from arena_newton.policies.experts.phases import Phases, select
from arena_newton.policies.experts.style import Style
from arena_newton.policies.experts.walking import BEYOND, Walk, along, passing
from arena_newton.robot.rotations import heading, rotate_xy, turn, wrap_angle
from arena_newton.tasks.open_door import DOORWAY, HANDLE, LEAF
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.navigate import NavigationLimits

__all__ = ["OpenDoorExpert"]

HANDLE_HINGE = "/World/Door/HandleHinge"
PHASES = {
    "approach": 15.0,
    "step in": 6.0,
    "lower": 2.0,
    "press": 3.0,
    "retreat": 4.0,
    "push": 12.0,
    "through": math.inf,
}
"""Longest times [s]; `retreat` is only there after a lever that was missed."""
ON_LEVER = 0.09
"""Distance of the pressed point from the lever's pivot [m]: 2.5 N·m/rad to 20° are 10 N there."""
SIDE = 0.17
"""The robot stands this far to the left of that point [m]: the point is in front of the right shoulder."""
STAND = 0.34
"""Pelvis before the lever when pressing [m]; from 0.47 m one tracker's fist stops 5 cm short and presses air."""
ABOVE = 0.14
"""Height of the fist over the lever when it begins to sink [m]."""
SINKING, TOUCHING = 0.10, 0.04
"""Speed at which it does [m/s], to which height over the lever [m]: how long it has been aligned can be seen."""
ALIGN_GAIN = 1.6
"""Integral gain on the palm [1/s]."""
UP = 0.7
"""Time in which the arm is raised before that begins [s]."""
PRESSING, BELOW = 0.35, 0.40
"""Speed of the pressing command [m/s], and how far below the lever it goes [m]: the arm is soft, and with 14 cm the
lever stopped at 17°."""
RELEASED, AJAR = math.radians(20.0), math.radians(4.0)
"""Angles [rad] of the lever and of the leaf that tell that the latch is released."""
DEEP = math.radians(28.0)
"""Angle of the lever from which the robot pushes [rad]; the hand goes on pressing until the leaf is ajar. Who learns
from these demonstrations foresees the push, and at 20° would let go a moment too soon."""
SLIPPED = 0.08
"""A palm this far below the lever with the latch closed has missed it [m]."""
RAISED = (0.26, -0.16, 0.36)
"""The right palm while the robot steps in, pelvis' heading frame [m]: 16 cm above the lever."""
PUSHING = ((0.30, 0.18, 0.20), (0.34, -0.14, 0.22))
"""Left and right palm that push the leaf, pelvis' heading frame [m]."""
LEAN = 0.15
"""Waist pitch while the hand is at the lever [rad]."""
PUSH_OFFSET = 0.08
"""Feet behind the pelvis while pushing [m]: 15 N held back at the chest stop a walk without it; 10 cm fell."""
OPENED = math.radians(63.0)
"""Angle of a leaf that is open under either rule set [rad]."""
INSIDE, FAR_INSIDE = 0.45, 1.1
"""Pelvis past the door's plane [m] at which the robot stops when the leaf is open, and in any case."""
PASSING = (0.10, 0.12)
"""Errors at the two places before the door at which the robot goes on [m, rad]: the arm makes up for them."""
BACK = 0.25
"""Way back after a missed lever [m]."""
LEARN, MOST_LEARNED = 0.6, 0.06
"""Fraction of the palm's miss by which the stance is moved after a missed lever, and the largest such move [m]."""


class OpenDoorExpert(Expert):
    """Seven phases; a missed lever leads from `press` over `retreat` back to `step in`, with the stance moved."""

    task = "open_door"

    def __init__(self, sight: Sight):
        """Find doorway, leaf, handle and hands."""
        super().__init__(sight)
        worlds, device = sight.worlds, sight.device
        self._doorway, self._frame = sight.frame(DOORWAY), sight.scene.marker(DOORWAY).body_id
        self._handle = sight.scene.body_id(HANDLE)
        self._leaf_angle, self._lever_angle = sight.joint(LEAF), sight.joint(HANDLE_HINGE)
        limits = NavigationLimits(forward=0.55, turn=0.9, position_gain=1.3, arrive_position=0.045, arrive_heading=0.06)
        self.walk = Walk(sight, limits)
        self.palms = Palms(sight, gain=ALIGN_GAIN)
        self.states = Phases(PHASES, worlds, device)
        self._learned = torch.zeros(worlds, 2, device=device)
        self._ready, self._lane, self._forward = (torch.zeros(worlds, device=device) for _ in range(3))
        self._raised = torch.zeros(worlds, 3, device=device)
        self._arms = MotionCommand.neutral(worlds, device).arms
        self._pushing = torch.tensor(PUSHING, device=device).expand(worlds, 2, 3)
        self._from_pivot = torch.tensor([0.0, ON_LEVER], device=device).expand(worlds, 2)

    def begin(self, mask: Tensor, style: Style) -> None:
        """Walk to a pose in front of the lever."""
        self._ready = torch.where(mask, style.uniform("ready", 0.80, 0.95), self._ready)
        self._lane = torch.where(mask, style.uniform("lane", 0.07, 0.12), self._lane)
        self._forward = torch.where(mask, style.uniform("push", 0.34, 0.38), self._forward)
        jitter = torch.stack([style.uniform(f"raised {axis}", -0.015, 0.015) for axis in "xyz"], dim=1)
        raised = torch.tensor(RAISED, device=self.sight.device) + jitter
        self._raised = select(mask, raised, self._raised)
        arms = MotionCommand.neutral(self.sight.worlds, self.sight.device).arms
        for column, name in ((0, "shoulder"), (3, "elbow")):  # the same in both arms
            arms[:, [column, column + 7]] += style.uniform(name, -0.15, 0.15)[:, None]
        self._arms = select(mask, arms, self._arms)
        self._learned = select(mask, torch.zeros_like(self._learned), self._learned)
        self.palms.reset(mask)
        self.walk.begin(mask)
        self.states.begin(mask)
        self.walk.to(mask, self._before(self._ready))

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Walk, press, push."""
        states = self.states
        states.advance(mask, dt)
        self._onward(mask)
        walking = states.at("approach", "step in", "retreat")
        answer = self.walk.command(mask & walking, dt)
        arrived = mask & (passing(answer, PASSING) | states.late)
        self._arrive(arrived & walking)

        command = MotionCommand.neutral(self.sight.worlds, self.sight.device)
        command.arms = self._arms
        command.hands = torch.ones_like(command.hands)
        # A hand that the lever or the leaf holds goes up before the robot steps back.
        moving = states.at("approach", "step in") | states.at("retreat") & (states.clock > 0.6)
        command.velocity = select(moving, answer.velocity, command.velocity)
        self._reach(command, mask, dt)
        self._push(command)
        return command

    def phases(self) -> list[str]:
        """Names of `PHASES`."""
        return self.states.names()

    def _yaw(self) -> Tensor:
        """Heading through the doorway [rad], shape [worlds]."""
        return self.sight.once("doorway", lambda: heading(self.sight.body(self._frame)[1]) + math.pi / 2)

    def _lever(self) -> Tensor:
        """The point of the lever that is pressed, as long as lever and leaf are at rest [m], shape [worlds, 3]."""
        pivot = self.sight.body(self._handle)[0]
        return torch.cat([pivot[:, :2] + rotate_xy(self._yaw(), self._from_pivot), pivot[:, 2:]], dim=1)

    def _before(self, distance: Tensor) -> Tensor:
        """Pose in front of the lever, this far from it [m]: x, y [m], yaw [rad], shape [worlds, 3]."""
        yaw = self._yaw()
        offset = torch.stack([-distance, torch.full_like(distance, SIDE)], dim=1) + self._learned
        return torch.cat([self._lever()[:, :2] + rotate_xy(yaw, offset), wrap_angle(yaw)[:, None]], dim=1)

    def _inside(self) -> Tensor:
        """The pelvis past the door's plane [m], shape [worlds]."""
        return rotate_xy(-self._yaw(), self.sight.pose[:, :2] - self._doorway()[:, :2])[:, 0]

    def _onward(self, mask: Tensor) -> None:
        """Enter the phases that do not wait for a walk."""
        states = self.states
        released = (self._lever_angle() < -RELEASED) | (self._leaf_angle() > AJAR)
        palm, lever = self.palms.measured()[:, 1], self._lever()
        pressing = mask & states.at("press")
        missed = pressing & ~released & ((palm[:, 2] < lever[:, 2] - SLIPPED) | states.late)
        stuck = mask & states.at("push") & states.late
        again = missed | stuck
        if again.any():
            self.walk.to(again, self._before(torch.full_like(self._ready, STAND + BACK)))
        states.enter("retreat", again)
        deep = (self._lever_angle() < -DEEP) | (self._leaf_angle() > AJAR)
        states.enter("push", pressing & (deep | released & states.late))

        if missed.any():
            miss = rotate_xy(-self._yaw(), lever[:, :2] - palm[:, :2])
            learned = (self._learned + LEARN * miss).clamp(-MOST_LEARNED, MOST_LEARNED)
            self._learned = select(missed, learned, self._learned)
        states.enter("press", states.over("lower", mask, lambda: SINKING * states.clock > ABOVE - TOUCHING))
        if states.present("push"):
            inside, open_ = self._inside(), self._leaf_angle() > OPENED
            passed = mask & states.at("push") & ((inside > FAR_INSIDE) | (inside > INSIDE) & open_)
            states.enter("through", passed)

    def _arrive(self, mask: Tensor) -> None:
        """Enter the state that follows a walk."""
        states = self.states
        near, before = mask & states.at("step in"), mask & states.at("approach", "retreat")
        states.enter("lower", near)
        released = states.at("retreat") & (self._leaf_angle() > AJAR)
        states.enter("push", before & released)
        again = before & ~released
        if again.any():
            self.walk.to(again, self._before(torch.full_like(self._ready, STAND - BEYOND)))
            self.palms.reset(again)
        states.enter("step in", again)

    def _reach(self, command: MotionCommand, mask: Tensor, dt: float) -> None:
        """The right hand at the lever; both at the leaf."""
        states = self.states
        raised, holding = states.at("step in", "retreat"), states.at("lower", "press")
        opening = states.at("push") & (self._leaf_angle() < AJAR)
        down = (SINKING * states.clock).clamp_max(ABOVE - TOUCHING) * states.at("lower")
        pressed = ABOVE - TOUCHING + (PRESSING * states.clock).clamp_max(TOUCHING + BELOW)
        wanted = self._lever()
        wanted[:, 2] += ABOVE - down - pressed * states.at("press") - (ABOVE + BELOW) * opening
        wanted = select(holding | opening, wanted, self.sight.root_position + turn(self.sight.pose[:, 2], self._raised))
        both = torch.stack([self.palms.measured()[:, 0], wanted], dim=1)
        learn = torch.zeros(len(wanted), 2, dtype=torch.bool, device=wanted.device)
        learn[:, 1] = mask & (states.at("lower") | states.at("step in") & (states.clock > UP))
        point = self.palms.lead(both, learn, dt)[:, 1]
        pushing = select(states.at("push"), self._pushing, command.hand_point)
        right = select(raised | holding | opening, point, pushing[:, 1])
        command.hand_point = torch.stack([pushing[:, 0], right], dim=1)
        command.reach[:, 0] = states.at("push").to(command.reach.dtype)
        command.reach[:, 1] = (raised | holding | states.at("push")).to(command.reach.dtype)
        command.waist[:, 2] = LEAN * holding

    def _push(self, command: MotionCommand) -> None:
        """Feet behind, straight through the doorway."""
        if not self.states.present("push"):
            return
        pushing, yaw = self.states.at("push"), self._yaw()
        right_of_middle = torch.stack([torch.zeros_like(self._lane), -self._lane], dim=1)
        point = self._doorway()[:, :2] + rotate_xy(yaw, right_of_middle)
        velocity = along(self.sight.pose, point, yaw, self._forward)
        command.velocity = select(pushing, velocity, command.velocity)
        command.foot_offset = PUSH_OFFSET * pushing
