"""Boxing's expert: look for the target, walk to its side of the bag, crouch to its height, lead the nearer fist to it.

What its decisions are read from:
- Bags and posts are in the first picture and always in the same place.
- The target's position counts from the decision on at which the head camera has seen a third of it for `GLANCES`
  decisions (`seen`, from `eyes`); 23 of the protocol's 60 first pictures do not show it. Until then the robot looks
  from one place after the other, in a fixed order, so that a learner without memory can do the same: what the picture
  shows of bags and posts says where to go next. From the start it sees the fronts of both bags; then it walks around
  them clockwise, its eyes on the nearer one, past the outer side and the back of bag 1 and the back of bag 2.
- The palms, at the strike, are in the picture too.

The palm must come within 13 cm of a target in the bag's surface, and the palm frame is behind the fingers: a hand that
comes straight at the bag stops too far away. So the robot stands such that the target is on the bag's flank, in front
of a shoulder, and the hand passes next to the bag.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Expert, Sight
from arena_newton.policies.experts.eyes import Eyes, silhouette
from arena_newton.policies.experts.phases import Phases, select
from arena_newton.policies.experts.planning import Floor, signed_distance
from arena_newton.policies.experts.style import Style
from arena_newton.policies.experts.walking import Walk, beyond, paced, passing
from arena_newton.robot.g1 import PALMS
from arena_newton.robot.rotations import atan2, rotate_xy, wrap_angle
from arena_newton.tasks.base import ROOM
from arena_newton.tasks.boxing import TARGET
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.kinematics import HAND_POINT
from arena_newton.trackers.motions.navigate import NavigationLimits
from arena_newton.usd_scenes.g1.links import PALM_OFFSET

__all__ = ["BoxingExpert"]

BAGS = ("/World/Bag_1", "/World/Bag_2")
STRIPES = 8
"""Upright stripes that the target's width is divided into ..."""
ENOUGH = 3
"""... and how many of them must be in view: at 2 m these are 8 pixels of a policy's picture."""
GLANCES = 2
"""Decisions at which the target was in view before it counts as seen: one picture may be a coincidence of a step."""
PLACES = {
    "beside 1": (0, 0.68, 0.25, -1.60),
    "behind 1": (0, 0.75, -1.35, -2.40),
    "behind 2": (1, -0.20, -1.25, 2.60),
    "beside 2": (1, -1.00, 0.10, 1.40),
    "before 2": (1, 0.20, 1.40, 0.00),
}
"""Phase → place to look from: number of the bag, x, y from its axis [m] and heading [rad]. They lead clockwise around
both bags. From the start and on the way to the fourth every azimuth of the target comes into view; the last one is for
a robot that missed it, and then the first."""
NEXT = dict(zip(PLACES, [*list(PLACES)[1:], next(iter(PLACES))], strict=True))
"""Phase → where to look next."""
PASSED = 0.40
"""Distance to a place from which the robot goes on to the next one [m]: it need not stop to see."""
TWIST = 0.9
"""Waist yaw at most [rad], by which the head turns to what it looks at: the nearer bag while it searches, then the
target that it has seen, so that a learner without memory still sees on the way what the way is for."""
LONGEST = {
    "look": 0.15,
    **dict.fromkeys(PLACES, 14.0),
    "approach": 14.0,
    "go round": 6.0,
    "step up": 6.0,
    "strike": 3.5,
}
"""Phase → longest time in it [s]: the first glance; 6 m of way; 4 m of way and a turn; the way around the bag; the last
steps, after which it strikes from where it is; one strike, after which the robot moves by the error of its palm."""

FLANKS = tuple(math.radians(a) for a in (60, -60, 75, -75, 45, -45, 90, -90))
"""Bearing of the target from the bag's axis minus that of the robot [rad]: positive is on the robot's right."""
BEST_FLANK = (math.radians(56), math.radians(68))
"""The one preferred, drawn between these."""
OTHER = 1.5
"""Price of the side of the target that leads towards the bag's post, at its highest, as a length of way [m] ..."""
BEHIND = 3.0
"""... and what is added where the target is on the post's half of the bag, so that the azimuth alone decides."""
COME = (math.radians(6), math.radians(62))
"""Bearing of the target at which the robot comes to the bag, drawn between these, less than at the stance: where the
target is straight ahead, a learner that has not decided for a side comes the same way, and sees how to go round."""
ROUND = 0.82
"""Distance from the bag's axis there [m]."""
STAND = 0.45
"""Distance of pelvis and bag axis when striking [m]: bag radius, forearms and knees fit in between."""
READY = (0.66, 0.76)
"""The same when the robot turns to the bag, before the last step, drawn between these [m]: its hands must not touch the
bag."""
PACE = (0.88, 1.0)
"""Speed against the limits, drawn between these."""
ASIDE = 0.12
"""Places to look from are moved by up to this in x and y, drawn [m]."""
OFF = 0.06
"""Distance of the palm from the target, away from the bag [m]: the hand arrives before it touches."""
BELOW = 0.12
"""Height of the target above the pelvis [m]: the shoulder is then 17 cm above the target."""
LOW, HIGH = 0.52, 0.74
"""Range of pelvis heights [m]."""
SHIFTS = 1
"""Number of moves by the palm's error before the robot goes to another side of the target."""
CLOSER = 0.12
"""Longest such move [m]."""
LEAN = 0.25
"""Waist pitch of a strike [rad]."""
COME_WITHIN = (0.22, 0.60)
"""Errors before it goes round, seen from `BEYOND` that pose, that do not matter [m, rad]."""
READY_WITHIN = (0.16, 0.30)
"""Errors at the ready pose, seen from `BEYOND` it, that do not matter [m, rad]."""
STAND_WITHIN = (0.16, 0.25)
"""The same in front of the bag: the strike goes on walking until the palm is there."""
FAR, CLOSE = 0.32, 0.14
"""Distances to the stance between which crouch and turn of the waist grow with the way that is done [m]: no step of a
strike waits for something that a picture does not show."""
FOLLOW = 1.2
"""Speed of a strike's steps for the palm's error [1/s]."""
STEPS = (0.20, 0.12)
"""Largest speed of these steps ahead and to either side [m/s]."""
SLOWEST = 0.08
"""Smallest speed ahead while there is room [m/s]."""
NEAREST = 0.36
"""Distance of pelvis and bag axis from which on no step leads nearer [m]."""
ARM = 0.44
"""A hand is led at most this far ahead of the pelvis [m], until the robot is near enough."""
GAIN = 0.6
"""Integral gain on the palm's error [1/s]: trackers leave the hand 5-20 cm behind."""
MOST = 0.15
"""Largest correction [m]."""
LIMITS = NavigationLimits(forward=0.8, backward=0.3, sideways=0.3, turn=1.1, position_gain=1.2, near=0.3, far=0.6)
"""Fast, since `released` gives 900 ticks: only targets on the far side of bag 2, which are seen last, take longer."""


class BoxingExpert(Expert):
    """Looks from place to place until the target is seen, walks to it, steps up, strikes; after a miss again."""

    task = "boxing"

    def __init__(self, sight: Sight):
        """Find bags, target and palms."""
        super().__init__(sight)
        worlds, device = sight.worlds, sight.device
        bags, boxes, cylinders = [], [], []
        for bag in BAGS:
            zero = torch.zeros(1, device=device)
            for part in ("Collider", "Post"):
                _, centre, half = sight.box(f"{bag}/{part}")
                wide = half[1:2] if part == "Post" else half[:1]
                boxes.append(torch.cat([centre[:2], zero, half[:1], wide]))
                cylinders.append(torch.cat([centre[:2], half[:1]]))
                if part == "Collider":
                    bags.append(centre[:2])
        self._bags = torch.stack(bags)
        self._boxes = torch.stack(boxes).expand(worlds, -1, 5)
        self._cylinders = torch.stack(cylinders).expand(worlds, -1, 3)
        self._target = sight.frame(f"{TARGET}/Frame/Bounds")
        self._radius = min(sight.scene.marker(f"{TARGET}/Frame/Bounds").half)
        self._palms = [sight.frame(name) for name in PALMS]
        self._eyes = Eyes(sight)
        self._phases = Phases(LONGEST, worlds, device)
        self._acting: list[str] = ["look"] * worlds
        self._walk = Walk(sight, LIMITS)
        self.seen = torch.zeros(worlds, dtype=torch.bool, device=device)
        """The head camera has seen the target in this episode, so that its position may be used, shape [worlds]."""
        self._glances = torch.zeros(worlds, dtype=torch.long, device=device)
        self.right = torch.zeros(worlds, dtype=torch.bool, device=device)
        """The right hand strikes, shape [worlds]."""
        self.stand = torch.zeros(worlds, 3, device=device)
        """Pose in front of the bag: x, y [m], yaw [rad], shape [worlds, 3]."""
        self._first = torch.zeros(worlds, 3, device=device)
        self._tries = torch.zeros(worlds, dtype=torch.long, device=device)
        self._correction = torch.zeros(worlds, 3, device=device)
        self._flank, self._ready, self._pace, self._come = (torch.zeros(worlds, device=device) for _ in range(4))
        self._aside = torch.zeros(worlds, 2, device=device)

    def begin(self, mask: Tensor, style: Style) -> None:
        """Forget the last episode; draw pace, side and stance."""
        self._tries = self._tries.masked_fill(mask, 0)
        self._glances = self._glances.masked_fill(mask, 0)
        self.seen = self.seen & ~mask
        self._flank = select(mask, style.uniform("flank", *BEST_FLANK), self._flank)
        self._ready = select(mask, style.uniform("ready", *READY), self._ready)
        self._come = select(mask, style.uniform("come", *COME), self._come)
        self._pace = select(mask, style.uniform("pace", *PACE), self._pace)
        aside = torch.stack([style.uniform(f"aside {axis}", -ASIDE, ASIDE) for axis in "xy"], dim=1)
        self._aside = select(mask, aside, self._aside)
        self._walk.begin(mask)
        self._go(next(iter(PLACES)), mask)
        self._phases.begin(mask)

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Look, then decide where to go, then walk, step up or strike."""
        self._look(mask)
        looking = self._looking()
        self._approach(mask & self.seen & looking)
        self._search(mask & ~self.seen & looking)
        self._try_again(mask & self._phases.at("strike") & self._phases.late)

        striking, waiting = self._phases.at("strike"), self._phases.at("look")
        answer = self._walk.command(mask & ~waiting & ~striking, dt)
        command = MotionCommand.neutral(self.sight.worlds, self.sight.device)
        command.velocity = paced(answer.velocity, self._pace) * ~waiting[:, None]
        if self._phases.present("strike"):
            command.velocity = select(striking, self._steps(), command.velocity)
        command.hands = torch.ones_like(command.hands)
        command.waist[:, 0] = self._gaze() * ~waiting
        self._strike(command, striking, mask, dt)
        self._acting = self._phases.names()

        self._phases.advance(mask, dt)
        approaching, rounding, stepping = (
            self._phases.over(name, mask, functools.partial(passing, answer, within))
            for name, within in (("approach", COME_WITHIN), ("go round", READY_WITHIN), ("step up", STAND_WITHIN))
        )
        self._walk.to(approaching, beyond(self._first), Floor(self._boxes, *ROOM))
        self._phases.enter("go round", approaching)
        self._step_up(rounding, self.stand)
        self._phases.enter("strike", stepping)
        return command

    def phases(self) -> list[str]:
        """`look`, the places of `PLACES` while it searches, `approach`, `go round`, `step up`, `strike`."""
        return self._acting

    def _looking(self) -> Tensor:
        """Worlds that have not yet gone for the target, bool, [worlds]."""
        return self._phases.at("look", *PLACES)

    def _look(self, mask: Tensor) -> None:
        """Count the decisions at which enough of the target is in view, until it counts as seen."""
        if not (mask & ~self.seen).any():
            return
        ball = silhouette(self._eyes.position, self._target(), self._radius, STRIPES)
        glance = self._eyes.sees(ball, self._cylinders).sum(dim=1) >= ENOUGH
        self._glances = self._glances + (mask & glance)
        self.seen = self.seen | (self._glances >= GLANCES)

    def _gaze(self) -> Tensor:
        """Waist yaw that turns the head to the target, or to the nearer bag before it was seen [rad], [worlds]."""
        pose = self.sight.pose
        to_bags = self._bags - pose[:, None, :2]
        nearer = torch.linalg.vector_norm(to_bags, dim=2).argmin(dim=1)
        to_bag = torch.gather(to_bags, 1, nearer[:, None, None].expand(-1, 1, 2))[:, 0]
        way = select(self.seen, self._target()[:, :2] - pose[:, :2], to_bag)
        return wrap_angle(atan2(way[:, 1], way[:, 0]) - pose[:, 2]).clamp(-TWIST, TWIST)

    def _search(self, mask: Tensor) -> None:
        """Go on to the next place where the last one has shown nothing."""
        if not mask.any():
            return
        near = torch.linalg.vector_norm((self._walk.goal - self.sight.pose)[:, :2], dim=1) < PASSED
        waiting, late = self._phases.at("look"), self._phases.late
        passed = mask & ~waiting & (near | late)
        self._phases.enter(next(iter(PLACES)), mask & waiting & late)
        if passed.any():
            at = {place: passed & self._phases.at(place) for place in PLACES}
            for place, following in NEXT.items():
                self._go(following, at[place])

    def _go(self, place: str, mask: Tensor) -> None:
        """Walk to a place to look from."""
        bag, x, y, yaw = PLACES[place]
        xy = self._bags[bag] + torch.tensor([x, y], device=self.sight.device) + self._aside
        goal = torch.cat([xy, torch.full_like(xy[:, :1], yaw)], dim=1)
        self._walk.to(mask, goal, Floor(self._boxes, *ROOM))
        self._phases.enter(place, mask)

    def _bag(self) -> tuple[Tensor, Tensor]:
        """The target's bag [m], and the bearing of the target from its axis [rad]; [worlds, 2] and [worlds]."""
        target = self._target()[:, :2]
        gap = torch.linalg.vector_norm(target[:, None] - self._bags, dim=2)
        bag = self._bags[gap.argmin(dim=1)]
        return bag, atan2(target[:, 1] - bag[:, 1], target[:, 0] - bag[:, 0])

    def _approach(self, mask: Tensor) -> None:
        """Plan the path to the best stance; after misses to the next best one."""
        if not mask.any():
            return
        pose = self.sight.pose
        bag, bearing = self._bag()
        flank = torch.tensor(FLANKS, device=pose.device)
        side = bearing[:, None] - flank  # [W, C]: bearing of the robot from the bag

        def before(angle: Tensor, distance: Tensor | float) -> Tensor:
            return bag[:, None] + distance * torch.stack([torch.cos(angle), torch.sin(angle)], dim=2)

        ready, stand = before(side, self._ready[:, None, None]), before(side, STAND)
        room = signed_distance(torch.cat([ready, stand], dim=1), self._boxes[:, 1::2])
        tight = (0.40 - room.view(len(pose), 2, -1).amin(dim=1)).clamp_min(0.0)
        far = torch.linalg.vector_norm(ready - pose[:, None, :2], dim=2)
        other = flank.sign() * torch.cos(bearing)[:, None]
        behind = (other > 0.0) & (torch.sin(bearing)[:, None] < 0.0)
        price = far + OTHER * other.clamp_min(0.0) + BEHIND * behind
        price = price + 20.0 * tight + 0.5 * (flank.abs() - self._flank[:, None]).abs()
        order = price.argsort(dim=1)
        pick = torch.gather(order, 1, (self._tries // (SHIFTS + 1) % len(FLANKS))[:, None])

        def chosen(values: Tensor) -> Tensor:
            index = pick if values.ndim == 2 else pick[..., None].expand(-1, 1, 2)
            return torch.gather(values, 1, index)[:, 0]

        facing = wrap_angle(chosen(side) + math.pi)[:, None]
        self._first = select(mask, torch.cat([chosen(ready), facing], dim=1), self._first)
        self.stand = select(mask, torch.cat([chosen(stand), facing], dim=1), self.stand)
        self.right = torch.where(mask, flank[pick[:, 0]] > 0, self.right)
        here = atan2(pose[:, 1] - bag[:, 1], pose[:, 0] - bag[:, 0])
        sign, most = flank[pick[:, 0]].sign(), flank[pick[:, 0]].abs()
        present = wrap_angle(bearing - here) * sign
        come = bearing - sign * torch.minimum(torch.maximum(self._come, present), most)
        way = torch.stack([torch.cos(come), torch.sin(come)], dim=1)
        goal = torch.cat([bag + ROUND * way, wrap_angle(come + math.pi)[:, None]], dim=1)
        self._walk.to(mask, beyond(goal), Floor(self._boxes, *ROOM))
        self._phases.enter("approach", mask)

    def _try_again(self, mask: Tensor) -> None:
        """Move by what the palm missed, after a miss; when that did not help, go to another side."""
        if not mask.any():
            return
        self._tries = self._tries + mask
        elsewhere = self._tries % (SHIFTS + 1) == 0
        # A crouch and a stretched arm push the robot back by centimetres.
        miss = (self._wanted() - self._palm())[:, :2]
        size = torch.linalg.vector_norm(miss, dim=1, keepdim=True).clamp_min(1e-6)
        moved = self.sight.pose[:, :2] + miss * (CLOSER / size).clamp_max(1.0)
        self._step_up(mask & ~elsewhere, torch.cat([moved, self.stand[:, 2:]], dim=1))
        self._approach(mask & elsewhere)

    def _step_up(self, mask: Tensor, stand: Tensor) -> None:
        """The last steps, straight to a pose in front of the bag."""
        if not mask.any():
            return
        self.stand = select(mask, stand, self.stand)
        self._walk.to(mask, beyond(self.stand))
        self._correction = self._correction.masked_fill(mask[:, None], 0.0)
        self._phases.enter("step up", mask)

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

    def _steps(self) -> Tensor:
        """Velocity of a strike: after the palm's error, on and on until it is gone, [worlds, 3]."""
        pose = self.sight.pose
        error = self._local(self._wanted() - self._palm(), pose)
        bag, _ = self._bag()
        room = torch.linalg.vector_norm(bag - pose[:, :2], dim=1) - NEAREST
        ahead = torch.minimum((FOLLOW * error[:, 0]).clamp(SLOWEST, STEPS[0]), FOLLOW * room).clamp_min(-STEPS[0])
        aside = (FOLLOW * error[:, 1]).clamp(-STEPS[1], STEPS[1])
        turn = (LIMITS.heading_gain * wrap_angle(self.stand[:, 2] - pose[:, 2])).clamp(-0.5, 0.5)
        return torch.stack([ahead, aside, turn], dim=1)

    def _strike(self, command: MotionCommand, striking: Tensor, mask: Tensor, dt: float) -> None:
        """Fill in height, waist and hand point of the last steps and of the strike."""
        pose, wanted = self.sight.pose, self._wanted()
        error = self._local(wanted - self._palm(), pose)
        settled = striking & mask & (self._phases.clock > 1.0)
        correction = (self._correction + GAIN * dt * error).clamp(-MOST, MOST)
        self._correction = select(settled, correction, self._correction)

        root = torch.cat([pose[:, :2], self.sight.height[:, None]], dim=1)
        point = self._local(wanted - root, pose) + self._correction
        point[:, 0] = (point[:, 0] + HAND_POINT - PALM_OFFSET[0]).clamp_max(ARM)
        is_right = torch.stack([~self.right, self.right], dim=1)
        command.hand_point = torch.where(is_right[..., None], point[:, None], command.hand_point)
        leading = striking | self._phases.at("step up")
        command.reach = (is_right & leading[:, None]).to(command.reach.dtype)
        left = torch.linalg.vector_norm(self.stand[:, :2] - pose[:, :2], dim=1)
        done = torch.where(striking, 1.0, ((FAR - left) / (FAR - CLOSE)).clamp(0.0, 1.0)) * leading
        height = (wanted[:, 2] - BELOW).clamp(LOW, HIGH)
        command.height = command.height + done * (height - command.height)
        turn = torch.where(self.right, 0.35, -0.35)
        waist = torch.stack([turn, torch.zeros_like(turn), torch.full_like(turn, LEAN)], dim=1)
        command.waist = command.waist + done[:, None] * (waist - command.waist)

    @staticmethod
    def _local(vector: Tensor, pose: Tensor) -> Tensor:
        return torch.cat([rotate_xy(-pose[:, 2], vector[:, :2]), vector[:, 2:]], dim=1)
