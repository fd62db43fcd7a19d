"""Recordings that are made by hand in milliseconds: a robot that strolls, in every field of the schema."""

import json

import numpy as np

from arena_newton import tasks
from arena_newton.data.readers.looks import FIRST_SHAPE, Looks
from arena_newton.data.recording.demonstration import FPS
from arena_newton.data.recording.episode import SCHEMA_VERSION, vision, write_episode
from arena_newton.data.recording.image_statistics import VALUES, add_picture
from arena_newton.pictures.video import VideoWriter
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO
from arena_newton.rules import seeding


def pictures(rows, size, seed):
    """Pictures on which a bar moves by a column each, so that all have one mean, with a coloured corner."""
    found = np.full((rows, size, size, 3), 60, np.uint8)
    for number in range(rows):
        found[number, size // 4 :, (number + np.arange(size // 4)) % size] = 180
    found[:, : size // 4, : size // 4] = np.random.default_rng(seed).integers(60, 180, 3)
    return found


LOOKS = Looks(5, ((900.0,), (4000.0, 0.6, 0.0, -0.8)), (("/World/Room/Floor", 1.0), ("/World/Target/Ball", 0.0)))
"""Looks of made recordings: two lights and shapes."""


def look_frames(count, size, seed):
    """Frames of looks: robot to the left, floor below, a ball to the right, and light ratios about 1."""
    found = np.zeros((count, size, size, 3), np.uint8)
    shown = found[:, size // 8 : -size // 8]
    shown[..., 0] = FIRST_SHAPE
    shown[:, :, : size // 4, 0], shown[:, : size // 4, -size // 4 :, 0] = 1, FIRST_SHAPE + 1
    shown[..., 1:] = np.random.default_rng(seed).integers(120, 137, (*shown.shape[:3], 2))
    return found


def make_episode(
    folder,
    rows=40,
    *,
    task="boxing",
    tracker="twist2",
    repeat=0,
    outcome="success",
    size=32,
    cameras=("front",),
    looks=None,
    **more,
):
    """Write one recording; `more` are arrays that are changed or added, None drops them. Returns the NPZ.

    `looks` describes looks that it gets too.
    """
    rng = np.random.default_rng(repeat)
    spec = tasks.get(task)
    seed = seeding.recording_seed(spec.gym_id, seeding.DEMONSTRATION, 0, repeat)
    stem = f"{task}__{tracker}__base__seed0__repeat{repeat:04d}"
    time = np.arange(rows) / FPS
    action = np.tile(STAND_ACTION, (rows, 1))
    action[:, ACTION["joint_pos"]] += 0.2 * np.sin(3 * time + rng.uniform(0, 6))[:, None].astype(np.float32)
    action[:, ACTION["root_xy_delta"]] = 0.01, 0.001 * repeat
    qpos = np.cumsum(rng.normal(0, 0.004, (rows, 29)), axis=0).astype(np.float32)
    state = np.zeros((rows, 64), np.float32)
    state[:, [0, 3]] = 1.0
    qvel = np.gradient(qpos, axis=0).astype(np.float32) if rows > 1 else qpos
    state[:, 6:35], state[:, 35:] = qpos[:, CANONICAL_TO_MUJOCO], qvel[:, CANONICAL_TO_MUJOCO]
    half = np.where(np.arange(rows) < rows // 2, 0, 1).astype(np.int16)
    three, quat = np.zeros((rows, 3), np.float32), np.tile(np.float32([1, 0, 0, 0]), (rows, 1))
    path = np.stack([0.01 * np.arange(rows), np.zeros(rows), np.full(rows, 0.8)], axis=1).astype(np.float32)
    facts = json.dumps({"code": "0123456789ab"})
    fields = {
        "schema_version": np.str_(SCHEMA_VERSION),
        "task": np.str_(spec.gym_id),
        "num_frames": np.int64(rows),
        "robot_qpos_before_decimation": qpos,
        "robot_qvel_before_decimation": qvel,
        "robot_root_position": path,
        "robot_root_orientation": quat,
        **{f"robot_root_{k}_vel_{f}": three for k in ("lin", "ang") for f in ("world", "local")},
        "robot_action_mimic": np.zeros((rows, 35), np.float32),
        "robot_twist2_inference_qpos": qpos,
        "human_body_pos": path,
        "human_body_quat_w": quat,
        "human_joint_pos": action[:, ACTION["joint_pos"]],
        "pico_left_grip_binary": np.zeros(rows, bool),
        "pico_right_grip_binary": np.zeros(rows, bool),
        "vla_state": state,
        "system_control_frequency": np.full(rows, float(FPS)),
        "system_decimation": np.full(rows, 20),
        "system_physics_dt": np.full(rows, 0.001),
        "system_timestamp": time,
        "env_obj_ball_position": path,
        "env_obj_ball_orientation": quat,
        "env_obj_ball_linear_velocity": three,
        "env_obj_ball_angular_velocity": three,
        "episode_init_env_obj_ball_position": np.zeros(3, np.float32),
        "episode_init_env_obj_ball_orientation": np.float32([1, 0, 0, 0]),
        **{f"episode_init_env_obj_ball_{k}_velocity": np.zeros(3, np.float32) for k in ("linear", "angular")},
        "episode_object_seed": np.uint64(seeding.object_seed(seed)),
        "episode_object_seed_source": np.str_("arena_episode_seed"),
    }
    codec = {"vcodec": "h264", "g": 10, "crf": 20, "preset": "veryfast", "bf": 0, "mbtree": 0}
    for number, camera in enumerate(cameras):
        shown, histogram = pictures(rows, size, number), np.zeros((3, VALUES), np.int64)
        file = folder / "videos" / f"{stem}_{camera}_rgb.mp4"
        with VideoWriter(file, size, size, FPS, crf=20, gop=10, b_frames=False) as writer:
            for picture in shown:
                writer.write(picture)
                add_picture(histogram, picture)
        fields |= {
            vision(camera, "storage_format"): np.str_("video_v1"),
            vision(camera, "frame_indices"): np.arange(rows),
            vision(camera, "rgb_video_path"): np.str_(f"videos/{file.name}"),
            vision(camera, "rgb_video_fps"): np.float64(FPS),
            vision(camera, "rgb_video_num_frames"): np.int64(rows),
            f"arena_{vision(camera, 'size')}": np.array([size, size]),
            f"arena_{vision(camera, 'codec')}": np.str_(json.dumps(codec)),
            f"arena_{vision(camera, 'histogram')}": histogram,
        }
    if looks is not None:
        film = folder / "videos" / f"{stem}_front_looks.mp4"
        with VideoWriter(film, size, size, FPS / looks.stride, gop=10, b_frames=False, lossless=True) as writer:
            for frame in look_frames(looks.frames(rows), size, repeat):
                writer.write(frame)
        fields["arena_vision_looks"] = np.str_(json.dumps(looks.plain()))
    fields |= {
        "arena_state": state,
        "arena_action": action,
        "arena_executed_action": action,
        "arena_qpos": np.concatenate([path, quat, qpos], axis=1),
        "arena_qvel": np.zeros((rows, 35), np.float32),
        "arena_final_qpos": np.zeros(36, np.float32),
        "arena_initial_heading": np.float32(0),
        "arena_phase": half,
        "arena_phase_names": np.array(["approach", "strike"]),
        "arena_task": np.str_(task),
        "arena_instruction": np.str_(spec.instruction),
        "arena_tracker": np.str_(tracker),
        "arena_policy": np.str_("expert"),
        "arena_mode": np.str_("base"),
        "arena_rules": np.str_("paper"),
        "arena_seed_range": np.str_(seeding.DEMONSTRATION),
        "arena_group_seed": np.int64(0),
        "arena_repeat": np.int64(repeat),
        "arena_episode_seed": np.uint64(seed),
        "arena_outcome": np.str_(outcome),
        "arena_reason": np.str_(outcome),
        "arena_margin": np.float64(0.1),
        "arena_configuration": np.str_(facts),
    }
    kept = {name: np.asarray(value) for name, value in (fields | more).items() if value is not None}
    file = folder / f"{stem}.npz"
    write_episode(file, kept, sync=False)
    return file
