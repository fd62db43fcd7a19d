"""Records demonstrations: one NPZ per episode, and one MP4 per camera with as many frames as the NPZ has rows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
import warp as wp

from arena_newton import robot as g1
from arena_newton import seeding
from arena_newton.canonical import ACTION, HAND_CLOSED, STATE
from arena_newton.data.episode import SCHEMA_VERSION, VIDEO_FOLDER, vision, write_episode
from arena_newton.data.image_statistics import VALUES, add_picture
from arena_newton.files import file_label
from arena_newton.interfaces import Recorder
from arena_newton.pictures.camera import Camera
from arena_newton.pictures.video import VideoWriter
from arena_newton.rotations import matrix_from_quat, quat_apply, quat_conjugate

if TYPE_CHECKING:
    from arena_newton.interfaces import EpisodeResult, Observation, World
    from arena_newton.pictures.settings import CameraConfig

__all__ = ["DemonstrationRecorder", "RecordedEpisode", "episode_label"]

FPS = round(1 / g1.TICK)
"""Frames per second: one a tick."""
SMALL = 256
"""Pictures up to this height [px] have a key frame every `GOP_SMALL` frames, larger ones every `GOP_LARGE`."""
GOP_SMALL, GOP_LARGE = 10, 2
"""Frames from one key frame to the next, between the size of the files and the time to read any one frame."""
CRF = 20
"""Constant rate factor of x264."""


class RecordedEpisode(Protocol):
    """What a planned episode must have so that its file says where it comes from."""

    index: int
    task: str
    tracker: str
    policy: str
    mode: str
    rules: str
    group_seed: int
    repeat: int
    episode_seed: int
    object_seed: int


def episode_label(episode: RecordedEpisode) -> str:
    """File stem of an episode."""
    parts = episode.task, file_label(episode.tracker), episode.mode
    return "__".join([*parts, f"seed{episode.group_seed}", f"repeat{episode.repeat:04d}"])


@dataclass
class _Stream:
    """What is recorded of one world's episode."""

    episode: RecordedEpisode
    label: str
    initial: dict[str, np.ndarray]
    """Fields of the reset."""
    heading: float = 0.0
    before: list[np.ndarray] = field(default_factory=list)
    """Packed rows of the ticks' beginnings."""
    after: list[np.ndarray] = field(default_factory=list)
    """Packed rows of what was executed."""
    writers: dict[str, VideoWriter] = field(default_factory=dict)
    histograms: dict[str, np.ndarray] = field(default_factory=dict)


class DemonstrationRecorder(Recorder):
    """Records the worlds of an `ArenaEnv` while a `rollout.Rollout` plays; close it after use."""

    wants_observation = True

    def __init__(
        self,
        folder: str | Path,
        *,
        cameras: Mapping[str, CameraConfig] | None = None,
        seeds: str | None = None,
        only_success: bool = False,
        facts: Mapping[str, object] | None = None,
    ):
        """Set up the recorder.

        Args:
            folder: Where `<label>.npz` and `videos/` are written.
            cameras: Camera as datasets name it (`episode.CAMERAS`) → its picture; none: states and actions only.
            seeds: Range of the seeds, where the seed itself does not tell (`seeding.TELEOPERATION`).
            only_success: Write successes only.
            facts: What the run depends on, as JSON; it must not name times, folders or numbers of worlds.
        """
        self.folder, self.cameras = Path(folder), dict(cameras or {})
        self.seeds, self.only_success = seeds, only_success
        self.facts = json.dumps(dict(facts or {}), sort_keys=True)
        self._env: World | None = None
        self._views: dict[str, Camera] = {}
        self._streams: dict[int, _Stream] = {}
        self._acting: list[int] = []

    def file(self, episode: RecordedEpisode) -> Path:
        """The NPZ of an episode."""
        return self.folder / f"{episode_label(episode)}.npz"

    def _bind(self, env: World) -> None:
        """Cameras and packed rows of an environment."""
        if self._env is env:
            return
        self._discard()
        self._env = env
        self._views = {
            name: Camera.from_scene(
                env.scene,
                prim=config.prim,
                width=config.width,
                height=config.height,
                fit=config.fit,
                samples=config.samples,
                lights=env.lights,
            )
            for name, config in self.cameras.items()
        }
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
        self._live = view(physics.qpos), view(physics.qvel)
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

    def start(self, env: World, world: int, episode: RecordedEpisode) -> None:
        """An episode without rows yet.

        Raises:
            OSError: A file cannot be written; the error carries its name.
        """
        self._bind(env)
        initial = {}
        for name, body in self._bodies.items():
            initial[f"episode_init_env_obj_{name}_position"] = self._xpos[world, body].cpu().numpy().copy()
            initial[f"episode_init_env_obj_{name}_orientation"] = self._xquat[world, body].cpu().numpy().copy()
        self._streams[world] = _Stream(episode, episode_label(episode), initial)

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Keep state, label and pictures of the worlds that act.

        Raises:
            OSError: A file cannot be written; the error carries its name.
        """
        mask = env.active & (env.tick >= 0)
        self._acting = [world for world in np.flatnonzero(mask).tolist() if world in self._streams]
        if not self._acting or observation is None:
            return
        worlds = env.worlds
        objects = self._xpos[:, self._object_rows].reshape(worlds, -1), self._xquat[:, self._object_rows]
        parts = (observation.state, action, *self._live, objects[0], objects[1].reshape(worlds, -1))
        rows = torch.cat([part.float() for part in parts], dim=1).cpu().numpy()
        self._widths = [part.shape[1] for part in parts]
        for world in self._acting:
            stream = self._streams[world]
            if not stream.before:
                stream.heading = float(self._heading[world])
            stream.before.append(rows[world].copy())
        for name, camera in self._views.items():
            pictures = env.render(camera, mask).cpu().numpy()
            for world in self._acting:
                self._picture(self._streams[world], name, pictures[world])

    def _picture(self, stream: _Stream, name: str, picture: np.ndarray) -> None:
        """Append a frame to a camera's video."""
        height, width = picture.shape[:2]
        if name not in stream.writers:
            path = self.folder / VIDEO_FOLDER / f"{stream.label}_{name}_rgb.mp4"
            stream.writers[name] = VideoWriter(path, width, height, FPS, crf=CRF, gop=_gop(height), b_frames=False)
            stream.histograms[name] = np.zeros((3, VALUES), np.int64)
        stream.writers[name].write(picture)
        add_picture(stream.histograms[name], picture)

    def tick(self, env: World) -> None:
        """Keep what was executed."""
        if not self._acting:
            return
        self._executed = [part.shape[1] for part in self._after]
        rows = torch.cat([part.float() for part in self._after], dim=1).cpu().numpy()
        for world in self._acting:
            self._streams[world].after.append(rows[world].copy())
        self._acting = []

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Write the episode; one that ended as an error, or before its first action, leaves nothing.

        Raises:
            OSError: A file cannot be written; the error carries its name.
        """
        stream = self._streams.pop(world, None)
        if stream is None:
            return
        wanted = result.outcome == "success" or (not self.only_success and result.outcome != "error")
        if not wanted or not stream.before:
            for writer in stream.writers.values():
                writer.discard()
            return
        for writer in stream.writers.values():
            writer.close()
        write_episode(self.file(stream.episode), self._fields(env, world, stream, result))

    def _fields(self, env: World, world: int, stream: _Stream, result: EpisodeResult) -> dict[str, np.ndarray]:
        """All arrays of an episode, in the order of `episode.FIELDS`."""
        episode, rows = stream.episode, len(stream.before)
        state, action, qpos, qvel, positions, quats = _split(stream.before, self._widths)
        executed, mimic, targets, position, quat, joints = _split(stream.after, self._executed)
        robot, physics = env.scene.robot, env.physics
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
        facts = env.describe()
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
            "system_control_frequency": np.float64(FPS),
            "system_decimation": np.int64(facts["substeps"]),
            "system_physics_dt": np.float64(facts["physics_dt"]),
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
        for name, writer in stream.writers.items():
            fields[vision(name, "storage_format")] = np.str_("video_v1")
            fields[vision(name, "frame_indices")] = np.arange(rows)
            fields[vision(name, "rgb_video_path")] = np.str_(f"{VIDEO_FOLDER}/{writer.path.name}")
            fields[vision(name, "rgb_fps")] = np.float64(FPS)
            fields[vision(name, "num_frames")] = np.int64(writer.frames)
            fields[f"arena_{vision(name, 'size')}"] = np.array([writer.width, writer.height])
            codec = {"vcodec": "h264", "g": _gop(writer.height), "crf": CRF, "preset": "veryfast", "bf": 0}
            fields[f"arena_{vision(name, 'codec')}"] = np.str_(json.dumps(codec))
            fields[f"arena_{vision(name, 'histogram')}"] = stream.histograms[name]
        physical = wp.to_torch(physics.qpos)[world].cpu().numpy().copy()
        fields |= {
            "arena_state": state,
            "arena_action": action,
            "arena_executed_action": executed,
            "arena_qpos": qpos,
            "arena_qvel": qvel,
            "arena_final_qpos": physical,
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
            "arena_index": np.int64(episode.index),
            "arena_episode_seed": np.uint64(episode.episode_seed),
            "arena_outcome": np.str_(result.outcome),
            "arena_reason": np.str_(result.reason),
            "arena_margin": np.float64(result.margin),
            "arena_configuration": np.str_(self.facts),
        }
        return {name: np.asarray(value) for name, value in fields.items()}

    def close(self) -> None:
        """Drop what is unfinished; no partial file stays."""
        self._discard()
        self._env, self._views = None, {}

    def _discard(self) -> None:
        for stream in self._streams.values():
            for writer in stream.writers.values():
                writer.discard()
        self._streams, self._acting = {}, []


def _gop(height: int) -> int:
    return GOP_SMALL if height <= SMALL else GOP_LARGE


def _split(rows: Sequence[np.ndarray], widths: Sequence[int]) -> list[np.ndarray]:
    """Packed rows as one array per part, shape [T, width]."""
    return [np.ascontiguousarray(part) for part in np.split(np.stack(rows), np.cumsum(widths)[:-1], axis=1)]


def _turned(quat: torch.Tensor, vector: np.ndarray) -> np.ndarray:
    """Vectors [T, 3] turned by quaternions wxyz [T, 4], float32."""
    turned: np.ndarray = quat_apply(quat, torch.from_numpy(np.ascontiguousarray(vector))).numpy()
    return turned
