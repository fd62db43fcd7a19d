"""SONIC: an encoder of the reference, a latent of 64 numbers, a decoder of latent and proprioception.

Facts are those of the released controller as the original benchmark drives it (its joint-reference mode): the encoder
takes 1762 numbers of which mode 0 fills the joint positions, the joint velocities and the orientation anchor; there is
no look-ahead, the current frame is repeated ten times. Inside, joints are in canonical order. The elementwise
arithmetic is exactly rounded, so a world's bits do not depend on the other worlds.

The three releases as NVIDIA drives them, with a window of coming references, are `VARIANTS`: layouts and steps are
those of `observation_config*.yaml` in NVlabs/GR00T-WholeBodyControl (commit 1983e88, mode `g1`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from torch import nn

from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, MUJOCO_TO_CANONICAL, SONIC_DRIVE, PhysicsRate
from arena_newton.robot.rotations import heading_quat
from arena_newton.trackers.front_end import FrontEnd, Mirror, NetworkTracker, column, plain, store, without_gradients
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.inference.networks import InputNorm, PartialNetwork, TrackerNetwork, folded, mlp, shrink_last
from arena_newton.trackers.inference.onnx_session import OnnxSession
from arena_newton.trackers.inference.quadratic import Quadratic
from arena_newton.trackers.interface import JOINTS, ActionForm, Interface, slices
from arena_newton.trackers.motions.library import MIRROR_JOINTS, MIRROR_SIGNS

__all__ = [
    "INTERFACE",
    "SONIC_DEFAULT_POSE",
    "SONIC_FORM",
    "SonicFrontEnd",
    "SonicNet",
    "SonicTracker",
    "VARIANTS",
    "Variant",
    "from_checkpoint",
    "official_pair",
]

FRAMES = 10
"""Frames of the reference window and of the histories, oldest first."""
ENCODER_LAYOUT = {
    "mode": 4,
    "ref_pos": FRAMES * JOINTS,
    "ref_vel": FRAMES * JOINTS,
    "heights": FRAMES + 1,
    "anchor": 6,
    "anchors": FRAMES * 6,
    "other_modes": 1101,
}
"""Parts of the encoder's input; `mode`, `heights` and `other_modes` stay zero in the joint-reference mode."""
PROPRIOCEPTION_LAYOUT = {
    "ang_vel": FRAMES * 3,
    "joint_pos": FRAMES * JOINTS,
    "joint_vel": FRAMES * JOINTS,
    "actions": FRAMES * JOINTS,
    "gravity": FRAMES * 3,
}
"""Parts of the decoder's input besides the latent, each a history."""
LAYOUT = ENCODER_LAYOUT | PROPRIOCEPTION_LAYOUT
"""The whole observation: encoder input, then proprioception."""
AT = slices(LAYOUT)
ENCODER_INPUT = sum(ENCODER_LAYOUT.values())
PROPRIOCEPTION = sum(PROPRIOCEPTION_LAYOUT.values())
OBSERVATION = ENCODER_INPUT + PROPRIOCEPTION
LATENT = 64
"""Width of the latent."""
ENCODED = ("ref_pos", "ref_vel", "anchor", "anchors")
"""Parts that the encoder reads in the joint-reference mode."""


@dataclass(frozen=True)
class Variant:
    """Encoder input of a release, and what of the reference it shows."""

    layout: Mapping[str, int]
    """Parts in order → their widths; what the joint-reference mode does not read stays zero."""
    step: int = 0
    """Ticks from frame to frame of the window; 0: the reference of this tick in all frames."""
    heading: bool = False
    """Anchors are relative to the robot's heading instead of its whole orientation."""

    @property
    def lookahead(self) -> int:
        """Ticks from the first frame to the last."""
        return self.step * (FRAMES - 1)


_WINDOW = {"mode": 4, "ref_pos": FRAMES * JOINTS, "ref_vel": FRAMES * JOINTS, "anchors": FRAMES * 6, "anchor": 6}
VARIANTS: Mapping[str, Variant] = {
    "": Variant(ENCODER_LAYOUT),
    "default": Variant(ENCODER_LAYOUT, step=5),
    "low_latency": Variant(_WINDOW | {"other_modes": 597}, step=1),
    "v1_1": Variant(_WINDOW | {"other_modes": 1101}, step=5, heading=True),
}
"""`--tracker sonic:<variant>` → encoder input; the one without a name is the original benchmark's."""
_ONE_FRAME = tuple(
    slice(AT[name].start, AT[name].start + width)
    for name, width in {"ref_pos": JOINTS, "ref_vel": JOINTS, "anchor": 6}.items()
)
"""One frame of them: the deployed encoder takes it once, since all ten are equal."""

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
ROT6D = (_R00, _R01, _R10, _R11, _R20, _R21)
"""Two columns of the rotation matrix, row by row, minus the identity's: from a_i a_j (index 4 i + j)."""
IDENTITY_6D = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)
"""The identity's."""
RELATIVE_AND_DOWN = (
    ((4, 1), (13, 1), (22, 1), (31, 1)),
    ((5, 1), (12, -1), (23, -1), (30, 1)),
    ((6, 1), (15, 1), (20, -1), (29, -1)),
    ((7, 1), (14, -1), (21, 1), (28, -1)),
    ((11, -2), (2, 2), (0, 0), (0, 0)),
    ((19, -2), (1, -2), (0, 0), (0, 0)),
    ((9, 2), (18, 2), (0, 0), (0, 0)),
)
"""conj(a) b; then the negative last row of a's rotation matrix without the identity's, the direction down seen from the
body. From a_i (a, b)_j (index 8 i + j)."""
DOWN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
"""Constants added to these: 0 to the relative rotation, the identity's negative last row to down."""


_MIRROR = (
    [MUJOCO_TO_CANONICAL[MIRROR_JOINTS[joint]] for joint in CANONICAL_TO_MUJOCO],
    [MIRROR_SIGNS[joint] for joint in CANONICAL_TO_MUJOCO],
)
"""Mirror image of joints in canonical order."""


class SonicNet(TrackerNetwork):
    """Encoder of the reference → bounded latent; latent and proprioception → decoder → 29 raw actions."""

    obs_width = OBSERVATION

    used: torch.Tensor
    """Indices of the encoder inputs that the encoder reads, shape [646]."""

    def __init__(
        self, encoder: Sequence[int] = (512, 256), decoder: Sequence[int] = (512, 512, 256), latent: int = LATENT
    ):
        """Make layers with these hidden widths."""
        super().__init__()
        self.widths = tuple(encoder), tuple(decoder), latent
        # No `arange`: where weights are checked on the device "meta" it would import SymPy, which takes seconds.
        used = torch.tensor([column for name in ENCODED for column in range(AT[name].start, AT[name].stop)])
        self.register_buffer("used", used, persistent=False)
        self.encoder_norm = InputNorm(len(used))
        self.decoder_norm = InputNorm(PROPRIOCEPTION)
        self.encoder = nn.Sequential(*mlp((len(used), *encoder, latent)), nn.Tanh())
        self.decoder = mlp((latent + PROPRIOCEPTION, *decoder, JOINTS))
        shrink_last(self.decoder)

    def config(self) -> dict[str, Any]:
        """Arguments that make this network again."""
        encoder, decoder, latent = self.widths
        return {"encoder": list(encoder), "decoder": list(decoder), "latent": latent}

    def encode(self, reference: torch.Tensor) -> torch.Tensor:
        """Latent in (-1, 1) of encoder inputs [rows, 1762], shape [rows, latent]."""
        return self.encoder(self.encoder_norm(reference.index_select(1, self.used)))

    def decode(self, latent: torch.Tensor, proprio: torch.Tensor) -> torch.Tensor:
        """Raw actions of latents [rows, latent] and proprioception [rows, 930], shape [rows, 29]."""
        return self.decoder(torch.cat((latent, self.decoder_norm(proprio)), 1))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Raw actions of observations [rows, 2692], shape [rows, 29]."""
        return self.decode(self.encode(obs), obs[:, ENCODER_INPUT:])

    def update_norm(self, obs: torch.Tensor) -> None:
        """Take a batch of observations into the input statistics."""
        self.encoder_norm.update(obs.index_select(1, self.used))
        self.decoder_norm.update(obs[:, ENCODER_INPUT:])

    def deployed(self) -> nn.Module:
        """The same function with normalisation inside the first layers and one frame of the reference instead of ten.

        It needs what `SonicFrontEnd` gives: ten equal frames.
        """
        return _DeployedSonic(self).eval().requires_grad_(False)


class _DeployedSonic(PartialNetwork):
    def __init__(self, network: SonicNet):
        super().__init__()
        assert isinstance(network.encoder, nn.Sequential)
        first = folded(network.encoder[0], network.encoder_norm)
        weight = first.weight.detach().double()
        pos, vel, anchor, anchors = weight.split([LAYOUT[name] for name in ENCODED], 1)
        pos, vel, anchors = (part.unflatten(1, (FRAMES, -1)).sum(1) for part in (pos, vel, anchors))
        merged = torch.cat([pos, vel, anchor + anchors], 1)
        layer = nn.Linear(merged.shape[1], first.out_features, device=merged.device)
        with torch.no_grad():
            layer.weight.copy_(merged)
            layer.bias.copy_(first.bias)
        self.encoder = nn.Sequential(layer, *list(network.encoder)[1:])
        self.decoder = nn.Sequential(
            folded(network.decoder[0], network.decoder_norm, network.widths[2]), *list(network.decoder)[1:]
        )

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self._act(torch.cat([obs[:, part] for part in _ONE_FRAME], 1), obs[:, ENCODER_INPUT:])

    def columns(self) -> torch.Tensor:
        """Columns of the observation that are read, in the order of `from_columns`, shape [994]."""
        read = (*_ONE_FRAME, slice(ENCODER_INPUT, OBSERVATION))
        return torch.cat([torch.arange(part.start, part.stop) for part in read])

    def from_columns(self, used: torch.Tensor) -> torch.Tensor:
        """Raw actions of those columns, shape [rows, 29]."""
        reference = used.shape[1] - PROPRIOCEPTION
        return self._act(used[:, :reference], used[:, reference:])

    def _act(self, reference: torch.Tensor, proprio: torch.Tensor) -> torch.Tensor:
        return self.decoder(torch.cat((self.encoder(reference), proprio), 1))


class SonicFrontEnd(FrontEnd):
    """Encoder input (1762 without a variant), then proprioception (930)."""

    obs_width = OBSERVATION
    default_pose = SONIC_DEFAULT_POSE
    graphable = True

    def __init__(self, action_form: ActionForm = SONIC_FORM, variant: Variant = VARIANTS[""]):
        """Take SONIC's action form or another, and the encoder input."""
        super().__init__(action_form)
        self.variant, self.lookahead = variant, variant.lookahead
        self.encoder_width = sum(variant.layout.values())
        self.obs_width = self.encoder_width + PROPRIOCEPTION

    def bind(self, worlds: int, device: torch.device | str = "cpu", obs: torch.Tensor | None = None) -> None:
        """Allocate buffers for `worlds` worlds on `device`."""
        super().bind(worlds, device, obs)
        four = [JOINTS * part + joint for part in range(4) for joint in CANONICAL_TO_MUJOCO]
        self._four_to_canonical = torch.tensor(four, device=self.device)
        self._from_canonical = torch.tensor(MUJOCO_TO_CANONICAL, device=self.device)
        self._relative_and_down = Quadratic(RELATIVE_AND_DOWN, DOWN, width=8, device=self.device)
        self._rot6d = Quadratic(ROT6D, IDENTITY_6D, device=self.device)
        at = slices({**self.variant.layout, **PROPRIOCEPTION_LAYOUT})
        if self.lookahead:
            self._relatives = Quadratic(RELATIVE_AND_DOWN[:4], DOWN[:4], width=8, device=self.device)
            self._to_canonical = torch.tensor(CANONICAL_TO_MUJOCO, device=self.device)

        def frames(name: str) -> torch.Tensor:
            return self.obs[:, at[name]].view(worlds, FRAMES, -1)

        self._ref_pos, self._ref_vel, self._anchors = frames("ref_pos"), frames("ref_vel"), frames("anchors")
        self._ang_vel, self._gravity = frames("ang_vel"), frames("gravity")
        self._joint_pos, self._joint_vel, self._actions = frames("joint_pos"), frames("joint_vel"), frames("actions")
        self._anchor = self.obs[:, None, at["anchor"]]
        self._now_ang_vel, self._now_gravity = self._ang_vel[:, -1], self._gravity[:, -1]
        self._now_joint_pos, self._now_joint_vel = self._joint_pos[:, -1:], self._joint_vel[:, -1:]
        self._now_action = self._actions[:, -1]
        self._proprio = self.obs[:, self.encoder_width :]
        # Column from which each column of the histories takes its value when a tick ends; the newest stay.
        source = []
        for name, size in PROPRIOCEPTION_LAYOUT.items():
            newest = size - size // FRAMES
            first = at[name].start - self.encoder_width
            source += [first + (i if i >= newest else i + size // FRAMES) for i in range(size)]
        self._source = torch.tensor(source, device=self.device)
        self._first_tick = torch.ones(worlds, 1, 1, dtype=torch.bool, device=self.device)
        # Saves two operations per tick on the CPU; elsewhere a graph may be recorded now and replayed after a reset.
        self._may_be_first = True

    @torch.no_grad()
    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Histories of the worlds in `mask` become zero; those of the joints take the first values measured."""
        super().reset(mask)
        self._may_be_first = True
        rows = column(mask, self.device)
        self._first_tick.fill_(True) if rows is None else self._first_tick.logical_or_(rows[:, None])

    @without_gradients
    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Fill the measured histories of the masked worlds with the current frame; past actions stay."""
        self.write(command, state)
        rows = column(mask, self.device)
        for history in (self._ang_vel, self._joint_pos, self._joint_vel, self._gravity):
            store(history, history[:, -1:].clone().expand_as(history), rows)

    def mirror_obs(self) -> Mirror:
        """Mirror image of an observation; the zeros of the other modes stay where they are."""
        anchor = plain(1, -1, -1, 1, 1, -1)
        mode, heights, rest = (plain(*[1] * LAYOUT[name]) for name in ("mode", "heights", "other_modes"))
        reference = [mode, *[_MIRROR] * (2 * FRAMES), heights, *[anchor] * (1 + FRAMES)]
        past = [*[plain(-1, 1, -1)] * FRAMES, *[_MIRROR] * (3 * FRAMES), *[plain(1, -1, 1)] * FRAMES]
        return Mirror([*reference, rest, *past], self.device)

    def mirror_action(self) -> Mirror:
        """Mirror image of a raw action: limbs change sides."""
        return Mirror([_MIRROR], self.device)

    def write(self, command: TrackerCommand, state: RobotState) -> None:
        """Write reference, anchor and the newest entry of each history but the actions'."""
        joints = torch.cat((command.joints, command.joint_vel, state.joint_pos - self._default, state.joint_vel), 1)
        ref_pos, ref_vel, pos, vel = joints.index_select(1, self._four_to_canonical).view(-1, 4, 1, JOINTS).unbind(1)
        quats = torch.cat((state.quat, command.quat), 1)
        relative, down = self._relative_and_down(state.quat, quats).split((4, 3), 1)
        if self.lookahead:
            self._write_window(command, state)
        else:
            self._ref_pos.copy_(ref_pos.expand_as(self._ref_pos))
            self._ref_vel.copy_(ref_vel.expand_as(self._ref_vel))
            anchor = self._rot6d(relative, relative)[:, None]
            self._anchor.copy_(anchor)
            self._anchors.copy_(anchor.expand_as(self._anchors))
        self._now_gravity.copy_(down)
        self._now_ang_vel.copy_(state.ang_vel_body)
        self._now_joint_pos.copy_(pos)
        self._now_joint_vel.copy_(vel)
        if self._may_be_first:
            first = self._first_tick.clone()  # `advance` changes it, a gradient needs it
            self._joint_pos.copy_(torch.where(first, pos, self._joint_pos))
            self._joint_vel.copy_(torch.where(first, vel, self._joint_vel))

    def _write_window(self, command: TrackerCommand, state: RobotState) -> None:
        """Write this tick's reference and the coming ones that the window shows; `anchor` is another mode's."""
        ahead, step = command.ahead, self.variant.step
        assert ahead is not None
        joints, vel, quats = (
            torch.cat((now[:, None], later[:, step - 1 :: step]), 1)
            for now, later in (
                (command.joints, ahead.joints),
                (command.joint_vel, ahead.joint_vel),
                (command.quat, ahead.quat),
            )
        )
        self._ref_pos.copy_(joints.index_select(2, self._to_canonical))
        self._ref_vel.copy_(vel.index_select(2, self._to_canonical))
        here = (heading_quat(state.quat) if self.variant.heading else state.quat)[:, None].expand_as(quats)
        here, pairs = here.flatten(0, 1), torch.cat((here, quats), 2).flatten(0, 1)
        relative = self._relatives(here, pairs)
        self._anchors.copy_(self._rot6d(relative, relative).view_as(self._anchors))

    def advance(self, rows: torch.Tensor | None = None) -> None:
        """Shift the histories; the raw output becomes the newest action."""
        store(self._proprio, self._proprio.index_select(1, self._source), rows)
        store(self._now_action, self.last_action, rows)
        if self._may_be_first:
            self._first_tick.fill_(False) if rows is None else self._first_tick.logical_and_(~rows[:, None])
            self._may_be_first = rows is not None or self.device.type != "cpu"

    def to_mujoco(self, raw: torch.Tensor) -> torch.Tensor:
        """The raw output, which is in canonical order, in MuJoCo order."""
        return raw.index_select(1, self._from_canonical)


class EncoderDecoder(torch.nn.Module):
    """The two official networks as one: observation [rows, width + 930] → raw action [rows, 29]."""

    def __init__(self, encoder: torch.nn.Module, decoder: torch.nn.Module, width: int = ENCODER_INPUT):
        """Join an encoder of `width` numbers and a decoder of 994."""
        super().__init__()
        self.encoder, self.decoder, self.width = encoder, decoder, width

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Raw actions, shape [rows, 29]."""
        latent = self.encoder(obs[:, : self.width].contiguous())
        return self.decoder(torch.cat((latent, obs[:, self.width :]), 1))


class SonicTracker(NetworkTracker):
    """SONIC behind joint positions, joint velocities and the root's orientation."""

    name = "sonic"
    drive = SONIC_DRIVE
    physics_rate = PhysicsRate(dt=0.005, substeps=4)
    fast_physics_rate = PhysicsRate(dt=0.005, substeps=4)
    ignores = ("root xy", "root height")
    max_root_delta_deg = 26.0
    variant = ""
    """Key of `VARIANTS`."""

    @classmethod
    def official(cls, checkpoint: str | Path, variant: str = "") -> Self:
        """The tracker of the official networks of a variant, which `official_pair` finds.

        Raises:
            InputError: A file is absent or not a network of the variant's widths.
        """
        encoder, decoder = official_pair(checkpoint)
        front = SonicFrontEnd(variant=VARIANTS[variant])
        networks = (
            OnnxSession(encoder, in_width=front.encoder_width, out_width=LATENT),
            OnnxSession(decoder, in_width=LATENT + PROPRIOCEPTION, out_width=JOINTS),
        )
        digest = hashlib.sha256(encoder.read_bytes() + decoder.read_bytes()).hexdigest()
        joined = EncoderDecoder(*networks, front.encoder_width)
        tracker = cls(front, joined, checkpoint=str(checkpoint), checkpoint_hash=digest[:12])
        tracker.variant = variant
        return tracker

    def describe(self) -> dict[str, Any]:
        """Facts to record with every result; the variant, where there is one."""
        return super().describe() | ({"variant": self.variant} if self.variant else {})


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


def from_checkpoint(checkpoint: Path | None, variant: str = "") -> SonicTracker:
    """Make the SONIC tracker: with the weights of this package, or with a checkpoint's, of a variant or without.

    Raises:
        InputError: The checkpoint is unfit, or there is none and no weights came with the package; an unknown variant.
    """
    if variant:
        if variant not in VARIANTS:
            raise InputError(f"--tracker sonic:{variant}: unknown; known are {', '.join(filter(None, VARIANTS))}")
        if checkpoint is None or checkpoint.suffix == ".safetensors":
            raise InputError(f"--tracker sonic:{variant}: pass --checkpoint with the folder of its official networks")
        return SonicTracker.official(checkpoint, variant)
    checkpoint = checkpoint or weights_file.default("sonic", "--checkpoint with the folder of the official networks")
    if not checkpoint.is_dir() and checkpoint.suffix not in (".onnx", ".safetensors"):
        raise InputError(
            f"--checkpoint {checkpoint}: --tracker sonic reads a .safetensors file or a folder with two .onnx files"
        )
    own = checkpoint.suffix == ".safetensors"
    return SonicTracker.from_weights(checkpoint) if own else SonicTracker.official(checkpoint)


INTERFACE = Interface(
    name="sonic",
    front_end=SonicFrontEnd,
    network=SonicNet,
    layout=LAYOUT,
    drive=SONIC_DRIVE,
    rate=PhysicsRate(dt=0.005, substeps=4),
    official_form=SONIC_FORM,
    bars={"fall_rate": 0.03},
)
