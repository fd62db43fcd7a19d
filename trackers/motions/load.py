"""Readers of motion clips in pickles (TWIST2/GMR, GMT, ASAP) and of action files (NPZ).

Pickles run code when they are read. Only NumPy arrays, numbers, strings and plain containers are admitted here; a file
that names anything else is refused before it is called. Arrays may also follow between the pickle's frames, as joblib
writes them.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.files.untrusted_files import numbers, read_arrays, read_bytes
from arena_newton.robot.canonical import ACTION_WIDTH, validate_action

__all__ = ["JOINTS_23", "Clip", "checked_clip", "clip_from_fields", "load_actions", "load_clip", "load_plain_pickle"]
__all__ += ["motions_of", "resample"]

JOINTS = 29
JOINTS_23: tuple[int, ...] = (*range(19), *range(22, 26))
"""The joints of 23-DoF clips (GMT, ASAP): legs, waist, shoulders and elbows; their wrists are set to zero."""
FIELDS = {"root_pos": "root_trans_offset", "root_rot": "root_rot", "dof_pos": "dof"}
"""TWIST2's name of a field → ASAP's."""
FAR = 1000.0
"""Farthest that a root may be from the origin [m]; beyond it a file is in other units or damaged."""
START_FRAMES = 15
"""A motion capture jump is searched for in this many first frames."""
START_HEIGHT = 1.3
"""Root height [m] that no clip starts with; captures that begin with a jump show 1.8 m."""
START_SPEED = 2.5
"""Root speed [m/s] that no clip starts with (the jumps show 40 m/s and more)."""
START_JOINT_SPEED = 15.0
"""Joint speed [rad/s] that no clip starts with."""


@dataclass(frozen=True)
class Clip:
    """A whole-body motion."""

    fps: float
    """Frames per second."""
    root_pos: np.ndarray
    """Root position [m], world, shape [frames, 3]."""
    root_quat: np.ndarray
    """Root orientation, wxyz, shape [frames, 4]."""
    joint_pos: np.ndarray
    """Joint positions [rad], MuJoCo order, shape [frames, 29]."""
    trimmed: int = 0
    """Frames of a motion capture jump that were cut off at the start."""
    hands: np.ndarray | None = None
    """Left and right hand, 1 closed, 0 open, shape [frames, 2]; None means open."""

    @property
    def duration(self) -> float:
        """Length [s]."""
        return (len(self.root_pos) - 1) / self.fps


class _RefusedError(Exception):
    """The pickle names something that is not plain data."""


def _latin1(text: str, encoding: str = "latin1") -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise _RefusedError(f"encoding {encoding}")
    return text.encode("latin1")


class _ArrayType:
    """Stands for `numpy.ndarray`, which pickles name and never call: a call would invent an array of any size."""


def _empty_array(kind: Any, shape: Any, _code: Any) -> np.ndarray:
    """NumPy's `_reconstruct`: the empty array that a state is then set on."""
    if kind is not _ArrayType or tuple(shape) != (0,):
        raise _RefusedError(f"an array of shape {shape} without numbers")
    return np.empty(0, dtype=np.int8)


def _scalar(dtype: Any, data: Any = None) -> Any:
    from numpy._core import multiarray

    if not isinstance(dtype, np.dtype) or dtype.hasobject or not isinstance(data, bytes):
        raise _RefusedError("a number without bytes")
    return multiarray.scalar(dtype, data)


def _dtype(*arguments: Any) -> np.dtype[Any]:
    dtype = np.dtype(*arguments)
    if dtype.subdtype is not None or dtype.names is not None:
        raise _RefusedError(f"numbers of type {dtype}")
    return dtype


def _admitted() -> dict[tuple[str, str], Any]:
    from numpy._core import numeric

    admitted: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): _ArrayType,
        ("numpy", "dtype"): _dtype,
        ("_codecs", "encode"): _latin1,
        ("joblib.numpy_pickle", "NumpyArrayWrapper"): _JoblibArray,
    }
    for package in ("numpy._core", "numpy.core"):
        admitted[f"{package}.multiarray", "_reconstruct"] = _empty_array
        admitted[f"{package}.multiarray", "scalar"] = _scalar
        admitted[f"{package}.numeric", "_frombuffer"] = getattr(numeric, "_frombuffer")  # noqa: B009 (private)
    return admitted


class _JoblibArray:
    """Replaces joblib's `NumpyArrayWrapper`, which says what array follows in the file."""

    shape: Any
    dtype: Any
    order: Any = "C"
    numpy_array_alignment_bytes: Any = None

    def read(self, file: io.BytesIO) -> np.ndarray:
        """The array whose bytes come next (joblib 0.10 and later)."""
        dtype, shape = self.dtype, tuple(int(n) for n in self.shape)
        if not isinstance(dtype, np.dtype) or dtype.hasobject:
            raise _RefusedError("an array of objects")
        if self.numpy_array_alignment_bytes is not None:
            file.read(file.read(1)[0])
        size = dtype.itemsize * int(np.prod(shape, dtype=object))
        data = file.read(size) if min(shape, default=1) >= 0 else b""
        if len(data) != size:
            raise EOFError
        array = np.frombuffer(data, dtype=dtype).copy()
        return array.reshape(shape[::-1]).T if self.order == "F" else array.reshape(shape)


# The C unpickler cannot read an array between two frames; the one in Python can.
class _PlainUnpickler(pickle._Unpickler):
    """Admits NumPy arrays and plain containers only."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self._file = file
        self._held = 0

    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        admitted = _admitted().get((module, name))
        if admitted is None:
            raise _RefusedError(f"{module}.{name}")
        return admitted

    def persistent_load(self, pid: Any) -> Any:
        raise _RefusedError("a persistent id")

    def _hold(self, value: Any) -> None:
        """Count what an instruction made: a few bytes can repeat it without end."""
        if isinstance(value, np.ndarray | np.generic):
            self._held += value.nbytes
        elif isinstance(value, bytes | str):
            self._held += len(value)
        if self._held > limits.PICKLE_BYTES:
            raise _RefusedError(f"arrays of more than {limits.PICKLE_BYTES // limits.MIB} MiB")

    def load_bytearray8(self) -> None:
        # Python's own makes the array before it checks the length of the file.
        size = int.from_bytes(self.read(8), "little")  # type: ignore[attr-defined]
        data = self.read(size)  # type: ignore[attr-defined]
        if len(data) != size:
            raise EOFError
        self.append(bytearray(data))  # type: ignore[attr-defined]

    def _instantiate(self, kind: Any, arguments: Any) -> None:
        super()._instantiate(kind, arguments)  # type: ignore[misc]
        self._hold(self.stack[-1])  # type: ignore[attr-defined]

    def load_reduce(self) -> None:
        stack: list[Any] = self.stack  # type: ignore[attr-defined]
        if stack[-2] is _ArrayType:
            raise _RefusedError("a call of numpy.ndarray")
        super().load_reduce()  # type: ignore[misc]
        self._hold(self.stack[-1])  # type: ignore[attr-defined]

    def load_build(self) -> None:
        stack: list[Any] = self.stack  # type: ignore[attr-defined]
        # A state is set on arrays and their types only: set on a function it would change the function.
        if not isinstance(stack[-2], np.ndarray | np.dtype | _JoblibArray):
            raise _RefusedError(f"a state for {stack[-2]!r}")
        super().load_build()  # type: ignore[misc]
        if isinstance(stack[-1], _JoblibArray):
            stack[-1] = _JoblibArray.read(stack[-1], self._file)
        self._hold(stack[-1])

    dispatch = dict(pickle._Unpickler.dispatch)
    dispatch[pickle.BUILD[0]] = load_build  # type: ignore[assignment]
    dispatch[pickle.REDUCE[0]] = load_reduce  # type: ignore[assignment]
    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8  # type: ignore[assignment]


def load_plain_pickle(path: str | Path, *, flag: str = "--policy replay:") -> Any:
    """Read a pickle that holds nothing but NumPy arrays, numbers, strings and plain containers.

    Raises:
        InputError: The file is absent, damaged, or holds anything else; nothing of it was executed.
    """
    data = read_bytes(path, limits.PICKLE_BYTES, where=f"{flag}{path}")
    try:
        content = _PlainUnpickler(io.BytesIO(data)).load()
        _check_size(content)
        return content
    except _RefusedError as error:
        raise InputError(
            f"{flag}{path}: the pickle holds {error}, which is refused: only NumPy arrays and plain containers are read"
        ) from error
    except Exception as error:  # a damaged pickle raises nearly anything
        raise InputError(f"{flag}{path}: not a readable pickle ({type(error).__name__})") from error


def _check_size(content: Any) -> None:
    """Refuse lists that hold one another again and again: a few bytes of them unfold to any number of numbers."""
    sizes: dict[int, int] = {}

    def measured(value: Any, depth: int) -> int:
        if isinstance(value, np.ndarray) and not value.dtype.hasobject:
            return value.nbytes
        if not isinstance(value, dict | list | tuple | set | frozenset | np.ndarray):
            return 8
        known = sizes.get(id(value))
        if known is not None:
            return known
        if depth > limits.NESTING:
            raise _RefusedError(f"lists nested deeper than {limits.NESTING}")
        sizes[id(value)] = 0
        items = value.values() if isinstance(value, dict) else value.flat if isinstance(value, np.ndarray) else value
        size = 8 + sum(measured(item, depth + 1) for item in items)
        if size > limits.PICKLE_BYTES:
            raise _RefusedError(f"lists that unfold to more than {limits.PICKLE_BYTES // limits.MIB} MiB")
        sizes[id(value)] = size
        return size

    measured(content, 0)


def load_clip(path: str | Path, *, trim: bool = True) -> Clip:
    """Read a pickled clip: fields `fps`, `root_pos`, `root_rot` (xyzw) and `dof_pos` (MuJoCo order; TWIST2, GMR, GMT).

    29 joints, or the 23 without wrists, which are then zero. ASAP's names of the fields do as well. `trim` cuts a
    motion capture jump off the start.

    Raises:
        InputError: A field is missing, of the wrong shape, or not finite; or the file holds several clips.
    """
    where = f"--policy replay:{path}"
    motions = motions_of(load_plain_pickle(path), where)
    if len(motions) != 1:
        raise InputError(f"{where}: holds {len(motions)} clips, expected one; `motions convert` reads them all")
    return clip_from_fields(next(iter(motions.values())), where, trim=trim)


def motions_of(content: Any, where: str) -> dict[str, Mapping[str, Any]]:
    """The clips of an unpickled file by name: ASAP nests them under names, the others hold one (named "").

    Raises:
        InputError: The content is not a clip.
    """
    if not isinstance(content, dict):
        raise InputError(f"{where}: holds {type(content).__name__}, expected a clip with named fields")
    if content and all(isinstance(value, dict) for value in content.values()):
        return {str(name): value for name, value in content.items()}
    return {"": content}


def clip_from_fields(content: Mapping[str, Any], where: str, *, trim: bool = True) -> Clip:
    """A clip of the fields of an unpickled one; see `load_clip`.

    Raises:
        InputError: A field is missing, of the wrong shape, or not finite.
    """
    asap = "root_trans_offset" in content
    arrays = {}
    for field in ("fps", "root_pos", "root_rot", "dof_pos"):
        name = FIELDS.get(field, field) if asap else field
        if name not in content:
            raise InputError(f"{where}: field {name} is missing")
        try:
            arrays[field] = np.asarray(content[name], dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"{where}: field {name} holds no numbers") from error
        if not np.isfinite(arrays[field]).all():
            raise InputError(f"{where}: field {name} holds NaN or infinity")
    if arrays["fps"].size != 1:
        raise InputError(f"{where}: field fps must be one number from 1 to 1000")
    fps = float(arrays["fps"].reshape(()))
    return checked_clip(fps, arrays["root_pos"], arrays["root_rot"], arrays["dof_pos"], where, xyzw=True, trim=trim)


def checked_clip(
    fps: float,
    root_pos: np.ndarray,
    root_rot: np.ndarray,
    dof_pos: np.ndarray,
    where: str,
    *,
    xyzw: bool = False,
    trim: bool = True,
) -> Clip:
    """A clip of finite arrays: root [m] and quaternions, and joints [rad], MuJoCo order, 29 or the 23 without wrists.

    Args:
        where: What errors name.
        xyzw: The quaternions' scalar comes last.
        trim: Cut a motion capture jump off the start.

    Raises:
        InputError: A frame rate outside 1 to 1000, a wrong shape, a quaternion that is not of length 1, or numbers
            that are too large for their units.
    """
    if not 1.0 <= fps <= 1000.0:
        raise InputError(f"{where}: field fps must be one number from 1 to 1000")
    if dof_pos.ndim == 2 and dof_pos.shape[1] == len(JOINTS_23):
        padded = np.zeros((len(dof_pos), JOINTS), dtype=dof_pos.dtype)
        padded[:, JOINTS_23] = dof_pos
        dof_pos = padded
    if dof_pos.ndim == 2 and dof_pos.shape[1] != JOINTS:
        raise InputError(f"{where}: dof_pos has {dof_pos.shape[1]} joints, expected {JOINTS} or {len(JOINTS_23)}")
    frames = root_pos.shape[0] if root_pos.ndim == 2 else 0
    for field, array, width in (("root_pos", root_pos, 3), ("root_rot", root_rot, 4), ("dof_pos", dof_pos, JOINTS)):
        if array.shape != (frames, width) or frames < 2:
            shape = list(array.shape)
            raise InputError(f"{where}: {field} has shape {shape}, expected [frames, {width}] with 2 or more frames")
    for field, array, most, unit in (("root_pos", root_pos, FAR, "m"), ("dof_pos", dof_pos, 2.0 * np.pi, "rad")):
        if np.abs(array).max() > most:
            raise InputError(f"{where}: {field} holds {np.abs(array).max():.3g}, expected {unit} up to {most:.4g}")
    norm = np.linalg.norm(root_rot, axis=1, keepdims=True)
    if (np.abs(norm - 1.0) > 0.1).any():
        raise InputError(f"{where}: root_rot holds a quaternion that is not of length 1")
    quat = root_rot / norm
    clip = Clip(fps, root_pos, quat[:, [3, 0, 1, 2]] if xyzw else quat, dof_pos)
    return _trim_start(clip, where) if trim else clip


def _trim_start(clip: Clip, where: str) -> Clip:
    """The clip without a motion capture jump at its start; `trimmed` counts the frames.

    Raises:
        InputError: Nothing is left.
    """
    start = _start(clip.root_pos, clip.joint_pos, clip.fps)
    if len(clip.root_pos) - start < 2:
        raise InputError(f"{where}: nothing is left after the jump at its start")
    if not start:
        return clip
    arrays = {name: getattr(clip, name)[start:] for name in ("root_pos", "root_quat", "joint_pos")}
    return replace(clip, **arrays, trimmed=start)


def _start(root_pos: np.ndarray, joint_pos: np.ndarray, fps: float) -> int:
    """First frame after the last jump within the first frames."""
    speed = np.linalg.norm(np.diff(root_pos, axis=0), axis=1) * fps
    joint_speed = np.abs(np.diff(joint_pos, axis=0)).max(axis=1) * fps
    # A jump between frames i and i + 1 condemns frame i.
    bad = (speed > START_SPEED) | (joint_speed > START_JOINT_SPEED) | (root_pos[:-1, 2] > START_HEIGHT)
    hits = np.flatnonzero(bad[:START_FRAMES])
    return int(hits[-1]) + 1 if hits.size else 0


def resample(clip: Clip, fps: float) -> Clip:
    """The same motion at another frame rate: orientation by slerp, hands from the previous frame, all else linearly.

    A clip of that rate is returned unchanged.
    """
    if abs(clip.fps - fps) < 1e-6 * fps:
        return clip
    count = int(np.floor(clip.duration * fps + 1e-6)) + 1
    at = np.minimum(np.arange(count) * (clip.fps / fps), len(clip.root_pos) - 1)
    low = np.minimum(at.astype(int), len(clip.root_pos) - 2)
    weight = (at - low)[:, None]

    def between(values: np.ndarray) -> np.ndarray:
        return (1 - weight) * values[low] + weight * values[low + 1]

    return Clip(
        fps,
        between(clip.root_pos),
        _slerp(clip.root_quat[low], clip.root_quat[low + 1], weight),
        between(clip.joint_pos),
        clip.trimmed,
        None if clip.hands is None else clip.hands[low],
    )


def _slerp(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Spherical interpolation of unit quaternions [n, 4] along the shorter arc; `weight` [n, 1]."""
    dot = (a * b).sum(axis=-1, keepdims=True)
    b, dot = np.where(dot < 0, -b, b), np.abs(dot)
    angle = np.arccos(np.clip(dot, 0.0, 1.0))
    near = angle < 1e-6
    sine = np.where(near, 1.0, np.sin(angle))
    quat = np.where(near, a + weight * (b - a), (np.sin((1 - weight) * angle) * a + np.sin(weight * angle) * b) / sine)
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def load_actions(path: str | Path, *, flag: str = "--policy replay:") -> np.ndarray:
    """Read canonical actions from an NPZ file with an array `action` of shape [ticks, 40].

    Returns:
        float32, shape [ticks, 40].

    Raises:
        InputError: The array is missing, of another width, or not finite.
    """
    where = f"{flag}{path}"
    arrays = read_arrays(path, ("action",), where=where)
    if "action" not in arrays:
        raise InputError(f"{where}: array action is missing")
    actions = numbers(arrays["action"], f"{where}: array action", np.float32)
    if actions.ndim != 2 or len(actions) == 0:
        raise InputError(f"{where}: action has shape {list(actions.shape)}, expected [ticks, {ACTION_WIDTH}]")
    return validate_action(actions, where)
