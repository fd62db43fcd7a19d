"""P&PBox's expert: two closed fists squeeze the box, carry it near the body, lower it onto the shelf and let go.

What each decision is read from:

- Where the box stands and how it is turned: in the head camera's view from the start. The true pose is what the picture
  shows.
- The shelf is always to the left behind the robot, and comes into view when the robot, box in hands, has turned left
  (phase `turn`, which reads nothing but the robot's own heading). Only then the spot on the deck is chosen.
- How hard the fists press: the distance between commanded and measured palms, which the robot knows from its joints.
- Whether the box is still between the hands: its height, in view ahead of the robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Expert, Sight
from arena_newton.policies.experts.hands import WRISTS, Palms, Wrists
from arena_newton.policies.experts.phases import Phases, select
from arena_newton.policies.experts.style import Style
from arena_newton.policies.experts.walking import Walk, along, beyond, paced, passing
from arena_newton.robot.rotations import heading, matrix_from_quat, quat_from_yaw, rotate_xy, wrap_angle
from arena_newton.tasks.pp_box import BOX, DECKS, TABLE
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.navigate import NavigationCommand, NavigationLimits

__all__ = ["PPBoxExpert"]

DECK = 1
"""The deck at 0.67 m, the only empty one, at hip height: no bend is needed. `released` accepts no other."""
MOST_TURN = 0.4
"""The robot faces one of the box's sides if that is turned by less than this from its own side of the table [rad]; a
box turned farther is squeezed across its corners, and comes to lie flat between the fists."""
STAND_OFF = 0.75
"""Distance of pelvis and box centre from which the robot steps straight ahead to the box [m]."""
STAND = 0.30
"""The same when it steps up to grasp [m]: stretching the arms and the last steps move the pelvis back by 6-9 cm."""
EDGE = 0.07
"""Least distance of the pelvis from the table when it steps up [m]; it ends 6-9 cm farther off. With twice as much the
arms do not reach the middle of a box far in on the table, which tips out of the hands."""
REACH = 0.42
"""Farthest that the arms bring the palms ahead of the pelvis [m]; a box farther off is held nearer to its front."""
UPRIGHT = 0.36
"""Distance of the box ahead of the pelvis up to which the robot stands upright [m] ..."""
LEAN, MOST_LEAN = 2.5, 0.30
"""... beyond it leans by this much [rad/m], to this limit [rad]."""
FIST = 0.055
"""Half thickness of a closed fist [m]: a palm's distance from the face that it touches."""
READY = 0.28
"""Distance of the palms ahead of the pelvis before that [m]."""
PASSING = (0.10, 0.12)
"""Errors at the places on the way, and in front of box and shelf, that do not matter [m, rad]: the arms compensate."""
ALIGN_GAIN = 1.5
"""Integral gain on palms and wrists while they align [1/s]."""
LEARNING = 0.4
"""Time in which the hands get near the box before that begins [s]."""
SOONEST = 0.6
"""Least time of aligning [s]."""
ALIGNED = 0.025
"""Error of the palms that is good enough [m]."""
ASIDE = 0.107
"""Gap between fist and box when the hands begin to align [m]."""
ASIDE_LEAST = 0.04
"""The same when they have aligned for long [m]."""
CREEPING = 0.05
"""Speed of each hand towards the box while they align [m/s]: how far they are can be seen."""
WAITING = 0.2
"""Time before that begins [s]."""
CLOSING = 0.15
"""Speed of each hand when closing [m/s]; twice as fast where it presses too little."""
OVERLAP = 0.115
"""Depth of each palm's commanded position inside the box, beyond the one it reaches [m]: about 100 N/m times this,
10-12 N a side. Below 8 N weak arms drop the box in the carry."""
TURNED = 0.08
"""Additional depth in a box that is turned between the fists [m/rad]: they slide on its faces, and press less."""
SERVO = 5.0
"""Gain of the squeeze [1/s]: speed of a hand for what the overlap lacks. It ends with the lift, since a turned box
comes to lie flat between the fists only when they press, and is then narrower."""
SQUEEZED = 0.4
"""Least time of the squeeze [s]."""
DEEPEST = 0.20
"""Most that a palm is commanded into the box [m]."""
HOLDING = 0.12
"""The same from the lift on, alike for all boxes: whoever learns from demonstrations need not know how it was held."""
RELAXING = 0.05
"""Speed at which each hand gets there [m/s]."""
LIFT = 0.12
"""Height to which the box is lifted above the table [m]."""
LIFTED = 0.07
"""Height from which the robot steps back while the box still rises [m]."""
LIFTING = 0.10
"""Speed of that [m/s]."""
BACK = 0.45
"""Way back from the table [m] before the robot turns."""
NEAR = 0.32
"""Distance ahead of the pelvis at which the fists carry the box [m]: with stretched arms a step's roll of the torso
raises one hand over the other and the box slips."""
DRAWING = 0.10
"""Speed at which they are drawn there, and stretched again on the way to the shelf [m/s]."""
CLEAR = 0.08
"""Height of the box's underside above the deck while it is carried there [m]."""
RAISED = 0.115
"""Height of the hands' command above the wanted height [m]: arms sink by that under the box."""
HEIGHT_GAIN = 1.5
"""More of it for what the box's height lacks. No integral: whoever learns from demonstrations does not know it."""
MOST_RAISED = 0.20
"""Largest correction of the height [m]."""
RAISING = 0.10
"""Speed at which it changes [m/s]."""
FACING = 0.9
"""Heading from which the whole shelf is in view: this close to the direction of its place behind the table [rad].
From there to `reach` all commands follow from what is in view: no goal is remembered, no clock is waited for."""
AT_SHELF = 0.05
"""Distance of pelvis and front edge of the deck to which the robot walks [m]; it never gets there ..."""
STOP = (0.16, 0.15)
"""... but stops where the errors there are smaller than these [m, rad]: it walks briskly until then."""
BESIDE = (0.10, 0.25)
"""Ways to the side between which the robot keeps from the shelf, so that the box does not meet an upright [m] ..."""
CLEARANCE = 0.60
"""... by this distance of pelvis and front edge [m]."""
STRETCHING = (0.50, 0.25)
"""Distances of pelvis and front edge between which the arms stretch to the box's place on the deck [m]."""
AHEAD = 0.02
"""Distance of the box ahead of the palms' command [m]."""
SIDE = 0.55
"""Largest distance of the spot from the deck's middle [m]: the opening hands clear the uprights."""
INSIDE = 0.21
"""Distance of the placed box's centre from the front edge [m]: 10.5 cm more than half of it."""
ENOUGH = 0.05
"""Lack of depth with which the box is lowered [m]: it goes on inwards meanwhile."""
SHORT = 0.01
"""Lack of overlap that does not matter [m]."""
FARTHEST = 0.52
"""Largest distance ahead of the pelvis to which the palms are commanded at the shelf [m]."""
BEND = 0.15
"""Waist pitch at the shelf [rad]."""
SINKING = 0.05
"""Speed of the box from the lift to the height in which it is carried over the deck [m/s]."""
LOWERING = 0.08
"""Speed of the box on its way down [m/s]."""
SUNK = 0.06
"""Depth of the hands' command below the deck before they open [m]: a posture that can be seen."""
DOWN = (0.006, 0.02)
"""Reduction of that depth; one value is drawn per episode [m]."""
RESTS = 0.03
"""Height of the box's lowest corner above the deck below which it counts as put down [m]. A box that is tilted between
the fists comes to lie flat when they open; to wait for that is to wait for nothing that can be seen."""
TURNING = 0.35
"""Yaw rate of the turn to the shelf [rad/s]: at 0.6 SONIC dropped four more boxes of 60."""
OPENING = 0.5
"""Speed of each hand when it lets go [m/s]."""
LET_GO = 0.8
"""Least time of that: fists still on the box would drag it along [s]."""
OPEN = 0.12
"""Way of each hand off the box [m]."""
LEAVE = 0.25
"""Speed of the way back from the shelf and the table [m/s]."""
DROPPED = 0.20
"""Distance of box and middle of the palms from which it is not held [m]."""
RESTING = 0.1
"""A dropped box is judged once it is slower than this [m/s]."""
LOST = 0.60
"""A box whose centre is lower than this is on the floor or in the deck below [m]: out of reach."""
SLIPPED = 0.05
"""A box whose underside is closer to the table than this after the lift has slipped out of the hands [m]."""

LONGEST = {
    "approach": 12.0,
    "step up": 4.0,
    "align": 3.0,
    "close": 2.2,
    "lift": 3.0,
    "back": 4.0,
    "turn": 6.0,
    "carry": 20.0,
    "reach": 3.0,
    "lower": 2.5,
    "open": 1.0,
    "leave": 3.0,
    "retreat": 3.0,
    "stand": math.inf,
}
"""Phases in their usual order with their longest times [s]; `retreat` goes back to the first one."""

HELD = ("lift", "back", "turn", "carry", "reach", "lower")
"""Phases in which the box must be between the hands."""
SIDES = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
"""Directions from the box to left and right palm, pelvis' heading frame."""
BRISK = NavigationLimits(forward=0.6, turn=0.9, arrive_position=0.045, arrive_heading=0.06)
"""Walk with free hands."""
LADEN = NavigationLimits(forward=0.4, turn=0.45, near=0.6, far=1.1, arrive_position=0.045, arrive_heading=0.06)
"""Walk with the box."""


class PPBoxExpert(Expert):
    """One state machine: to the box, squeeze, lift, back, turn, to the shelf, lower, let go, step back.

    The commanded palms are a middle `grip`, half their distance `half`, and what the arms lacked while they aligned in
    the air (`Palms.correction`), all in the pelvis' heading frame: from the squeeze on the hands move with the robot. A
    box that slips on the table is grasped again; one on the floor is lost, and the robot stands still.
    """

    task = "pp_box"

    def __init__(self, sight: Sight):
        """Find box and deck."""
        super().__init__(sight)
        worlds, device = sight.worlds, sight.device
        self._body, self._middle, self._box_half = sight.box(f"{BOX}/Collider")
        self._box_velocity = sight.velocity(BOX)
        _, table, table_half = sight.box(f"{TABLE}/Top")
        self._edge = table[0] - table_half[0]
        deck = sight.scene.marker(DECKS[DECK])
        self._deck_body, self._deck_half = deck.body_id, deck.half
        self._deck = sight.frame(DECKS[DECK])
        self._sides, self._columns = SIDES.to(device), WRISTS.to(device)
        self._ready = torch.tensor([READY, 0.0], device=device).expand(worlds, 2)
        self._turning = torch.tensor([0.0, 0.0, TURNING], device=device).expand(worlds, 3)
        self.state = Phases(LONGEST, worlds, device)
        """Phase of each world."""
        self.walk, self.haul = Walk(sight, BRISK), Walk(sight, LADEN)
        self.palms, self.wrists = Palms(sight, ALIGN_GAIN), Wrists(sight, ALIGN_GAIN)
        zero = torch.zeros(worlds, device=device)
        self.half = zero
        """Half the commanded distance of the palms, without what they lacked [m], shape [worlds]."""
        self.grip = torch.zeros(worlds, 3, device=device)
        """Middle between the commanded palms [m], pelvis' heading frame, shape [worlds, 3]."""
        self.underside = zero
        """Wanted height of the box's underside [m], shape [worlds]."""
        self._raised = self._level = self._table = zero
        self._lean = self._deep = zero
        self._angles = torch.zeros(worlds, 2, 3, device=device)
        self._stand = self._spot = torch.zeros(worlds, 3, device=device)
        self._off = self._near = self._inside = self._pace = self._down = zero

    def begin(self, mask: Tensor, style: Style) -> None:
        """Draw the style and go to the box."""

        def drawn(name: str, old: Tensor, low: float, high: float) -> Tensor:
            return select(mask, style.uniform(name, low, high), old)

        self._off = drawn("stand-off", self._off, STAND_OFF - 0.03, STAND_OFF + 0.05)
        self._near = drawn("near", self._near, NEAR - 0.01, NEAR + 0.01)
        self._inside = drawn("inside", self._inside, INSIDE - 0.01, INSIDE + 0.01)
        self._pace = drawn("pace", self._pace, 0.9, 1.0)
        self._down = drawn("down", self._down, *DOWN)
        self.walk.begin(mask)
        self.haul.begin(mask)
        self.haul.to(mask, self.sight.pose)
        self._table = select(mask, self._underside(), self._table)
        self._approach(mask)

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Walk, and lead both hands, as the phase of each world says."""
        self.state.advance(mask, dt)
        # A world that begins to walk now does so by the command that it would have had.
        walk = self.walk.command(
            mask & self.state.at("approach", "step up"), dt, others=bool(self.state.present("retreat"))
        )
        self._choose_spot(mask & self.state.at("turn", "carry"))
        haul = self.haul.command(mask & self.state.at("carry"), dt, others=bool(self.state.present("turn")))
        self._go_on(mask, walk, haul)
        self._watch(mask)
        self._squeeze(mask, dt)
        self._carry(mask, dt)

        state, command = self.state, MotionCommand.neutral(self.sight.worlds, self.sight.device)
        command.velocity = self._velocity(walk.velocity, haul.velocity)
        active = ~state.at("stand")
        points = self.grip[:, None] + self.half[:, None, None] * self._sides + self.palms.correction
        command.hand_point = select(active, points, command.hand_point)
        command.reach = active[:, None].expand(-1, 2).to(command.reach.dtype)
        command.hands = command.reach
        lean = torch.where(state.at("align", "close", "lift"), self._lean, 0.0)
        lean = torch.where(state.at("reach", "lower", "open"), BEND, lean)
        command.waist = torch.stack([torch.zeros_like(lean), torch.zeros_like(lean), lean], dim=1)
        arms = command.arms.clone()
        arms[:, self._columns] = self._angles
        command.arms = select(active, arms, command.arms)
        return command

    def phases(self) -> list[str]:
        """Names in `LONGEST`; a world that slipped starts over after `retreat`."""
        return self.state.names()

    def _centre(self) -> Tensor:
        """Centre of the box [m], shape [worlds, 3]."""
        return self.sight.once("centre", lambda: self.sight.point(self._body, self._middle))

    def _underside(self) -> Tensor:
        """Height of the box's lowest corner [m], shape [worlds]."""

        def measure() -> Tensor:
            upward = matrix_from_quat(self.sight.body(self._body)[1])[:, 2]
            return self._centre()[:, 2] - (upward.abs() * self._box_half).sum(dim=1)

        return self.sight.once("underside", measure)

    def _wide(self) -> Tensor:
        """Half of the box's width from hand to hand as it stands before the robot [m], shape [worlds]."""
        off = heading(self.sight.body(self._body)[1]) - self._stand[:, 2]
        return self._box_half[0] * torch.sin(off).abs() + self._box_half[1] * torch.cos(off).abs()

    def _depth(self, points: Tensor) -> Tensor:
        """Points [m], shape [worlds, 2], seen from the deck: to its right and beyond its front edge, same shape."""
        local = rotate_xy(-self._deck_yaw(), points - self._deck()[:, :2])
        return torch.stack([local[:, 0], local[:, 1] + self._deck_half[1]], dim=1)

    def _beside(self) -> Tensor:
        """Fraction of the way to the side of all positions on the deck, 0 to 1, shape [worlds]."""
        aside = self._depth(self.sight.pose[:, :2])[:, 0].abs() - SIDE
        return ((aside - BESIDE[0]) / (BESIDE[1] - BESIDE[0])).clamp(0.0, 1.0)

    def _deck_yaw(self) -> Tensor:
        return heading(self.sight.body(self._deck_body)[1])

    def _deck_top(self) -> Tensor:
        """Height of the deck's surface [m], shape [worlds]."""
        return self._deck()[:, 2] + self._deck_half[2]

    def _approach(self, mask: Tensor) -> None:
        """Go to the place straight in front of the box, from the table's side."""
        if not mask.any():
            return
        yaw = heading(self.sight.body(self._body)[1])
        turned = wrap_angle(yaw - 0.5 * math.pi * torch.round(yaw / (0.5 * math.pi)))
        facing, box = turned.clamp(-MOST_TURN, MOST_TURN), self._centre()[:, :2]
        gap = ((box[:, 0] - self._edge + EDGE) / torch.cos(facing)).clamp(min=STAND)
        self._stand = select(mask, pose_before(box, facing, gap), self._stand)
        self._deep = select(mask, OVERLAP + TURNED * (turned - facing).abs(), self._deep)
        self.walk.to(mask, pose_before(box, facing, self._off))
        self.palms.reset(mask)
        self.wrists.reset(mask)
        self._raised = self._raised.masked_fill(mask, 0.0)
        self.underside = select(mask, self._table, self.underside)
        self.state.begin(mask)

    def _choose_spot(self, mask: Tensor) -> None:
        """Go to the place on the deck nearest to the robot."""
        if not mask.any():
            return
        here, yaw = self._depth(self.sight.pose[:, :2]), self._deck_yaw()
        x = here[:, 0].clamp(-SIDE, SIDE)
        edge = torch.stack([x, torch.full_like(x, -self._deck_half[1])], dim=1)
        edge = self._deck()[:, :2] + rotate_xy(yaw, edge)
        facing = wrap_angle(yaw + 0.5 * math.pi)
        self._spot = select(mask, pose_before(edge, facing, torch.full_like(x, AT_SHELF)), self._spot)
        self.haul.to(mask, pose_before(edge, facing, AT_SHELF + self._beside() * (CLEARANCE - AT_SHELF)))

    def _go_on(self, mask: Tensor, walk: NavigationCommand, haul: NavigationCommand) -> None:
        """Enter the next phase where the present one is done or has lasted too long.

        From the last phase to the first, so that a world advances by one at the most.
        """
        state, pose = self.state, self.sight.pose
        clock = state.clock

        def enter(phase: str, following: str, condition: Callable[[], Tensor]) -> Tensor:
            entering = state.over(phase, mask, condition)
            state.enter(following, entering)
            return entering

        def away(start: Tensor) -> Tensor:
            return torch.linalg.vector_norm(pose[:, :2] - start[:, :2], dim=1) > BACK

        def sunk() -> Tensor:
            low = self.underside < self._deck_top() - SUNK + self._down
            return low & (self._underside() < self._deck_top() + RESTS)

        def there() -> Tensor:
            return passing(haul, STOP) & (self._depth(pose[:, :2])[:, 1] > -STRETCHING[1] - ENOUGH)

        self._approach(state.over("retreat", mask, lambda: away(self._stand)))
        enter("leave", "stand", lambda: away(self._spot))
        enter("open", "leave", lambda: (self.half >= self._opened()) & (clock > LET_GO))
        enter("lower", "open", sunk)
        enter("reach", "lower", lambda: self._depth(self._centre()[:, :2])[:, 1] >= self._inside - ENOUGH)
        enter("carry", "reach", there)
        enter("turn", "carry", lambda: wrap_angle(0.5 * math.pi - pose[:, 2]) < FACING)
        enter("back", "turn", lambda: away(self._stand))
        lifted = state.over("lift", mask, lambda: self._underside() > self._table + LIFTED)
        held = self._underside() > self._table + SLIPPED
        state.enter("back", lifted & held)
        state.enter("retreat", lifted & ~held)
        enter("close", "lift", lambda: (self._overlap() > self._deep - SHORT) & (clock > SQUEEZED))
        enter("align", "close", lambda: (clock > SOONEST) & (self._missing() < ALIGNED))
        enter("step up", "align", lambda: passing(walk, PASSING))
        stepping = enter("approach", "step up", lambda: passing(walk, PASSING) & (state.clock > 0))
        if stepping.any():
            self.walk.to(stepping, beyond(self._stand))

    def _watch(self, mask: Tensor) -> None:
        """Leave the usual order where the box rests somewhere else than between the hands."""
        if not self.state.present(*HELD):
            return
        box, palms = self._centre(), self.palms.measured().mean(dim=1)
        out = torch.linalg.vector_norm(box - palms, dim=1) > DROPPED
        rests = torch.linalg.vector_norm(self._box_velocity(), dim=1) < RESTING
        dropped = mask & self.state.at(*HELD) & out & rests
        lost = box[:, 2] < LOST
        early = self.state.at("lift", "back", "turn")
        self.state.enter("stand", dropped & lost)
        self.state.enter("retreat", dropped & ~lost & early)
        self.state.enter("open", dropped & ~lost & ~early)

    def _overlap(self) -> Tensor:
        """Distance of each palm outside its commanded position [m], shape [worlds]."""
        y = self.palms.local(self.palms.measured())[:, :, 1]
        return 0.5 * (y[:, 0] - y[:, 1]) - self.half

    def _reached(self) -> Tensor:
        """The box's centre [m], pelvis' heading frame, shape [worlds, 3]."""
        return self.palms.local(self._centre()[:, None])[:, 0]

    def _grasp(self) -> Tensor:
        """The box's centre as far as the arms reach [m], pelvis' heading frame, shape [worlds, 3]."""
        x, y, z = self._reached().unbind(dim=1)
        return torch.stack([x.clamp(max=REACH), y, z], dim=1)

    def _wanted(self) -> Tensor:
        """Positions of the palms from which they close on the box [m], world, shape [worlds, 2, 3]."""
        yaw = self.sight.pose[:, 2:3].expand(-1, 2)
        side = self.half[:, None, None] * self._sides
        side = torch.cat([rotate_xy(yaw, side[..., :2]), side[..., 2:]], dim=2)
        root = self.sight.root_position
        middle = rotate_xy(yaw[:, 0], self.grip[:, :2])
        return torch.cat([root[:, :2] + middle, root[:, 2:] + self.grip[:, 2:]], dim=1)[:, None] + side

    def _missing(self) -> Tensor:
        """Distance of the worse palm from there [m], shape [worlds]."""
        return torch.linalg.vector_norm(self._wanted() - self.palms.measured(), dim=2).amax(dim=1)

    def _opened(self) -> Tensor:
        """Half the distance of palms that are off the box [m], shape [worlds]."""
        return self._wide() + FIST + OPEN

    def _squeeze(self, mask: Tensor, dt: float) -> None:
        """Palms beside the box, fists level; then together until they are commanded `OVERLAP` deeper than they get."""
        state = self.state
        self._align(mask, dt)
        if state.present("close", "lift"):
            closing = dt * (SERVO * (self._deep - self._overlap())).clamp(-CLOSING, 2.0 * CLOSING)
            squeezed = torch.maximum(self.half - closing, self._box_half[:2].amin() + FIST - DEEPEST)
            self.half = select(mask & state.at("close", "lift"), squeezed, self.half)
        holding = self._box_half[:2].amin() + FIST - HOLDING
        step = dt * RELAXING
        held = self.half + (holding - self.half).clamp(-step, step)
        self.half = select(mask & state.at("back", "turn", "carry", "reach", "lower"), held, self.half)
        if state.present("open", "retreat"):
            opening = torch.minimum(self.half + OPENING * dt, self._opened())
            self.half = select(mask & state.at("open", "retreat"), opening, self.half)

    def _align(self, mask: Tensor, dt: float) -> None:
        """Palms beside the box, fists level."""
        state = self.state
        if not state.present("approach", "step up", "align"):
            return
        before, aligning = state.at("approach", "step up"), state.at("align")
        middle = self._grasp()
        ready = torch.cat([self._ready, middle[:, 2:]], dim=1)
        self.grip = select(mask & before, ready, select(mask & aligning, middle, self.grip))
        self._level = select(mask & (before | aligning), middle[:, 2], self._level)
        crept = CREEPING * (state.clock - WAITING).clamp(min=0.0) * aligning
        apart = (ASIDE - crept).clamp(min=ASIDE_LEAST)
        self.half = select(mask & (before | aligning), self._wide() + FIST + apart, self.half)
        lean = (LEAN * (self._reached()[:, 0] - UPRIGHT)).clamp(0.0, MOST_LEAN)
        self._lean = select(mask & aligning, lean, self._lean.masked_fill(mask & before, 0.0))
        learn = (mask & aligning & (state.clock > LEARNING))[:, None].expand(-1, 2)
        self.palms.lead(self._wanted(), learn, dt)
        level = quat_from_yaw(self.sight.pose[:, 2])[:, None].expand(-1, 2, 4)
        angles = self.wrists.lead(level, learn, dt)
        self._angles = select(mask & (before | aligning), angles, self._angles)

    def _carry(self, mask: Tensor, dt: float) -> None:
        """Height of the box and distance of the fists from the body."""
        if not self.state.present(*HELD):
            return
        state, deck = self.state, self._deck_top()
        over = state.at("turn", "carry", "reach")
        target = torch.where(state.at("lift", "back"), self._table + LIFT, torch.where(over, deck + CLEAR, deck - SUNK))
        speed = torch.where(state.at("lift", "back"), LIFTING, torch.where(over, SINKING, LOWERING)) * dt
        moved = self.underside + torch.minimum(torch.maximum(target - self.underside, -speed), speed)
        carried = mask & state.at(*HELD)
        self.underside = select(carried, moved, self.underside)
        lacking = (RAISED + HEIGHT_GAIN * (self.underside - self._underside())).clamp(-MOST_RAISED, MOST_RAISED)
        raised = self._raised + (lacking - self._raised).clamp(-RAISING * dt, RAISING * dt)
        self._raised = select(carried & ~state.at("lower"), raised, self._raised)

        x, step = self.grip[:, 0], DRAWING * dt
        gap = -self._depth(self.sight.pose[:, :2])[:, 1]
        stretched = ((STRETCHING[0] - gap) / (STRETCHING[0] - STRETCHING[1])).clamp(0.0, 1.0)
        stretched = stretched * state.at("carry", "reach", "lower") * (1.0 - self._beside())
        wanted = self._near + stretched * ((gap + self._inside - AHEAD).clamp(max=FARTHEST) - self._near)
        drawn = (wanted - x).clamp(-step, step)
        x = torch.where(state.at("lift"), x, (x + drawn).clamp(max=FARTHEST))
        z = self._level + self.underside - self._table + self._raised
        grip = torch.stack([x, self.grip[:, 1], z], dim=1)
        self.grip = select(carried, grip, self.grip)

    def _velocity(self, walk: Tensor, haul: Tensor) -> Tensor:
        """Velocity of each world for its phase, shape [worlds, 3]."""
        state = self.state
        velocity = torch.zeros_like(walk)
        velocity = select(state.at("approach", "step up"), paced(walk, self._pace), velocity)
        velocity = select(state.at("carry"), paced(haul, self._pace), velocity)
        for line, phases in ((self._stand, ("back", "retreat")), (self._spot, ("leave",))):
            if state.present(*phases):
                backward = along(self.sight.pose, line[:, :2], line[:, 2], torch.full_like(self._pace, -LEAVE))
                velocity = select(state.at(*phases), backward, velocity)
        return select(state.at("turn"), self._turning, velocity)


def pose_before(point: Tensor, yaw: Tensor, distance: Tensor) -> Tensor:
    """Pose from which a point [m], shape [worlds, 2], is straight ahead.

    Args:
        yaw: Heading of the pose [rad], shape [worlds].
        distance: Way to the point [m], shape [worlds].

    Returns:
        x, y [m], yaw [rad], shape [worlds, 3].
    """
    ahead = torch.stack([torch.cos(yaw), torch.sin(yaw)], dim=1)
    return torch.cat([point - distance[:, None] * ahead, yaw[:, None]], dim=1)
