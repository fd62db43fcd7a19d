"""A dataset as the original's own converter writes it: LeRobot v3.0, protocol 3.1, made by hand with pyarrow."""

import json

import numpy as np
import pyarrow
import pyarrow.parquet

from arena_newton.robot.g1 import CANONICAL_JOINTS

ACTION_NAMES = [
    *("action.root_ref_base_local_xy_delta.x", "action.root_ref_base_local_xy_delta.y", "action.root_z"),
    *(f"action.root_ref_rot6d.{i}" for i in range(6)),
    *(f"action.joint_pos.{joint}" for joint in CANONICAL_JOINTS),
    *("action.hand_binary.left", "action.hand_binary.right"),
]
STATE_NAMES = [
    *(f"state.root_heading_canonical_rot6d.{i}" for i in range(6)),
    *(f"state.dof_pos.{joint}" for joint in CANONICAL_JOINTS),
    *(f"state.dof_vel.{joint}" for joint in CANONICAL_JOINTS),
]


def features():
    """The features of the released data."""
    scalar = {"shape": [1], "names": None}
    video = {"video.height": 480, "video.width": 640, "video.codec": "av1", "video.fps": 50, "has_audio": False}
    image = {"dtype": "video", "shape": [480, 640, 3], "names": ["height", "width", "channels"], "info": video}
    return {
        "observation.images.front": image,
        "observation.state": {"dtype": "float32", "shape": [64], "names": STATE_NAMES},
        "action": {"dtype": "float32", "shape": [40], "names": ACTION_NAMES},
        "timestamp": {"dtype": "float32", **scalar},
        **{name: {"dtype": "int64", **scalar} for name in ("frame_index", "episode_index", "index", "task_index")},
    }


def write_dataset(root, episodes, instruction="Strike the green markers on the punching bag.", info=None):
    """Write actions, each [T, 40], as a dataset without its videos; `info` changes entries of info.json, None drops."""
    lengths = [len(actions) for actions in episodes]
    first = np.cumsum([0, *lengths])
    described = {
        "codebase_version": "v3.0",
        "robot_type": "unitree_g1_refpose_v3_1",
        "total_episodes": len(episodes),
        "total_frames": int(first[-1]),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": 50,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features(),
        "vla_protocol": {
            "schema": "unitree_g1_gmt_refpose_v3_1",
            "version": "3.1",
            "action_dim": 40,
            "action_layout": "root_xy_delta_z_rot6d_joints29_hands2",
            "rotation_6d_layout": "row",
            "fps": 50.0,
            "control_dt": 0.02,
            "backend_source": "twist2",
        },
    }
    described |= info or {}
    meta, data = root / "meta", root / "data" / "chunk-000"
    (meta / "episodes" / "chunk-000").mkdir(parents=True)
    data.mkdir(parents=True)
    kept = {key: value for key, value in described.items() if value is not None}
    (meta / "info.json").write_text(json.dumps(kept, indent=4))
    task = pyarrow.table({"task_index": np.array([0]), "__index_level_0__": [instruction]})
    pyarrow.parquet.write_table(task, meta / "tasks.parquet")
    rows = np.concatenate(episodes).astype(np.float32)
    frames = np.concatenate([np.arange(n) for n in lengths])

    def vectors(values):
        width = values.shape[1]
        return pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(values.ravel(), pyarrow.float32()), width)

    table = {
        "observation.state": vectors(np.zeros((len(rows), 64), np.float32)),
        "action": vectors(rows),
        "timestamp": (frames / 50).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.repeat(np.arange(len(episodes)), lengths),
        "index": np.arange(len(rows)),
        "task_index": np.zeros(len(rows), np.int64),
    }
    pyarrow.parquet.write_table(pyarrow.table(table), data / "file-000.parquet")
    zeros = np.zeros(len(episodes), np.int64)
    key = "videos/observation.images.front"
    table = {
        "episode_index": np.arange(len(episodes)),
        "tasks": [[instruction]] * len(episodes),
        "length": np.array(lengths),
        **{name: zeros for name in ("data/chunk_index", "data/file_index", f"{key}/chunk_index", f"{key}/file_index")},
        "dataset_from_index": first[:-1],
        "dataset_to_index": first[1:],
        f"{key}/from_timestamp": first[:-1] / 50,
        f"{key}/to_timestamp": first[1:] / 50,
    }
    pyarrow.parquet.write_table(pyarrow.table(table), meta / "episodes" / "chunk-000" / "file-000.parquet")
    return root
