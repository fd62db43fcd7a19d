"""The reference generator in torch, written once more: what `kernels.footwork` and `kernels.gait` are compared with.

Constants are the product's; formulas are batched over worlds here, and each is a function of whole arrays. The joints
come from the same solver.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from arena_newton.kernels import ik
from arena_newton.kernels.footwork import (
    BEHIND_PER_STEP,
    BRAKING,
    DOUBLE_SUPPORT,
    EDGE,
    FOOT_LEAD,
    GAIT_ACCELERATION,
    GAIT_RATE,
    HIGH_STEP,
    KICK_BACK,
    KICK_FRONT,
    KICK_GAIT,
    KICK_LIFT,
    KICK_LOW,
    KICK_OVERLAP,
    KICK_RETURN,
    KICK_SETTLE,
    KICK_SHIFT,
    KICK_TOE,
    KICK_WIND,
    LANDING_BLEND,
    LANDING_FIXED,
    LEAD_IN,
    LEAST_CLEARANCE,
    MISPLACED,
    MOST_RISE,
    PEAK_OF_SMOOTH,
    PLACED,
    RISE_PER_HEIGHT,
    SIDE_STRIDE,
    SLOWEST,
    STANDSTILL,
    STRIDE,
    SWAY,
    SWAY_WIDTH,
    TURN_SIDE,
)
from arena_newton.kernels.gait import (
    CAREFUL_DEPTH,
    COM_AHEAD,
    DEEP,
    DEEP_LEAN,
    KICK_COM_AHEAD,
    KICK_HEIGHT,
    LIFT_ACCELERATION,
    LIFT_SPEED,
    LONGEST_BEHIND,
    LOWERING,
    SEAT_BLEND,
    SEATED,
    STILL,
    WALK_HEIGHT,
    WALK_PITCH,
)
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, DEFAULT_POSE, TICK
from arena_newton.robot.rotations import quat_from_euler, rotate_xy
from arena_newton.trackers.motions.commands import (
    CHANNELS,
    COLUMNS,
    LIMITED_COLUMNS,
    LIMITED_WIDTH,
    SHORTEST_STEP,
    MotionCommand,
    neutral_row,
)
from arena_newton.trackers.motions.generator import REACHING_JOINTS, ReferenceFrames
from arena_newton.trackers.motions.kinematics import SOLE_CENTRE, SOLE_HEIGHT, chain, neutral_stance

CAREFUL_COM_AHEAD = SOLE_CENTRE


def wrap_by_remainder(angle: Tensor) -> Tensor:
    """The same angle within [-pi, pi) [rad], as the kernels make it."""
    return torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi


@dataclass
class TorchGait:
    """`kernels.footwork.GaitState` as tensors; feet have shape [worlds, 2, 5], a course or a position [worlds, 3]."""

    body: Tensor
    channels: Tensor
    rates: Tensor
    feet: Tensor
    lift_off: Tensor
    landing: Tensor
    stepping: Tensor
    side: Tensor
    phase: Tensor
    first: Tensor
    final: Tensor
    gait: Tensor
    ground: Tensor
    floor: Tensor
    lift_off_floor: Tensor
    base: Tensor
    kick_side: Tensor
    kick_pending: Tensor
    kick_command: Tensor
    kick_time: Tensor
    kick_weight: Tensor
    kick_length: Tensor
    kick_swing: Tensor
    support: Tensor
    euler: Tensor
    root: Tensor
    previous_root: Tensor
    start_yaw: Tensor
    hands: Tensor

    def channel(self, name: str) -> Tensor:
        """A rate-limited channel, shape [worlds, columns]."""
        return self.channels[:, LIMITED_COLUMNS[name]]

    def scalar(self, name: str) -> Tensor:
        """A rate-limited channel of one column, shape [worlds]."""
        return self.channels[:, LIMITED_COLUMNS[name].start]

    def where(self, mask: Tensor, other: TorchGait) -> TorchGait:
        """This state in the worlds of `mask`, bool, shape [worlds], the other one elsewhere."""
        return TorchGait(**{name: merged(mask, value, getattr(other, name)) for name, value in vars(self).items()})


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
    speed = torch.minimum(torch.sqrt(BRAKING * acceleration * size + brake * brake) - brake, top)
    arrives = size / TICK <= speed
    wanted = torch.sign(away) * torch.where(arrives, size / TICK, speed)
    change = acceleration * TICK
    arrives &= (wanted - rate).abs() <= change
    rate = rate + torch.maximum(torch.minimum(wanted - rate, change), -change)
    return torch.where(arrives, target, x + rate * TICK), rate


def walk(s: TorchGait, moving: Tensor, free: Tensor) -> None:
    """Starts, advances and ends steps; moves the swing foot."""
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


def _step_time(s: TorchGait) -> Tensor:
    """Time of a step [s]: shorter in a fast walk, whose steps would be too long."""
    velocity = s.channel("velocity")
    speed = velocity[:, :2].square().sum(1).sqrt().clamp(min=SLOWEST)
    longest = torch.minimum(STRIDE / speed, SIDE_STRIDE / velocity[:, 1].abs().clamp(min=SLOWEST))
    return torch.minimum(s.scalar("step_time"), longest).clamp(min=SHORTEST_STEP)


def _nominal_feet(s: TorchGait, ahead: Tensor) -> Tensor:
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
    """Feet of the side, in the worlds of a mask, bool, shape [worlds, 2]."""
    return torch.stack([side == 0, side == 1], dim=1) & where[:, None]


def _advance_phase(s: TorchGait, moving: Tensor, free: Tensor, step_time: Tensor) -> Tensor:
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


def _plan_landing(s: TorchGait, begin: Tensor, swing: Tensor, step_time: Tensor) -> None:
    """Landing of the swing foot, and the ground of it."""
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


def _swing_pose(s: TorchGait, swing: Tensor) -> Tensor:
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


def sway(s: TorchGait) -> Tensor:
    """Sideways position of the pelvis [m], left positive, shape [worlds]."""
    shape = torch.sin(math.pi * s.phase.clamp(0.0, 1.0))
    lead = smooth((s.phase + LEAD_IN) / (0.5 + LEAD_IN))
    tail = smooth((1.0 + LEAD_IN - s.phase) / (0.5 + LEAD_IN))
    shape = torch.where(s.first & (s.phase < 0.5), lead, shape)
    shape = torch.where(s.final & (s.phase >= 0.5), tail, shape)
    size = SWAY * s.scalar("stance_width") / SWAY_WIDTH
    return torch.where(s.stepping, (2.0 * s.side - 1.0) * size * shape, 0.0)


def kick(s: TorchGait, kick_speed: Tensor) -> None:
    """Starts, advances and ends kicks; moves the kicking foot."""
    still = ~s.stepping & (s.channel("velocity").abs() < STANDSTILL).all(1) & (s.gait[:, 0] < KICK_GAIT)
    start = (s.kick_pending > 0) & (s.kick_side == 0) & still
    swing_seconds = PEAK_OF_SMOOTH * (KICK_BACK + KICK_FRONT) / kick_speed
    around = KICK_SHIFT + KICK_WIND + KICK_RETURN + KICK_SETTLE
    s.kick_swing = torch.where(start, swing_seconds, s.kick_swing)
    s.kick_length = torch.where(start, around + swing_seconds, s.kick_length)
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


def _kick_pose(s: TorchGait, foot: Tensor) -> tuple[Tensor, Tensor]:
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


class TorchGenerator:
    """References for a batch of worlds, one tick at a time."""

    def __init__(self, worlds: int, device: torch.device | str = "cpu"):
        """Stands in the robot's default pose at the origin."""
        self.worlds, self.device = worlds, torch.device(device)
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device("cuda", torch.cuda.current_device())
        wp.init()
        self._model = ik.upload_model(chain(), str(wp.device_from_torch(self.device)))
        self._goal = self._zeros(ik.GOAL_WIDTH)
        self._pelvis, self._joints, self._arms = self._zeros(2), self._zeros(29), self._zeros(8)
        self._palms, self._com, self._error = self._zeros(6), self._zeros(3), self._zeros()
        self._all = torch.ones(worlds, dtype=torch.int32, device=self.device)
        self._solved = self._all.clone()
        self._wp_goal, self._wp_mask = wp.from_torch(self._goal), wp.from_torch(self._solved)
        self._wp_state = ik.IkState(
            pelvis=wp.from_torch(self._pelvis),
            joints=wp.from_torch(self._joints),
            arms=wp.from_torch(self._arms),
            palms=wp.from_torch(self._palms),
            com=wp.from_torch(self._com),
            error=wp.from_torch(self._error),
        )

        self._stance = stance = neutral_stance()
        neutral = self._constant(neutral_row())
        self._rest = torch.cat([neutral[COLUMNS[name]] for name in LIMITED_COLUMNS])
        self._rest[LIMITED_COLUMNS["stance_width"]] = stance.width
        self._default = self._constant(DEFAULT_POSE)
        self._default_palms = self._constant([*stance.hands[0], *stance.hands[1]])
        self._sides = self._constant([1.0, -1.0])
        limited = [CHANNELS[name] for name in LIMITED_COLUMNS]
        self._rate = self._constant([x for c in limited for x in c.spread(c.rate)])
        self._acceleration = self._constant([x for c in limited for x in c.spread(c.acceleration)])
        per_arm_speed = [c.per_arm_speed for c in limited for _ in range(c.width)]
        self._per_arm_speed = torch.tensor(per_arm_speed, device=self.device)
        self._low = self._constant([x for c in CHANNELS.values() for x in c.spread(c.low)])
        self._high = self._constant([x for c in CHANNELS.values() for x in c.spread(c.high)])
        self._to_mujoco = torch.tensor(CANONICAL_TO_MUJOCO, device=self.device)
        self._s = self._standing(self._zeros(2), self._zeros())
        self.reset()

    def _zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(self.worlds, *shape, dtype=dtype, device=self.device)

    def _constant(self, values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self.device)

    def _standing(self, root: Tensor, yaw: Tensor) -> TorchGait:
        """The default pose at rest with the pelvis at x, y [m], shape [worlds, 2], and a heading [rad]."""
        zero = self._zeros()
        ankles = self._zeros(2, 2)
        ankles[:, :, 0] = self._stance.ankle
        ankles[:, :, 1] = 0.5 * self._stance.width * self._sides
        feet = self._zeros(2, 5)
        feet[:, :, :2] = root[:, None] + rotate_xy(yaw[:, None], ankles)
        feet[:, :, 2], feet[:, :, 3] = SOLE_HEIGHT, yaw[:, None]
        pelvis = torch.cat([root, torch.full_like(yaw, self._stance.height)[:, None]], dim=1)
        return TorchGait(
            body=torch.cat([feet[:, :, :2].mean(1), yaw[:, None]], dim=1),
            channels=self._rest.repeat(self.worlds, 1),
            rates=self._zeros(LIMITED_WIDTH),
            feet=feet,
            lift_off=feet[:, 0, [0, 1, 3]],
            landing=feet[:, 0, [0, 1, 3]],
            **dict.fromkeys(("stepping", "first", "final"), self._zeros(dtype=torch.bool)),
            **dict.fromkeys(("side", "kick_side", "kick_pending", "kick_command"), self._zeros(dtype=torch.int64)),
            **dict.fromkeys(("phase", "ground", "lift_off_floor", "kick_time", "kick_weight"), zero),
            **dict.fromkeys(("gait", "floor", "base", "hands"), self._zeros(2)),
            kick_length=torch.ones_like(yaw),
            kick_swing=torch.ones_like(yaw),
            support=~self._zeros(2, dtype=torch.bool),
            euler=torch.stack([yaw, zero, zero], dim=1),
            root=pelvis,
            previous_root=pelvis,
            start_yaw=yaw,
        )

    def reset(self, mask: Tensor | None = None, *, root_xy: Tensor | None = None, yaw: Tensor | None = None) -> None:
        """Stand in the default pose, at rest."""
        yaw = self._zeros() if yaw is None else yaw.to(self.device, torch.float32)
        root = self._zeros(2) if root_xy is None else root_xy.to(self.device, torch.float32)
        standing = self._standing(root, yaw)
        com = self._constant([self._stance.com, 0.0]).expand(self.worlds, 2)
        # Solver's memory → where it starts.
        start = (
            (self._pelvis, root),
            (self._joints, self._default.expand_as(self._joints)),
            (self._arms, self._default[list(REACHING_JOINTS)].expand_as(self._arms)),
            (self._palms, self._default_palms.expand_as(self._palms)),
            (self._com, torch.cat([root + rotate_xy(yaw, com), standing.root[:, 2:]], dim=1)),
            (self._error, self._zeros()),
        )
        mask = self._all.bool() if mask is None else mask.to(self.device)
        self._s = standing.where(mask, self._s)
        for memory, value in start:
            memory.copy_(merged(mask, value, memory))
        self._publish()

    def remember(self, solved: dict[str, Tensor]) -> None:
        """Take another solver's memory over; the next tick starts from it."""
        memory = {"pelvis": self._pelvis, "joints": self._joints, "arms": self._arms, "palms": self._palms}
        for name, value in (memory | {"com": self._com}).items():
            value.copy_(solved[name])

    def step(self, command: MotionCommand, mask: Tensor | None = None) -> ReferenceFrames:
        """One 50 Hz tick."""
        old = self._s
        new = copy.copy(old)
        row = torch.maximum(torch.minimum(command.pack(), self._high), self._low)
        self._plan(new, {name: row[:, part] for name, part in COLUMNS.items()})
        if mask is not None:
            mask = mask.to(self.device)
            new = new.where(mask, old)
            self._solved.copy_(mask)
        else:
            self._solved.copy_(self._all)
        ik.launch_ik(self._model, self._wp_goal, self._wp_mask, self._wp_state)
        new.root = torch.cat([self._pelvis, new.channel("height") + new.base[:, :1]], dim=1)
        new.previous_root = old.root
        if mask is not None:
            new.root = torch.where(mask[:, None], new.root, old.root)
            new.previous_root = torch.where(mask[:, None], old.root, old.previous_root)
        self._s = new
        self._publish()
        return self.frames

    def _plan(self, s: TorchGait, command: dict[str, Tensor]) -> None:
        """Advances the state of all worlds by one tick and writes the goals of the solver.

        Args:
            s: State, changed in place.
            command: Channels within their ranges, each shape [worlds, columns].
        """
        kick_command = command["kick"].squeeze(1).round().long()
        s.kick_pending = torch.where((kick_command > 0) & (s.kick_command == 0), kick_command, s.kick_pending)
        s.kick_command = kick_command
        busy = (s.kick_pending > 0) | (s.kick_side > 0)
        seated = (s.scalar("pelvis_back") > SEATED) | (command["pelvis_back"].squeeze(1) > SEATED)
        free = ~(busy | seated)

        velocity = command["velocity"]
        velocity = velocity * (free & (velocity.abs() > STILL).any(1))[:, None]
        in_place = free & (command["step_in_place"].squeeze(1) >= 0.5)
        moving = in_place | (velocity != 0.0).any(1)

        s.ground = command["ground"].squeeze(1)
        self._limit(s, command, velocity, moving | s.stepping, busy)
        self._advance_body(s)
        walk(s, moving, free)
        kick(s, command["kick_speed"].squeeze(1))
        base, rate = s.base.unbind(1)
        limits = torch.full_like(base, LIFT_SPEED), torch.full_like(base, LIFT_ACCELERATION)
        # A foot counts where it will land: the body rises when the second foot leaves the floor, sinks with the first.
        s.base = torch.stack(approach(base, rate, s.floor.amin(1), *limits), dim=1)
        self._aim(s)
        s.hands = (command["hands"] >= 0.5).float()

    def _limit(self, s: TorchGait, command: dict[str, Tensor], velocity: Tensor, walking: Tensor, busy: Tensor) -> None:
        """Moves every rate-limited channel towards its command."""
        target = {name: command[name] for name in LIMITED_COLUMNS}
        target["velocity"] = velocity
        speed = torch.maximum(velocity[:, :2].norm(dim=1), s.channel("velocity")[:, :2].norm(dim=1))[:, None]
        behind = BEHIND_PER_STEP * (speed * s.channel("step_time")).clamp(max=STRIDE) + s.channel("foot_offset")
        top = WALK_HEIGHT - LOWERING * (behind - LONGEST_BEHIND).clamp(min=0.0)
        height = target["height"]
        height = torch.where(walking[:, None], torch.minimum(height, top), height)
        target["height"] = torch.where(busy[:, None], height.clamp(max=KICK_HEIGHT), height)
        # Feet stay where they are until there is a reason to step: their offset waits for it.
        target["foot_offset"] = torch.where(walking[:, None], target["foot_offset"], s.channel("foot_offset"))
        target["stagger"] = target["stagger"] * (velocity != 0.0).any(1, keepdim=True)
        # A hand that does not reach carries its point along, so that a reach starts where the hand is.
        resting = (s.channel("reach") <= 0.0).repeat_interleave(3, dim=1)
        point = torch.where(resting, self._palms, s.channel("hand_point"))
        reaching = (target["reach"] > 0.0).repeat_interleave(3, dim=1)
        target["hand_point"] = torch.where(reaching, target["hand_point"], point)
        now = s.channels.clone()
        now[:, LIMITED_COLUMNS["hand_point"]] = point

        scale = torch.where(self._per_arm_speed, command["arm_speed"], 1.0)
        packed = torch.cat(list(target.values()), dim=1)
        s.channels, s.rates = approach(now, s.rates, packed, self._rate * scale, self._acceleration * scale)

    def _advance_body(self, s: TorchGait) -> None:
        velocity = s.channel("velocity")
        middle = s.body[:, 2] + 0.5 * TICK * velocity[:, 2]
        xy = s.body[:, :2] + TICK * rotate_xy(middle, velocity[:, :2])
        s.body = torch.cat([xy, s.body[:, 2:] + TICK * velocity[:, 2:]], dim=1)

    def _aim(self, s: TorchGait) -> None:
        """Writes the goals of the solver."""
        xy, yaw, gait = s.body[:, :2], s.body[:, 2], s.gait[:, :1].clamp(0.0, 1.0)
        height, offset, back = s.channel("height"), s.channel("foot_offset"), s.channel("pelvis_back")
        careful = ((self._stance.height - height) / CAREFUL_DEPTH).clamp(0.0, 1.0)
        ahead = COM_AHEAD + (CAREFUL_COM_AHEAD - COM_AHEAD) * careful - offset * (1.0 - gait)
        aside = sway(s)[:, None]
        shift = s.channel("shift") * (1.0 - gait)
        com = xy + rotate_xy(yaw, torch.cat([ahead + shift[:, :1], aside + shift[:, 1:]], dim=1))
        stance = torch.where((s.kick_side == 1)[:, None], s.feet[:, 1], s.feet[:, 0])
        sole = torch.zeros_like(com)
        sole[:, 0] = KICK_COM_AHEAD
        com = com + s.kick_weight[:, None] * (stance[:, :2] + rotate_xy(stance[:, 3], sole) - com)
        pitch = s.channel("pitch") + WALK_PITCH * gait
        pitch = torch.maximum(pitch, (DEEP_LEAN * (DEEP - height)).clamp(min=0.0))
        roll = s.channel("roll")
        s.euler = torch.cat([yaw[:, None], pitch, roll], dim=1)
        goals = {
            "com": com,
            "pelvis": xy + rotate_xy(yaw, torch.cat([torch.zeros_like(aside), aside], dim=1)),
            "pelvis_weight": gait,
            "height": height + s.base[:, :1],
            "seat": -back - offset,
            "anchor": xy,
            "yaw": yaw[:, None],
            "pitch": pitch,
            "roll": roll,
            "feet": s.feet.reshape(-1, 10),
            "upper": torch.cat([s.channel("waist"), s.channel("arms")], dim=1),
            "hand_point": s.channel("hand_point"),
            "reach": smooth(s.channel("reach")),
            "seat_weight": smooth(back / SEAT_BLEND),
        }
        torch.cat([goals[name] for name in ik.GOAL], dim=1, out=self._goal)

    def _publish(self) -> None:
        """Makes the present frame available."""
        s = self._s
        self.frames = ReferenceFrames(s.root, quat_from_euler(s.euler), self._joints.clone(), s.hands)

    def action(self) -> Tensor:
        """Canonical action of the last tick, shape [worlds, 40]."""
        s = self._s
        yaw, pitch, roll = s.euler.unbind(1)
        cp, sp, cr, sr = torch.cos(pitch), torch.sin(pitch), torch.cos(roll), torch.sin(roll)
        moved = s.root - s.previous_root
        forward, left = rotate_xy(-yaw, moved[:, :2]).unbind(1)
        up = moved[:, 2]
        dx = cp * forward - sp * up
        dy = sp * sr * forward + cr * left + cp * sr * up
        relative = yaw - s.start_yaw
        cy, sy = torch.cos(relative), torch.sin(relative)
        rot = torch.stack([cy * cp, cy * sp * sr - sy * cr, sy * cp, sy * sp * sr + cy * cr, -sp, cp * sr], dim=1)
        joints = self._joints[:, self._to_mujoco]
        return torch.cat([torch.stack([dx, dy], dim=1), s.root[:, 2:], rot, joints, s.hands], dim=1)

    def realign(self, yaw: Tensor, weight: float | Tensor = 1.0) -> None:
        """Turns the odometry about the pelvis towards a measured heading."""
        s = self._s
        turn = weight * wrap_by_remainder(yaw.to(self.device) - s.body[:, 2])
        centre = s.root[:, :2]

        def about(xy: Tensor) -> Tensor:
            dims = (slice(None), *([None] * (xy.ndim - 2)))
            return centre[dims] + rotate_xy(turn[dims], xy - centre[dims])

        found = {name: getattr(s, name) for name in ("body", "feet", "lift_off", "landing", "previous_root")}
        moves = {name: torch.cat([about(v[..., :2]), v[..., 2:]], dim=-1) for name, v in found.items()}
        s = self._s = dataclasses.replace(s, **moves)
        for name in ("body", "lift_off", "landing"):
            value = getattr(s, name)
            setattr(s, name, torch.cat([value[:, :2], value[:, 2:] + turn[:, None]], dim=1))
        yaws = s.feet[:, :, 3:4] + turn[:, None, None]
        s.feet = torch.cat([s.feet[:, :, :3], yaws, s.feet[:, :, 4:]], dim=2)
        s.euler = torch.cat([s.euler[:, :1] + turn[:, None], s.euler[:, 1:]], dim=1)
        self._com[:, :2] = about(self._com[:, :2])
        self._publish()
