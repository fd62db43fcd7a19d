"""``data clean``: drop rows of recordings that a stalled or jumping source spoiled, by the original's five rules.

Rules and thresholds are those of the original's `sonic2lerobot_clean_64_40`. A rule compares a row with the one
recorded immediately before it, dropped or not; the first row always stays. They are for teleoperation, and for the
original's own recordings, whose fields are read where ours are missing. Policies break none of them: they decide every
tick, so that one whose action stays stands, and the rule of held actions does not judge it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import av
import numpy as np
from tqdm import tqdm

from arena_newton.data.recording.episode import CAMERAS, VIDEO_FOLDER, episode_files, looks_film, vision, write_episode
from arena_newton.data.recording.image_statistics import VALUES, add_picture
from arena_newton.errors import InputError
from arena_newton.files.new_folder import link, new_folder
from arena_newton.files.text import counted
from arena_newton.files.untrusted_files import numbers, read_arrays, read_bytes
from arena_newton.pages.tables import Table
from arena_newton.pictures.video import VideoWriter, key_frames
from arena_newton.rules import seeding

if TYPE_CHECKING:
    from arena_newton.data.datasets.data_options import CleanOptions

__all__ = ["RULES", "Rows", "broken_rules", "clean", "clean_episode"]

RULES: Mapping[str, str] = {
    "nonmonotonic": "the frame index does not grow",
    "gap": "the frame index grows by more than --max-gap",
    "backward": "the clock does not go on",
    "slow": "the clock goes on by more than --max-step control steps",
    "held": "the action stays while the joints move",
}
"""Rules by the flag that turns each off (`--no-gap`), in the order of the table."""
HELD_ACTION = 1e-6
"""An action whose numbers all change by no more than this was held (original's rule)."""
MOVING = 0.02
"""Joints of which one moves by this or more within a row are moving [rad] (original's rule)."""
MAX_BYTES = 2**31
"""Size of a recording that is read."""
ACTIONS = ("arena_executed_action", "arena_action", "vla_action", "robot_action_mimic")
JOINTS = ("robot_qpos_before_decimation", "robot_qpos", "robot_joint_pos")
"""Fields, the first that a recording has: ours, and the original's of TWIST2 and SONIC. What was executed moves the
joints: a label may repeat under a disturbance."""
POLICIES = (seeding.DEMONSTRATION, seeding.EVALUATION)
"""Ranges of seeds of policies, whose actions no source holds."""
MARKER = "raw_frame_index"
"""Frame index of the source in the original's SONIC recordings, which have others beside it."""
ONCE = ("arena_phase_names", "arena_final_qpos", "schema_version", "task")
"""Fields that are not rows, whatever their length."""


@dataclass(frozen=True)
class Rows:
    """Fields that the rules read, row by row; None where a recording has no such field."""

    frame: np.ndarray | None
    """Frame index of the source, shape [T]."""
    time: np.ndarray | None
    """Clock [s], shape [T]."""
    action: np.ndarray | None
    joints: np.ndarray | None
    """[rad], shape [T, 29]."""
    step: float
    """Control step [s]."""
    fields: Mapping[str, str]
    """Name of the field that each was read from."""


def broken_rules(rows: Rows, *, max_gap: int = 1, max_step: float = 2.5) -> dict[str, np.ndarray]:
    """Rows that break each rule, bool, shape [T]; the first row breaks none. A rule without its fields is absent."""
    found: dict[str, np.ndarray] = {}
    if rows.frame is not None:
        step = np.diff(rows.frame.astype(np.int64))
        found["nonmonotonic"], found["gap"] = step <= 0, step > max_gap
    if rows.time is not None:
        passed = np.diff(rows.time.astype(np.float64))
        # A little more, so that a step of exactly so many control steps is none too long.
        found["backward"], found["slow"] = ~(passed > 0), passed > max_step * rows.step + 1e-9
    if rows.action is not None and rows.joints is not None:
        held = np.abs(np.diff(rows.action.astype(np.float64), axis=0)).max(axis=1) <= HELD_ACTION
        found["held"] = held & (np.abs(np.diff(rows.joints.astype(np.float64), axis=0)).max(axis=1) >= MOVING)
    return {name: np.concatenate([[False], found[name]]) for name in RULES if name in found}


def rows_of(path: Path, arrays: Mapping[str, np.ndarray]) -> Rows:
    """The fields of a recording that the rules need.

    Raises:
        InputError: One of them does not fit its number of rows.
    """
    count = row_count(path, arrays)

    def first(names: Sequence[str], width: bool, kinds: str) -> tuple[np.ndarray | None, str]:
        for name in names:
            if name in arrays:
                array = arrays[name]
                if array.dtype.kind not in kinds or array.ndim != 1 + width or len(array) != count:
                    raise InputError(f"{path}: {name} holds {array.dtype} {list(array.shape)}, expected {count} rows")
                if not np.isfinite(numbers(array, f"{path}: {name}", np.float64)).all():
                    raise InputError(f"{path}: {name} holds a number that is not finite")
                return array, name
        return None, ""

    markers = sorted(name for name in arrays if "frame_ind" in name and "vision" not in name)
    markers.sort(key=lambda name: name != MARKER)
    clocks = sorted(name for name in arrays if "realtime" in name or "monotonic" in name)
    found = {
        "frame": first([*markers, "vision_frame_indices"], False, "iu"),
        "time": first([*reversed(clocks), "system_timestamp"], False, "f"),
        "action": first(ACTIONS, True, "f"),
        "joints": first(JOINTS, True, "f"),
    }
    if str(arrays.get("arena_seed_range")) in POLICIES:
        found["action"] = None, ""
    arrived = {name: array for name, (array, _) in found.items()}
    used = {name: field for name, (_, field) in found.items() if field}
    return Rows(**arrived, step=_control_step(path, arrays), fields=used)


def row_count(path: Path, arrays: Mapping[str, np.ndarray]) -> int:
    """Number of rows of a recording.

    Raises:
        InputError: It does not say.
    """
    count = arrays.get("num_frames", np.empty(0))
    if count.ndim or count.dtype.kind not in "iu" or int(count) < 1:
        raise InputError(f"{path}: num_frames is missing or no number of rows: is it a recording?")
    return int(count)


def _control_step(path: Path, arrays: Mapping[str, np.ndarray]) -> float:
    for name, of in (("meta_control_dt", lambda v: v), ("system_control_frequency", lambda v: 1.0 / v)):
        if name in arrays and arrays[name].dtype.kind in "fiu" and arrays[name].size:
            # The original stores one value, or one per row: the median is what it converts with.
            value = float(np.median(arrays[name].astype(np.float64)))
            if not 1e-4 < value < 1e4:
                raise InputError(f"{path}: {name} is {value}")
            return float(of(value))
    raise InputError(f"{path}: has neither meta_control_dt nor system_control_frequency")


def clean(folders: Sequence[Path], options: CleanOptions) -> int:
    """Clean the recordings of a command line and print what was dropped.

    Returns:
        Exit code 0.

    Raises:
        InputError: A recording or a flag is unfit; the message names it.
        ArenaError: The folder cannot be written.
    """
    if options.max_gap < 1:
        raise InputError(f"--max-gap {options.max_gap}: expected at least 1")
    if not 1.0 <= options.max_step < 1e6:
        raise InputError(f"--max-step {options.max_step}: expected at least 1 control step")
    files = episode_files(folders)
    doubled = {file.name for file in files if sum(other.name == file.name for other in files) > 1}
    if doubled:
        raise InputError(f"{min(doubled)}: is the name of two recordings; clean their folders one by one")
    lines: dict[str, dict[str, int]] = {}
    bar = tqdm(files, unit="episode", desc="clean", disable=None, dynamic_ncols=True)
    if options.count:
        for file in bar:
            _add(lines, file, *_judged(file, options)[1:])
    else:
        with new_folder(options.out.expanduser()) as folder:
            for file in bar:
                _add(lines, file, *clean_episode(file, folder, options))
    print(table(lines))
    dropped = sum(line["dropped"] for line in lines.values())
    if not options.count:
        print(f"{options.out}: {counted(len(files), 'episode')}, {counted(dropped, 'row')} dropped")
    return 0


def _judged(file: Path, options: CleanOptions) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray]:
    """Arrays of a recording, the rows that break each rule that is on, and the rows that stay."""
    arrays = read_arrays(file)
    rows = rows_of(file, arrays)
    found = broken_rules(rows, max_gap=options.max_gap, max_step=options.max_step)
    found = {name: broken for name, broken in found.items() if getattr(options, name)}
    stays = ~np.logical_or.reduce([np.zeros(row_count(file, arrays), dtype=bool), *found.values()])
    return arrays, found, stays


def clean_episode(file: Path, folder: Path, options: CleanOptions) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Write one recording without its spoiled rows.

    Without such rows the file and its videos are linked or copied, byte for byte; otherwise the videos are encoded
    again from the frames that stay.

    Returns:
        The rows that break each rule that is on, and the rows that stay.

    Raises:
        InputError: The recording is unfit.
    """
    arrays, found, stays = _judged(file, options)
    cameras = [camera for camera in CAMERAS if vision(camera, "rgb_video_path") in arrays]
    videos = {camera: _video(file, arrays, camera) for camera in cameras}
    if stays.all():
        link(file, folder / file.name)
        for camera, video in videos.items():
            for film in (video, *([looks_film(video)] if f"arena_{vision(camera, 'looks')}" in arrays else [])):
                link(film, folder / VIDEO_FOLDER / film.name)
        return found, stays
    kept = {name: array[stays] if _is_rows(name, array, len(stays)) else array for name, array in arrays.items()}
    rows = int(stays.sum())
    kept["num_frames"] = np.asarray(np.int64(rows))
    for camera, video in videos.items():
        kept.pop(f"arena_{vision(camera, 'looks')}", None)  # whose frames are of rows that are gone
        index = vision(camera, "frame_indices")
        frames = arrays[index][stays] if index in arrays else np.flatnonzero(stays)
        target = folder / VIDEO_FOLDER / video.name
        changed = _encoded_again(file, arrays, camera, video, target, frames)
        kept |= {index: np.arange(rows), vision(camera, "rgb_video_num_frames"): np.asarray(np.int64(rows))} | changed
    counts = {name: int(broken.sum()) for name, broken in found.items()}
    source = hashlib.sha256(read_bytes(file, MAX_BYTES)).hexdigest()
    facts = {"dropped": int((~stays).sum()), "rules": counts, "source": file.name, "sha256": source}
    kept["arena_cleaned"] = np.asarray(np.str_(json.dumps(facts, sort_keys=True)))
    kept["arena_source_rows"] = arrays.get("arena_source_rows", np.arange(len(stays)))[stays]
    write_episode(folder / file.name, kept)
    return found, stays


def _is_rows(name: str, array: np.ndarray, count: int) -> bool:
    """True if an array has one entry per row."""
    once = name in ONCE or name.startswith(("episode_", "meta_"))
    if once or name.startswith("arena_vision_") and name.endswith(("_histogram", "_size")):
        return False
    return array.ndim > 0 and len(array) == count


def _video(file: Path, arrays: Mapping[str, np.ndarray], camera: str) -> Path:
    """A camera's MP4, which is in the folder of videos next to the recording."""
    name = vision(camera, "rgb_video_path")
    given = Path(str(arrays[name]))
    video = file.parent / VIDEO_FOLDER / given.name
    if given.parent.name not in (VIDEO_FOLDER, "") or not given.name or not video.is_file() or video.is_symlink():
        raise InputError(f"{file}: {name}: {video} is missing")
    return video


def _encoded_again(
    file: Path, arrays: Mapping[str, np.ndarray], camera: str, video: Path, target: Path, frames: np.ndarray
) -> dict[str, np.ndarray]:
    """Write a video of some of another's frames; returns the fields that change."""
    wanted = dict.fromkeys(frames.tolist())
    if list(wanted) != sorted(wanted) or len(wanted) != len(frames):
        raise InputError(f"{file}: {vision(camera, 'frame_indices')} does not grow")
    name = f"arena_{vision(camera, 'codec')}"
    try:
        codec = json.loads(str(arrays[name])) if name in arrays else {}
        gop, crf, b_frames = int(codec.get("g", 0)), int(codec.get("crf", 20)), bool(codec.get("bf", 0))
        rate = float(arrays[vision(camera, "rgb_video_fps")])
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(f"{file}: {name} or {vision(camera, 'rgb_video_fps')} is unfit") from error
    size = arrays.get(f"arena_{vision(camera, 'size')}")
    histogram = np.zeros((3, VALUES), np.int64)
    writer = None
    try:
        with av.open(str(video)) as container:
            for number, frame in enumerate(container.decode(video=0)):
                if number not in wanted:
                    continue
                picture = frame.to_ndarray(format="rgb24")
                if size is not None:  # without the row and column that make odd sizes even
                    picture = picture[: int(size[1]), : int(size[0])]
                if writer is None:
                    height, width = picture.shape[:2]
                    gop = gop or key_frames(height)
                    writer = VideoWriter(target, width, height, rate, crf=crf, gop=gop, b_frames=b_frames)
                writer.write(np.ascontiguousarray(picture))
                add_picture(histogram, picture)
    except (av.error.FFmpegError, IndexError) as error:
        raise InputError(f"{video}: not a readable video ({type(error).__name__})") from error
    finally:
        if writer is not None:
            written = writer.frames
            writer.close()
    if writer is None or written != len(frames):
        raise InputError(f"{video}: has not the frames that {file.name} names")
    shown = f"arena_{vision(camera, 'histogram')}"
    return {shown: histogram} if shown in arrays else {}


def _add(lines: dict[str, dict[str, int]], file: Path, found: Mapping[str, np.ndarray], stays: np.ndarray) -> None:
    """Count a recording in the line of its folder."""
    name = str(file.parent.parent if file.parent.name == "episodes" else file.parent)
    line = lines.setdefault(name, dict.fromkeys(("episodes", "rows", *RULES, "dropped", "spoiled"), 0))
    line["episodes"] += 1
    line["rows"] += len(stays)
    line["dropped"] += int((~stays).sum())
    line["spoiled"] += not stays.all()
    for rule, broken in found.items():
        line[rule] += int(broken.sum())


def table(lines: Mapping[str, Mapping[str, int]]) -> str:
    """Counts per folder as Markdown; a row that breaks several rules counts in each, and once as dropped."""
    names = ("episodes", "rows", *RULES, "dropped", "spoiled")
    rows = [[folder, *(line[name] for name in names)] for folder, line in lines.items()]
    rows += [["all", *(sum(line[name] for line in lines.values()) for name in names)]] if len(lines) > 1 else []
    return "\n".join(Table(("folder", *names[:-1], "episodes with dropped rows"), rows, "lr").compact())
