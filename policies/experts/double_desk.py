"""DoubleDesk's expert: grasp the hammer at the right desk, step over the sill, let go of it above the crate.

What each decision is read from: it looks before it walks. The robot turns towards a desk until what lies on it is
within the head camera's view, and only then chooses where to stand; hammer, crate, desk edges and the sill are in the
picture whenever they are used, and true positions stand in for what the picture shows. Whether the hammer is in the
hand is read from its distance to the palm, which the camera sees as well.

A policy without memory learns from these demonstrations. It knows neither phase nor clock, so that nothing may wait for
what it cannot see (docs/howto/train/experts.md):

- The hand begins to hover over the hammer while the robot still walks its last steps.
- While the left hand grasps, and again while it lets go, the free right wrist rolls steadily: time can be seen on it.
- The robot sidles to the sill and the crate. If it turned towards them and back, the same pictures would lie on the way
  there and back, with opposite turns to learn from them.
- It holds the hammer over the crate for 1.2 s (`HOLD`) before it opens the hand, also when it is there at once.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import fields, replace

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Expert, Sight
from arena_newton.policies.experts.hands import WRISTS, Palms, Wrists
from arena_newton.policies.experts.phases import Phases, select
from arena_newton.policies.experts.style import Style
from arena_newton.policies.experts.walking import Walk, along, passing
from arena_newton.robot.g1 import FEET
from arena_newton.robot.rotations import (
    atan2,
    heading,
    quat_apply,
    quat_from_yaw,
    quat_multiply,
    rotate_xy,
    turn,
    wrap_angle,
)
from arena_newton.tasks.double_desk import HAMMER, INSIDE, LEFT_DESK, RIGHT_DESK, SILL
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.kinematics import HAND_POINT
from arena_newton.trackers.motions.navigate import NavigationCommand, NavigationLimits

__all__ = ["DoubleDeskExpert"]

LONGEST = {
    "look": 5.0,
    "approach": 12.0,
    "step in": 5.0,
    "hover": 2.4,
    "lower": 1.4,
    "close": 0.8,
    "lift": 1.3,
    "step back": 2.5,
    "turn": 7.0,
    "line up": 12.0,
    "back off": 4.0,
    "pace": 5.0,
    "sill": 6.0,
    "deliver": 10.0,
    "over": 6.0,
    "open": 2.0,
    "rest": math.inf,
}
"""Phases in their usual order and their longest times [s]."""
WALKING = ("look", "approach", "step in", "hover", "turn")
"""Phases that walk to a goal, from farther off facing it. `hover` makes the last steps of `step in`: the hand comes
over the hammer while the robot still moves."""
SIDLING = ("line up", "deliver", "over")
"""Phases that walk to a goal without turning towards it. `over` makes the last steps of `deliver`."""
BEFORE_WALKING = ("lift", "step back", "back off", "pace", "sill")
"""Other phases from which a robot may come to one of these."""
ENDING = ("hover", "over")
"""Those of them that make the last steps, and stand once the robot was `THERE`."""
GRASPING = ("hover", "lower", "close", "lift")
"""Phases in which the left hand is led along the hammer."""
ROLLING = (*GRASPING, "over", "open")
"""Phases in which the right wrist rolls."""
CARRYING = ("step back", "turn", "line up", "back off", "pace", "sill", "deliver", "over")
"""Phases with the hammer in the left hand, after the lift."""
LIMITS = NavigationLimits(forward=0.6, turn=0.9, arrive_position=0.045, arrive_heading=0.06)
"""Coarser stops than the navigator's own: the arm makes up for 5 cm, and each correction costs 2 s."""
SIDE_LIMITS = replace(LIMITS, near=3.0, far=4.0)
"""The same for a robot that keeps its goal's heading on the whole way: each way to sill and crate is below 3 m."""
WITHIN = {"approach": (0.10, 0.15), "step in": (0.08, 0.15), "line up": (0.07, 0.08), "deliver": (0.06, 0.10)}
"""Errors at the end of a walk that do not matter [m, rad]: what comes next takes the last steps with it."""
THERE = (0.03, 0.10)
"""Errors with which the last steps end [m, rad]: steps for less move the hand by more than they correct."""
IN_VIEW = 0.75
"""Bearing within which the head camera shows an object [rad]; half of its horizontal field of view is 0.92."""
ROLL = 0.33
"""Speed of the free right wrist's roll while the left hand grasps [rad/s]: 0.13 rad from one look of a policy to the
next, 0.4 s later, and the joint's whole range in the longest grasp."""
OVER_ROLL = 0.8
"""The same over the crate [rad/s]: letting go is shorter."""
RIGHT_ROLL = int(WRISTS[1, 0])
"""Right wrist's roll among the columns of `MotionCommand.arms`."""
MOST_ROLL = 1.9
"""Largest angle of that roll [rad]: the joint ends at 1.97."""
LOOK_RIGHT, LOOK_LEFT = -0.5 * math.pi, 0.5 * math.pi
"""Headings that face the right and the left desk [rad]."""

ALONG_HANDLE = 0.05
"""Grasp point from the middle of the handle towards the head [m]: half way to the centre of mass."""
GRASP = (0.6645, 0.6645, 0.2418, -0.2418)
"""Orientation of the left hand, wxyz, when x points away across the handle and z up: palm down, fingers forward and
40 deg down. Of the pitches tried, 30 to 45 deg close around a handle that lies on a bench."""
WRIST = (-0.033, 0.0, 0.104)
"""Wrist from the grasp point in the same axes [m]."""
STAND = (0.32, 0.17)
"""The grasp point in the heading frame of the standing robot [m]: within the arm's reach, in front of the shoulder."""
EDGE = 0.16
"""Nearest distance of the pelvis to the right desk's edge [m]: thighs and belly."""
LEAN, LEAN_MORE = 0.25, 2.0
"""Waist pitch of a grasp [rad], and more of it per metre that the edge keeps the robot away [rad/m]."""
RAISE = 0.9
"""Distance to the goal from which the forearms are raised [m]: hanging hands meet the edge from below."""
LEFT_RAISED, RIGHT_RAISED = (0.24, 0.20, 0.25), (0.18, -0.25, 0.05)
"""Palms of raised forearms [m], heading frame of the pelvis."""
HOVER = 0.12
"""Height of the hand above its grasp while it aligns [m]: fingers clear the head."""
ALIGN = 1.5
"""Least time to align [s]."""
ALIGNED = (0.02, 0.10)
"""Errors of palm and hand that are small enough to lower [m, rad]."""
DESCENT, ASCENT = 0.12, 0.14
"""Speeds of lowering and lifting [m/s]."""
LIFTED = 0.15
"""Height of the lift [m]: the hammer's predicate asks for 0.10 m."""
HELD = 0.13
"""Distance of palm and grasp point below which the hammer is in the hand [m]; 0.05 m when grasped."""
BENCH_HEIGHT = 0.6
"""A hammer that is not held is still on a desk above this height [m]."""

STEP_BACK = (0.2, 0.25)
"""Distance [m] and speed [m/s] of the walk back from the desk."""
LEFT_CARRY, LEFT_HIGH = (0.27, 0.22, 0.16), (0.27, 0.22, 0.33)
"""Left palm while carrying, and in front of the crate, where the hammer must pass over the rim [m]."""
BESIDE = 0.13
"""The crate's middle is this far to the robot's left [m]: the left arm does not cross over."""
BEFORE_SILL = 0.85
"""Distance of the pelvis from the sill's middle when it stops to line up [m]: two or three strides."""
LAST_PAIR = 0.23
"""Distance of the pelvis from the sill's middle when the feet are side by side for the last time before it [m]: the
ankles are then 5 cm further on, so that a stride of 0.40 m leaves as much room for toes before as for heels behind."""
PAST_SILL = 0.14
"""Both ankles must be this far beyond the sill's middle [m]: the heel reaches 6 cm back."""
SILL_SPEED, SILL_STEP, SILL_HEIGHT = 0.46, 0.52, 0.74
"""Walk over the sill: speed [m/s], time of a step [s], pelvis [m]."""
PACE_STAGGER, SILL_STAGGER = 0.17, 0.25
"""Lead of the left foot by the length of a step on the way to the sill and over it [m]: the right foot lands next to
it, and the pairs of footprints are 0.3 and 0.4 m apart."""
PACES = (0.10, 0.48)
"""Speeds by which the footprints are moved to where they must be [m/s]."""
BRISK = 0.38
"""A pace that is faster than this would come short [m/s]: one more pair of footprints is made instead."""
COMMITTED = 0.30
"""Time before the feet are side by side from which the landing is fixed [s]."""
USUAL_PACE, TOO_FAR = 0.35, 0.06
"""Speed at the last pair [m/s], and how far beyond its place it may be [m]: else the robot goes back to try again."""
NO_TIME = 27.0
"""Time of an episode from which it does not back off any more but steps over as it comes [s]: the way back costs 6 s,
and what follows takes 10 s of the 40."""
NEAR_CRATE, NEAR_EDGE = 0.38, 0.09
"""Pelvis from the crate's middle and at least from the left desk's edge [m]."""
OVER_HEIGHT = 1.02
"""Height of the hammer's centre of mass above the crate [m]; the rim is at 0.915 m."""
RIM = 0.93
"""Least height of the centre of mass above the crate [m]."""
AIM = (0.12, 0.0)
"""Half sizes of the rectangle in the crate to which the centre of mass is led [m]: its middle line. A network that
learned from (0.18, 0.09) let go 4 cm nearer to the robot and scattered by 5 cm (docs/results/generalist.md)."""
ENOUGH, MOST = (0.20, 0.08), (0.24, 0.15)
"""Half sizes of the larger one in which it may be let go once it was held for `HOLD`, and some time later [m]: the arm
does not always reach as far as `AIM`. The walls are at 0.30 and 0.20 m."""
RELAX = 0.05
"""Growth from the one to the other [m/s]."""
HOLD = 1.2
"""Least time above the crate before the hand opens [s]: the wrist's roll shows how much of it has passed."""
CLOSER = 0.10
"""Longest step by what the hammer lacks when it did not come over the crate [m]."""
OVER_LEAN = 0.50
"""Waist pitch above the crate [rad]."""
OVER_LEAN_MORE = 0.10
"""Growth of that while the hammer is held there [rad/s], so that the arm reaches farther."""
MOST_LEAN = 0.7
"""... to this limit [rad]. The hand opens with the pitch at which it came to rest."""

STYLE = {
    "pace": (0.92, 1.0),
    "ready": (0.34, 0.44),
    "aside": (-0.02, 0.02),
    "swing": (0.18, 0.20),
    "palm x": (-0.02, 0.02),
    "palm y": (-0.02, 0.02),
    "palm z": (-0.02, 0.02),
}
"""Ranges of what differs between episodes: fraction of the walking speed, distance of the ready place behind the stand
[m], sideways offset of the stand [m], height of a step over the sill [m], offset of the left palm's postures [m]."""


class DoubleDeskExpert(Expert):
    """Look, approach, grasp and lift; turn, step over the sill, hold over the crate and let go."""

    task = "double_desk"

    def __init__(self, sight: Sight):
        """Find hammer, crate, desks, sill and ankles."""
        super().__init__(sight)
        worlds, device = sight.worlds, sight.device
        self._origin, self._mass = sight.frame(HAMMER), sight.com(HAMMER)
        inside = sight.scene.marker(INSIDE)
        self._crate, self._middle = inside.body_id, sight.frame(INSIDE)
        _, centre, half = sight.box(f"{RIGHT_DESK}/Top")
        self._right_edge = float(centre[1] + half[1])
        _, centre, half = sight.box(f"{LEFT_DESK}/Top")
        self._left_edge = float(centre[1] - half[1])
        self._sill = float(sight.box(SILL)[1][1])
        self._ankles = [sight.scene.link(name) for name in FEET]
        self._grasp_quat = torch.tensor(GRASP, device=device)
        self._palm_offset = torch.tensor(WRIST, device=device) + HAND_POINT * quat_apply(
            self._grasp_quat, torch.tensor([1.0, 0.0, 0.0], device=device)
        )
        self.machine = Phases(LONGEST, worlds, device)
        """The phase of each world."""
        self.palms, self.wrists = Palms(sight), Wrists(sight)
        self.walk, self.sidle = Walk(sight, LIMITS), Walk(sight, SIDE_LIMITS)
        self._acting: list[str] = []
        self._style = {name: torch.zeros(worlds, device=device) for name in STYLE}
        self._turns_left = torch.zeros(worlds, dtype=torch.bool, device=device)
        self._grasp, self._hand_yaw = torch.zeros(worlds, 3, device=device), torch.zeros(worlds, device=device)
        self._from = torch.zeros(worlds, 2, device=device)
        self._error = torch.zeros(worlds, 2, device=device)
        self._pairs = torch.arange(3, device=device)
        self._backwards = torch.tensor([-STEP_BACK[1], 0.0, 0.0], device=device).expand(worlds, 3)
        self._postures = torch.tensor([LEFT_RAISED, LEFT_CARRY, LEFT_HIGH, RIGHT_RAISED], device=device)
        """Palms where nothing is grasped [m], heading frame of the pelvis, [4, 3]."""
        self._last = torch.zeros(worlds, 3, device=device)
        self._elapsed = torch.zeros(worlds, device=device)
        self._rolled = torch.zeros(worlds, device=device)
        """Time for which the right wrist has rolled [s], [worlds]."""
        self._there = torch.zeros(worlds, dtype=torch.bool, device=device)
        self._lean = torch.zeros(worlds, device=device)

    def begin(self, mask: Tensor, style: Style) -> None:
        """Draw the episode's style; look at the right desk."""
        for name, (low, high) in STYLE.items():
            self._style[name] = select(mask, style.uniform(name, low, high), self._style[name])
        self._turns_left = select(mask, style.coin("turns left"), self._turns_left)
        self.walk.begin(mask)
        self.sidle.begin(mask)
        self.machine.begin(mask)
        self._elapsed = self._elapsed.masked_fill(mask, 0.0)
        self._rolled = self._rolled.masked_fill(mask, 0.0)
        self.palms.reset(mask)
        self.wrists.reset(mask)
        self._face(mask, LOOK_RIGHT)

    def phases(self) -> list[str]:
        """Names of `LONGEST`."""
        return self._acting

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Move on where a phase is over, then act."""
        self._aim(mask & self.machine.at("look", "approach", "step in", "hover"))
        at = self.machine.at
        aside = at(*SIDLING)
        # A world that begins to walk now does so by the command that it would have had.
        answer = self.walk.command(mask & at(*WALKING), dt, others=bool(self.machine.present(*BEFORE_WALKING)))
        sidling = self.sidle.command(mask & aside, dt)
        if self.machine.present(*SIDLING):
            answer = NavigationCommand(
                **{
                    field.name: select(aside, getattr(sidling, field.name), getattr(answer, field.name))
                    for field in fields(NavigationCommand)
                }
            )
        self._onward(mask, answer)
        self._acting = self.machine.names()
        command = self._act(mask, dt, answer)
        self.machine.advance(mask, dt)
        self._elapsed = self._elapsed + dt * mask
        self._rolled = self._rolled + dt * (mask & at(*ROLLING))
        return command

    # What it sees.

    def _aim(self, mask: Tensor) -> None:
        """Grasp point on the hammer and heading of the hand, in the worlds of `mask`."""
        if not mask.any():
            return
        origin = self._origin()
        handle = torch.nn.functional.normalize((self._mass() - origin)[:, :2], dim=1)
        grasp = torch.cat([origin[:, :2] + ALONG_HANDLE * handle, origin[:, 2:]], dim=1)
        # The hand lies across the handle on the side of the robot, whichever end the head is.
        off = wrap_angle(atan2(handle[:, 1], handle[:, 0]) - 0.5 * math.pi - LOOK_RIGHT)
        off = torch.where(off.abs() > 0.5 * math.pi, wrap_angle(off + math.pi), off)
        self._grasp = select(mask, grasp, self._grasp)
        self._hand_yaw = select(mask, LOOK_RIGHT + off, self._hand_yaw)

    def _held(self) -> Tensor:
        """True if the hammer is in the left hand, bool, [worlds]."""
        origin = self._origin()
        point = origin + ALONG_HANDLE * torch.nn.functional.normalize(self._mass() - origin, dim=1)
        return torch.linalg.vector_norm(self.palms.measured()[:, 0] - point, dim=1) < HELD

    def _in_view(self, point: Tensor) -> Tensor:
        """True if the head camera shows a point that is ahead, bool, [worlds]."""
        pose = self.sight.pose
        offset = point[:, :2] - pose[:, :2]
        return wrap_angle(atan2(offset[:, 1], offset[:, 0]) - pose[:, 2]).abs() < IN_VIEW

    def _stand(self) -> tuple[Tensor, Tensor]:
        """x, y [m] to grasp from, [worlds, 2], and how far the edge keeps the robot from the best distance [m]."""
        nearest = self._right_edge + EDGE
        y = self._grasp[:, 1] + STAND[0]
        stand = torch.stack([self._grasp[:, 0] - STAND[1] + self._style["aside"], y.clamp_min(nearest)], dim=1)
        return stand, (nearest - y).clamp_min(0.0)

    def _crossing(self) -> Tensor:
        """X [m] on which it walks to the crate, [worlds]."""
        return self._middle()[:, 0] + BESIDE

    def _past_sill(self) -> Tensor:
        """True if both ankles are beyond the sill, bool, [worlds]."""
        y = torch.stack([self.sight.body(ankle)[0][:, 1] for ankle in self._ankles], dim=1)
        return y.amin(dim=1) > self._sill + PAST_SILL

    def _pace(self) -> tuple[Tensor, Tensor]:
        """Speed [m/s] that brings the feet side by side before the sill, and the time until they are [s], [worlds].

        They are whenever the right foot lands. Of the next landings the first one is taken that is not too near in
        time.
        """
        times = (1.0 - self.reference.phase[:, None] + self._pairs) * (2.0 * SILL_STEP)
        speeds = (self._sill - LAST_PAIR - self.sight.pose[:, 1:2]) / times.clamp_min(0.1)
        soon = (speeds > BRISK).sum(dim=1, keepdim=True).clamp_max(times.shape[1] - 1)
        return torch.gather(speeds, 1, soon)[:, 0], torch.gather(times, 1, soon)[:, 0]

    def _over(self) -> tuple[Tensor, Tensor]:
        """Target of the centre of mass above the crate [m], [worlds, 3]; whether to release it by now, [worlds]."""
        mass, middle = self._mass(), self._middle()
        yaw = heading(self.sight.body(self._crate)[1])
        local = rotate_xy(-yaw, mass[:, :2] - middle[:, :2])
        aim, enough, most = (torch.tensor(half, device=mass.device) for half in (AIM, ENOUGH, MOST))
        enough = torch.minimum(enough + RELAX * (self.machine.clock[:, None] - HOLD).clamp_min(0.0), most)
        goal = middle[:, :2] + rotate_xy(yaw, torch.minimum(torch.maximum(local, -aim), aim))
        over = torch.cat([goal, torch.full_like(goal[:, :1], OVER_HEIGHT)], dim=1)
        return over, (local.abs() < enough).all(dim=1) & (mass[:, 2] > RIM)

    # What comes next.

    def _face(self, mask: Tensor, yaw: float) -> None:
        self._go(mask, self.sight.pose[:, :2], yaw)

    def _go(self, mask: Tensor, xy: Tensor, yaw: float) -> None:
        goal = torch.cat([xy, torch.full_like(xy[:, :1], yaw)], dim=1)
        self.walk.to(mask, goal)
        self.sidle.to(mask, goal)

    def _onward(self, mask: Tensor, answer: NavigationCommand) -> None:
        """Enter the next phase where one is over."""
        machine, pose, held = self.machine, self.sight.pose, self._held()
        self._there = (self._there | (mask & passing(answer, THERE))) & machine.at(*ENDING)
        over: dict[str, Callable[[], Tensor]] = {
            "look": lambda: self._in_view(self._origin()),
            "hover": lambda: (
                (machine.clock > ALIGN) & (self._error[:, 0] < ALIGNED[0]) & (self._error[:, 1] < ALIGNED[1])
            ),
            "step back": lambda: torch.linalg.vector_norm(pose[:, :2] - self._from, dim=1) > STEP_BACK[0],
            "turn": lambda: self._in_view(self._middle()),
            "back off": lambda: pose[:, 1] < self._sill - BEFORE_SILL,
            "pace": lambda: self._pace()[1] < COMMITTED,
            "sill": self._past_sill,
            "over": lambda: self._over()[1] & (machine.clock > HOLD),
        }
        over |= {name: functools.partial(passing, answer, within) for name, within in WITHIN.items()}
        done = {name: machine.over(name, mask, over.get(name, lambda: machine.late)) for name in LONGEST}
        # A hammer that fell onto the desk is grasped again; one on the floor is out of reach.
        lost = mask & machine.at(*CARRYING) & ~held
        if not torch.stack([lost, *done.values()]).any():
            return
        on_desk = self._origin()[:, 2] > BENCH_HEIGHT
        missed = done["lift"] & ~held
        self._aim(missed)
        again = lost & on_desk & (pose[:, 1] < self._sill)
        (pace, time), (wanted, over_crate) = self._pace(), self._over()
        short = done["over"] & ~over_crate

        stand, _ = self._stand()
        ready = stand + torch.stack([torch.zeros_like(stand[:, 0]), self._style["ready"]], dim=1)
        self._from = select(done["lift"], pose[:, :2], self._from)
        for name, following in zip(LONGEST, list(LONGEST)[1:], strict=False):
            machine.enter(following, done[name])
        machine.enter("step in", missed)
        machine.enter("deliver", short)
        again_paced = ((pace - USUAL_PACE) * time < -TOO_FAR) & (self._elapsed < NO_TIME)
        machine.enter("back off", done["pace"] & again_paced)
        machine.enter("pace", done["line up"])
        machine.enter("look", again)
        machine.enter("rest", (lost & ~again) | (missed & ~on_desk))

        self._face(again, LOOK_RIGHT)
        self._go(done["look"], ready, LOOK_RIGHT)
        self._go(done["approach"] | missed, stand, LOOK_RIGHT)
        self._face(done["step back"], LOOK_LEFT)
        crossing, crate = self._crossing(), self._middle()
        self._go(
            done["turn"], torch.stack([crossing, torch.full_like(crossing, self._sill - BEFORE_SILL)], 1), LOOK_LEFT
        )
        near = (crate[:, 1] - NEAR_CRATE).clamp_max(self._left_edge - NEAR_EDGE)
        self._go(done["sill"], torch.stack([crossing, near], dim=1), LOOK_LEFT)
        closer = pose[:, :2] + (wanted - self._mass())[:, :2].clamp(-CLOSER, CLOSER)
        closer = torch.stack([closer[:, 0], closer[:, 1].clamp_max(self._left_edge - NEAR_EDGE)], dim=1)
        self._go(short, closer, LOOK_LEFT)
        restart = done["step in"] | done["lift"]
        self._rolled = self._rolled.masked_fill(restart | again | done["deliver"], 0.0)
        self.palms.reset(restart)
        self.wrists.reset(restart)

    # What it does.

    def _act(self, mask: Tensor, dt: float, answer: NavigationCommand) -> MotionCommand:
        """The command of the present phase."""
        at, clock = self.machine.at, self.machine.clock
        command = MotionCommand.neutral(self.sight.worlds, self.sight.device)
        command.velocity = self._velocity(answer.velocity)
        present = self.machine.present
        raised = ~at("look") & (~at("approach") | (answer.distance < RAISE))

        lean = torch.zeros_like(clock)
        if present("step in", *GRASPING):
            lean = torch.where(at("step in", *GRASPING), LEAN + LEAN_MORE * self._stand()[1], lean)
        lean = torch.where(at("over"), (OVER_LEAN + OVER_LEAN_MORE * clock).clamp_max(MOST_LEAN), lean)
        lean = torch.where(at("open"), self._lean, lean)
        self._lean = select(mask, lean, self._lean)
        command.waist[:, 2] = lean

        if present("pace", "sill"):
            crossing = at("pace", "sill")
            command.swing_height = torch.where(crossing, self._style["swing"], command.swing_height)
            command.step_time = torch.where(crossing, SILL_STEP, command.step_time)
            command.height = torch.where(crossing, SILL_HEIGHT, command.height)
            command.stagger = torch.where(at("pace"), PACE_STAGGER, command.stagger)
            command.stagger = torch.where(at("sill"), SILL_STAGGER, command.stagger)

        command.reach = raised[:, None].expand(-1, 2).to(command.reach.dtype)
        self._lead_hands(command, mask, dt, raised)
        roll = torch.where(at("over", "open"), OVER_ROLL, ROLL)
        command.arms[:, RIGHT_ROLL] = (roll * self._rolled).clamp_max(MOST_ROLL)
        command.hands[:, 0] = at("close", "lift", *CARRYING).float()
        return command

    def _velocity(self, walking: Tensor) -> Tensor:
        """vx, vy [m/s] and yaw rate [rad/s] in every phase, [worlds, 3]."""
        at, pose = self.machine.at, self.sight.pose
        pace = torch.where(at("approach", "line up"), self._style["pace"], 1.0)
        walks = at(*WALKING, *SIDLING) & ~(at(*ENDING) & self._there)
        velocity = walking * pace[:, None] * walks[:, None]
        if self.machine.present("turn"):
            # A half turn may go either way.
            spin = torch.where(self._turns_left, 1.0, -1.0) * velocity[:, 2].abs()
            far = at("turn") & (wrap_angle(LOOK_LEFT - pose[:, 2]).abs() > 0.6 * math.pi)
            velocity = torch.cat([velocity[:, :2], torch.where(far, spin, velocity[:, 2])[:, None]], dim=1)
        velocity = select(at("step back", "back off"), self._backwards, velocity)
        if not self.machine.present("pace", "sill"):
            return velocity
        crossing = self._crossing()
        line = torch.stack([crossing, torch.full_like(crossing, self._sill)], dim=1)
        north = torch.full_like(crossing, LOOK_LEFT)
        speed = torch.where(at("pace"), self._pace()[0].clamp(*PACES), SILL_SPEED)
        return select(at("pace", "sill"), along(pose, line, north, speed, side=0.05, turn=0.3), velocity)

    def _lead_hands(self, command: MotionCommand, mask: Tensor, dt: float, raised: Tensor) -> None:
        """Fill in hand points and the left wrist."""
        at, present, yaw = self.machine.at, self.machine.present, self.sight.pose[:, 2]
        style = torch.stack([self._style[f"palm {axis}"] for axis in "xyz"], dim=1)
        left = select(at("deliver"), self._postures[2] + style, self._postures[1] + style)
        left = select(at("look", "approach", "step in"), self._postures[0] + style, left)
        if present("over"):
            over = self.palms.measured()[:, 0] + self._over()[0] - self._mass()
            left = select(at("over"), self.palms.local(over[:, None])[:, 0], left)
        hand_yaw = yaw
        if present(*GRASPING):
            grasping, hand_yaw = self._grasping(), torch.where(at(*GRASPING), self._hand_yaw, yaw)
            left = select(at(*GRASPING), self.palms.local(grasping[:, None])[:, 0], left)
        left = select(at("open", "rest"), self._last, left)
        self._last = select(mask, left, self._last)
        both = torch.stack([left, self._postures[3].expand_as(left)], dim=1)

        learn = mask & at("hover", "lower", *CARRYING)
        wanted = self.sight.root_position[:, None] + turn(yaw[:, None], both)
        command.hand_point = self.palms.lead(wanted, torch.stack([learn, torch.zeros_like(learn)], dim=1), dt)
        if not raised.any():
            return
        hand = quat_multiply(quat_from_yaw(hand_yaw), self._grasp_quat.expand(len(yaw), 4))
        twist = mask & at("hover", "lower")
        angles = self.wrists.lead(
            torch.stack([hand, hand], dim=1), torch.stack([twist, torch.zeros_like(twist)], 1), dt
        )
        columns = WRISTS[0].to(yaw.device)
        command.arms[:, columns] = torch.where(raised[:, None], angles[:, 0], command.arms[:, columns])
        if present("hover"):
            miss = torch.linalg.vector_norm(grasping - self.palms.measured()[:, 0], dim=1)
            cosine = (self.sight.body(self.palms.bodies[0])[1] * hand).sum(dim=1).abs().clamp_max(1.0)
            self._error = select(mask, torch.stack([miss, 2.0 * torch.acos(cosine)], dim=1), self._error)

    def _grasping(self) -> Tensor:
        """The left palm at the hammer, above it before the grasp and after it [m], [worlds, 3]."""
        at, clock = self.machine.at, self.machine.clock
        above = torch.where(at("hover"), HOVER, 0.0) + torch.where(
            at("lower"), (HOVER - DESCENT * clock).clamp_min(0.0), 0.0
        )
        above = above + torch.where(at("lift"), (ASCENT * clock).clamp_max(LIFTED), 0.0)
        offset = quat_apply(quat_from_yaw(self._hand_yaw), self._palm_offset.expand(len(clock), 3))
        grasping = self._grasp + offset
        return torch.cat([grasping[:, :2], (grasping[:, 2] + above)[:, None]], dim=1)
