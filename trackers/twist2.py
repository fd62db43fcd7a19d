"""TWIST2: the whole-body tracker behind the mimic command, with our weights or the official ones.

Facts of its observation are those of its own simulation script, as the original benchmark uses them: 127 numbers a
frame, ten past frames, and the command once more, 1432 in all. All elementwise arithmetic on the observation is either
exactly rounded or done on rows padded to whole vectors, because the vector and scalar versions of `atan2` and `asin`
differ in their last bit.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from arena_newton.errors import InputError
from arena_newton.robot import DEFAULT_POSE, MUJOCO_JOINTS, TWIST2_DRIVE, TWIST2_HUMANOIDARENA_DRIVE, PhysicsRate
from arena_newton.trackers.base import RobotState, TrackerCommand
from arena_newton.trackers.front_end import JOINTS, ActionForm, FrontEnd, Mirror, NetworkTracker, column, plain
from arena_newton.trackers.inference import onnx_mlp, weights_file
from arena_newton.trackers.inference.quadratic import Quadratic, products
from arena_newton.trackers.motions.library import MIRROR_JOINTS, MIRROR_SIGNS

__all__ = ["FRAME", "HISTORY", "OBSERVATION", "OFFICIAL_FORM", "Twist2FrontEnd", "Twist2Tracker", "from_checkpoint"]

COMMAND = 35
"""Width of the mimic command."""
FRAME = 127
"""Width of one frame: command 35, angular velocity 3, roll and pitch 2, joints 29, their velocities 29, action 29."""
HISTORY = 10
"""Past frames, oldest first."""
OBSERVATION = FRAME + HISTORY * FRAME + COMMAND
"""Width of the network's input: current frame, history, command once more."""

_ANG_VEL = slice(35, 38)
_TILT = slice(38, 40)
_JOINTS = slice(40, 69)
_JOINT_VEL = slice(69, 98)
_LAST_ACTION = slice(98, 127)
_PAST = slice(FRAME, FRAME + HISTORY * FRAME)
_FUTURE = slice(FRAME + HISTORY * FRAME, OBSERVATION)

ANG_VEL_SCALE = 0.25
JOINT_VEL_SCALE = 0.05
OFFICIAL_FORM = ActionForm("default", (0.5,) * JOINTS, clip=10.0)
"""Action form of the official checkpoints."""
OBSERVATION_CLIP = 100.0
_TILT_TERMS = (((1, 2), (11, 2)), ((5, -2), (10, -2)), ((2, 2), (7, -2)))
"""2(wx + yz), -2(x² + y²), 2(wy - zx) from the products of a quaternion with itself (`Quadratic`)."""
_VECTOR = 64
"""Rows are padded to a multiple of this for `atan2` and `asin`: two AVX-512 vectors and room."""


class Twist2FrontEnd(FrontEnd):
    """TWIST2's observation around the 35-number mimic command."""

    interface = "twist2"
    obs_width = OBSERVATION
    default_pose = DEFAULT_POSE
    graphable = True

    def __init__(self, action_form: ActionForm = OFFICIAL_FORM):
        """Take the official action form or another."""
        super().__init__(action_form)

    def bind(self, worlds: int, device: Any = "cpu", obs: torch.Tensor | None = None) -> None:
        """Allocate buffers for `worlds` worlds on `device`."""
        super().bind(worlds, device, obs)
        self._frame = self.obs[:, :FRAME]
        # Views are made once: a tick of one world is mostly the cost of calls.
        self._mimic, self._ang_vel, self._tilt = self._frame[:, :COMMAND], self.obs[:, _ANG_VEL], self.obs[:, _TILT]
        self._joints, self._joint_vel = self.obs[:, _JOINTS], self.obs[:, _JOINT_VEL]
        self._past_action = self.obs[:, _LAST_ACTION]
        self._past = self.obs[:, _PAST]
        self._later, self._earlier = self._past[:, FRAME:], self._past[:, :-FRAME]
        self._newest = self._past[:, -FRAME:]
        self._future = self.obs[:, _FUTURE]
        self._shifted = torch.zeros(worlds, (HISTORY - 1) * FRAME, device=self.device)
        padded = -(-worlds // _VECTOR) * _VECTOR
        self._tilt_terms = Quadratic(_TILT_TERMS, (0.0, 1.0, 0.0), self.device)
        terms, angles = torch.zeros(3, padded, device=self.device), torch.zeros(2, padded, device=self.device)
        self._roll_sine, self._roll_cosine, self._pitch_sine = terms
        self._roll, self._pitch = angles
        self._terms, self._angles = terms[:, :worlds].t(), angles[:, :worlds].t()
        self._joint_vel_scale = torch.full((JOINTS,), JOINT_VEL_SCALE, device=self.device)
        self._joint_vel_scale[[i for i, name in enumerate(MUJOCO_JOINTS) if "ankle" in name]] = 0.0

    @torch.no_grad()
    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Set history and last action of the worlds in `mask` to zero."""
        if mask is None:
            self.obs.zero_()
            self.last_action.zero_()
            return
        row = column(mask, self.device)
        self.obs.masked_fill_(row, 0.0)
        self.last_action.masked_fill_(row, 0.0)

    @torch.no_grad()
    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Fill the history of the worlds in `mask` with the present frame: a start is then no jump for the network."""
        self.write(command, state)
        past = self._past.view(-1, HISTORY, FRAME)
        if mask is None:
            past.copy_(self._frame[:, None].expand_as(past))
        else:
            past.copy_(torch.where(column(mask, self.device)[:, None], self._frame[:, None], past))

    def advance(self) -> None:
        """Move the present frame into the history."""
        # History takes the present frame only after the network has seen it.
        self._shifted.copy_(self._later)
        self._earlier.copy_(self._shifted)
        self._newest.copy_(self._frame)

    def mirror_obs(self) -> Mirror:
        """Mirror image of an observation: vy, roll and yaw rate change sign, limbs change sides."""
        joints = MIRROR_JOINTS, MIRROR_SIGNS
        command = [plain(1, -1, 1, -1, 1, -1), joints]
        frame = [*command, plain(-1, 1, -1), plain(-1, 1), joints, joints, joints]
        return Mirror([*frame * (1 + HISTORY), *command], self.device)

    def mirror_action(self) -> Mirror:
        """Mirror image of a raw action: limbs change sides."""
        return Mirror([(MIRROR_JOINTS, MIRROR_SIGNS)], self.device)

    def write(self, command: TrackerCommand, state: RobotState) -> None:
        """Write the present frame and the command's second place."""
        self._mimic.copy_(command.mimic)
        torch.mul(state.ang_vel_body, ANG_VEL_SCALE, out=self._ang_vel)
        self._tilt.copy_(self._roll_pitch(state.quat))
        torch.sub(state.joint_pos, self._default, out=self._joints)
        torch.mul(state.joint_vel, self._joint_vel_scale, out=self._joint_vel)
        self._past_action.copy_(self.last_action)
        self._frame.clamp_(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        self._future.copy_(self._mimic)

    def _roll_pitch(self, quat: torch.Tensor) -> torch.Tensor:
        """Roll atan2(2(wx + yz), 1 - 2(x² + y²)) and pitch asin(clamp(2(wy - zx))); shape [worlds, 2] [rad]."""
        self._terms.copy_(self._tilt_terms(products(quat, quat)))
        torch.atan2(self._roll_sine, self._roll_cosine, out=self._roll)
        torch.asin(self._pitch_sine.clamp_(-1.0, 1.0), out=self._pitch)
        return self._angles


class Twist2Tracker(NetworkTracker):
    """TWIST2's network behind the 35-number mimic command."""

    name = "twist2"
    drive = TWIST2_DRIVE
    physics_rate = PhysicsRate(dt=0.001, substeps=20)
    fast_physics_rate = PhysicsRate(dt=0.005, substeps=4)
    ignores = ("absolute heading", "absolute position")

    def __init__(self, checkpoint: str | Path):
        """Read the network.

        Args:
            checkpoint: The official `.onnx` file, or a `.safetensors` file of `trackers.weights_file`.

        Raises:
            InputError: The file is absent or is no network of TWIST2's widths.
        """
        if Path(checkpoint).suffix == ".safetensors":
            weights = weights_file.load(checkpoint, "twist2")
            self.follow(weights, Twist2FrontEnd(weights.action_form), checkpoint)
            return
        network = onnx_mlp.load(checkpoint, in_width=OBSERVATION, out_width=JOINTS)
        super().__init__(Twist2FrontEnd(), network, checkpoint=str(checkpoint), checkpoint_hash=network.sha256[:12])
        self.original_drive = TWIST2_HUMANOIDARENA_DRIVE


def from_checkpoint(checkpoint: Path | None) -> Twist2Tracker:
    """Make the TWIST2 tracker: with the weights of this package, or with a checkpoint's.

    Raises:
        InputError: The checkpoint is unfit, or there is none and no weights came with the package.
    """
    checkpoint = checkpoint or weights_file.default("twist2", "--checkpoint with the official twist2_1017_20k.onnx")
    if checkpoint.suffix not in (".onnx", ".safetensors"):
        raise InputError(f"--checkpoint {checkpoint}: --tracker twist2 reads .onnx and .safetensors files")
    return Twist2Tracker(checkpoint)
