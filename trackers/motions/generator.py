"""The streaming reference generator: commands in, one whole-body frame per 50 Hz tick out, for a batch of worlds.

The gait is the one that TWIST2's released checkpoint follows best: footsteps planned one and a half steps ahead of the
body, a pelvis of constant height that sways towards the stance foot. Standing, the centre of mass is kept above the
feet. Every channel of a command is limited in rate and acceleration here (`commands.Channel`), so that any composition
of commands gives a feasible reference. Torch plans, one Warp kernel solves the joints (`kernels.ik`).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from arena_newton.kernels import ik
from arena_newton.robot import CANONICAL_TO_MUJOCO, DEFAULT_POSE, TICK
from arena_newton.rotations import quat_from_euler, rotate_xy, wrap_by_remainder
from arena_newton.streams import on_torch_stream
from arena_newton.trackers.motions.commands import (
    CHANNELS,
    COLUMNS,
    LIMITED_COLUMNS,
    LIMITED_WIDTH,
    MotionCommand,
    neutral_row,
)
from arena_newton.trackers.motions.footwork import (
    BEHIND_PER_STEP,
    STRIDE,
    GaitState,
    approach,
    kick,
    merged,
    smooth,
    sway,
    walk,
)
from arena_newton.trackers.motions.kinematics import SOLE_CENTRE, SOLE_HEIGHT, chain, neutral_stance

__all__ = ["Frames", "ReferenceGenerator"]

WALK_HEIGHT = 0.75
"""Highest pelvis of a walk [m]: higher, the legs do not reach their footsteps."""
LONGEST_BEHIND, LOWERING = 0.22, 0.8
"""A foot farther behind the pelvis than this at the end of its stance [m] lowers the walk by this much per metre."""
LIFT_SPEED, LIFT_ACCELERATION = 0.35, 2.0
"""The pelvis follows the ground under the feet with this speed [m/s] and acceleration [m/s²]."""
DEEP, DEEP_LEAN = 0.55, 2.6
"""Below this pelvis height [m] the pelvis leans so much per metre [rad/m]: upright, ankles would not bend enough."""
WALK_PITCH = 0.05
"""Forward lean of the pelvis in a walk [rad]."""
STILL = 0.02
"""Commanded speeds below this are standing [m/s, rad/s]."""
SEATED = 0.01
"""A pelvis farther behind its position above the feet than this sits [m]."""
SEAT_BLEND = 0.05
"""The seat's bound on the pelvis is complete at this `pelvis_back` [m]."""
COM_AHEAD = 0.0214
"""Centre of mass ahead of the ankles in a relaxed stand [m]: where the default pose has it."""
CAREFUL_COM_AHEAD, CAREFUL_DEPTH = SOLE_CENTRE, 0.2
"""The same in a squat this deep, or on one foot [m]: the middle of the soles."""
KICK_COM_AHEAD = 0.055
"""Centre of mass ahead of the ankle of the standing foot in a kick [m]."""
KICK_HEIGHT = 0.75
"""Highest pelvis of a kick [m]."""
REACHING_JOINTS = (15, 16, 17, 18, 22, 23, 24, 25)
"""Shoulders and elbows, MuJoCo order."""


@dataclass
class Frames:
    """One tick of reference; rows are worlds."""

    root_pos: Tensor
    """Pelvis position [m], world of the odometry, shape [worlds, 3]."""
    root_quat: Tensor
    """Pelvis orientation, wxyz, shape [worlds, 4]."""
    joint_pos: Tensor
    """Joint positions [rad], MuJoCo order, shape [worlds, 29]."""
    hands: Tensor
    """Left and right hand, 1 closed, 0 open, shape [worlds, 2]."""


class ReferenceGenerator:
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
            hands=wp.from_torch(self._palms),
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

    def _standing(self, root: Tensor, yaw: Tensor) -> GaitState:
        """The default pose at rest with the pelvis at x, y [m], shape [worlds, 2], and a heading [rad]."""
        zero = self._zeros()
        ankles = self._zeros(2, 2)
        ankles[:, :, 0] = self._stance.ankle
        ankles[:, :, 1] = 0.5 * self._stance.width * self._sides
        feet = self._zeros(2, 5)
        feet[:, :, :2] = root[:, None] + rotate_xy(yaw[:, None], ankles)
        feet[:, :, 2], feet[:, :, 3] = SOLE_HEIGHT, yaw[:, None]
        pelvis = torch.cat([root, torch.full_like(yaw, self._stance.height)[:, None]], dim=1)
        return GaitState(
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
        """Stand in the default pose, at rest.

        Args:
            mask: Worlds to reset (all without one), bool, shape [worlds].
            root_xy: Position of the pelvis [m], shape [worlds, 2]; the origin without it.
            yaw: Heading [rad], shape [worlds]; zero without it.
        """
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

    def step(self, command: MotionCommand, mask: Tensor | None = None) -> Frames:
        """One 50 Hz tick.

        Args:
            command: What to do.
            mask: Worlds that advance (all without one), bool, shape [worlds]; the others keep frame and state.

        Returns:
            The frame of the tick.
        """
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
        with on_torch_stream(self.device):
            ik.launch_ik(self._model, self._wp_goal, self._wp_mask, self._wp_state)
        new.root = torch.cat([self._pelvis, new.channel("height") + new.base[:, :1]], dim=1)
        new.previous_root = old.root
        if mask is not None:
            new.root = torch.where(mask[:, None], new.root, old.root)
            new.previous_root = torch.where(mask[:, None], old.root, old.previous_root)
        self._s = new
        self._publish()
        return self.frames

    def _plan(self, s: GaitState, command: dict[str, Tensor]) -> None:
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

    def _limit(self, s: GaitState, command: dict[str, Tensor], velocity: Tensor, walking: Tensor, busy: Tensor) -> None:
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

    def _advance_body(self, s: GaitState) -> None:
        velocity = s.channel("velocity")
        middle = s.body[:, 2] + 0.5 * TICK * velocity[:, 2]
        xy = s.body[:, :2] + TICK * rotate_xy(middle, velocity[:, :2])
        s.body = torch.cat([xy, s.body[:, 2:] + TICK * velocity[:, 2:]], dim=1)

    def _aim(self, s: GaitState) -> None:
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
        self.frames = Frames(s.root, quat_from_euler(s.euler), self._joints.clone(), s.hands)

    def action(self) -> Tensor:
        """Canonical action of the last tick, orientation relative to the yaw at reset, float32, shape [worlds, 40]."""
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

    @property
    def feet_pos(self) -> Tensor:
        """Ankles [m], left and right, shape [worlds, 2, 3]."""
        return self._s.feet[:, :, :3]

    @property
    def feet_yaw(self) -> Tensor:
        """Headings of the feet [rad], shape [worlds, 2]."""
        return self._s.feet[:, :, 3]

    @property
    def floor(self) -> Tensor:
        """Height of the ground under each foot, of a moving one where it will land [m], shape [worlds, 2]."""
        return self._s.floor

    @property
    def support(self) -> Tensor:
        """Feet on the ground, bool, shape [worlds, 2]."""
        return self._s.support

    @property
    def phase(self) -> Tensor:
        """Phase of the gait, 0 to 1 over a left and a right step, shape [worlds]."""
        return 0.5 * (self._s.side + self._s.phase.clamp(0.0, 1.0))

    @property
    def kick_progress(self) -> Tensor:
        """Fraction of the kick that is done, 0 without one, shape [worlds]."""
        return self._s.kick_time / self._s.kick_length

    @property
    def settled(self) -> Tensor:
        """Neither a step nor a kick is under way or pending, bool, shape [worlds]."""
        s = self._s
        return ~s.stepping & (s.kick_side == 0) & (s.kick_pending == 0)

    @property
    def com(self) -> Tensor:
        """Centre of mass of the reference [m], shape [worlds, 3]; valid until the next step."""
        return self._com

    @property
    def hand_points(self) -> Tensor:
        """Palms of the reference [m], pelvis' heading frame, shape [worlds, 2, 3]; valid until the next step."""
        return self._palms.reshape(-1, 2, 3)

    @property
    def ik_error(self) -> Tensor:
        """Largest distance of a foot from where it must be [m], shape [worlds]; valid until the next step."""
        return self._error

    def realign(self, yaw: Tensor, weight: float | Tensor = 1.0) -> None:
        """Turns the odometry about the pelvis towards a measured heading.

        Args:
            yaw: Measured heading [rad], shape [worlds].
            weight: Fraction of the difference to take up.
        """
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
