"""TWIST2: the official whole-body tracker, run from its ONNX file for all worlds at once.

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
from arena_newton.robot import DEFAULT_POSE, MUJOCO_JOINTS, TWIST2_DRIVE, PhysicsRate
from arena_newton.trackers import onnx_mlp
from arena_newton.trackers.base import RobotState, Tracker, TrackerCommand
from arena_newton.trackers.blocks import BlockRunner

__all__ = ["FRAME", "HISTORY", "OBSERVATION", "Twist2Tracker", "from_checkpoint"]

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
ACTION_SCALE = 0.5
ACTION_CLIP = 10.0
OBSERVATION_CLIP = 100.0
_VECTOR = 64
"""Rows are padded to a multiple of this for `atan2` and `asin`: two AVX-512 vectors and room."""


class Twist2Tracker(Tracker):
    """TWIST2's network behind the 35-number mimic command."""

    name = "twist2"
    drive = TWIST2_DRIVE
    physics_rate = PhysicsRate(dt=0.001, substeps=20)
    fast_physics_rate = PhysicsRate(dt=0.005, substeps=4)
    ignores = ("absolute heading", "absolute position")

    def __init__(self, checkpoint: str | Path):
        """Read the network.

        Args:
            checkpoint: The official `.onnx` file.

        Raises:
            InputError: The file is absent or is no network of TWIST2's widths.
        """
        self.network = onnx_mlp.load(checkpoint, in_width=OBSERVATION, out_width=len(MUJOCO_JOINTS))
        self.checkpoint = str(checkpoint)
        self.checkpoint_hash = self.network.sha256[:12]

    def bind(self, worlds: int, device: Any = "cpu", scene: Any = None) -> None:
        """Allocate observation buffers for `worlds` worlds on `device`."""
        super().bind(worlds, device, scene)
        device = torch.device(device)
        self.network.to(device)
        self._runner = BlockRunner(self.network, OBSERVATION, worlds, device)
        self._obs = self._runner.input
        self._frame = self._obs[:, :FRAME]
        self._past = self._obs[:, _PAST]
        self._future = self._obs[:, _FUTURE]
        self._shifted = torch.zeros(worlds, (HISTORY - 1) * FRAME, device=device)
        padded = -(-worlds // _VECTOR) * _VECTOR
        self._quat = torch.zeros(4, padded, device=device)
        self._tilt = torch.zeros(2, padded, device=device)
        self._scratch = torch.zeros(4, padded, device=device)
        self._default = torch.tensor(DEFAULT_POSE, device=device)
        self._joint_vel_scale = torch.full((29,), JOINT_VEL_SCALE, device=device)
        ankles = [i for i, name in enumerate(MUJOCO_JOINTS) if "ankle" in name]
        self._joint_vel_scale[ankles] = 0.0
        self.last_action = torch.zeros(worlds, 29, device=device)
        """Last raw network output, unclipped, shape [worlds, 29]."""
        self._targets = torch.zeros(worlds, 29, device=device)
        self.reset()

    @torch.inference_mode()
    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Set history and last action of the worlds in `mask` to zero."""
        if mask is None:
            self._obs.zero_()
            self.last_action.zero_()
            return
        row = mask.to(device=self._obs.device, dtype=torch.bool)[:, None]
        self._obs.masked_fill_(row, 0.0)
        self.last_action.masked_fill_(row, 0.0)

    @torch.inference_mode()
    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Fill the history of the worlds in `mask` with the present frame: a start is then no jump for the network."""
        self._write_frame(command, state)
        past = self._past.view(-1, HISTORY, FRAME)
        if mask is None:
            past.copy_(self._frame[:, None].expand_as(past))
        else:
            row = mask.to(device=self._obs.device, dtype=torch.bool)[:, None, None]
            past.copy_(torch.where(row, self._frame[:, None], past))

    @torch.inference_mode()
    def step(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        """Joint targets of this tick [rad], MuJoCo order, shape [worlds, 29]; the buffer is reused by the next call."""
        self._write_frame(command, state)
        raw = self._runner.run()
        self.last_action.copy_(raw)
        # History takes the present frame only after the network has seen it.
        self._shifted.copy_(self._past[:, FRAME:])
        self._past[:, :-FRAME].copy_(self._shifted)
        self._past[:, -FRAME:].copy_(self._frame)
        return torch.clamp(raw, -ACTION_CLIP, ACTION_CLIP, out=self._targets).mul_(ACTION_SCALE).add_(self._default)

    def observation(self) -> torch.Tensor:
        """What the network saw last, except that the history already holds that frame; shape [worlds, 1432]."""
        return self._obs

    def _write_frame(self, command: TrackerCommand, state: RobotState) -> None:
        frame = self._frame
        frame[:, :COMMAND] = command.mimic
        torch.mul(state.ang_vel_body, ANG_VEL_SCALE, out=frame[:, _ANG_VEL])
        frame[:, _TILT] = self._roll_pitch(state.quat)
        torch.sub(state.joint_pos, self._default, out=frame[:, _JOINTS])
        torch.mul(state.joint_vel, self._joint_vel_scale, out=frame[:, _JOINT_VEL])
        frame[:, _LAST_ACTION] = self.last_action
        frame.clamp_(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        self._future.copy_(frame[:, :COMMAND])

    def _roll_pitch(self, quat: torch.Tensor) -> torch.Tensor:
        """Roll atan2(2(wx + yz), 1 - 2(x² + y²)) and pitch asin(clamp(2(wy - zx))); shape [worlds, 2] [rad]."""
        self._quat[:, : self.worlds] = quat.t()
        w, x, y, z = self._quat
        a, b, c, d = self._scratch
        torch.mul(w, x, out=a)
        a.add_(torch.mul(y, z, out=b)).mul_(2.0)
        torch.mul(x, x, out=b)
        b.add_(torch.mul(y, y, out=c)).mul_(-2.0).add_(1.0)
        torch.mul(w, y, out=c)
        c.sub_(torch.mul(z, x, out=d)).mul_(2.0).clamp_(-1.0, 1.0)
        torch.atan2(a, b, out=self._tilt[0])
        torch.asin(c, out=self._tilt[1])
        return self._tilt[:, : self.worlds].t()


def from_checkpoint(checkpoint: Path | None) -> Twist2Tracker:
    """Make the TWIST2 tracker.

    Raises:
        InputError: No checkpoint was given, or it is unfit.
    """
    if checkpoint is None:
        raise InputError(
            "--tracker twist2: no weights come with this package; pass --checkpoint with the official "
            "twist2_1017_20k.onnx, or use --tracker pd"
        )
    if checkpoint.suffix != ".onnx":
        raise InputError(f"--checkpoint {checkpoint}: --tracker twist2 reads .onnx files")
    return Twist2Tracker(checkpoint)
