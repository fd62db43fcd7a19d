"""What the feet do: footsteps planned ahead of the body, the sway that goes with them, and kicks.

`GaitState` is what one tick hands to the next; each function here advances its part by one tick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from arena_newton.robot import TICK
from arena_newton.rotations import rotate_xy, wrap_by_remainder
from arena_newton.trackers.motions.commands import LIMITED_COLUMNS, SHORTEST_STEP
from arena_newton.trackers.motions.kinematics import SOLE_HEIGHT

__all__ = [
    "BEHIND_PER_STEP",
    "STRIDE",
    "GaitState",
    "approach",
    "kick",
    "kick_seconds",
    "merged",
    "smooth",
    "sway",
    "walk",
]

PEAK_OF_SMOOTH = 1.875
"""Peak speed of a minimum-jerk course (`smooth`) over its mean: 15/8."""
BRAKING = 1.8
"""A value slows down as v² = `BRAKING` · acceleration · distance. At 2 it would stop exactly at its target in
continuous time; what is less makes up for ticks."""
DOUBLE_SUPPORT = 0.2
"""Fraction of a step with both feet on the ground."""
SWAY, SWAY_WIDTH = 0.05, 0.22
"""Sway of the pelvis towards the stance foot [m] at this stance width [m]; proportional to the width."""
LEAD_IN = 0.4
"""Weight shift before the first lift and after the last touchdown, in steps."""
FOOT_LEAD = 0.5
"""A foot lands where the body needs it this many steps after the landing: in the middle of its stance."""
BEHIND_PER_STEP = 0.75
"""Distance of the stance foot behind the pelvis when it lifts, in steps: half a step, and what the lift takes."""
STRIDE = 0.28
"""Longest step [m]: faster walks take shorter time."""
SIDE_STRIDE = 0.11
"""Longest step sideways [m]: keeps the feet apart."""
SLOWEST = 0.05
"""Speeds below this count as this for the time of a step [m/s]."""
STANDSTILL = 1e-3
"""A body slower than this no longer moves [m/s, rad/s]."""
TURN_SIDE = 0.3
"""Weight of the yaw rate against the sideways speed in the choice of the first foot [m]."""
EDGE = 0.2
"""A foot steps onto other ground when it lands this far ahead of the other one [m]: a sole and room for the edge."""
LEAST_CLEARANCE = 0.05
"""Least height of a step down above the ground that it leaves [m]."""
HIGH_STEP, RISE_PER_HEIGHT, MOST_RISE = 0.08, 1.6, 0.16
"""A step higher than this [m] rises before it goes on: by this fraction of the swing per metre, up to a limit."""
LANDING_FIXED, LANDING_BLEND = 0.9, 0.4
"""From this fraction of a swing on, the landing no longer follows the plan; over the fraction before, ever less."""
GAIT_RATE, GAIT_ACCELERATION = 3.0, 15.0
"""Limits of the change between standing and walking [1/s, 1/s²]."""
MISPLACED = (0.02, 0.07)
"""A standing robot steps when a foot is this far from its position [m, rad]."""
PLACED = (0.004, 0.02)
"""A walk ends when both feet are this near to their positions [m, rad]."""
KICK_SHIFT, KICK_WIND, KICK_RETURN, KICK_SETTLE = 1.2, 0.4, 0.6, 1.2
"""Times of a kick's phases around the swing [s]; a faster shift would need a support next to the standing foot."""
KICK_BACK, KICK_FRONT = 0.20, 0.24
"""Ends of the swing behind and ahead of the stance [m]."""
KICK_TOE = (0.45, -0.25)
"""Pitch of the foot there [rad], toes down positive: within the ankle's range."""
KICK_LIFT, KICK_LOW = 0.10, 0.09
"""Height of the foot at the end of the wind-up and of the swing [m]: it meets a ball at its middle. 5 cm lower it
scoops the ball up, and a third of the speed is lost."""
KICK_OVERLAP = 0.75
"""Fraction of the return in which the foot goes back, and, ending with it, in which it goes down."""
KICK_GAIT = 0.02
"""A kick starts when the gait has faded to this."""


@dataclass
class GaitState:
    """What the generator remembers; rows are worlds. Ground and world are those of the odometry."""

    body: Tensor
    """Course of the body: x, y [m], yaw [rad], shape [worlds, 3]."""
    channels: Tensor
    """Rate-limited channels, columns `commands.LIMITED_COLUMNS`, shape [worlds, `commands.LIMITED_WIDTH`]."""
    rates: Tensor
    """Their rates [unit/s], same shape."""
    feet: Tensor
    """Left and right ankle: x, y, z [m], yaw, pitch [rad], shape [worlds, 2, 5]."""
    lift_off: Tensor
    """Where the moving foot left the ground: x, y [m], yaw [rad], shape [worlds, 3]."""
    landing: Tensor
    """Where it will land, same shape."""
    stepping: Tensor
    """Whether a step is under way, bool, shape [worlds]."""
    side: Tensor
    """Foot of the present or last step, 0 left, 1 right, int64, shape [worlds]."""
    phase: Tensor
    """Phase of the step, 0 to 1; below 0 leads into the first, above 1 out of the last one, shape [worlds]."""
    first: Tensor
    """Whether the step is the first of a walk, bool, shape [worlds]."""
    final: Tensor
    """Whether it is the last of a walk, bool, shape [worlds]."""
    gait: Tensor
    """From 0 standing to 1 walking, and its rate [1/s], shape [worlds, 2]."""
    ground: Tensor
    """Commanded height of the ground ahead [m], shape [worlds]."""
    floor: Tensor
    """Height of the ground under each foot, of a moving one where it will land [m], shape [worlds, 2]."""
    lift_off_floor: Tensor
    """Height of the ground that the moving foot left [m], shape [worlds]."""
    base: Tensor
    """Height of the ground that carries the pelvis [m], and its rate [m/s], shape [worlds, 2]."""
    kick_side: Tensor
    """Present kick: 0 none, 1 left, 2 right, int64, shape [worlds]."""
    kick_pending: Tensor
    """Kick that waits for the end of a walk, same values."""
    kick_command: Tensor
    """Kick of the last command, same values: a change from 0 starts a kick."""
    kick_time: Tensor
    """Time since the start of the kick [s], shape [worlds]."""
    kick_weight: Tensor
    """Weight of the standing foot of a kick in where the centre of mass must be, 0 to 1, shape [worlds]."""
    kick_length: Tensor
    """Length of the present or last kick [s], shape [worlds]."""
    kick_swing: Tensor
    """Time of its swing [s], shape [worlds]."""
    support: Tensor
    """Feet on the ground, bool, shape [worlds, 2]."""
    euler: Tensor
    """Yaw, pitch, roll of the pelvis [rad], shape [worlds, 3]."""
    root: Tensor
    """Pelvis [m], shape [worlds, 3]."""
    previous_root: Tensor
    """Pelvis one tick earlier [m], shape [worlds, 3]."""
    start_yaw: Tensor
    """Heading at the reset [rad], shape [worlds]."""
    hands: Tensor
    """Left and right hand, 1 closed, 0 open, shape [worlds, 2]."""

    def channel(self, name: str) -> Tensor:
        """A rate-limited channel, shape [worlds, columns]."""
        return self.channels[:, LIMITED_COLUMNS[name]]

    def scalar(self, name: str) -> Tensor:
        """A rate-limited channel of one column, shape [worlds]."""
        return self.channels[:, LIMITED_COLUMNS[name].start]

    def where(self, mask: Tensor, other: GaitState) -> GaitState:
        """This state in the worlds of `mask`, bool, shape [worlds], the other one elsewhere."""
        return GaitState(**{name: merged(mask, value, getattr(other, name)) for name, value in vars(self).items()})


def merged(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Rows of `new` where the mask is set, of `old` elsewhere."""
    return torch.where(mask.reshape(-1, *([1] * (new.ndim - 1))), new, old)


def smooth(fraction: Tensor) -> Tensor:
    """Minimum-jerk course from 0 to 1."""
    t = fraction.clamp(0.0, 1.0)
    return t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)


def approach(x: Tensor, rate: Tensor, target: Tensor, top: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
    """One tick towards `target` with bounded rate and acceleration; returns value and rate."""
    away = target - x
    size = away.abs()
    brake = 0.5 * TICK * acceleration
    speed = torch.minimum(torch.sqrt(BRAKING * acceleration * size + brake * brake) - brake, size / TICK)
    wanted = torch.sign(away) * torch.minimum(speed, top)
    change = acceleration * TICK
    rate = rate + torch.maximum(torch.minimum(wanted - rate, change), -change)
    return x + rate * TICK, rate


def kick_seconds[T: (float, Tensor)](speed: T) -> T:
    """Length of a kick [s] at a foot speed [m/s]."""
    return KICK_SHIFT + KICK_WIND + _swing_seconds(speed) + KICK_RETURN + KICK_SETTLE


def _swing_seconds[T: (float, Tensor)](speed: T) -> T:
    return PEAK_OF_SMOOTH * (KICK_BACK + KICK_FRONT) / speed


def walk(s: GaitState, moving: Tensor, free: Tensor) -> None:
    """Starts, advances and ends steps; moves the swing foot.

    Args:
        s: State, whose body and channels are those of this tick.
        moving: Worlds whose command is to walk or to step, bool, shape [worlds].
        free: Worlds that neither kick nor sit, bool, shape [worlds].
    """
    step_time = _step_time(s)
    begin = _advance_phase(s, moving, free, step_time)
    swing = ((s.phase - 0.5 * DOUBLE_SUPPORT) / (1.0 - DOUBLE_SUPPORT)).clamp(0.0, 1.0)
    _plan_landing(s, begin, swing, step_time)
    swings = _chosen(s.side, s.stepping)
    s.feet = torch.where(swings[:, :, None], _swing_pose(s, swing)[:, None], s.feet)
    s.support = ~(swings & ((swing > 0.0) & (swing < 1.0))[:, None])
    gait, rate = s.gait.unbind(1)
    limits = torch.full_like(gait, GAIT_RATE), torch.full_like(gait, GAIT_ACCELERATION)
    s.gait = torch.stack(approach(gait, rate, s.stepping.float(), *limits), dim=1)


def _step_time(s: GaitState) -> Tensor:
    """Time of a step [s]: shorter in a fast walk, whose steps would be too long."""
    velocity = s.channel("velocity")
    speed = velocity[:, :2].square().sum(1).sqrt().clamp(min=SLOWEST)
    longest = torch.minimum(STRIDE / speed, SIDE_STRIDE / velocity[:, 1].abs().clamp(min=SLOWEST))
    return torch.minimum(s.scalar("step_time"), longest).clamp(min=SHORTEST_STEP)


def _nominal_feet(s: GaitState, ahead: Tensor) -> Tensor:
    """Positions of both feet after the body has gone on for `ahead` [s]: x, y [m], yaw [rad], [worlds, 2, 3]."""
    velocity = s.channel("velocity")
    yaw = s.body[:, 2] + velocity[:, 2] * ahead
    xy = s.body[:, :2] + rotate_xy(s.body[:, 2] + 0.5 * velocity[:, 2] * ahead, velocity[:, :2] * ahead[:, None])
    width, offset, stagger = s.channel("stance_width"), s.channel("foot_offset"), s.channel("stagger")
    forward = torch.cat([0.5 * stagger - offset, -0.5 * stagger - offset], dim=1)
    left = torch.cat([0.5 * width, -0.5 * width], dim=1)
    feet = xy[:, None] + rotate_xy(yaw[:, None], torch.stack([forward, left], dim=-1))
    return torch.cat([feet, yaw[:, None, None].expand(-1, 2, 1)], dim=2)


def _of_side(values: Tensor, side: Tensor) -> Tensor:
    """The row of one foot per world; values, shape [worlds, 2, ...], side, int64, shape [worlds]."""
    return values[torch.arange(len(side), device=side.device), side]


def _chosen(side: Tensor, where: Tensor) -> Tensor:
    """Which feet are of the side, in the worlds of a mask, bool, shape [worlds, 2]."""
    return torch.stack([side == 0, side == 1], dim=1) & where[:, None]


def _advance_phase(s: GaitState, moving: Tensor, free: Tensor, step_time: Tensor) -> Tensor:
    """Advances the phase, decides which step comes next; returns the worlds where one begins."""
    velocity = s.channel("velocity")
    still = ~moving & (velocity.abs() < STANDSTILL).all(1)
    nominal = _nominal_feet(s, torch.zeros_like(step_time))
    away = (s.feet[:, :, :2] - nominal[:, :, :2]).square().sum(2).sqrt()
    twist = wrap_by_remainder(s.feet[:, :, 3] - nominal[:, :, 2]).abs()
    misplaced = (away > MISPLACED[0]) | (twist > MISPLACED[1])
    unplaced = (away > PLACED[0]) | (twist > PLACED[1])

    phase = s.phase + torch.where(s.stepping, TICK / step_time, 0.0)
    over = s.stepping & (phase >= 1.0 + LEAD_IN * s.final)
    other = 1 - s.side
    go_on = over & (~still | unplaced.any(1))
    next_side = torch.where(still & ~_of_side(unplaced, other), s.side, other)
    start = ~s.stepping & free & (moving | misplaced.any(1))
    turn = velocity[:, 1] + TURN_SIDE * velocity[:, 2]
    first_side = torch.where(turn > 0.01, 0, torch.where(turn < -0.01, 1, other))
    first_side = torch.where(still & ~_of_side(misplaced, first_side), 1 - first_side, first_side)

    begin = go_on | start
    s.side = torch.where(start, first_side, torch.where(go_on, next_side, s.side))
    s.stepping = (s.stepping & ~over) | begin
    s.first = torch.where(begin, start, s.first)
    s.final = torch.where(begin, still & ~_of_side(unplaced, 1 - s.side), s.final)
    phase = torch.where(start, -LEAD_IN, torch.where(go_on, phase - 1.0 - LEAD_IN * (phase > 1.0 + LEAD_IN), phase))
    s.phase = torch.where(s.stepping, phase, 0.0)
    s.lift_off = torch.where(begin[:, None], _of_side(s.feet, s.side)[:, [0, 1, 3]], s.lift_off)
    return begin


def _plan_landing(s: GaitState, begin: Tensor, swing: Tensor, step_time: Tensor) -> None:
    """Where the swing foot lands, and on which ground."""
    remaining = (1.0 - s.phase).clamp(min=0.0) * step_time
    planned = _of_side(_nominal_feet(s, remaining + FOOT_LEAD * step_time), s.side)
    # Onto other ground goes the foot that leads by enough for the edge between them, and then the other one.
    lead = rotate_xy(-s.body[:, 2], planned[:, :2] - _of_side(s.feet, 1 - s.side)[:, :2])[:, 0]
    next_to = _of_side(s.floor, 1 - s.side)
    floor = torch.where((lead > EDGE) | (next_to == s.ground), s.ground, next_to)
    s.lift_off_floor = torch.where(begin, _of_side(s.floor, s.side), s.lift_off_floor)
    s.floor = torch.where(_chosen(s.side, begin), floor[:, None], s.floor)
    # The end of a swing no longer follows the plan, so that a foot comes down without sliding.
    gain = ((LANDING_FIXED - swing) / LANDING_BLEND).clamp(0.0, 1.0)
    gain = torch.where(begin, 1.0, gain)[:, None]
    s.landing = s.landing + gain * (planned - s.landing)


def _swing_pose(s: GaitState, swing: Tensor) -> Tensor:
    """Pose of the swing foot at a fraction of its swing: x, y, z [m], yaw, pitch [rad], shape [worlds, 5]."""
    height = s.scalar("swing_height")
    # A high step rises before it goes on, so that the foot clears what is in front of it.
    early = ((height - HIGH_STEP) * RISE_PER_HEIGHT).clamp(0.0, MOST_RISE)
    course = smooth((swing - early) / (1.0 - 2.0 * early))[:, None]
    flat = s.lift_off + course * (s.landing - s.lift_off)
    climb = _of_side(s.floor, s.side) - s.lift_off_floor
    # Down from higher ground the path over its edge is short, and the bent knee has no more to give.
    height = torch.where(climb < 0.0, (height + climb).clamp(min=LEAST_CLEARANCE), height)
    rise = height * torch.sin(math.pi * swing).square()
    # Up first and then ahead, ahead first and then down.
    level = s.lift_off_floor + climb * torch.where(climb > 0.0, smooth(swing / 0.5), smooth((swing - 0.5) / 0.5))
    z = SOLE_HEIGHT + level + rise
    return torch.stack([flat[:, 0], flat[:, 1], z, flat[:, 2], torch.zeros_like(rise)], dim=1)


def sway(s: GaitState) -> Tensor:
    """Sideways position of the pelvis [m], left positive, shape [worlds]."""
    shape = torch.sin(math.pi * s.phase.clamp(0.0, 1.0))
    lead = smooth((s.phase + LEAD_IN) / (0.5 + LEAD_IN))
    tail = smooth((1.0 + LEAD_IN - s.phase) / (0.5 + LEAD_IN))
    shape = torch.where(s.first & (s.phase < 0.5), lead, shape)
    shape = torch.where(s.final & (s.phase >= 0.5), tail, shape)
    size = SWAY * s.scalar("stance_width") / SWAY_WIDTH
    return torch.where(s.stepping, (2.0 * s.side - 1.0) * size * shape, 0.0)


def kick(s: GaitState, kick_speed: Tensor) -> None:
    """Starts, advances and ends kicks; moves the kicking foot.

    Args:
        s: State, after `walk`.
        kick_speed: Commanded speed of the foot [m/s], shape [worlds].
    """
    still = ~s.stepping & (s.channel("velocity").abs() < STANDSTILL).all(1) & (s.gait[:, 0] < KICK_GAIT)
    start = (s.kick_pending > 0) & (s.kick_side == 0) & still
    s.kick_swing = torch.where(start, _swing_seconds(kick_speed), s.kick_swing)
    s.kick_length = torch.where(start, kick_seconds(kick_speed), s.kick_length)
    s.kick_side = torch.where(start, s.kick_pending, s.kick_side)
    s.kick_pending = torch.where(start, 0, s.kick_pending)
    active = s.kick_side > 0
    time = torch.where(active, s.kick_time + TICK, 0.0)
    over = time >= s.kick_length
    s.kick_side = torch.where(over, 0, s.kick_side)
    s.kick_time = torch.where(over, 0.0, time)
    foot = (s.kick_side - 1).clamp(min=0)
    s.lift_off = torch.where(start[:, None], _of_side(s.feet, foot)[:, [0, 1, 3]], s.lift_off)

    pose, height = _kick_pose(s, foot)
    kicks = torch.stack([s.kick_side == 1, s.kick_side == 2], dim=1)
    s.feet = torch.where(kicks[:, :, None], pose[:, None], s.feet)
    s.support = s.support & ~(kicks & (height > 1e-6)[:, None])
    settling = s.kick_time - (KICK_SHIFT + KICK_WIND + s.kick_swing) - KICK_RETURN
    s.kick_weight = (active & ~over) * (smooth(s.kick_time / KICK_SHIFT) - smooth(settling / KICK_SETTLE))


def _kick_pose(s: GaitState, foot: Tensor) -> tuple[Tensor, Tensor]:
    """Pose of the kicking foot, x, y, z [m], yaw, pitch [rad], shape [worlds, 5], and its height above the ground."""
    swing_start = KICK_SHIFT + KICK_WIND
    swing_end = swing_start + s.kick_swing
    part = KICK_OVERLAP * KICK_RETURN
    wind = smooth((s.kick_time - KICK_SHIFT) / KICK_WIND)
    swing = smooth((s.kick_time - swing_start) / s.kick_swing)
    home = smooth((s.kick_time - swing_end) / part)
    down = smooth((s.kick_time - swing_end - (1.0 - KICK_OVERLAP) * KICK_RETURN) / part)
    forward = -KICK_BACK * wind + (KICK_BACK + KICK_FRONT) * swing - KICK_FRONT * home
    height = KICK_LIFT * wind - (KICK_LIFT - KICK_LOW) * swing - KICK_LOW * down
    toe = KICK_TOE[0] * wind + (KICK_TOE[1] - KICK_TOE[0]) * swing - KICK_TOE[1] * home
    xy = s.lift_off[:, :2] + rotate_xy(s.lift_off[:, 2], torch.stack([forward, torch.zeros_like(forward)], dim=1))
    z = SOLE_HEIGHT + _of_side(s.floor, foot) + height
    return torch.cat([xy, z[:, None], s.lift_off[:, 2:], toe[:, None]], dim=1), height
