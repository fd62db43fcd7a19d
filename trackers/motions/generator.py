"""The streaming reference generator: commands in, one whole-body frame per 50 Hz tick out, for a batch of worlds.

The gait is the one that TWIST2's released checkpoint follows best: footsteps planned one and a half steps ahead of the
body, a pelvis of constant height that sways towards the stance foot. Standing, the centre of mass is kept above the
feet. Every channel of a command is limited in rate and acceleration (`commands.Channel`), so that any composition
of commands gives a feasible reference. A tick is three launches: plan (`kernels.gait`), joints (`kernels.ik`), frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from arena_newton.errors import InputError
from arena_newton.kernels import footwork, gait, ik
from arena_newton.kernels.launching import record
from arena_newton.physics.streams import on_torch_stream
from arena_newton.robot.canonical import ACTION_WIDTH
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, DEFAULT_POSE, TICK
from arena_newton.robot.rotations import rotate_xy
from arena_newton.trackers.motions.commands import (
    CHANNELS,
    COLUMNS,
    COMMAND_WIDTH,
    LIMITED_COLUMNS,
    LIMITED_WIDTH,
    SHORTEST_STEP,
    MotionCommand,
    neutral_row,
)
from arena_newton.trackers.motions.kinematics import SOLE_CENTRE, SOLE_HEIGHT, chain, neutral_stance

__all__ = ["ReferenceFrames", "ReferenceGenerator"]

REACHING_JOINTS = (15, 16, 17, 18, 22, 23, 24, 25)
"""Shoulders and elbows, MuJoCo order."""


@dataclass
class ReferenceFrames:
    """One tick of reference; rows are worlds. Later ticks leave it as it is."""

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
        on = str(wp.device_from_torch(self.device))
        self._stance = neutral_stance()
        neutral = self._constant(neutral_row())
        self._rest = torch.cat([neutral[COLUMNS[name]] for name in LIMITED_COLUMNS])
        self._rest[LIMITED_COLUMNS["stance_width"]] = self._stance.width
        self._command, self._mask = self._zeros(COMMAND_WIDTH), self._zeros(dtype=torch.int32)
        self._frame, self._action = self._zeros(gait.FRAME_WIDTH), self._zeros(ACTION_WIDTH)
        self._yaw, self._weight = self._zeros(), self._zeros()
        # The solver's memory, as `ik.IkState` names it.
        widths = {"pelvis": (2,), "joints": (29,), "arms": (8,), "palms": (6,), "com": (3,), "error": ()}
        self._solved = {name: self._zeros(*width) for name, width in widths.items()}
        with on_torch_stream(self.device):
            state, arrays = footwork.allocate_gait(worlds, LIMITED_WIDTH, on)
            self._s = {name: wp.to_torch(array) for name, array in arrays.items()}
            self._pack_launches(state, on)
        self.reset()

    def _zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(self.worlds, *shape, dtype=dtype, device=self.device)

    def _constant(self, values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self.device)

    def _pack_launches(self, state: footwork.GaitState, device: str) -> None:
        """Packs the arguments of the launches, which never change."""
        limited = [CHANNELS[name] for name in LIMITED_COLUMNS]
        model = footwork.upload_gait_model(
            {
                "tick": TICK,
                "sole_height": SOLE_HEIGHT,
                "sole_centre": SOLE_CENTRE,
                "shortest_step": SHORTEST_STEP,
                "stand_height": self._stance.height,
            },
            {
                "low": [x for c in CHANNELS.values() for x in c.spread(c.low)],
                "high": [x for c in CHANNELS.values() for x in c.spread(c.high)],
                "rate": [x for c in limited for x in c.spread(c.rate)],
                "acceleration": [x for c in limited for x in c.spread(c.acceleration)],
                "per_arm_speed": [c.per_arm_speed for c in limited for _ in range(c.width)],
            },
            LIMITED_COLUMNS,
            COLUMNS,
            device,
        )
        mask, goal = wp.from_torch(self._mask), wp.zeros((self.worlds, ik.GOAL_WIDTH), dtype=float, device=device)
        solved = ik.IkState(**{name: wp.from_torch(memory) for name, memory in self._solved.items()})
        presented = gait.Presented(
            frame=wp.from_torch(self._frame),
            action=wp.from_torch(self._action),
            to_mujoco=wp.array(CANONICAL_TO_MUJOCO, dtype=wp.int32, device=device),
        )
        ik_model = ik.upload_model(chain(), device)
        # A packed launch knows addresses; their arrays live as long as it.
        self._held = (model, ik_model, mask, goal, solved, presented, state)
        self._plan = record(gait.launch_plan, model, wp.from_torch(self._command), mask, solved.palms, state, goal)
        self._solve = record(ik.launch_ik, ik_model, goal, mask, solved)
        self._present = record(gait.launch_present, model, mask, solved, state, presented)
        yaw, weight = wp.from_torch(self._yaw), wp.from_torch(self._weight)
        self._realign = record(gait.launch_realign, yaw, weight, solved, state, presented)

    def reset(self, mask: Tensor | None = None, *, root_xy: Tensor | None = None, yaw: Tensor | None = None) -> None:
        """Stand in the default pose, at rest.

        Args:
            mask: Worlds to reset (all without one), bool, shape [worlds].
            root_xy: Position of the pelvis [m], shape [worlds, 2]; the origin without it.
            yaw: Heading [rad], shape [worlds]; zero without it.
        """
        yaw = self._zeros() if yaw is None else yaw.to(self.device, torch.float32)
        root = self._zeros(2) if root_xy is None else root_xy.to(self.device, torch.float32)
        self._mask.fill_(1) if mask is None else self._mask.copy_(mask)
        chosen, standing = self._mask.bool(), self._standing(root, yaw)
        for name, memory in (self._s | self._solved).items():
            value = standing.get(name, torch.zeros_like(memory))
            memory.copy_(torch.where(chosen.reshape(-1, *([1] * (memory.ndim - 1))), value, memory))
        with on_torch_stream(self.device):
            self._present()

    def _standing(self, root: Tensor, yaw: Tensor) -> dict[str, Tensor]:
        """Non-zero values of a state of rest in the default pose, and the start of the solver.

        Args:
            root: Pelvis x, y [m], shape [worlds, 2].
            yaw: Heading [rad], shape [worlds].
        """
        stance, zero, one = self._stance, torch.zeros_like(yaw), torch.ones_like(yaw)
        ankles = self._zeros(2, 2)
        ankles[:, :, 0] = stance.ankle
        ankles[:, :, 1] = 0.5 * stance.width * self._constant([1.0, -1.0])
        feet = self._zeros(2, 5)
        feet[:, :, :2] = root[:, None] + rotate_xy(yaw[:, None], ankles)
        feet[:, :, 2], feet[:, :, 3] = SOLE_HEIGHT, yaw[:, None]
        pelvis = torch.cat([root, torch.full_like(yaw, stance.height)[:, None]], dim=1)
        default = self._constant(DEFAULT_POSE)
        com = root + rotate_xy(yaw, self._constant([stance.com, 0.0]).expand(self.worlds, 2))
        return {
            "body": torch.cat([feet[:, :, :2].mean(1), yaw[:, None]], dim=1),
            "channels": self._rest.expand(self.worlds, -1),
            "feet": feet,
            "lift_off": feet[:, 0, [0, 1, 3]],
            "landing": feet[:, 0, [0, 1, 3]],
            "kick_length": one,
            "kick_swing": one,
            "support": self._s["support"].new_ones(()),
            "euler": torch.stack([yaw, zero, zero], dim=1),
            "root": pelvis,
            "previous_root": pelvis,
            "start_yaw": yaw,
            "pelvis": root,
            "joints": default,
            "arms": default[list(REACHING_JOINTS)],
            "palms": self._constant([*stance.hands[0], *stance.hands[1]]),
            "com": torch.cat([com, pelvis[:, 2:]], dim=1),
        }

    def step(self, command: MotionCommand | Tensor, mask: Tensor | None = None) -> ReferenceFrames:
        """One 50 Hz tick.

        Args:
            command: What to do; a caller that repeats a command saves time with its packed rows
                (`MotionCommand.pack`), shape [worlds, `commands.COMMAND_WIDTH`].
            mask: Worlds that advance (all without one), bool, shape [worlds]; the others keep frame and state.

        Returns:
            The frame of the tick.

        Raises:
            InputError: A command for another number of worlds, or of another width.
        """
        table = command.pack() if isinstance(command, MotionCommand) else command
        if table.shape != self._command.shape:
            expected = list(self._command.shape)
            raise InputError(f"motion command: packed rows have shape {list(table.shape)}, expected {expected}")
        self._command.copy_(table)
        self._mask.fill_(1) if mask is None else self._mask.copy_(mask)
        with on_torch_stream(self.device):
            self._plan()
            self._solve()
            self._present()
        return self.frames

    @property
    def frames(self) -> ReferenceFrames:
        """The present frame."""
        frame = self._frame.clone()
        return ReferenceFrames(**{name: frame[:, part] for name, part in gait.FRAME.items()})

    def action(self) -> Tensor:
        """Canonical action of the last tick, orientation relative to the yaw at reset, float32, shape [worlds, 40]."""
        return self._action.clone()

    def channel(self, name: str) -> Tensor:
        """A rate-limited channel as it is now, shape [worlds, columns]."""
        return self._s["channels"][:, LIMITED_COLUMNS[name]].clone()

    @property
    def feet_pos(self) -> Tensor:
        """Ankles [m], left and right, shape [worlds, 2, 3]."""
        return self._s["feet"][:, :, :3].clone()

    @property
    def feet_yaw(self) -> Tensor:
        """Headings of the feet [rad], shape [worlds, 2]."""
        return self._s["feet"][:, :, 3].clone()

    @property
    def floor(self) -> Tensor:
        """Height of the ground under each foot, of a moving one where it will land [m], shape [worlds, 2]."""
        return self._s["floor"].clone()

    @property
    def support(self) -> Tensor:
        """Feet on the ground, bool, shape [worlds, 2]."""
        return self._s["support"].clone()

    @property
    def phase(self) -> Tensor:
        """Phase of the gait, 0 to 1 over a left and a right step, shape [worlds]."""
        return 0.5 * (self._s["side"] + self._s["phase"].clamp(0.0, 1.0))

    @property
    def kick_progress(self) -> Tensor:
        """Fraction of the kick that is done, 0 without one, shape [worlds]."""
        return self._s["kick_time"] / self._s["kick_length"]

    @property
    def settled(self) -> Tensor:
        """Neither a step nor a kick is under way or pending, bool, shape [worlds]."""
        s = self._s
        return ~s["stepping"] & (s["kick_side"] == 0) & (s["kick_pending"] == 0)

    @property
    def com(self) -> Tensor:
        """Centre of mass of the reference [m], shape [worlds, 3]; valid until the next step."""
        return self._solved["com"]

    @property
    def hand_points(self) -> Tensor:
        """Palms of the reference [m], pelvis' heading frame, shape [worlds, 2, 3]; valid until the next step."""
        return self._solved["palms"].reshape(-1, 2, 3)

    @property
    def ik_error(self) -> Tensor:
        """Largest distance of a foot from where it must be [m], shape [worlds]; valid until the next step."""
        return self._solved["error"]

    def realign(self, yaw: Tensor, weight: float | Tensor = 1.0) -> None:
        """Turns the odometry about the pelvis towards a measured heading; a world that need not turn keeps every bit.

        Args:
            yaw: Measured heading [rad], shape [worlds].
            weight: Fraction of the difference to take up, for all worlds or shape [worlds].
        """
        self._yaw.copy_(yaw)
        self._weight.copy_(weight) if isinstance(weight, Tensor) else self._weight.fill_(weight)
        with on_torch_stream(self.device):
            self._realign()
