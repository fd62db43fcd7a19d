"""The streaming reference generator: commands in, one whole-body frame a 50 Hz tick out, for a batch of worlds.

The gait is the one that TWIST2's released checkpoint follows best: footsteps planned one and a half steps ahead of the
body, a pelvis of constant height that sways towards the stance foot. Standing, the centre of mass is kept above the
feet. Every channel of a command is limited in rate and acceleration here, so that any composition of commands gives a
feasible reference. Torch plans, one Warp kernel solves the joints (`kernels.ik`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from arena_newton.errors import InputError
from arena_newton.robot import CANONICAL_TO_MUJOCO, DEFAULT_POSE, TICK
from arena_newton.streams import on_torch_stream
from arena_newton.trackers.motions.commands import CHANNELS, COMMAND_WIDTH, MotionCommand, neutral_row
from arena_newton.trackers.motions.footwork import (
    SHORTEST_STEP,
    STRIDE,
    State,
    approach,
    kick,
    rotate,
    smooth,
    sway,
    walk,
    wrap,
)
from arena_newton.trackers.motions.kinematics import SOLE_CENTRE, SOLE_HEIGHT, chain, neutral_stance

if TYPE_CHECKING:
    import torch

__all__ = ["Frames", "ReferenceGenerator"]

WALK_HEIGHT = 0.75
"""Highest pelvis of a walk [m]: higher, the legs do not reach their footsteps."""
LONGEST_BEHIND = 0.22
"""A foot farther behind the pelvis at the end of its stance lowers the walk [m]."""
STAND_HEIGHT = 0.785
"""Highest pelvis of all [m]: the knees are nearly straight."""
HIGHEST_GROUND = 0.2
"""Highest step up [m]."""
LIFT_SPEED, LIFT_SLOPE = 0.35, 2.0
"""The pelvis follows the ground under the feet with this speed [m/s] and acceleration [m/s²]."""
LOWEST = 0.38
DEEP, DEEP_LEAN = 0.55, 2.6
"""Below this pelvis height [m] the pelvis leans so much per metre [rad/m]: upright, ankles would not bend enough."""
WALK_PITCH = 0.05
"""Forward lean of the pelvis in a walk [rad]."""
STILL = 0.02
"""Commanded speeds below this are standing [m/s, rad/s]."""
SUPPORT = 0.0214
"""Centre of mass before the ankles in a relaxed stand [m]: where the default pose has it."""
CAREFUL_SUPPORT = SOLE_CENTRE
"""The same in a squat or on one foot [m]: the middle of the soles."""
KICK_SUPPORT = 0.055
"""Centre of mass before the ankle of the standing foot in a kick [m]."""
KICK_HEIGHT = 0.75
"""Highest pelvis of a kick [m]."""

_FILTERED = CHANNELS["reach"].stop
"""Channels before this column are limited in rate."""
_LIMITS: dict[str, tuple[float, float]] = {
    "velocity": (0.6, 4.0),
    "height": (0.35, 1.2),
    "pitch": (0.6, 2.5),
    "roll": (0.4, 2.0),
    "waist": (1.2, 6.0),
    "shift": (0.12, 0.5),
    "foot_offset": (0.08, 0.4),
    "stance_width": (0.2, 1.0),
    "stagger": (0.2, 1.0),
    "swing_height": (0.2, 1.0),
    "step_time": (0.3, 2.0),
    "pelvis_back": (0.25, 0.8),
    "arms": (1.0, 8.0),
    "hand_point": (0.4, 3.2),
    "reach": (1.6, 8.0),
}
"""Rate and acceleration [unit/s, unit/s²]; of arms and hand points in units of `arm_speed`."""
_TURN_LIMITS = (1.5, 10.0)
"""Rate and acceleration of the yaw rate [rad/s², rad/s³]."""


@dataclass
class Frames:
    """One tick of reference; rows are worlds."""

    root_pos: torch.Tensor
    """Pelvis position [m], world of the odometry, shape [worlds, 3]."""
    root_quat: torch.Tensor
    """Pelvis orientation, wxyz, shape [worlds, 4]."""
    joint_pos: torch.Tensor
    """Joint positions [rad], MuJoCo order, shape [worlds, 29]."""
    hands: torch.Tensor
    """Left and right hand, 1 closed, 0 open, shape [worlds, 2]."""


class ReferenceGenerator:
    """References for a batch of worlds, one tick at a time."""

    def __init__(self, worlds: int, device: Any = "cpu", seed_pose: str = "stand"):
        """Stands in the neutral pose at the origin.

        Args:
            worlds: Number of worlds.
            device: Torch device.
            seed_pose: Pose to start in; `stand` is the default pose of the robot.

        Raises:
            InputError: An unknown start pose.
        """
        import torch
        import warp as wp

        from arena_newton.kernels import ik

        if seed_pose != "stand":
            raise InputError(f"reference generator: no start pose {seed_pose!r}, expected 'stand'")
        self.worlds, self.device = worlds, torch.device(device)
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device("cuda", torch.cuda.current_device())
        self._ik = ik
        wp.init()
        name = str(wp.device_from_torch(self.device))
        self._model = ik.upload_model(chain(), name)

        def zeros(*shape: int, dtype: Any = torch.float32) -> torch.Tensor:
            return torch.zeros(*shape, dtype=dtype, device=self.device)

        def constant(values: Any) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32, device=self.device)

        self._goal = zeros(worlds, ik.GOAL_WIDTH)
        self._pelvis, self._joints, self._arms = zeros(worlds, 2), zeros(worlds, 29), zeros(worlds, 8)
        self._palms, self._com, self._error = zeros(worlds, 6), zeros(worlds, 3), zeros(worlds)
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

        stance = neutral_stance()
        self._rest = constant(neutral_row())
        self._rest[CHANNELS["stance_width"]] = stance.width
        self._default = constant(DEFAULT_POSE)
        self._default_arms = self._default[[15, 16, 17, 18, 22, 23, 24, 25]]
        self._default_palms = constant([*stance.hands[0], *stance.hands[1]])
        self._stance = stance
        self._sides = constant([1.0, -1.0])
        top, slope = zeros(_FILTERED), zeros(_FILTERED)
        for channel, (rate, acceleration) in _LIMITS.items():
            top[CHANNELS[channel]], slope[CHANNELS[channel]] = rate, acceleration
        top[2], slope[2] = _TURN_LIMITS
        self._top, self._slope = top, slope
        self._to_mujoco = torch.tensor(CANONICAL_TO_MUJOCO, device=self.device)
        self._low, self._high = self._bounds(constant)

        self._s: State = {}
        self.reset()

    def _bounds(self, constant: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """What channels are clamped to."""
        low, high = [-1e3] * COMMAND_WIDTH, [1e3] * COMMAND_WIDTH
        for name, (a, b) in {
            "velocity": (-0.9, 0.9),
            "height": (LOWEST, STAND_HEIGHT),
            "pitch": (-0.3, 1.0),
            "roll": (-0.2, 0.2),
            "waist": (-2.5, 2.5),
            "shift": (-0.12, 0.12),
            "foot_offset": (0.0, 0.12),
            "stance_width": (0.16, 0.36),
            "stagger": (-0.3, 0.3),
            "swing_height": (0.02, 0.22),
            "step_time": (SHORTEST_STEP, 0.8),
            "pelvis_back": (0.0, 0.45),
            "reach": (0.0, 1.0),
            "arm_speed": (0.1, 12.0),
            "kick_speed": (0.5, 4.0),
            "ground": (0.0, HIGHEST_GROUND),
        }.items():
            part = CHANNELS[name]
            low[part], high[part] = [a] * (part.stop - part.start), [b] * (part.stop - part.start)
        low[1:3], high[1:3] = [-0.35, -1.2], [0.35, 1.2]
        return constant(low), constant(high)

    def reset(
        self, mask: torch.Tensor | None = None, *, root_xy: torch.Tensor | None = None, yaw: torch.Tensor | None = None
    ) -> None:
        """Stand neutrally, at rest.

        Args:
            mask: Worlds to reset (all without one), bool, shape [worlds].
            root_xy: Where the pelvis is [m], shape [worlds, 2]; the origin without it.
            yaw: Heading [rad], shape [worlds]; zero without it.
        """
        import torch

        w = self.worlds

        def zeros(*shape: int, dtype: Any = torch.float32) -> torch.Tensor:
            return torch.zeros(w, *shape, dtype=dtype, device=self.device)

        yaw = zeros() if yaw is None else yaw.to(self.device, torch.float32)
        root = zeros(2) if root_xy is None else root_xy.to(self.device, torch.float32)
        offset = zeros(2, 2)
        offset[:, :, 0] = self._stance.ankle
        offset[:, :, 1] = 0.5 * self._stance.width * self._sides
        feet = zeros(2, 5)
        feet[:, :, :2] = root[:, None] + rotate(yaw[:, None], offset)
        feet[:, :, 2], feet[:, :, 3] = SOLE_HEIGHT, yaw[:, None]
        body = torch.cat([feet[:, :, :2].mean(1), yaw[:, None]], dim=1)
        height = torch.full_like(yaw, self._stance.height)
        fresh = {
            "body": body,
            "channels": self._rest[:_FILTERED].repeat(w, 1),
            "rates": zeros(_FILTERED),
            "feet": feet,
            "lifted": feet[:, 0, [0, 1, 3]],
            "landing": feet[:, 0, [0, 1, 3]],
            "stepping": zeros(dtype=torch.bool),
            "side": zeros(dtype=torch.int64),
            "share": zeros(),
            "first": zeros(dtype=torch.bool),
            "final": zeros(dtype=torch.bool),
            "gait": zeros(2),
            "ground": zeros(),
            "floor": zeros(2),
            "left_floor": zeros(),
            "base": zeros(2),
            "kick_side": zeros(dtype=torch.int64),
            "kick_asked": zeros(dtype=torch.int64),
            "kick_last": zeros(dtype=torch.int64),
            "kick_time": zeros(),
            "kick_share": zeros(),
            "kick_length": torch.ones_like(yaw),
            "kick_swing": torch.ones_like(yaw),
            "support": torch.ones(w, 2, dtype=torch.bool, device=self.device),
            "euler": torch.stack([yaw, zeros(), zeros()], dim=1),
            "root": torch.cat([root, height[:, None]], dim=1),
            "before": torch.cat([root, height[:, None]], dim=1),
            "start_yaw": yaw,
            "hands": zeros(2),
        }
        solver = {
            "_pelvis": root,
            "_joints": self._default.expand(w, 29),
            "_arms": self._default_arms.expand(w, 8),
            "_palms": self._default_palms.expand(w, 6),
            "_com": torch.cat([root + rotate(yaw, offset[:, 0] * 0.0 + self._com_offset()), height[:, None]], dim=1),
            "_error": zeros(),
        }
        if mask is None:
            self._s = fresh
            for name, value in solver.items():
                getattr(self, name).copy_(value)
        else:
            mask = mask.to(self.device)
            self._s = _merge(mask, fresh, self._s)
            for name, value in _merge(mask, solver, {k: getattr(self, k) for k in solver}).items():
                getattr(self, name).copy_(value)
        self._publish()

    def _com_offset(self) -> torch.Tensor:
        return self._default.new_tensor([self._stance.com, 0.0])

    def step(self, command: MotionCommand, mask: torch.Tensor | None = None) -> Frames:
        """One 50 Hz tick.

        Args:
            command: What to do.
            mask: Worlds that advance (all without one), bool, shape [worlds]; the others keep frame and state.
        """
        import torch

        old = self._s
        new = dict(old)
        row = command.pack()
        row = torch.maximum(torch.minimum(row, self._high), self._low)
        self._plan(new, row)
        if mask is not None:
            mask = mask.to(self.device)
            new = _merge(mask, new, old)
            self._solved.copy_(mask)
        else:
            self._solved.copy_(self._all)
        with on_torch_stream(self.device):
            self._ik.launch_ik(self._model, self._wp_goal, self._wp_mask, self._wp_state)
        height = new["channels"][:, CHANNELS["height"]] + new["base"][:, :1]
        root = torch.cat([self._pelvis, height], dim=1)
        if mask is None:
            new["before"], new["root"] = old["root"], root
        else:
            new["before"] = torch.where(mask[:, None], old["root"], old["before"])
            new["root"] = torch.where(mask[:, None], root, old["root"])
        self._s = new
        self._publish()
        return self.frames

    def _plan(self, s: State, row: torch.Tensor) -> None:
        """Advances the state of all worlds by one tick and writes the goals of the solver."""
        import torch

        at = CHANNELS
        asked = row[:, at["kick"]].squeeze(1).round().long()
        s["kick_asked"] = torch.where((asked > 0) & (s["kick_last"] == 0), asked, s["kick_asked"])
        s["kick_last"] = asked
        busy = (s["kick_asked"] > 0) | (s["kick_side"] > 0)
        seated = (s["channels"][:, at["pelvis_back"]].squeeze(1) > 0.01) | (row[:, at["pelvis_back"]].squeeze(1) > 0.01)
        free = ~(busy | seated)

        velocity = row[:, at["velocity"]]
        velocity = velocity * (free & (velocity.abs() > STILL).any(1))[:, None]
        in_place = free & (row[:, at["step_in_place"]].squeeze(1) >= 0.5)
        moving = in_place | (velocity != 0.0).any(1)

        s["ground"] = row[:, at["ground"]].squeeze(1)
        self._limit(s, row, velocity, moving | s["stepping"], busy)
        self._advance_body(s)
        walk(s, moving, free)
        kick(s, row)
        base, rate = s["base"].unbind(1)
        top, slope = torch.full_like(base, LIFT_SPEED), torch.full_like(base, LIFT_SLOPE)
        # A foot counts where it will land: the body rises when the second foot leaves the floor, sinks with the first.
        s["base"] = torch.stack(approach(base, rate, s["floor"].amin(1), top, slope), dim=1)
        self._aim(s)
        s["hands"] = (row[:, at["hands"]] >= 0.5).float()

    def _limit(self, s: State, row: torch.Tensor, velocity: torch.Tensor, walking: torch.Tensor, busy: Any) -> None:
        """Moves every channel towards its command."""
        import torch

        at = CHANNELS
        now = s["channels"]
        height = row[:, at["height"]]
        speed = torch.maximum(velocity[:, :2].norm(dim=1), now[:, :2].norm(dim=1))[:, None]
        behind = 0.75 * (speed * now[:, at["step_time"]]).clamp(max=STRIDE) + now[:, at["foot_offset"]]
        top = WALK_HEIGHT - 0.8 * (behind - LONGEST_BEHIND).clamp(min=0.0)
        height = torch.where(walking[:, None], torch.minimum(height, top), height)
        height = torch.where(busy[:, None], height.clamp(max=KICK_HEIGHT), height)
        # Feet stay where they are until there is a reason to step: their offset waits for it.
        offset = torch.where(walking[:, None], row[:, at["foot_offset"]], now[:, at["foot_offset"]])
        stagger = row[:, at["stagger"]] * (velocity != 0.0).any(1, keepdim=True)
        wanted, held = row[:, at["reach"]], now[:, at["reach"]]
        going = (wanted > 0.0).repeat_interleave(3, dim=1)
        resting = (held <= 0.0).repeat_interleave(3, dim=1)
        point = now[:, at["hand_point"]]
        # A hand that does not reach carries its point along, so that a reach starts where the hand is.
        point = torch.where(resting, self._palms, point)
        now = torch.cat([now[:, : at["hand_point"].start], point, held], dim=1)
        target = torch.cat(
            [
                velocity,
                height,
                row[:, at["pitch"].start : at["foot_offset"].start],
                offset,
                row[:, at["stance_width"]],
                stagger,
                row[:, at["swing_height"].start : at["hand_point"].start],
                torch.where(going, row[:, at["hand_point"]], point),
                wanted,
            ],
            dim=1,
        )
        arms = slice(at["arms"].start, at["hand_point"].stop)
        top, slope = self._top.expand_as(now).clone(), self._slope.expand_as(now).clone()
        top[:, arms] *= row[:, at["arm_speed"]]
        slope[:, arms] *= row[:, at["arm_speed"]]
        s["channels"], s["rates"] = approach(now, s["rates"], target, top, slope)

    def _advance_body(self, s: State) -> None:
        import torch

        v, body = s["channels"][:, CHANNELS["velocity"]], s["body"]
        xy = body[:, :2] + TICK * rotate(body[:, 2] + 0.5 * TICK * v[:, 2], v[:, :2])
        s["body"] = torch.cat([xy, body[:, 2:] + TICK * v[:, 2:]], dim=1)

    def _aim(self, s: State) -> None:
        """Writes the goals of the solver."""
        import torch

        at, c, body, feet = CHANNELS, s["channels"], s["body"], s["feet"]
        yaw, gait = body[:, 2], s["gait"][:, :1].clamp(0.0, 1.0)
        height = c[:, at["height"]]
        careful = ((self._stance.height - height) / 0.2).clamp(0.0, 1.0)
        ahead = SUPPORT + (CAREFUL_SUPPORT - SUPPORT) * careful - c[:, at["foot_offset"]] * (1.0 - gait)
        aside = sway(s)[:, None]
        shift = c[:, at["shift"]] * (1.0 - gait)
        com = body[:, :2] + rotate(yaw, torch.cat([ahead + shift[:, :1], aside + shift[:, 1:]], dim=1))
        stance = torch.where((s["kick_side"] == 1)[:, None], feet[:, 1], feet[:, 0])
        sole = torch.zeros_like(com)
        sole[:, 0] = KICK_SUPPORT
        com = com + s["kick_share"][:, None] * (stance[:, :2] + rotate(stance[:, 3], sole) - com)
        pelvis = body[:, :2] + rotate(yaw, torch.cat([torch.zeros_like(aside), aside], dim=1))
        pitch, roll = c[:, at["pitch"]] + WALK_PITCH * gait, c[:, at["roll"]]
        pitch = torch.maximum(pitch, (DEEP_LEAN * (DEEP - height)).clamp(min=0.0))
        back = c[:, at["pelvis_back"]]
        seat = -back - c[:, at["foot_offset"]]
        s["euler"] = torch.cat([yaw[:, None], pitch, roll], dim=1)
        torch.cat(
            [
                com,
                pelvis,
                gait,
                height + s["base"][:, :1],
                seat,
                body,
                pitch,
                roll,
                feet.reshape(-1, 10),
                c[:, at["waist"]],
                c[:, at["arms"]],
                c[:, at["hand_point"]],
                smooth(c[:, at["reach"]]),
                smooth(back / 0.05),
            ],
            dim=1,
            out=self._goal,
        )

    def _publish(self) -> None:
        """Hands out the present frame."""
        import torch

        s = self._s
        half = 0.5 * s["euler"]
        cz, cy, cx = torch.cos(half).unbind(1)
        sz, sy, sx = torch.sin(half).unbind(1)
        quat = torch.stack(
            [
                cz * cy * cx + sz * sy * sx,
                cz * cy * sx - sz * sy * cx,
                cz * sy * cx + sz * cy * sx,
                sz * cy * cx - cz * sy * sx,
            ],
            dim=1,
        )
        self.frames = Frames(s["root"], quat, self._joints.clone(), s["hands"])

    def action(self) -> torch.Tensor:
        """Canonical action of the last tick, orientation relative to the yaw at reset, float32, shape [worlds, 40]."""
        import torch

        s = self._s
        yaw, pitch, roll = s["euler"].unbind(1)
        cy, sy, cx, sx = torch.cos(pitch), torch.sin(pitch), torch.cos(roll), torch.sin(roll)
        moved = s["root"] - s["before"]
        c, n = torch.cos(yaw), torch.sin(yaw)
        forward, left = c * moved[:, 0] + n * moved[:, 1], c * moved[:, 1] - n * moved[:, 0]
        up = moved[:, 2]
        dx = cy * forward - sy * up
        dy = sy * sx * forward + cx * left + cy * sx * up
        relative = yaw - s["start_yaw"]
        c, n = torch.cos(relative), torch.sin(relative)
        rot = torch.stack([c * cy, c * sy * sx - n * cx, n * cy, n * sy * sx + c * cx, -sy, cy * sx], dim=1)
        joints = self._joints[:, self._to_mujoco]
        return torch.cat([torch.stack([dx, dy], dim=1), s["root"][:, 2:], rot, joints, s["hands"]], dim=1)

    @property
    def feet_pos(self) -> torch.Tensor:
        """Ankles [m], left and right, shape [worlds, 2, 3]."""
        return self._s["feet"][:, :, :3]

    @property
    def feet_yaw(self) -> torch.Tensor:
        """Headings of the feet [rad], shape [worlds, 2]."""
        return self._s["feet"][:, :, 3]

    @property
    def support(self) -> torch.Tensor:
        """Feet on the ground, bool, shape [worlds, 2]."""
        return self._s["support"]

    @property
    def phase(self) -> torch.Tensor:
        """Phase of the gait, 0 to 1 over a left and a right step, shape [worlds]."""
        return 0.5 * (self._s["side"] + self._s["share"].clamp(0.0, 1.0))

    @property
    def kick_progress(self) -> torch.Tensor:
        """Share of a kick that has passed, 0 when there is none, shape [worlds]."""
        return self._s["kick_time"] / self._s["kick_length"]

    @property
    def settled(self) -> torch.Tensor:
        """Neither a step nor a kick is going on or asked for, bool, shape [worlds]."""
        s = self._s
        return ~s["stepping"] & (s["kick_side"] == 0) & (s["kick_asked"] == 0)

    @property
    def com(self) -> torch.Tensor:
        """Centre of mass of the reference [m], shape [worlds, 3]; valid until the next step."""
        return self._com

    @property
    def hand_points(self) -> torch.Tensor:
        """Palms of the reference [m], pelvis' heading frame, shape [worlds, 2, 3]; valid until the next step."""
        return self._palms.reshape(-1, 2, 3)

    @property
    def ik_error(self) -> torch.Tensor:
        """Largest distance of a foot from where it should be [m], shape [worlds]; valid until the next step."""
        return self._error

    def realign(self, yaw: torch.Tensor, weight: float | torch.Tensor = 1.0) -> None:
        """Turns the odometry about the pelvis towards a measured heading.

        Args:
            yaw: Measured heading [rad], shape [worlds].
            weight: Share of the difference to take up.
        """
        import torch

        s = dict(self._s)
        turn = weight * wrap(yaw.to(self.device) - s["body"][:, 2])
        centre = s["root"][:, :2]

        def about(xy: torch.Tensor) -> torch.Tensor:
            dims = (slice(None), *([None] * (xy.ndim - 2)))
            return centre[dims] + rotate(turn[dims], xy - centre[dims])

        s["body"] = torch.cat([about(s["body"][:, :2]), (s["body"][:, 2] + turn)[:, None]], dim=1)
        feet = s["feet"]
        s["feet"] = torch.cat(
            [about(feet[:, :, :2]), feet[:, :, 2:3], feet[:, :, 3:4] + turn[:, None, None], feet[:, :, 4:]], dim=2
        )
        for name in ("lifted", "landing"):
            s[name] = torch.cat([about(s[name][:, :2]), s[name][:, 2:] + turn[:, None]], dim=1)
        s["before"] = torch.cat([about(s["before"][:, :2]), s["before"][:, 2:]], dim=1)
        s["euler"] = torch.cat([s["euler"][:, :1] + turn[:, None], s["euler"][:, 1:]], dim=1)
        self._com[:, :2] = about(self._com[:, :2])
        self._s = s
        self._publish()

    def rebase(self, xy: torch.Tensor) -> None:
        """Moves the odometry so that the pelvis is at `xy` [m], shape [worlds, 2]; displacements stay."""
        import torch

        s = dict(self._s)
        by = xy.to(self.device) - s["root"][:, :2]
        for name in ("body", "lifted", "landing", "root", "before"):
            s[name] = torch.cat([s[name][:, :2] + by, s[name][:, 2:]], dim=1)
        s["feet"] = torch.cat([s["feet"][:, :, :2] + by[:, None], s["feet"][:, :, 2:]], dim=2)
        self._pelvis += by
        self._com[:, :2] += by
        self._s = s
        self._publish()


def _merge(mask: torch.Tensor, new: State, old: State) -> State:
    """Rows of `new` where the mask is set, of `old` elsewhere."""
    import torch

    out = {}
    for name, value in new.items():
        before = old.get(name, value)
        out[name] = torch.where(mask.reshape(-1, *([1] * (value.ndim - 1))), value, before)
    return out
