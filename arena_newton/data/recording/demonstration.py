"""Records demonstrations: one NPZ per episode, and one MP4 per camera with as many frames as the NPZ has rows."""

from __future__ import annotations

import dataclasses
import json
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
import warp as wp

from arena_newton.data.recording.encoder_pool import EncoderPool
from arena_newton.data.recording.encoding import EncoderThreads, Pictured, VideoEncoder, VideoStream
from arena_newton.data.recording.episode import SCHEMA_VERSION, VIDEO_FOLDER, looks_film, vision, write_episode
from arena_newton.data.recording.episode_film import CRF, FilmFacts
from arena_newton.data.recording.image_statistics import VALUES
from arena_newton.data.recording.look_planes import LookPlanes
from arena_newton.errors import ArenaError, InputError
from arena_newton.files.own_files import PARTIAL, file_label
from arena_newton.interfaces import Recorder
from arena_newton.kernels.pictures.histogram import launch_histogram
from arena_newton.pictures.camera import Camera
from arena_newton.pictures.video import key_frames
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, HAND_CLOSED, STATE
from arena_newton.robot.rotations import matrix_from_quat, quat_apply, quat_conjugate
from arena_newton.rules import seeding

if TYPE_CHECKING:
    from arena_newton.data.readers.looks import Looks
    from arena_newton.interfaces import EpisodeResult, Observation, World
    from arena_newton.pictures.settings import CameraConfig

__all__ = ["DemonstrationRecorder", "RecordedEpisode", "SavedEpisode", "episode_label"]

FPS = round(1 / g1.TICK)
"""Frames per second: one a tick."""
LOOKS = "looks"
"""Name of the film of looks among those of the cameras; it is of the head camera's pictures."""
WAITING_EPISODES = 8
"""Ended episodes whose files are not written yet, beside one per world: more of them wait for the disk."""


class RecordedEpisode(Protocol):
    """Attributes that a planned episode needs so that its file can name its origin."""

    @property
    def index(self) -> int:
        """Number in the plan."""

    @property
    def task(self) -> str:
        """Task."""

    @property
    def tracker(self) -> str:
        """Tracker."""

    @property
    def policy(self) -> str:
        """Policy."""

    @property
    def mode(self) -> str:
        """Mode."""

    @property
    def rules(self) -> str:
        """Rule set."""

    @property
    def group_seed(self) -> int:
        """Group seed, or number of the series."""

    @property
    def repeat(self) -> int:
        """Number in the series."""

    @property
    def episode_seed(self) -> int:
        """Everything random about the episode follows from it."""

    @property
    def object_seed(self) -> int:
        """Master seed of the objects."""


def episode_label(episode: RecordedEpisode) -> str:
    """File stem of an episode."""
    parts = episode.task, file_label(episode.tracker), episode.mode
    return "__".join([*parts, f"seed{episode.group_seed}", f"repeat{episode.repeat:04d}"])


@dataclass
class _Stream:
    """Recorded arrays of one world's episode."""

    episode: RecordedEpisode
    worker: int
    """Whoever makes its films."""
    initial: dict[str, np.ndarray]
    """Fields of the reset."""
    videos: dict[str, VideoStream]
    """Its films by camera, and that of its looks."""
    looks: Looks | None = None
    heading: float = 0.0
    histograms: dict[str, np.ndarray] = field(default_factory=dict)
    """Pixels of the pictures of each camera by channel and value, int64, shape [3, 256]; when it has ended."""
    rows: list[np.ndarray] = field(default_factory=list)
    """Packed rows: the beginning of a tick, then what was executed in it."""


@dataclass(frozen=True)
class SavedEpisode:
    """An episode that ended, and whose files are on the disk."""

    result: EpisodeResult
    files: Mapping[str, Path]
    """`episode`, the NPZ, and the MP4 of each camera, by its name; empty where nothing was to be kept."""


class DemonstrationRecorder(Recorder):
    """Records the worlds of an `ArenaEnv` while a `rollout.Rollout` plays; close it after use."""

    wants_observation = True

    def __init__(
        self,
        folder: str | Path,
        *,
        cameras: Mapping[str, CameraConfig] | None = None,
        depth: bool = False,
        looks: int = 0,
        seeds: str | None = None,
        only_success: bool = False,
        facts: Mapping[str, object] | None = None,
        threads: int = 0,
        processes: int = 0,
        finishing: Callable[[RecordedEpisode, EpisodeResult, dict[str, np.ndarray]], dict[str, np.ndarray]]
        | None = None,
    ):
        """Set up the recorder.

        Args:
            folder: Where `<label>.npz` and `videos/` are written.
            cameras: Camera as datasets name it (`episode.CAMERAS`) → its picture; none: states and actions only.
            depth: Record the depth of each picture too, float16 [m].
            looks: Second lights of an episode (`readers.looks`), with the camera `front`; 0: no looks.
            seeds: Range of the seeds, where the seed itself does not tell (`seeding.TELEOPERATION`).
            facts: What the run depends on, as JSON; it must not name times, folders or numbers of worlds.
            threads: Threads that encode and write. Without any, an episode's files are there when it has ended;
                with threads, when `saved` names it.
            processes: Processes that encode instead of the threads, which then only write the NPZ files. They start
                with the first episode, where there are cameras.
            finishing: Makes the arrays that are written from those that were recorded.
        """
        self.folder, self.cameras, self.depth = Path(folder), dict(cameras or {}), depth
        self.looks = looks
        if looks and "front" not in self.cameras:
            raise InputError("looks: are those of the camera front, which is not recorded")
        self._planes: LookPlanes | None = None
        self.seeds, self.only_success, self.finishing = seeds, only_success, finishing
        self.facts = json.dumps(dict(facts or {}), sort_keys=True)
        self._env: World | None = None
        self._views: dict[str, Camera] = {}
        self._shared: set[str] = set()
        """Cameras whose pictures the policy sees too."""
        self._streams: dict[int, _Stream] = {}
        self._acting: list[int] = []
        self._videos: dict[str, list[VideoStream]] = {}
        """The films of the worlds that act, by camera."""
        self._chosen: torch.Tensor | None = None
        """The worlds that act, where not all do."""
        self._histograms: dict[str, wp.array] = {}
        """Pixels of each world's pictures by camera, int64, shape [worlds, 3, 256]."""
        self._before: torch.Tensor | None = None
        self._encoder: VideoEncoder = (
            EncoderPool(processes, threads) if processes and self.cameras else EncoderThreads(threads)
        )
        self._saved: deque[SavedEpisode] = deque()
        self._ended = 0

    def file(self, episode: RecordedEpisode) -> Path:
        """The NPZ of an episode."""
        return self.folder / f"{episode_label(episode)}.npz"

    def _bind(self, env: World) -> None:
        """Cameras and packed rows of an environment."""
        if self._env is env:
            return
        self._discard()
        self._env = env
        self._described = env.describe()
        same = {name for name, config in self.cameras.items() if env.camera_configs.get(name) == config}
        # Surfaces of worlds that a second render of a tick leaves out are not kept: then the cameras are two.
        self._shared = set() if self.depth or self.looks else same
        self._views = {name: self._view(env, name, config) for name, config in self.cameras.items()}
        with wp.ScopedDevice(env.scene.device):
            self._counted = wp.zeros(env.worlds, dtype=wp.bool)
            self._histograms = {name: wp.zeros((env.worlds, 3, VALUES), dtype=wp.int64) for name in self._views}
        pictured = {name: Pictured(env.worlds, c.height, c.width, self.depth) for name, c in self._views.items()}
        if self.looks:
            self._planes = LookPlanes(env, self._views["front"], self.looks)
            pictured[LOOKS] = dataclasses.replace(pictured["front"], depth=False)
        self._encoder.bind(pictured, torch.device(env.torch_device))
        scene = env.scene
        self._bodies = {}
        for placed in env.spec.objects:
            prim = placed.prim if scene.has_body(placed.prim) else f"{placed.prim}/Frame"
            self._bodies[placed.record] = scene.body_id(prim)
        model = scene.mj_model
        self._free = {
            name: int(model.jnt_dofadr[model.body_jntadr[body]])
            for name, body in self._bodies.items()
            if model.body_jntnum[body] == 1 and model.jnt_type[model.body_jntadr[body]] == 0
        }
        physics, reference = env.physics, env.loop.reference
        view = wp.to_torch
        self._xpos, self._xquat = view(physics.xpos), view(physics.xquat)
        self._qpos = view(physics.qpos)
        self._live = self._qpos, view(physics.qvel)
        self._after = (
            env.loop.action,
            view(reference.mimic),
            env.loop.targets,
            view(reference.position),
            view(reference.quat),
            view(reference.joints),
        )
        self._heading = view(reference.heading)
        self._object_rows = torch.tensor(list(self._bodies.values()), dtype=torch.long, device=env.torch_device)

    def _view(self, env: World, name: str, config: CameraConfig) -> Camera:
        return env.cameras[name] if name in self._shared else Camera.of_config(env.scene, config, env.lights)

    def start(self, env: World, world: int, episode: RecordedEpisode) -> None:
        """An episode without rows yet."""
        self._bind(env)
        for histogram in self._histograms.values():
            wp.to_torch(histogram)[world] = 0
        initial = {}
        for name, body in self._bodies.items():
            initial[f"episode_init_env_obj_{name}_position"] = self._xpos[world, body].cpu().numpy().copy()
            initial[f"episode_init_env_obj_{name}_orientation"] = self._xquat[world, body].cpu().numpy().copy()
            # A reset puts things down at rest.
            for motion in ("linear", "angular"):
                initial[f"episode_init_env_obj_{name}_{motion}_velocity"] = np.zeros(3, np.float32)
        label, worker = episode_label(episode), self._encoder.join()
        videos = {}
        for name in self.cameras:
            video = self.folder / VIDEO_FOLDER / f"{label}_{name}_rgb.mp4"
            depth = self.folder / f"{label}_{name}_depth.raw{PARTIAL}"
            videos[name] = self._encoder.open(worker, video, depth, FPS)
        looks = None
        if self._planes is not None:
            looks = self._planes.begin(world, episode.episode_seed)
            film = looks_film(videos["front"].video)
            videos[LOOKS] = self._encoder.open(worker, film, film, FPS / looks.stride, lossless=True)
        self._streams[world] = _Stream(episode, worker, initial, videos, looks)
        self._videos = {}

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Keep state, label and pictures of the worlds that act.

        Raises:
            OSError: A file could not be written, which the error names, or a process that encodes ended.
        """
        self._encoder.check()
        mask = env.active & (env.tick >= 0)
        self._act([world for world in np.flatnonzero(mask).tolist() if world in self._streams])
        if not self._acting or observation is None:
            return
        worlds = env.worlds
        objects = self._xpos[:, self._object_rows].reshape(worlds, -1), self._xquat[:, self._object_rows]
        parts = (observation.state, action, *self._live, objects[0], objects[1].reshape(worlds, -1))
        self._before = torch.cat([part.float() for part in parts], dim=1)
        self._widths = [part.shape[1] for part in (*parts, *self._after)]
        for world in self._acting:
            stream = self._streams[world]
            if not stream.rows:
                stream.heading = float(self._heading[world])
        for name, camera in self._views.items():
            self._film(env, name, camera, mask, observation)
            if name == "front" and self._planes is not None:
                self._film_looks(self._planes)

    def _act(self, worlds: list[int]) -> None:
        """Set the worlds that act in this tick; the choice of films follows only where it changes."""
        if worlds == self._acting and self._videos:
            return
        self._acting = worlds
        self._videos = {name: [self._streams[world].videos[name] for world in worlds] for name in self.cameras}
        self._chosen = None
        if self.cameras:
            acting: np.ndarray = np.zeros(self._counted.shape, bool)
            acting[worlds] = True
            self._counted.assign(acting)

    def _film(self, env: World, name: str, camera: Camera, mask: np.ndarray, observation: Observation) -> None:
        """Render a camera and hand the pictures to whoever makes the films."""
        missing = mask
        if name in self._shared and name in observation.images:  # what the policy saw is rendered once
            missing = mask & ~observation.mask
        if missing.any():
            env.render(camera, missing)
        launch_histogram(camera.image, self._counted, self._histograms[name])
        pictures = self._taken(wp.to_torch(camera.image))
        depths = self._taken(camera.distance_picture()).half() if self.depth else None
        self._encoder.add(name, self._videos[name], pictures, depths)

    def _film_looks(self, planes: LookPlanes) -> None:
        """Hand over the looks of the pictures that the head camera has just rendered, where a frame is due."""
        streams = {world: self._streams[world] for world in self._acting}
        due = [w for w, stream in streams.items() if stream.looks and not len(stream.rows) % stream.looks.stride]
        if due:
            self._encoder.add(LOOKS, [streams[world].videos[LOOKS] for world in due], planes.frames(due), None)

    def _taken(self, pictures: torch.Tensor) -> torch.Tensor:
        """Pictures of the worlds that act."""
        if len(self._acting) == len(pictures):
            return pictures
        if self._chosen is None:
            self._chosen = torch.tensor(self._acting, device=pictures.device)
        return pictures[self._chosen]

    def tick(self, env: World) -> None:
        """Keep what was executed.

        Raises:
            OSError: As `before_physics`.
        """
        if not self._acting or self._before is None:
            return
        rows = torch.cat([self._before, *(part.float() for part in self._after)], dim=1).cpu().numpy()
        for world in self._acting:
            self._streams[world].rows.append(rows[world].copy())
        self._before = None
        self._encoder.check()  # the GPU has done what it was asked for: the pictures are there

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Write the episode; one that ended as an error, or before its first action, leaves nothing.

        Raises:
            OSError: A file cannot be written; the error carries its name.
        """
        stream = self._streams.pop(world, None)
        if stream is None:
            return
        self._ended += 1
        self._videos = {}
        wanted = result.outcome == "success" or (not self.only_success and result.outcome != "error")
        if wanted and stream.rows:
            last = self._qpos[world].cpu().numpy().copy()
            counts = {name: wp.to_torch(histogram)[world] for name, histogram in self._histograms.items()}
            stream.histograms = {name: count.cpu().numpy().copy() for name, count in counts.items()}
            fields = partial(self._fields, env, stream, result, last, self._described)
            self._encoder.finish(stream.worker, stream.videos, partial(self._save, stream, result, fields))
        else:
            dropped = partial(self._saved.append, SavedEpisode(result, {}))
            self._encoder.discard(stream.worker, stream.videos, dropped)
        self._encoder.leave(stream.worker)
        self._encoder.check()
        if self._ended - len(self._saved) > env.worlds + WAITING_EPISODES:
            self._encoder.wait()

    def _save(
        self,
        stream: _Stream,
        result: EpisodeResult,
        fields: Callable[[Mapping[str, FilmFacts | None]], dict[str, np.ndarray]],
        films: Mapping[str, FilmFacts | None] | None,
    ) -> None:
        """Write the file of an episode whose films are finished, in any thread; one with a broken film has none."""
        if films is None:
            return
        path = self.file(stream.episode)
        made = {name: facts for name, facts in films.items() if facts is not None}
        try:
            write_episode(path, fields(films))
        except BaseException:
            for name in made:
                stream.videos[name].video.unlink(missing_ok=True)
            raise
        finally:
            for name, facts in made.items():
                if facts.depth_shape:
                    stream.videos[name].depth.unlink(missing_ok=True)
        files = {name: stream.videos[name].video for name in made}
        self._saved.append(SavedEpisode(result, {"episode": path} | files))

    def saved(self, *, wait: bool = False) -> list[SavedEpisode]:
        """Episodes whose files were completed since the last call.

        Args:
            wait: Until all that ended are written.
        """
        if wait:
            self._encoder.wait()
        found = [self._saved.popleft() for _ in range(len(self._saved))]
        self._ended -= len(found)
        return found

    def check(self) -> None:
        """Raise what went wrong in a thread or process.

        Raises:
            OSError: A file could not be written, which the error names, or a process that encodes ended.
        """
        self._encoder.check()

    def _fields(
        self,
        env: World,
        stream: _Stream,
        result: EpisodeResult,
        last: np.ndarray,
        facts: Mapping[str, object],
        films: Mapping[str, FilmFacts | None],
    ) -> dict[str, np.ndarray]:
        """All arrays of an episode, in the order of `episode.FIELDS`; in its thread, so nothing that moves is read."""
        episode, rows = stream.episode, len(stream.rows)
        before, after = (parts := _split(stream.rows, self._widths))[:-6], parts[-6:]
        state, action, qpos, qvel, positions, quats = before
        executed, mimic, targets, position, quat, joints = after
        robot = env.scene.robot
        root = slice(robot.root_qpos + 3, robot.root_qpos + 7)
        linear = qvel[:, robot.root_qvel : robot.root_qvel + 3]
        angular = qvel[:, robot.root_qvel + 3 : robot.root_qvel + 6]
        hands = action[:, ACTION["hands"]] >= HAND_CLOSED
        turned = torch.from_numpy(qpos[:, root])
        names = [name for name, _ in dict.fromkeys((name, None) for name, _ in result.phases)]
        phase = np.full(rows, -1, np.int16)
        for name, tick in result.phases:
            phase[tick:] = names.index(name)
        raw_state = state.copy()
        raw_state[:, STATE["root_rot6d"]] = matrix_from_quat(turned)[:, :, :2].reshape(rows, 6).numpy()
        fields: dict[str, np.ndarray | np.generic] = {
            "schema_version": np.str_(SCHEMA_VERSION),
            "task": np.str_(env.spec.gym_id),
            "num_frames": np.int64(rows),
            "robot_qpos_before_decimation": qpos[:, robot.joint_qpos],
            "robot_qvel_before_decimation": qvel[:, robot.joint_qvel],
            "robot_root_position": qpos[:, robot.root_qpos : robot.root_qpos + 3],
            "robot_root_orientation": qpos[:, root],
            "robot_root_lin_vel_world": linear,
            "robot_root_lin_vel_local": _turned(quat_conjugate(turned), linear),
            "robot_root_ang_vel_world": _turned(turned, angular),
            "robot_root_ang_vel_local": angular,
            "robot_action_mimic": mimic,
            "robot_twist2_inference_qpos" if env.tracker.name == "twist2" else "final_body_action_29dof": targets,
            "human_body_pos": position,
            "human_body_quat_w": quat,
            "human_joint_pos": joints,
            "pico_left_grip_binary": hands[:, 0],
            "pico_right_grip_binary": hands[:, 1],
            "vla_state": raw_state,
            "system_control_frequency": np.full(rows, FPS, np.float64),
            "system_decimation": np.full(rows, int(str(facts["substeps"])), np.int64),
            "system_physics_dt": np.full(rows, float(str(facts["physics_dt"])), np.float64),
            "system_timestamp": np.arange(rows) * g1.TICK,
        }
        for number, name in enumerate(self._bodies):
            where = slice(4 * number, 4 * number + 4)
            fields[f"env_obj_{name}_position"] = positions[:, 3 * number : 3 * number + 3]
            fields[f"env_obj_{name}_orientation"] = quats[:, where]
            moved = np.zeros((2, rows, 3), np.float32)
            if name in self._free:
                first = self._free[name]
                moved[0] = qvel[:, first : first + 3]
                moved[1] = _turned(torch.from_numpy(quats[:, where]), qvel[:, first + 3 : first + 6])
            fields[f"env_obj_{name}_linear_velocity"], fields[f"env_obj_{name}_angular_velocity"] = moved
        fields |= stream.initial
        fields["episode_object_seed"] = np.uint64(episode.object_seed)
        fields["episode_object_seed_source"] = np.str_("arena_episode_seed")
        looks = stream.looks
        if looks is not None and (made := films.get(LOOKS)):
            _check_frames(stream.videos[LOOKS], made, looks.frames(rows))
            fields[f"arena_{vision('front', 'looks')}"] = np.str_(json.dumps(looks.plain()))
        for name in self.cameras:
            if (film := films[name]) is not None:
                fields |= _film_fields(name, stream, film, rows)
        fields |= {
            "arena_state": state,
            "arena_action": action,
            "arena_executed_action": executed,
            "arena_qpos": qpos,
            "arena_qvel": qvel,
            "arena_final_qpos": last,
            "arena_initial_heading": np.float32(stream.heading),
            "arena_phase": phase,
            "arena_phase_names": np.array(names, dtype=np.str_),
            "arena_task": np.str_(episode.task),
            "arena_instruction": np.str_(env.spec.instruction),
            "arena_tracker": np.str_(episode.tracker),
            "arena_policy": np.str_(episode.policy),
            "arena_mode": np.str_(episode.mode),
            "arena_rules": np.str_(episode.rules),
            "arena_seed_range": np.str_(self.seeds or seeding.seed_range(episode.episode_seed)),
            "arena_group_seed": np.int64(episode.group_seed),
            "arena_repeat": np.int64(episode.repeat),
            "arena_episode_seed": np.uint64(episode.episode_seed),
            "arena_outcome": np.str_(result.outcome),
            "arena_reason": np.str_(result.reason),
            "arena_margin": np.float64(result.margin),
            "arena_configuration": np.str_(self.facts),
        }
        arrays = {name: np.asanyarray(value) for name, value in fields.items()}
        return arrays if self.finishing is None else self.finishing(episode, result, arrays)

    def close(self) -> None:
        """Drop what is unfinished; no partial file stays."""
        self._discard()
        self._encoder.close()
        self._env, self._views, self._planes = None, {}, None

    def _discard(self) -> None:
        self._encoder.wait()
        for stream in self._streams.values():
            self._encoder.discard(stream.worker, stream.videos, lambda: None)
            self._encoder.leave(stream.worker)
        self._encoder.wait()
        self._streams, self._acting, self._videos, self._before = {}, [], {}, None

    def __enter__(self) -> DemonstrationRecorder:
        """The recorder itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Drop what is unfinished."""
        self.close()


def _film_fields(name: str, stream: _Stream, film: FilmFacts, rows: int) -> dict[str, np.ndarray | np.generic]:
    """Fields of a camera's film in the file.

    Raises:
        ArenaError: The film has another number of pictures.
    """
    video = stream.videos[name]
    _check_frames(video, film, rows)
    codec = {"vcodec": "h264", "g": key_frames(film.height), "crf": CRF, "preset": "veryfast", "bf": 0, "mbtree": 0}
    found: dict[str, np.ndarray | np.generic] = {
        vision(name, "storage_format"): np.str_("video_v1"),
        vision(name, "frame_indices"): np.arange(rows),
        vision(name, "rgb_video_path"): np.str_(f"{VIDEO_FOLDER}/{video.video.name}"),
        vision(name, "rgb_video_fps"): np.float64(FPS),
        vision(name, "rgb_video_num_frames"): np.int64(film.frames),
    }
    if film.depth_shape:
        shape = (rows, *film.depth_shape)
        found[vision(name, "depth")] = np.memmap(video.depth, np.float16, "r", shape=shape)
    return found | {
        f"arena_{vision(name, 'size')}": np.array([film.width, film.height]),
        f"arena_{vision(name, 'codec')}": np.str_(json.dumps(codec)),
        f"arena_{vision(name, 'histogram')}": stream.histograms[name],
    }


def _check_frames(stream: VideoStream, film: FilmFacts, frames: int) -> None:
    if film.frames != frames:
        raise ArenaError(f"{stream.video}: {film.frames} frames instead of {frames}")


def _split(rows: Sequence[np.ndarray], widths: Sequence[int]) -> list[np.ndarray]:
    """Packed rows as one array per part, shape [T, width]."""
    return [np.ascontiguousarray(part) for part in np.split(np.stack(rows), np.cumsum(widths)[:-1], axis=1)]


def _turned(quat: torch.Tensor, vector: np.ndarray) -> np.ndarray:
    """Vectors [T, 3] turned by quaternions wxyz [T, 4], float32."""
    turned: np.ndarray = quat_apply(quat, torch.from_numpy(np.ascontiguousarray(vector))).numpy()
    return turned
