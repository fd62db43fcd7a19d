"""A library of motions: many clips at 50 Hz in one NPZ file without pickles, each with its licence and its source.

Frames of all clips follow one another. `MotionLibrary` is the file; `DeviceLibrary` is what training and
evaluation read: torch tensors with velocities and mimic commands for every frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from arena_newton.errors import InputError
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.untrusted_files import numbers, read_arrays
from arena_newton.robot.g1 import MUJOCO_JOINTS, TICK
from arena_newton.robot.rotations import quat_conjugate, quat_multiply, rotation_vector
from arena_newton.trackers.motions.frames import frame_mimic
from arena_newton.trackers.motions.load import Clip, resample
from arena_newton.usd_scenes.g1.links import LINKS

__all__ = ["FIXTURES", "FORMAT", "MIRROR_JOINTS", "MIRROR_SIGNS", "SUPPORTS", "DeviceLibrary", "MotionLibrary"]

FORMAT = "arena-newton-motions-1"
"""Value of the array `format` of a library file."""
FPS = round(1.0 / TICK)
SUPPORTS = ("none", "seat", "sill", "platform")
"""Names of `support_kind`."""
FIXTURES = tuple(name.capitalize() for name in SUPPORTS[1:])
"""The lab's fixtures for `support_kind` 1, 2, 3."""
UNKNOWN = "unknown"
"""Licence and source of a clip for which none was given."""

_HINGE_AXIS = {link.hinge.name: link.hinge.axis for link in LINKS if link.hinge is not None}
_OTHER_SIDE = {"left": "right", "right": "left"}


def _mirrored_joint(name: str) -> str:
    side, _, rest = name.partition("_")
    return f"{_OTHER_SIDE[side]}_{rest}" if side in _OTHER_SIDE else name


MIRROR_JOINTS: tuple[int, ...] = tuple(MUJOCO_JOINTS.index(_mirrored_joint(name)) for name in MUJOCO_JOINTS)
"""Joint (MuJoCo order) that each joint becomes in the mirror: `mirrored[i] = signs[i] * joints[MIRROR_JOINTS[i]]`."""
MIRROR_SIGNS: tuple[float, ...] = tuple(1.0 if _HINGE_AXIS[name] == "Y" else -1.0 for name in MUJOCO_JOINTS)
"""The mirror keeps rotations about the sideways axis and reverses those about the other two."""


def _array(kind: Any, axis: str, *tail: int) -> Any:
    """A field of `MotionLibrary` that is an array: its type, what its first axis counts, and the other axes."""
    return field(metadata={"array": (kind, tail, axis)})


@dataclass(frozen=True, eq=False)
class MotionLibrary:
    """Clips at 50 Hz. Arrays are checked when the library is made."""

    root_pos: np.ndarray = _array(np.float32, "frames", 3)
    """Root position [m], world of the clip, float32, shape [frames, 3]."""
    root_quat: np.ndarray = _array(np.float32, "frames", 4)
    """Root orientation, wxyz, float32, shape [frames, 4]."""
    joint_pos: np.ndarray = _array(np.float32, "frames", 29)
    """Joint positions [rad], MuJoCo order, float32, shape [frames, 29]."""
    hands: np.ndarray = _array(np.float32, "frames", 2)
    """Left and right hand, 1 closed, 0 open, float32, shape [frames, 2]."""
    clip_start: np.ndarray = _array(np.int64, "clips")
    """First frame of each clip, int64, shape [clips]."""
    clip_length: np.ndarray = _array(np.int64, "clips")
    """Frames of each clip, 2 or more, int64, shape [clips]."""
    family: np.ndarray = _array(np.int64, "clips")
    """Index into `family_names` of each clip, int64, shape [clips]."""
    clip_names: np.ndarray = _array(np.str_, "clips")
    """Name of each clip, str, shape [clips]."""
    licence: np.ndarray = _array(np.str_, "clips")
    """Licence of each clip, str, shape [clips]."""
    source: np.ndarray = _array(np.str_, "clips")
    """Origin of each clip, str, shape [clips]."""
    support_kind: np.ndarray = _array(np.int64, "clips")
    """Index into `SUPPORTS` of what the clip stands or sits on in addition to the floor, int64, shape [clips]."""
    support_box: np.ndarray = _array(np.float32, "clips", 7)
    """Support: centre x, y, z of its top face [m], yaw [rad], length along x and width along y [m], height of the
    top above the floor [m]; float32, shape [clips, 7]."""
    family_names: np.ndarray = _array(np.str_, "families")
    """Names of the kinds of motion, str, shape [families]."""

    def __post_init__(self) -> None:
        """Bring the arrays to their types.

        Raises:
            InputError: An array is of the wrong shape, not finite, or contradicts another.
        """
        where = "motion library"
        count: dict[str, int] = {}
        for name, (kind, tail, axis) in _ARRAYS.items():
            array = np.asarray(getattr(self, name))
            if kind is not np.str_ and array.dtype.kind not in "fiub":
                raise InputError(f"{where}: array {name} holds {array.dtype}, expected numbers")
            if kind is np.str_ and array.dtype.kind != "U" and array.size:
                raise InputError(f"{where}: array {name} holds {array.dtype}, expected text")
            if kind is np.int64 and array.dtype.kind == "f":
                raise InputError(f"{where}: array {name} holds {array.dtype}, expected whole numbers")
            array = np.ascontiguousarray(array, dtype=kind)
            length = count.setdefault(axis, len(array) if array.ndim else 0)
            if array.shape != (length, *tail):
                wanted = ", ".join([axis, *map(str, tail)])
                shape = list(array.shape)
                raise InputError(f"{where}: array {name} has shape {shape}, expected [{wanted}] with {length} {axis}")
            if kind is np.float32 and not np.isfinite(array).all():
                raise InputError(f"{where}: array {name} holds NaN or infinity")
            object.__setattr__(self, name, array)
        if not count["clips"]:
            raise InputError(f"{where}: holds no clip")
        if (self.clip_length < 2).any():
            raise InputError(f"{where}: clip {self._first(self.clip_length < 2)} has fewer than 2 frames")
        ends = np.cumsum(self.clip_length)
        if not np.array_equal(self.clip_start, ends - self.clip_length) or ends[-1] != count["frames"]:
            raise InputError(f"{where}: clip_start and clip_length do not cover the {count['frames']} frames in order")
        for name, limit in (("family", count["families"]), ("support_kind", len(SUPPORTS))):
            outside = (getattr(self, name) < 0) | (getattr(self, name) >= limit)
            if outside.any():
                raise InputError(f"{where}: {name} of clip {self._first(outside)} is not from 0 to {limit - 1}")
        norm = np.linalg.norm(self.root_quat, axis=1, keepdims=True)
        if (np.abs(norm - 1.0) > 1e-2).any():
            raise InputError(f"{where}: root_quat holds a quaternion that is not of length 1")
        object.__setattr__(self, "root_quat", self.root_quat / norm)

    def _first(self, which: np.ndarray) -> str:
        return str(self.clip_names[int(np.flatnonzero(which)[0])])

    @property
    def clips(self) -> int:
        """Number of clips."""
        return len(self.clip_start)

    @property
    def frames(self) -> int:
        """Number of frames of all clips."""
        return len(self.root_pos)

    @property
    def seconds(self) -> np.ndarray:
        """Length of each clip [s], shape [clips]."""
        return (self.clip_length - 1) * TICK

    def rows(self, clip: int) -> slice:
        """The frames of a clip."""
        start = int(self.clip_start[clip])
        return slice(start, start + int(self.clip_length[clip]))

    def clip_index(self, name_or_number: str) -> int:
        """Index of a clip by its name or its number.

        Raises:
            InputError: There is no such clip.
        """
        found = np.flatnonzero(self.clip_names == name_or_number)
        if found.size:
            return int(found[0])
        if name_or_number.isdecimal() and int(name_or_number) < self.clips:
            return int(name_or_number)
        raise InputError(f"--clip {name_or_number}: neither a clip's name nor a number from 0 to {self.clips - 1}")

    @classmethod
    def from_clips(
        cls,
        clips: Sequence[Clip],
        names: Sequence[str],
        *,
        family: str | Sequence[str] = "clips",
        licence: str | Sequence[str] = UNKNOWN,
        source: str | Sequence[str] = UNKNOWN,
    ) -> MotionLibrary:
        """Make a library of clips, resampled to 50 Hz.

        Args:
            clips: The clips, of any frame rate.
            family: Kind of motion, of all or of each.
            licence: Licence, of all or of each.
            source: Origin, of all or of each.

        Raises:
            InputError: No clips, or lists of unequal length.
        """
        if not clips:
            raise InputError("motion library: holds no clip")
        families, licences, sources = (
            [given] * len(clips) if isinstance(given, str) else list(given) for given in (family, licence, source)
        )
        for label, values in (("names", names), ("family", families), ("licence", licences), ("source", sources)):
            if len(values) != len(clips):
                raise InputError(f"motion library: {len(values)} {label} for {len(clips)} clips")
        even = [resample(clip, FPS) for clip in clips]
        kinds = list(dict.fromkeys(families))
        lengths = np.array([len(clip.root_pos) for clip in even], dtype=np.int64)
        poses = ("root_pos", "root_quat", "joint_pos")
        return cls(
            **{name: np.concatenate([getattr(clip, name) for clip in even]) for name in poses},
            hands=np.concatenate([_hands(clip) for clip in even]),
            clip_start=np.cumsum(lengths) - lengths,
            clip_length=lengths,
            family=np.array([kinds.index(name) for name in families]),
            family_names=np.array(kinds),
            clip_names=np.array(list(names)),
            licence=np.array(licences),
            source=np.array(sources),
            support_kind=np.zeros(len(clips), dtype=np.int64),
            support_box=np.zeros((len(clips), 7)),
        )

    @classmethod
    def from_random(cls, generated: Mapping[str, Any], *, source: str = "generated") -> MotionLibrary:
        """Make a library of what `programs.random_clips` returns, whose origin is `source`."""
        arrays = {name: _host(generated[name]) for name in (*_PER_FRAME, "family", "support_kind", "support_box")}
        clips, ticks = arrays["root_pos"].shape[:2]
        names = np.array([str(name) for name in generated["family_names"]])
        numbers = np.zeros(clips, dtype=np.int64)
        for kind in np.unique(arrays["family"]):
            of_kind = arrays["family"] == kind
            numbers[of_kind] = np.arange(of_kind.sum())
        return cls(
            **{name: arrays[name].reshape(clips * ticks, -1) for name in _PER_FRAME},
            clip_start=np.arange(clips) * ticks,
            clip_length=np.full(clips, ticks),
            family=arrays["family"].astype(np.int64),
            family_names=names,
            clip_names=np.array([f"{names[k]}-{i:04d}" for k, i in zip(arrays["family"], numbers, strict=True)]),
            licence=np.full(clips, "Apache-2.0"),
            source=np.full(clips, source),
            support_kind=arrays["support_kind"].astype(np.int64),
            support_box=arrays["support_box"],
        )

    @classmethod
    def concatenate(cls, libraries: Sequence[MotionLibrary]) -> MotionLibrary:
        """All clips of several libraries; families of the same name become one.

        Raises:
            InputError: No library.
        """
        if not libraries:
            raise InputError("motion library: nothing to put together")
        kinds = list(dict.fromkeys(str(name) for library in libraries for name in library.family_names))
        arrays = {
            name: np.concatenate([getattr(library, name) for library in libraries])
            for name in _ARRAYS
            if name not in ("family", "family_names", "clip_start")
        }
        family = [np.array([kinds.index(n) for n in lib.family_names], dtype=np.int64)[lib.family] for lib in libraries]
        length = arrays["clip_length"]
        return cls(
            **arrays,
            clip_start=np.cumsum(length) - length,
            family=np.concatenate(family),
            family_names=np.array(kinds),
        )

    def select(self, clips: Sequence[int] | np.ndarray) -> MotionLibrary:
        """Some of the clips, in the order given; a boolean mask does too.

        Raises:
            InputError: None is left.
        """
        picked = np.arange(self.clips)[np.asarray(clips)].reshape(-1)
        if not picked.size:
            raise InputError("motion library: holds no clip")
        rows = np.concatenate([np.arange(self.rows(int(clip)).start, self.rows(int(clip)).stop) for clip in picked])
        length = self.clip_length[picked]
        arrays = {
            name: getattr(self, name)[rows if axis == "frames" else picked]
            for name, (_, _, axis) in _ARRAYS.items()
            if axis != "families"
        }
        arrays["clip_start"] = np.cumsum(length) - length
        return MotionLibrary(**arrays, family_names=self.family_names)

    def mirrored(self) -> MotionLibrary:
        """Every clip with left and right exchanged (about the plane of the world's x and z axes)."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        box = np.array([1, -1, 1, -1, 1, 1, 1], dtype=np.float32)
        arrays |= {
            "root_pos": self.root_pos * np.array([1, -1, 1], dtype=np.float32),
            "root_quat": self.root_quat * np.array([1, -1, 1, -1], dtype=np.float32),
            "joint_pos": self.joint_pos[:, list(MIRROR_JOINTS)] * np.array(MIRROR_SIGNS, dtype=np.float32),
            "hands": self.hands[:, ::-1],
            "clip_names": np.array([f"{name} mirrored" for name in self.clip_names]),
            "support_box": self.support_box * box,
        }
        return MotionLibrary(**arrays)

    def save(self, path: str | Path) -> None:
        """Write an NPZ file, which has its name only when it is complete.

        Raises:
            InputError: The file cannot be written.
        """
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        try:
            with replace_atomically(path) as file:
                np.savez(file, format=np.array(FORMAT), fps=np.array(FPS), **arrays)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from error

    @classmethod
    def load(cls, path: str | Path) -> MotionLibrary:
        """Read a library file.

        Raises:
            InputError: The file is absent, damaged, or not a motion library.
        """
        file = read_arrays(path, ("format", "fps", *_ARRAYS))
        if "format" not in file or str(file["format"]) != FORMAT:
            raise InputError(f"{path}: not a motion library (array format is not {FORMAT})")
        missing = [name for name in _ARRAYS if name not in file]
        if missing:
            raise InputError(f"{path}: array {missing[0]} is missing")
        fps = numbers(file.get("fps", np.array(FPS)), f"{path}: array fps", np.float64)
        if fps.size != 1 or fps.item() != FPS:
            given = f"{fps.item():g}" if fps.size == 1 else "several numbers of"
            raise InputError(f"{path}: has {given} frames per second, expected {FPS}; convert it again")
        try:
            return cls(**{name: file[name] for name in _ARRAYS})
        except InputError as error:
            raise InputError(str(error).replace("motion library", str(path), 1)) from None

    def to(self, device: str | torch.device = "cpu") -> DeviceLibrary:
        """The frames as tensors, with velocities and mimic commands."""
        return DeviceLibrary.build(self, device)


# Array → type, shape after the first axis, what the first axis counts; in the order of the file.
_ARRAYS: dict[str, tuple[Any, tuple[int, ...], str]] = {f.name: f.metadata["array"] for f in fields(MotionLibrary)}
_PER_FRAME = tuple(name for name, (_, _, axis) in _ARRAYS.items() if axis == "frames")


@dataclass(frozen=True, eq=False)
class DeviceLibrary:
    """A library's frames on a device; fields without a text are those of `MotionLibrary`.

    Velocities are backward differences, zero on a clip's first frame.
    """

    root_pos: Tensor
    root_quat: Tensor
    joint_pos: Tensor
    joint_vel: Tensor
    """Joint velocities [rad/s], MuJoCo order, float32, shape [frames, 29]."""
    lin_vel: Tensor
    """Root velocity [m/s], world, float32, shape [frames, 3]."""
    ang_vel: Tensor
    """Root angular velocity [rad/s], body frame, float32, shape [frames, 3]."""
    mimic: Tensor
    """Mimic command (canonical.MIMIC), float32, shape [frames, 35]."""
    hands: Tensor
    frame_clip: Tensor
    """Clip of each frame, int64, shape [frames]."""
    clip_start: Tensor
    clip_length: Tensor
    family: Tensor
    support_kind: Tensor
    support_box: Tensor
    family_names: tuple[str, ...]
    clip_names: tuple[str, ...]

    @classmethod
    def build(cls, library: MotionLibrary, device: str | torch.device) -> DeviceLibrary:
        """Upload a library and derive its velocities."""

        def up(array: np.ndarray) -> Tensor:
            return torch.as_tensor(np.array(array), device=device)

        pos, quat, joints = up(library.root_pos), up(library.root_quat), up(library.joint_pos)
        clip = np.repeat(np.arange(library.clips), library.clip_length)
        previous = up(np.maximum(np.arange(library.frames) - 1, library.clip_start[clip]))
        # In double precision: a difference over a tick multiplies rounding by 50.
        pos64, quat64 = pos.double(), torch.nn.functional.normalize(quat.double(), dim=-1)
        turned = quat_multiply(quat_conjugate(quat64[previous]), quat64)
        mimic = frame_mimic(pos64[previous], quat64[previous], pos64, quat64, joints.double())
        return cls(
            root_pos=pos,
            root_quat=quat,
            joint_pos=joints,
            joint_vel=(joints - joints[previous]) / TICK,
            lin_vel=((pos64 - pos64[previous]) / TICK).float(),
            ang_vel=(rotation_vector(turned) / TICK).float(),
            mimic=mimic.float(),
            frame_clip=up(clip),
            family_names=tuple(map(str, library.family_names)),
            clip_names=tuple(map(str, library.clip_names)),
            **{name: up(getattr(library, name)) for name in ("hands", "clip_start", "clip_length", "family")},
            **{name: up(getattr(library, name)) for name in ("support_kind", "support_box")},
        )

    @property
    def clips(self) -> int:
        """Number of clips."""
        return len(self.clip_names)

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.root_pos.device

    def index(self, clip: Tensor, step: Tensor) -> Tensor:
        """Frame of a clip at a step; outside a clip, its first or last frame. Shapes [...]."""
        last = self.clip_length[clip] - 1
        return self.clip_start[clip] + torch.minimum(step.clamp_min(0), last)


def _hands(clip: Clip) -> np.ndarray:
    return np.zeros((len(clip.root_pos), 2)) if clip.hands is None else clip.hands


def _host(values: Any) -> np.ndarray:
    """An array of an array or a tensor."""
    return values.detach().cpu().numpy() if hasattr(values, "detach") else np.asarray(values)
