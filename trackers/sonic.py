"""SONIC: an encoder of the reference, a latent of 64 numbers, a decoder of latent and proprioception.

Facts are those of the released controller as the original benchmark drives it (its joint-reference mode): the encoder
takes 1762 numbers of which mode 0 fills the joint positions, the joint velocities and the orientation anchor; there is
no look-ahead, the present frame stands ten times. Inside, joints are in canonical order. The elementwise arithmetic is
exactly rounded, so a world's bits do not depend on the other worlds.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import torch

from arena_newton.errors import InputError
from arena_newton.robot import (
    CANONICAL_TO_MUJOCO,
    MUJOCO_TO_CANONICAL,
    SONIC_DRIVE,
    PhysicsRate,
)
from arena_newton.trackers.base import RobotState, TrackerCommand
from arena_newton.trackers.front_end import JOINTS, ActionForm, FrontEnd, Mirror, NetworkTracker, column, plain
from arena_newton.trackers.inference import onnx_session, weights_file
from arena_newton.trackers.inference.quadratic import Quadratic, products
from arena_newton.trackers.motions.library import MIRROR_JOINTS, MIRROR_SIGNS

__all__ = [
    "ENCODER_INPUT",
    "OBSERVATION",
    "PROPRIOCEPTION",
    "SONIC_DEFAULT_POSE",
    "SONIC_FORM",
    "SonicFrontEnd",
    "SonicTracker",
    "from_checkpoint",
    "official_pair",
]

FRAMES = 10
"""Frames of the reference window and of the histories."""
ENCODER_INPUT = 1762
"""Width of the encoder's input."""
PROPRIOCEPTION = 930
"""Width of the decoder's input besides the latent."""
LATENT = 64
"""Width of the latent."""
DECODER_INPUT = LATENT + PROPRIOCEPTION
"""Width of the decoder's input."""
OBSERVATION = ENCODER_INPUT + PROPRIOCEPTION
"""Width of the whole observation: encoder input, then proprioception."""

# Encoder input: mode 4, joint positions 290, joint velocities 290, heights 10 + 1 (zero), anchor 6, anchors 60, then
# 1101 numbers of the other modes (zero).
_REF_POS = slice(4, 294)
_REF_VEL = slice(294, 584)
_ANCHOR = slice(595, 601)
_ANCHORS = slice(601, 661)
# Proprioception: each ten frames, oldest first.
_ANG_VEL = slice(ENCODER_INPUT, ENCODER_INPUT + 30)
_JOINT_POS = slice(_ANG_VEL.stop, _ANG_VEL.stop + 290)
_JOINT_VEL = slice(_JOINT_POS.stop, _JOINT_POS.stop + 290)
_ACTIONS = slice(_JOINT_VEL.stop, _JOINT_VEL.stop + 290)
_GRAVITY = slice(_ACTIONS.stop, _ACTIONS.stop + 30)

_LEG_POSE = (-0.312, 0.0, 0.0, 0.669, -0.363, 0.0)
SONIC_DEFAULT_POSE: tuple[float, ...] = (
    *_LEG_POSE, *_LEG_POSE, 0.0, 0.0, 0.0,
    0.2, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0,
    0.2, -0.2, 0.0, 0.6, 0.0, 0.0, 0.0,
)  # fmt: skip
"""SONIC's default pose [rad], MuJoCo order."""

_HIP, _YAW, _SMALL, _WRIST = 0.3506614566, 0.5475464463, 0.4385773242, 0.0745008737
_LEG_SCALE = (_HIP, _HIP, _YAW, _HIP, _SMALL, _SMALL)
_ARM_SCALE = (*(_SMALL,) * 5, _WRIST, _WRIST)
SONIC_FORM = ActionForm("default", (*_LEG_SCALE, *_LEG_SCALE, _YAW, _SMALL, _SMALL, *_ARM_SCALE, *_ARM_SCALE))
"""SONIC's action form: default pose plus scaled output, not clipped."""

# Tables of `Quadratic`: each entry names a product of wxyz quaternions and its factor.
_R00, _R01 = ((10, -2), (15, -2)), ((6, 2), (3, -2))
_R10, _R11 = ((6, 2), (3, 2)), ((5, -2), (15, -2))
_R20, _R21 = ((7, 2), (2, -2)), ((11, 2), (1, 2))
_ROT6D = (_R00, _R01, _R10, _R11, _R20, _R21)
"""Two columns of the rotation matrix, row by row, less the identity's: from a_i a_j (index 4 i + j)."""
_RELATIVE_AND_DOWN = (
    ((4, 1), (13, 1), (22, 1), (31, 1)),
    ((5, 1), (12, -1), (23, -1), (30, 1)),
    ((6, 1), (15, 1), (20, -1), (29, -1)),
    ((7, 1), (14, -1), (21, 1), (28, -1)),
    ((11, -2), (2, 2), (0, 0), (0, 0)),
    ((19, -2), (1, -2), (0, 0), (0, 0)),
    ((9, 2), (18, 2), (0, 0), (0, 0)),
)
"""conj(a) b, then minus the last row of a's rotation matrix, less the identity's: where down is, seen from the body.
From a_i (a, b)_j (index 8 i + j)."""


_MIRROR = (
    [MUJOCO_TO_CANONICAL[MIRROR_JOINTS[joint]] for joint in CANONICAL_TO_MUJOCO],
    [MIRROR_SIGNS[joint] for joint in CANONICAL_TO_MUJOCO],
)
"""Mirror image of joints in canonical order."""


class SonicFrontEnd(FrontEnd):
    """Encoder input (1762) and proprioception (930) side by side."""

    interface = "sonic"
    obs_width = OBSERVATION
    default_pose = SONIC_DEFAULT_POSE
    graphable = True

    def __init__(self, action_form: ActionForm = SONIC_FORM):
        """Take SONIC's action form or another."""
        super().__init__(action_form)

    def bind(self, worlds: int, device: Any = "cpu", obs: torch.Tensor | None = None) -> None:
        """Allocate buffers for `worlds` worlds on `device`."""
        super().bind(worlds, device, obs)
        four = [JOINTS * part + joint for part in range(4) for joint in CANONICAL_TO_MUJOCO]
        self._four_to_canonical = torch.tensor(four, device=self.device)
        self._from_canonical = torch.tensor(MUJOCO_TO_CANONICAL, device=self.device)
        self._relative_and_down = Quadratic(_RELATIVE_AND_DOWN, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0), self.device)
        self._rot6d = Quadratic(_ROT6D, (1.0, 0.0, 0.0, 1.0, 0.0, 0.0), self.device)

        def frames(part: slice) -> torch.Tensor:
            return self.obs[:, part].view(worlds, FRAMES, -1)

        self._ref_pos, self._ref_vel, self._anchors = frames(_REF_POS), frames(_REF_VEL), frames(_ANCHORS)
        self._ang_vel, self._gravity = frames(_ANG_VEL), frames(_GRAVITY)
        self._joint_pos, self._joint_vel, self._actions = frames(_JOINT_POS), frames(_JOINT_VEL), frames(_ACTIONS)
        self._anchor = self.obs[:, None, _ANCHOR]
        self._now_ang_vel, self._now_gravity = self._ang_vel[:, -1], self._gravity[:, -1]
        self._now_joint_pos, self._now_joint_vel = self._joint_pos[:, -1:], self._joint_vel[:, -1:]
        self._now_action = self._actions[:, -1]
        self._proprio = self.obs[:, ENCODER_INPUT:]
        # Column from which each column of the histories takes its value when a tick ends; the newest stay.
        source = []
        for part in (_ANG_VEL, _JOINT_POS, _JOINT_VEL, _ACTIONS, _GRAVITY):
            size = part.stop - part.start
            newest = size - size // FRAMES
            first = part.start - ENCODER_INPUT
            source += [first + (i if i >= newest else i + size // FRAMES) for i in range(size)]
        self._source = torch.tensor(source, device=self.device)
        self._shifted = torch.zeros(worlds, PROPRIOCEPTION, device=self.device)
        self._fresh = torch.ones(worlds, 1, 1, dtype=torch.bool, device=self.device)
        # Saves two operations a tick on the CPU; elsewhere a graph may be recorded now and replayed after a reset.
        self._may_be_fresh = True

    @torch.no_grad()
    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Histories of the worlds in `mask` become zero; those of the joints take the first values measured."""
        self._may_be_fresh = True
        if mask is None:
            self.obs.zero_()
            self.last_action.zero_()
            self._fresh.fill_(True)
            return
        row = column(mask, self.device)
        self.obs.masked_fill_(row, 0.0)
        self.last_action.masked_fill_(row, 0.0)
        self._fresh.logical_or_(row[:, None])

    @torch.no_grad()
    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Fill the measured histories of the worlds in `mask` with the present; past actions stay."""
        self.write(command, state)
        for history in (self._ang_vel, self._joint_pos, self._joint_vel, self._gravity):
            present = history[:, -1:].expand_as(history)
            if mask is None:
                history.copy_(present.clone())
            else:
                history.copy_(torch.where(column(mask, self.device)[:, None], present, history))

    def mirror_obs(self) -> Mirror:
        """Mirror image of an observation; the zeros of the other modes stay where they are."""
        anchor = plain(1, -1, -1, 1, 1, -1)
        reference = [plain(*[1] * 4), *[_MIRROR] * (2 * FRAMES), plain(*[1] * 11), anchor, *[anchor] * FRAMES]
        rest = plain(*[1] * (ENCODER_INPUT - _ANCHORS.stop))
        past = [*[plain(-1, 1, -1)] * FRAMES, *[_MIRROR] * (3 * FRAMES), *[plain(1, -1, 1)] * FRAMES]
        return Mirror([*reference, rest, *past], self.device)

    def mirror_action(self) -> Mirror:
        """Mirror image of a raw action: limbs change sides."""
        return Mirror([_MIRROR], self.device)

    def write(self, command: TrackerCommand, state: RobotState) -> None:
        """Write reference, anchor and the newest entry of each history but the actions'."""
        joints = torch.cat((command.joints, command.joint_vel, state.joint_pos - self._default, state.joint_vel), 1)
        ref_pos, ref_vel, pos, vel = joints.index_select(1, self._four_to_canonical).view(-1, 4, 1, JOINTS).unbind(1)
        self._ref_pos.copy_(ref_pos.expand_as(self._ref_pos))
        self._ref_vel.copy_(ref_vel.expand_as(self._ref_vel))
        quats = products(state.quat, torch.cat((state.quat, command.quat), 1))
        relative, down = self._relative_and_down(quats).split((4, 3), 1)
        anchor = self._rot6d(products(relative, relative))[:, None]
        self._anchor.copy_(anchor)
        self._anchors.copy_(anchor.expand_as(self._anchors))
        self._now_gravity.copy_(down)
        self._now_ang_vel.copy_(state.ang_vel_body)
        self._now_joint_pos.copy_(pos)
        self._now_joint_vel.copy_(vel)
        if self._may_be_fresh:
            self._joint_pos.copy_(torch.where(self._fresh, pos, self._joint_pos))
            self._joint_vel.copy_(torch.where(self._fresh, vel, self._joint_vel))

    def advance(self) -> None:
        """Shift the histories; the raw output becomes the newest action."""
        torch.index_select(self._proprio, 1, self._source, out=self._shifted)
        self._proprio.copy_(self._shifted)
        self._now_action.copy_(self.last_action)
        if self._may_be_fresh:
            self._fresh.fill_(False)
            self._may_be_fresh = self.device.type != "cpu"

    def to_mujoco(self, raw: torch.Tensor) -> torch.Tensor:
        """The raw output, which is in canonical order, in MuJoCo order."""
        return raw.index_select(1, self._from_canonical)


class EncoderDecoder(torch.nn.Module):
    """The two official networks as one: observation [rows, 2692] → raw action [rows, 29]."""

    def __init__(self, encoder: torch.nn.Module, decoder: torch.nn.Module):
        """Join an encoder of 1762 numbers and a decoder of 994."""
        super().__init__()
        self.encoder, self.decoder = encoder, decoder

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Raw actions, shape [rows, 29]."""
        latent = self.encoder(obs[:, :ENCODER_INPUT].contiguous())
        return self.decoder(torch.cat((latent, obs[:, ENCODER_INPUT:]), 1))


class SonicTracker(NetworkTracker):
    """SONIC behind joint positions, joint velocities and the root's orientation."""

    name = "sonic"
    drive = SONIC_DRIVE
    physics_rate = PhysicsRate(dt=0.005, substeps=4)
    fast_physics_rate = PhysicsRate(dt=0.005, substeps=4)
    ignores = ("root xy", "root height")
    max_root_delta_deg = 26.0

    def __init__(self, checkpoint: str | Path):
        """Read the networks.

        Args:
            checkpoint: A `.safetensors` file of `trackers.weights_file`, or the official networks: the folder that
                holds `model_encoder.onnx` and `model_decoder.onnx`, one of the two files, or both with a comma between.

        Raises:
            InputError: A file is absent or is no network of SONIC's widths.
        """
        if Path(checkpoint).suffix == ".safetensors":
            weights = weights_file.load(checkpoint, "sonic")
            self.follow(weights, SonicFrontEnd(weights.action_form), checkpoint)
            return
        encoder, decoder = official_pair(checkpoint)
        networks = (
            onnx_session.load_any(encoder, in_width=ENCODER_INPUT, out_width=LATENT),
            onnx_session.load_any(decoder, in_width=DECODER_INPUT, out_width=JOINTS),
        )
        digest = hashlib.sha256(encoder.read_bytes() + decoder.read_bytes()).hexdigest()
        super().__init__(
            SonicFrontEnd(), EncoderDecoder(*networks), checkpoint=str(checkpoint), checkpoint_hash=digest[:12]
        )


def official_pair(checkpoint: str | Path) -> tuple[Path, Path]:
    """Encoder and decoder that a `--checkpoint` names.

    Args:
        checkpoint: The folder with `model_encoder.onnx` and `model_decoder.onnx`, one of the two, or `a.onnx,b.onnx`.

    Raises:
        InputError: One of the two is absent.
    """
    path = Path(checkpoint)
    if path.is_dir():
        pair = path / "model_encoder.onnx", path / "model_decoder.onnx"
    elif "," in str(checkpoint):
        first, _, second = str(checkpoint).partition(",")
        pair = Path(first), Path(second)
    elif "encoder" in path.name:
        pair = path, path.with_name(path.name.replace("encoder", "decoder"))
    else:
        pair = path.with_name(path.name.replace("decoder", "encoder")), path
    absent = [p for p in pair if not p.is_file()]
    if absent or pair[0] == pair[1]:
        lacking = f"{absent[0]} is absent" if absent else "it names one network"
        raise InputError(
            f"--checkpoint {checkpoint}: --tracker sonic needs an encoder and a decoder, but {lacking}; pass the "
            "folder that holds model_encoder.onnx and model_decoder.onnx"
        )
    return pair


def from_checkpoint(checkpoint: Path | None) -> SonicTracker:
    """Make the SONIC tracker: with the weights of this package, or with a checkpoint's.

    Raises:
        InputError: The checkpoint is unfit, or there is none and no weights came with the package.
    """
    checkpoint = checkpoint or weights_file.default("sonic", "--checkpoint with the folder of the official networks")
    if not checkpoint.is_dir() and checkpoint.suffix not in (".onnx", ".safetensors"):
        raise InputError(
            f"--checkpoint {checkpoint}: --tracker sonic reads a .safetensors file or a folder with two .onnx files"
        )
    return SonicTracker(checkpoint)
