"""TWIST2: the whole-body tracker behind the mimic command, with our weights or the official ones.

Facts of its observation are those of its own simulation script, as the original benchmark uses them: 127 numbers a
frame, ten past frames, and the command once more, 1432 in all. All elementwise arithmetic on the observation is either
exactly rounded, or done on rows padded to whole vectors (`asin`) or one by one (`atan2`), because the vector and scalar
versions of these differ in their last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import torch
from torch import nn

from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot.g1 import DEFAULT_POSE, MUJOCO_JOINTS, TWIST2_DRIVE, TWIST2_HUMANOIDARENA_DRIVE, PhysicsRate
from arena_newton.robot.rotations import atan2
from arena_newton.trackers.front_end import FrontEnd, Mirror, NetworkTracker, column, plain, store, without_gradients
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.inference.networks import InputNorm, TrackerNetwork, folded, mlp, shrink_last
from arena_newton.trackers.inference.onnx_session import OnnxSession
from arena_newton.trackers.inference.quadratic import Quadratic
from arena_newton.trackers.interface import JOINTS, ActionForm, Interface, slices
from arena_newton.trackers.motions.library import MIRROR_JOINTS, MIRROR_SIGNS

__all__ = ["INTERFACE", "Twist2FrontEnd", "Twist2Net", "Twist2Tracker", "from_checkpoint"]

FRAME_LAYOUT = {"command": 35, "ang_vel": 3, "tilt": 2, "joints": 29, "joint_vel": 29, "last_action": 29}
"""Parts of one frame: mimic command, angular velocity, roll and pitch, joints, their velocities, last raw action."""
FRAME = sum(FRAME_LAYOUT.values())
HISTORY = 10
"""Past frames, oldest first."""
LAYOUT = FRAME_LAYOUT | {"history": HISTORY * FRAME, "future": FRAME_LAYOUT["command"]}
"""The network's input: current frame, history, command once more."""
OBSERVATION = sum(LAYOUT.values())

ANG_VEL_SCALE = 0.25
JOINT_VEL_SCALE = 0.05
OFFICIAL_FORM = ActionForm("default", (0.5,) * JOINTS, clip=10.0)
"""Action form of the official checkpoints."""
OBSERVATION_CLIP = 100.0
TILT_TERMS = (((1, 2), (11, 2)), ((5, -2), (10, -2)), ((2, 2), (7, -2)))
"""2(wx + yz), -2(x² + y²), 2(wy - zx) from the products of a quaternion with itself (`Quadratic`) ..."""
UPRIGHT = (0.0, 1.0, 0.0)
"""... to which these are added."""
_VECTOR = 64
"""Rows are padded to a multiple of this for `asin`. Measured with AVX-512: a multiple of 32 rows goes through torch's
vector code whole."""


class Twist2Net(TrackerNetwork):
    """1432 observations → 29 raw actions."""

    obs_width = OBSERVATION

    def __init__(self, hidden: Sequence[int] = (512, 512, 256)):
        """Make layers with these hidden widths."""
        super().__init__()
        self.hidden = tuple(hidden)
        self.norm = InputNorm(self.obs_width)
        self.actor = mlp((self.obs_width, *self.hidden, JOINTS))
        shrink_last(self.actor)

    def config(self) -> dict[str, Any]:
        """Arguments that make this network again."""
        return {"hidden": list(self.hidden)}

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Raw actions, shape [rows, 29]."""
        return self.actor(self.norm(obs))

    def deployed(self) -> nn.Module:
        """The same function with the normalisation inside the first layer."""
        return nn.Sequential(folded(self.actor[0], self.norm), *list(self.actor)[1:]).eval().requires_grad_(False)

    def update_norm(self, obs: torch.Tensor) -> None:
        """Take a batch of observations into the input statistics."""
        self.norm.update(obs)


class Twist2FrontEnd(FrontEnd):
    """TWIST2's observation around the 35-number mimic command."""

    obs_width = OBSERVATION
    default_pose = DEFAULT_POSE
    graphable = True

    def __init__(self, action_form: ActionForm = OFFICIAL_FORM):
        """Take the official action form or another."""
        super().__init__(action_form)

    def bind(self, worlds: int, device: torch.device | str = "cpu", obs: torch.Tensor | None = None) -> None:
        """Allocate buffers for `worlds` worlds on `device`."""
        super().bind(worlds, device, obs)
        self._frame = self.obs[:, :FRAME]
        # Views are made once: a tick of one world is mostly the cost of calls.
        views = {name: self.obs[:, part] for name, part in slices(LAYOUT).items()}
        self._mimic, self._ang_vel, self._tilt = views["command"], views["ang_vel"], views["tilt"]
        self._joints, self._joint_vel, self._past_action = views["joints"], views["joint_vel"], views["last_action"]
        self._past, self._future = views["history"], views["future"]
        self._later, self._earlier = self._past[:, FRAME:], self._past[:, :-FRAME]
        self._newest = self._past[:, -FRAME:]
        padded = -(-worlds // _VECTOR) * _VECTOR
        self._tilt_terms = Quadratic(TILT_TERMS, UPRIGHT, device=self.device)
        self._roll, self._pitch = self._tilt[:, 0], self._tilt[:, 1]
        self._padded = torch.zeros(padded, device=self.device)
        self._pitch_sine = self._padded[:worlds]
        self._joint_vel_scale = torch.full((JOINTS,), JOINT_VEL_SCALE, device=self.device)
        self._joint_vel_scale[[i for i, name in enumerate(MUJOCO_JOINTS) if "ankle" in name]] = 0.0

    @without_gradients
    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Fill the history of the masked worlds with the current frame: a start is then no jump for the network."""
        self.write(command, state)
        past = self._past.view(-1, HISTORY, FRAME)
        store(past, self._frame[:, None].expand_as(past), column(mask, self.device))

    def advance(self, rows: torch.Tensor | None = None) -> None:
        """Move the current frame into the history, which takes it only after the network has seen it."""
        store(self._earlier, self._later.clone(), rows)
        store(self._newest, self._frame, rows)

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
        """Write the current frame and the command's second copy."""
        self._mimic.copy_(command.mimic)
        self._ang_vel.copy_(state.ang_vel_body).mul_(ANG_VEL_SCALE)
        self._write_roll_pitch(state.quat)
        self._joints.copy_(state.joint_pos).sub_(self._default)
        self._joint_vel.copy_(state.joint_vel).mul_(self._joint_vel_scale)
        self._past_action.copy_(self.last_action)
        self._frame.clamp_(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        self._future.copy_(self._mimic)

    def _write_roll_pitch(self, quat: torch.Tensor) -> None:
        """Write roll atan2(2(wx + yz), 1 - 2(x² + y²)) and pitch asin(clamp(2(wy - zx))) [rad]."""
        roll_sine, roll_cosine, pitch_sine = self._tilt_terms(quat, quat).unbind(1)
        self._roll.copy_(atan2(roll_sine, roll_cosine))
        self._pitch_sine.copy_(pitch_sine)
        self._padded.clamp_(-1.0, 1.0).asin_()
        self._pitch.copy_(self._pitch_sine)


class Twist2Tracker(NetworkTracker):
    """TWIST2's network behind the 35-number mimic command."""

    name = "twist2"
    drive = TWIST2_DRIVE
    physics_rate = PhysicsRate(dt=0.001, substeps=20)
    fast_physics_rate = PhysicsRate(dt=0.005, substeps=4)
    ignores = ("absolute heading", "absolute position")

    @classmethod
    def official(cls, checkpoint: str | Path) -> Self:
        """The tracker of an official `.onnx` file.

        Raises:
            InputError: The file is absent or not a network of TWIST2's widths.
        """
        network = OnnxSession(checkpoint, in_width=OBSERVATION, out_width=JOINTS)
        tracker = cls(Twist2FrontEnd(), network, checkpoint=str(checkpoint), checkpoint_hash=network.sha256[:12])
        tracker.original_drive = TWIST2_HUMANOIDARENA_DRIVE
        return tracker


def from_checkpoint(checkpoint: Path | None) -> Twist2Tracker:
    """Make the TWIST2 tracker: with the weights of this package, or with a checkpoint's.

    Raises:
        InputError: The checkpoint is unfit, or there is none and no weights came with the package.
    """
    checkpoint = checkpoint or weights_file.default("twist2", "--checkpoint with the official twist2_1017_20k.onnx")
    if checkpoint.suffix not in (".onnx", ".safetensors"):
        raise InputError(f"--checkpoint {checkpoint}: --tracker twist2 reads .onnx and .safetensors files")
    own = checkpoint.suffix == ".safetensors"
    return Twist2Tracker.from_weights(checkpoint) if own else Twist2Tracker.official(checkpoint)


INTERFACE = Interface(
    name="twist2",
    front_end=Twist2FrontEnd,
    network=Twist2Net,
    layout=LAYOUT,
    drive=TWIST2_DRIVE,
    rate=PhysicsRate(dt=0.005, substeps=4),
    official_form=OFFICIAL_FORM,
    bars={"fall_rate": 0.01, "drift, walk 0.3": 0.20, "drift, walk 0.6": 0.30},
)
