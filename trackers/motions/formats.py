"""Motion files that users have, read into one library: pickles, BeyondMimic's NPZ, tables, our own files.

| file | what is in it |
|---|---|
| `.pkl` | TWIST2, GMR (29 joints), GMT (23), ASAP/PHC (23, several clips in a joblib file): `load` |
| `.csv` | Unitree's LAFAN1 set, Kimodo: root x, y, z, quaternion, 29 or 23 joints (MuJoCo order); a line per frame |
| `.npz` | BeyondMimic: fps, joint_pos, body_pos_w, body_quat_w (wxyz; body 0 is the pelvis) |
| `.npz` | a motion library, or canonical actions (array action) |
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.files.text import counted
from arena_newton.files.untrusted_files import numbers, read_arrays, read_bytes
from arena_newton.robot.g1 import MUJOCO_JOINTS, MUJOCO_TO_CANONICAL, TICK
from arena_newton.trackers.motions.frames import actions_to_motion
from arena_newton.trackers.motions.kinematics import forward
from arena_newton.trackers.motions.library import FORMAT, UNKNOWN, MotionLibrary
from arena_newton.trackers.motions.load import (
    JOINTS_23,
    Clip,
    checked_clip,
    clip_from_fields,
    load_actions,
    load_plain_pickle,
    motions_of,
)

__all__ = ["FileReport", "ReadOptions", "Reading", "read_file", "read_library"]

QuatOrder = Literal["auto", "wxyz", "xyzw"]
JointOrder = Literal["auto", "isaac", "mujoco"]
CSV_FPS = 30.0
"""Frame rate of Unitree's LAFAN1 tables, which do not state it."""
UPRIGHT_MARGIN = 0.2
"""Difference of the mean uprightness (-1 to 1) from which the order of a table's quaternions is clear."""
JOINT_ORDER_MARGIN = 0.01
"""Mean distance of links [m] from which the order of an NPZ's joints is clear."""


@dataclass(frozen=True)
class ReadOptions:
    """Facts about motions that files lack."""

    fps: float | None = None
    """Frame rate of tables [1/s]; 30 by default."""
    quat_order: QuatOrder = "auto"
    """Order of a table's quaternions; by default the one in which the robot is upright."""
    joint_order: JointOrder = "auto"
    """Order of the joints of BeyondMimic's NPZ: `isaac` (its own), `mujoco` (mjlab's); by default the one whose
    kinematics give the file's body positions."""
    trim: bool = True
    """Cut motion capture jumps off the start."""


@dataclass(frozen=True)
class FileReport:
    """Findings in one file."""

    path: Path
    """The file."""
    kind: str
    """Name of its format."""
    clips: int
    """Clips in it."""
    seconds: float
    """Their length together [s]."""
    trimmed: int
    """Frames cut off their starts."""
    notes: tuple[str, ...] = ()
    """Assumptions made."""

    def line(self) -> str:
        """The report in one line."""
        found = f"{self.path}: {self.kind}, {counted(self.clips, 'clip')}, {self.seconds:.1f} s"
        cut = [f"{counted(self.trimmed, 'frame')} of a jump cut off the start"] if self.trimmed else []
        return ", ".join([found, *cut, *self.notes])


@dataclass(frozen=True)
class Reading:
    """Clips of one file, or the library that it is."""

    report: FileReport
    """Findings."""
    names: tuple[str, ...]
    """Name of each clip."""
    clips: tuple[Clip, ...] = ()
    """The clips; none if the file is a library."""
    library: MotionLibrary | None = None
    """The library."""


def read_library(
    paths: Sequence[str | Path],
    options: ReadOptions | None = None,
    *,
    family: str = "clips",
    licence: str = UNKNOWN,
    source: str = UNKNOWN,
) -> tuple[MotionLibrary, list[FileReport]]:
    """Read files of any known format into one library.

    Args:
        paths: The files; clips of libraries keep their family, licence and source.
        options: What the files do not say.
        family: Kind of motion of the clips.
        source: Where they are from; their file's name is put behind it.

    Raises:
        InputError: A file cannot be read, or none was given.
    """
    parts, reports, taken = [], [], set()
    for path in paths:
        try:
            reading = read_file(path, options)
        except InputError as error:
            others = f"; nothing is made of the other {counted(len(paths) - 1, 'file')}" if len(paths) > 1 else ""
            raise InputError(f"{error}{others}") from error
        reports.append(reading.report)
        if reading.library is not None:
            parts.append(reading.library)
            taken.update(map(str, reading.library.clip_names))
            continue
        names = [_free_name(name, taken) for name in reading.names]
        origin = f"{source}: {Path(path).name}" if source != UNKNOWN else Path(path).name
        parts.append(MotionLibrary.from_clips(reading.clips, names, family=family, licence=licence, source=origin))
    return MotionLibrary.concatenate(parts), reports


def _free_name(name: str, taken: set[str]) -> str:
    free, number = name, 2
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    taken.add(free)
    return free


def read_file(path: str | Path, options: ReadOptions | None = None) -> Reading:
    """Read one file.

    Raises:
        InputError: The file is absent, damaged, or of no known format.
    """
    path, options = Path(path), options or ReadOptions()
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder, expected a file' if path.is_dir() else 'no such file'}")
    if options.fps is not None and not 1.0 <= options.fps <= 1000.0:
        raise InputError(f"--fps {options.fps:g}: expected a frame rate from 1 to 1000")
    suffix = path.suffix.lower()
    if suffix in (".pkl", ".pickle", ".joblib"):
        return _pickle(path, options)
    if suffix == ".csv":
        return _table(path, options)
    if suffix == ".npz":
        return _npz(path, options)
    raise InputError(f"{path}: unknown kind of motion file, expected .pkl, .csv or .npz")


def _reading(path: Path, kind: str, clips: dict[str, Clip], notes: Sequence[str] = ()) -> Reading:
    seconds, trimmed = sum(clip.duration for clip in clips.values()), sum(clip.trimmed for clip in clips.values())
    report = FileReport(path, kind, len(clips), seconds, trimmed, tuple(notes))
    return Reading(report, tuple(clips), tuple(clips.values()))


def _pickle(path: Path, options: ReadOptions) -> Reading:
    clips: dict[str, Clip] = {}
    widths, kinds = set(), set()
    for name, fields in motions_of(load_plain_pickle(path, flag=""), str(path)).items():
        where = f"{path}: {name}" if name else str(path)
        clips[name or path.stem] = clip_from_fields(fields, where, trim=options.trim)
        kinds.add("ASAP pickle" if "root_trans_offset" in fields else "TWIST2/GMR pickle")
        widths.add(np.asarray(fields.get("dof_pos", fields.get("dof"))).shape[1])
    if len(clips) == 1:  # is named after its file
        clips = {path.stem: clips.popitem()[1]}
    return _reading(path, " and ".join(sorted(kinds)), clips, _padding(widths))


def _padding(widths: set[int]) -> list[str]:
    return ["23 joints, wrists at zero"] if len(JOINTS_23) in widths else []


def _table(path: Path, options: ReadOptions) -> Reading:
    try:
        text = read_bytes(path, limits.TABLE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a readable table ({type(error).__name__})") from error
    widths = (7 + len(MUJOCO_JOINTS), 7 + len(JOINTS_23))
    rows: list[np.ndarray] = []
    for number, line in enumerate(io.StringIO(text), 1):
        # The first line may hold column names.
        if not line.strip() or (number == 1 and not _is_number(line.partition(",")[0])):
            continue
        # Counted before it is split: a single line can be as long as the file.
        width = line.count(",") + 1
        if not rows and width not in widths:
            raise InputError(
                f"{path}: has {width} columns, expected {widths[0]} (root x, y, z, quaternion, 29 joints) or "
                f"{widths[1]} (23 joints)"
            )
        row = line.split(",") if not rows or width == len(rows[0]) else []
        if not row or not all(map(_is_number, row)):
            raise InputError(f"{path}: line {number} does not hold {len(rows[0]) if rows else width} numbers")
        rows.append(np.array([float(value) for value in row]))
        if not np.isfinite(rows[-1]).all():
            raise InputError(f"{path}: line {number} holds NaN or infinity")
    if not rows:
        raise InputError(f"{path}: holds no frame")
    table, width = np.array(rows), len(rows[0])
    order = options.quat_order if options.quat_order != "auto" else _quat_order(table[:, 3:7], path)
    fps = CSV_FPS if options.fps is None else options.fps
    motion = table[:, :3], table[:, 3:7], table[:, 7:]
    clip = checked_clip(fps, *motion, str(path), xyzw=order == "xyzw", trim=options.trim)
    notes = [f"{fps:g} frames per second", f"quaternions {order}", *_padding({width - 7})]
    return _reading(path, "table", {path.stem: clip}, notes)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _quat_order(quat: np.ndarray, path: Path) -> str:
    """Unitree's tables say xyzw, others wxyz; the order in which the robot is upright is taken."""
    square = quat**2 / np.maximum((quat**2).sum(axis=1, keepdims=True), 1e-12)
    # Uprightness R22 = 1 - 2 (x² + y²).
    wxyz, xyzw = (float((1 - 2 * square[:, list(at)].sum(axis=1)).mean()) for at in ((1, 2), (0, 1)))
    if abs(wxyz - xyzw) < UPRIGHT_MARGIN:
        raise InputError(f"{path}: the order of the quaternions is not clear; state --quat-order wxyz or xyzw")
    return "wxyz" if wxyz > xyzw else "xyzw"


def _npz(path: Path, options: ReadOptions) -> Reading:
    names = set(read_arrays(path, ()))
    if "body_pos_w" in names and "format" not in names:
        wanted = ("fps", "joint_pos", "body_pos_w", "body_quat_w")
        missing = [name for name in wanted if name not in names]
        if missing:
            raise InputError(f"{path}: array {missing[0]} is missing")
        arrays = read_arrays(path, wanted)
        checked = {name: numbers(arrays[name], f"{path}: array {name}", np.float64) for name in wanted}
        return _beyond_mimic(path, checked, options)
    if "format" in names:
        library = MotionLibrary.load(path)
        seconds = float(library.seconds.sum())
        report = FileReport(path, "motion library", library.clips, seconds, 0)
        return Reading(report, tuple(map(str, library.clip_names)), library=library)
    if "action" in names:
        return _reading(path, "canonical actions", {path.stem: _from_actions(path)})
    raise InputError(
        f"{path}: no known motion file; expected a motion library ({FORMAT}), BeyondMimic's arrays "
        "(joint_pos, body_pos_w, body_quat_w, fps), or an array action"
    )


def _from_actions(path: Path) -> Clip:
    actions = load_actions(path, flag="")
    if len(actions) < 2:
        raise InputError(f"{path}: action has shape {list(actions.shape)}, expected 2 or more ticks")
    motion = actions_to_motion(torch.from_numpy(actions.astype(np.float64)))
    pos, quat, joints, hands = (part.numpy() for part in motion)
    return Clip(1.0 / TICK, pos, quat, joints, hands=hands)


def _beyond_mimic(path: Path, arrays: dict[str, np.ndarray], options: ReadOptions) -> Reading:
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise InputError(f"{path}: array {name} holds NaN or infinity")
    fps, joints, pos, quat = (arrays[name] for name in ("fps", "joint_pos", "body_pos_w", "body_quat_w"))
    frames = len(joints) if joints.ndim else 0
    for name, array, tail in (("body_pos_w", pos, 3), ("body_quat_w", quat, 4)):
        if array.ndim != 3 or array.shape[0] != frames or array.shape[1] < 1 or array.shape[2] != tail:
            raise InputError(f"{path}: {name} has shape {list(array.shape)}, expected [{frames}, bodies, {tail}]")
    if fps.size != 1:
        raise InputError(f"{path}: field fps must be one number from 1 to 1000")
    if joints.shape != (frames, len(MUJOCO_JOINTS)):
        raise InputError(f"{path}: joint_pos has shape {list(joints.shape)}, expected [frames, {len(MUJOCO_JOINTS)}]")
    rate, where = float(fps.reshape(())), str(path)
    candidates = {"isaac": joints[:, MUJOCO_TO_CANONICAL], "mujoco": joints}
    order = options.joint_order
    if order == "auto":
        plain = checked_clip(rate, pos[:, 0], quat[:, 0], joints, where, trim=False)
        far = {name: _link_distance(plain, mujoco, pos) for name, mujoco in candidates.items()}
        # Where both fit (joints alike on both sides), the format's own order is taken.
        order = "mujoco" if far["mujoco"] < far["isaac"] - JOINT_ORDER_MARGIN else "isaac"
    clip = checked_clip(rate, pos[:, 0], quat[:, 0], candidates[order], where, trim=options.trim)
    note = "joints in Isaac Lab's order" if order == "isaac" else "joints in MuJoCo's order"
    return _reading(path, "BeyondMimic NPZ", {path.stem: clip}, [note])


def _link_distance(clip: Clip, joint_pos: np.ndarray, body_pos: np.ndarray) -> float:
    """Mean distance [m] of a file's bodies to the nearest link, over some frames; whatever the bodies' order is."""
    some: Any = np.unique(np.linspace(0, len(joint_pos) - 1, 20).astype(int))
    links = forward(*(torch.from_numpy(x[some]) for x in (clip.root_pos, clip.root_quat, joint_pos))).position
    return float(torch.cdist(torch.from_numpy(body_pos[some]), links).min(dim=-1).values.mean())
