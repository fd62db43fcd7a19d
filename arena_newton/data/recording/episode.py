"""The file of one episode: an NPZ whose fields are those of the original's recordings where it has them.

Names without prefix, and their meaning where the table names no departure, are the original's (its recordings of
TWIST2, `twist2_episode_v3_multicam`, and of SONIC, `sonic_episode_v4_multicam`); what it lacks begins with `arena_`.
Not all of its fields are here. Rows are 50 Hz ticks: a row holds the state and the pictures before the
tick, the action decided on them, and what was executed. Pictures are MP4s next to the file, one frame a row.

The bytes depend on the episode alone: not on the number of worlds, on when or where it was recorded.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from arena_newton.data.readers.looks import Looks
from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.untrusted_files import check_size, numbers, read_arrays
from arena_newton.pages.tables import Table
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["CAMERAS", "FIELDS", "SCHEMA_VERSION", "VIDEO_FOLDER", "EpisodeFile", "Field", "camera_fields"]
__all__ += ["episode_files", "fields_table", "looks_film", "opened", "vision", "write_episode"]

SCHEMA_VERSION = "arena_episode_v1"
"""Version of the fields."""
VIDEO_FOLDER = "videos"
"""Folder of the MP4s, next to the NPZ files."""
CAMERAS = {"front": "", "left_wrist": "left_wrist_", "right_wrist": "right_wrist_", "world": "world_"}
"""Camera as datasets name it → its part of a field's name; the head camera's have none, as in the original."""
PICTURES = ("storage_format", "frame_indices", "rgb_video_path", "rgb_video_fps", "rgb_video_num_frames", "depth")
"""Fields of a camera, as the original names them after `vision_<camera>`."""
OWN_PICTURES = ("size", "codec", "histogram", "looks")
"""Our own fields of a camera, after `arena_vision_<camera>`."""
MAX_ROWS = 10_000
"""Rows of an episode: the original's cap."""
_STEM = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,200}")


@dataclass(frozen=True)
class Field:
    """One array of the file."""

    name: str
    shape: str
    """Shape as text, such as `T, 29`; T is the number of rows; empty: a single value."""
    kind: str
    """NumPy type."""
    sentence: str


FIELDS = (
    Field("schema_version", "", "text", f"`{SCHEMA_VERSION}`"),
    Field("task", "", "text", "the task's Gym id, as the original spells it"),
    Field("num_frames", "", "int64", "T, the number of rows"),
    Field(
        "robot_qpos_before_decimation",
        "T, 29",
        "float32",
        "joint positions [rad], TWIST2 order with every tracker",
    ),
    Field("robot_qvel_before_decimation", "T, 29", "float32", "joint velocities [rad/s], the same order"),
    Field("robot_root_position", "T, 3", "float32", "root in the world [m]"),
    Field("robot_root_orientation", "T, 4", "float32", "root in the world, wxyz"),
    Field("robot_root_lin_vel_world", "T, 3", "float32", "[m/s]"),
    Field("robot_root_lin_vel_local", "T, 3", "float32", "[m/s], frame of the root"),
    Field("robot_root_ang_vel_world", "T, 3", "float32", "[rad/s]"),
    Field("robot_root_ang_vel_local", "T, 3", "float32", "[rad/s], frame of the root"),
    Field("robot_action_mimic", "T, 35", "float32", "mimic command that was executed"),
    Field("robot_twist2_inference_qpos", "T, 29", "float32", "joint targets [rad], TWIST2 order; of tracker twist2"),
    Field("final_body_action_29dof", "T, 29", "float32", "joint targets [rad], TWIST2 order too; of other trackers"),
    Field("human_body_pos", "T, 3", "float32", "root of the reference that was executed, in the world [m]"),
    Field("human_body_quat_w", "T, 4", "float32", "its orientation, wxyz"),
    Field("human_joint_pos", "T, 29", "float32", "its joints [rad], canonical order"),
    Field("pico_left_grip_binary", "T", "bool", "the left hand is to be closed"),
    Field("pico_right_grip_binary", "T", "bool", "the right hand is to be closed"),
    Field("vla_state", "T, 64", "float32", "canonical state, but the orientation is in the world"),
    Field("system_control_frequency", "T", "float64", "ticks per second"),
    Field("system_decimation", "T", "int64", "physics steps of a tick"),
    Field("system_physics_dt", "T", "float64", "physics step [s]"),
    Field("system_timestamp", "T", "float64", "simulated time since step 0 [s]"),
    Field("env_obj_<object>_position", "T, 3", "float32", "[m]"),
    Field("env_obj_<object>_orientation", "T, 4", "float32", "wxyz"),
    Field("env_obj_<object>_linear_velocity", "T, 3", "float32", "[m/s], world; zero for fixtures"),
    Field("env_obj_<object>_angular_velocity", "T, 3", "float32", "[rad/s], world; zero for fixtures"),
    Field("episode_init_env_obj_<object>_position", "3", "float32", "as it was placed at the reset [m]"),
    Field("episode_init_env_obj_<object>_orientation", "4", "float32", "as it was placed at the reset, wxyz"),
    Field("episode_init_env_obj_<object>_linear_velocity", "3", "float32", "at the reset [m/s], world; zero: it rests"),
    Field("episode_init_env_obj_<object>_angular_velocity", "3", "float32", "at the reset [rad/s], world; zero"),
    Field("episode_object_seed", "", "uint64", "master seed of the objects"),
    Field("episode_object_seed_source", "", "text", "how it was made"),
    Field("vision_<camera>storage_format", "", "text", "`video_v1`"),
    Field("vision_<camera>frame_indices", "T", "int64", "frame of each row: 0 to T - 1"),
    Field("vision_<camera>rgb_video_path", "", "text", "MP4, relative to the file's folder"),
    Field("vision_<camera>rgb_video_fps", "", "float64", "frames per second"),
    Field("vision_<camera>rgb_video_num_frames", "", "int64", "T"),
    Field("vision_<camera>depth", "T, H, W", "float16", "distance along the ray [m], 0 where nothing is met; optional"),
    Field("arena_vision_<camera>size", "2", "int64", "width and height [px]"),
    Field("arena_vision_<camera>codec", "", "text", "JSON: codec and its options, as used"),
    Field("arena_vision_<camera>histogram", "3, 256", "int64", "pixels of all frames by channel and value, unencoded"),
    Field(
        "arena_vision_<camera>looks",
        "",
        "text",
        "JSON: stride, second lights and shapes of the film of looks; else absent",
    ),
    Field("arena_state", "T, 64", "float32", "canonical state as a policy sees it"),
    Field("arena_action", "T, 40", "float32", "canonical action v3.1 that was decided: the label"),
    Field("arena_executed_action", "T, 40", "float32", "what was executed: the label and the disturbance"),
    Field("arena_qpos", "T, nq", "float32", "all positions of the world, MuJoCo layout"),
    Field("arena_qvel", "T, nv", "float32", "all velocities of the world, MuJoCo layout"),
    Field("arena_final_qpos", "nq", "float32", "positions after the last tick"),
    Field("arena_initial_heading", "", "float32", "yaw that the state's and the action's orientation leave out [rad]"),
    Field("arena_phase", "T", "int16", "index of the policy's phase, -1 where it names none"),
    Field("arena_phase_names", "n", "text", "phases in the order of their first appearance"),
    Field("arena_task", "", "text", "task"),
    Field("arena_instruction", "", "text", "natural language"),
    Field("arena_tracker", "", "text", "tracker"),
    Field("arena_policy", "", "text", "policy"),
    Field("arena_mode", "", "text", "the test mode, as of `--mode`"),
    Field("arena_rules", "", "text", "rule set"),
    Field("arena_seed_range", "", "text", "evaluation, demonstration or teleoperation"),
    Field("arena_group_seed", "", "int64", "number of the series"),
    Field("arena_repeat", "", "int64", "number in the series"),
    Field("arena_episode_seed", "", "uint64", "everything random about the episode follows from it"),
    Field("arena_outcome", "", "text", "success, fall or timeout"),
    Field("arena_reason", "", "text", "finer cause"),
    Field("arena_margin", "", "float64", "signed distance to success at the end"),
    Field("rerecord_any_success", "", "bool", "the task succeeded while the episode was played again for its pictures"),
    Field("rerecord_final_reward", "", "float64", "1 where its last tick then was a success, otherwise 0"),
    Field("rerecord_max_reward", "", "float64", "1 where any of its ticks then was a success, otherwise 0"),
    Field("arena_configuration", "", "text", "JSON: what the run depends on, hashes included"),
    Field("arena_cleaned", "", "text", "JSON: rows that `data clean` dropped, by rule, and their source; else absent"),
    Field("arena_source_rows", "T", "int64", "row of the source of each row that `data clean` left; else absent"),
)
"""All arrays; `<object>` is an object's name in the original's records, `<camera>` a part of `CAMERAS`."""


def fields_table() -> str:
    """`FIELDS` as a Markdown table."""
    rows = [(f"`{f.name}`", f.kind, f.shape or "one value", f.sentence) for f in FIELDS]
    return "\n".join(Table(("field", "type", "shape", "what"), rows).compact()) + "\n"


def vision(camera: str, name: str) -> str:
    """Name of a camera's field: `front`, `rgb_video_path` → `vision_rgb_video_path`."""
    return f"vision_{CAMERAS[camera]}{name}"


def looks_film(video: Path) -> Path:
    """Film of the looks of a camera's MP4."""
    return video.with_name(f"{video.stem.removesuffix('_rgb')}_looks.mp4")


def camera_fields(camera: str) -> frozenset[str]:
    """Names of all fields that a camera may have."""
    own = (f"arena_{vision(camera, name)}" for name in OWN_PICTURES)
    return frozenset([*(vision(camera, name) for name in PICTURES), *own])


def write_episode(path: Path, arrays: Mapping[str, np.ndarray], *, sync: bool = True) -> None:
    """Write the file, whole or not at all; equal arrays give equal bytes.

    Args:
        path: `<stem>.npz`.
        arrays: Fields by name.
        sync: Wait until it is on the disk.

    Raises:
        OSError: It cannot be written; the error carries its name.
    """
    with replace_atomically(path, sync=sync) as file:
        # Not np.savez: its compression level and dates are not promised.
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as archive:
            for name, array in arrays.items():
                member = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                member.compress_type = zipfile.ZIP_DEFLATED
                member.file_size = array.nbytes + limits.HEADER_BYTES  # decides on the form of the member's header
                with archive.open(member, "w") as content:
                    np.lib.format.write_array(content, np.asanyarray(array, order="C"), allow_pickle=False)


def episode_files(folders: Iterable[str | Path]) -> list[Path]:
    """Episode files of folders, each a results folder (`episodes/` in it) or a folder of files, or single files.

    Sorted within each folder by name; the plan's order is in the files (`EpisodeFile.order`).

    Raises:
        InputError: A folder is absent or holds none.
    """
    found: list[Path] = []
    for folder in map(Path, folders):
        if folder.is_file() and folder.suffix == ".npz":
            found.append(folder)
            continue
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder or .npz file")
        own = folder / "episodes" if (folder / "episodes").is_dir() else folder
        files = sorted(file for file in own.glob("*.npz") if not file.name.endswith("_temp.npz"))
        if not files:
            raise InputError(f"{folder}: holds no episodes (.npz); eval record writes them")
        found += files
    return found


class EpisodeFile:
    """An episode that was recorded; arrays are read when they are asked for."""

    def __init__(self, path: str | Path):
        """Open and check the file: version, rows, numbers; pictures are not decoded.

        Raises:
            InputError: It is absent, damaged or not such a file; the message names the field.
        """
        self.path = Path(path)
        check_size(self.path, 64 * limits.ARRAY_BYTES)
        try:
            with zipfile.ZipFile(self.path) as archive:
                self.names = tuple(name.removesuffix(".npy") for name in archive.namelist()[: limits.ARCHIVE_MEMBERS])
        except Exception as error:
            raise InputError(f"{self.path}: not a readable NPZ file ({type(error).__name__})") from error
        self._arrays: dict[str, np.ndarray] = {}
        version = self.text("schema_version")
        if version != SCHEMA_VERSION:
            raise InputError(f"{self.path}: schema_version is {version[:80]!r}, expected {SCHEMA_VERSION}")
        self.rows = self.integer("num_frames")
        if not 1 <= self.rows <= MAX_ROWS:
            raise InputError(f"{self.path}: num_frames is {self.rows}, expected 1 to {MAX_ROWS}")

    def __contains__(self, name: str) -> bool:
        """True if the file has that array."""
        return name in self.names

    def load(self, names: Iterable[str]) -> None:
        """Read several arrays at once."""
        missing = [name for name in names if name not in self._arrays]
        for name in missing:
            if name not in self.names:
                raise InputError(f"{self.path}: {name} is missing")
        read = read_arrays(self.path, missing)
        self._arrays |= {name: read[name] for name in missing}

    def array(self, name: str, *shape: int) -> np.ndarray:
        """An array as it is stored; with a shape it must be finite numbers of that shape (-1: any length).

        Raises:
            InputError: It is missing or unfit.
        """
        self.load([name])
        array = self._arrays[name]
        if not shape:
            return array
        fits = array.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits:
            raise InputError(f"{self.path}: {name} has shape {list(array.shape)}, expected {list(shape)}")
        if not np.isfinite(numbers(array, f"{self.path}: {name}", np.float64)).all():
            raise InputError(f"{self.path}: {name} holds a number that is not finite")
        return array

    def text(self, name: str) -> str:
        """A field that is one text.

        Raises:
            InputError: It is missing or no text.
        """
        array = self.array(name)
        if array.ndim or array.dtype.kind != "U":
            raise InputError(f"{self.path}: {name} is no text")
        return str(array)

    def integer(self, name: str) -> int:
        """A field that is one integer.

        Raises:
            InputError: It is missing or no integer.
        """
        array = self.array(name)
        if array.ndim or array.dtype.kind not in "iu":
            raise InputError(f"{self.path}: {name} is no integer")
        return int(array)

    def json(self, name: str) -> dict[str, object]:
        """A field that is a JSON object as text.

        Raises:
            InputError: It is missing or no JSON object.
        """
        try:
            value = json.loads(self.text(name))
        except (ValueError, RecursionError):
            value = None
        if not isinstance(value, dict):
            raise InputError(f"{self.path}: {name} is no JSON object")
        return value

    @property
    def stem(self) -> str:
        """File name without ending."""
        return self.path.stem

    @cached_property
    def state(self) -> np.ndarray:
        """Canonical state, float32, shape [T, 64]."""
        return self.array("arena_state", self.rows, STATE_WIDTH).astype(np.float32, copy=False)

    @cached_property
    def action(self) -> np.ndarray:
        """Canonical action v3.1, the label, float32, shape [T, 40]."""
        return self.array("arena_action", self.rows, ACTION_WIDTH).astype(np.float32, copy=False)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that it has videos of."""
        return tuple(camera for camera in CAMERAS if vision(camera, "rgb_video_path") in self.names)

    def video(self, camera: str) -> Path:
        """The camera's MP4, which is in the folder `videos` next to the file.

        Raises:
            InputError: The field names another folder, or the file is absent.
        """
        name = vision(camera, "rgb_video_path")
        given = Path(self.text(name))
        if given.parent != Path(VIDEO_FOLDER) or not _STEM.fullmatch(given.name):
            raise InputError(f"{self.path}: {name} is {str(given)[:120]!r}, expected a file in {VIDEO_FOLDER}/")
        video = self.path.parent / given
        if not video.is_file() or video.is_symlink():
            raise InputError(f"{self.path}: {name}: {video} is missing")
        return video

    def looks(self, camera: str) -> tuple[Looks, Path] | None:
        """Looks of a camera's pictures and their film; None where none were recorded.

        Raises:
            InputError: The field is damaged, or the film is absent.
        """
        name = f"arena_{vision(camera, 'looks')}"
        if name not in self.names:
            return None
        film = looks_film(self.video(camera))
        if not film.is_file() or film.is_symlink():
            raise InputError(f"{self.path}: {name}: {film} is missing")
        return Looks.read(self.json(name), f"{self.path}: {name}"), film

    @property
    def phases(self) -> list[str]:
        """Name of the phase of each row; empty text where none is named."""
        names = [str(name) for name in self.array("arena_phase_names")]
        index = self.array("arena_phase", self.rows)
        if len(index) and not (-1 <= index.min() and index.max() < len(names)):
            raise InputError(f"{self.path}: arena_phase names phase {index.max()}, there are {len(names)}")
        return [names[i] if i >= 0 else "" for i in index]

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects whose motion it has."""
        found = (re.fullmatch(r"env_obj_(.+)_position", name) for name in self.names)
        return tuple(match[1] for match in found if match)

    @property
    def order(self) -> tuple[str, str, str, str, int, int]:
        """Sorts episodes as their plans: task, tracker, mode, range of seeds, series, number."""
        words = (self.text(f"arena_{name}") for name in ("task", "tracker", "mode", "seed_range"))
        task, tracker, mode, seeds = words
        return task, tracker, mode, seeds, self.integer("arena_group_seed"), self.integer("arena_repeat")

    def copy_of(self, changes: Mapping[str, np.ndarray], drop: Iterable[str] = ()) -> dict[str, np.ndarray]:
        """All arrays in the file's order, some of them changed, others dropped or added at the end."""
        dropped = set(drop)
        self.load(self.names)
        kept = {name: changes.get(name, self._arrays[name]) for name in self.names if name not in dropped}
        return kept | {name: array for name, array in changes.items() if name not in kept}


def opened(files: Iterable[Path]) -> Iterator[EpisodeFile]:
    """Episodes of files, in the order of their plans."""
    yield from sorted(map(EpisodeFile, files), key=lambda episode: episode.order)
