"""Layout of a LeRobot dataset of our episodes: features by name, from the arrays of an episode.

Three layouts. `arena` is that of the original's released data (protocol v3.1, or its authors' draft v4) and what our
policies are trained on. `sonic` has the names of GR00T-WholeBodyControl's SONIC exporter
(`gear_sonic/data/features_sonic_vla.py`), as far as an episode holds what they name: not the wrists' poses
(`observation.eef_state`), the motion token and the operator's body (`teleop.smpl_*`, `teleop.vr_3pt_*`). `lerobot` has
those of LeRobot's own robot `unitree_g1` without a locomotion controller. All are LeRobot v3.0 containers; GR00T reads
v2.1, so a set of layout `sonic` is converted for it once more by LeRobot's or NVIDIA's own tool.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from arena_newton.data.readers.label_protocols import action_names, encode_v4, protocol
from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.errors import InputError
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, HAND_CLOSED, STATE

__all__ = ["FPS", "LAYOUTS", "REFERENCE_SOURCES", "Column", "Layout", "described_protocol", "described_slots"]
__all__ += ["layout", "modality", "state_names"]

FPS = round(1 / g1.TICK)
"""Frames per second of every dataset: one per tick."""
_JOINTS = g1.CANONICAL_JOINTS
_FINGERS = ("index_0", "index_1", "middle_0", "middle_1", "thumb_0", "thumb_1", "thumb_2")
"""Joints of a hand in the order of the robot's model, which is the alphabet."""
_TO_MODEL = [g1.HAND_JOINTS.index(f"left_hand_{finger}_joint") for finger in _FINGERS]
"""Finger of the model's order → its number in `g1.HAND_JOINTS`."""
_LEFT_ARM_END = 22
"""Joints of the robot's model, in MuJoCo order, before those of the left hand."""
_HAND = len(_FINGERS)
_WRIST = 3


def _fingers(side: str) -> list[str]:
    return [f"{side}_hand_{finger}_joint" for finger in _FINGERS]


_SONIC_JOINTS = [
    *g1.MUJOCO_JOINTS[:_LEFT_ARM_END],
    *_fingers("left"),
    *g1.MUJOCO_JOINTS[_LEFT_ARM_END:],
    *_fingers("right"),
]
"""All 43 joints in the order of SONIC's datasets, which is that of the robot's model: legs, waist, left arm and hand,
right arm and hand."""
_UNITREE = [f"k{''.join(part.title() for part in joint.split('_')[:-1])}.q" for joint in g1.MUJOCO_JOINTS]
"""LeRobot's names of the 29 motors (`G1_29_JointIndex`), which are in MuJoCo order."""


@dataclass(frozen=True)
class Column:
    """One feature that is a vector."""

    key: str
    dtype: str
    names: tuple[str, ...]
    parts: Mapping[str, slice]
    """Its named slices, for `meta/modality.json`."""
    modality: str
    """`state` or `action`."""


@dataclass(frozen=True)
class Layout:
    """Names of one family of datasets."""

    name: str
    robot_type: Callable[[str], str]
    """Robot type by the label protocol's name."""
    cameras: Mapping[str, str]
    """Camera as episodes name it → name after `observation.images.`."""
    columns: Callable[[str], tuple[Column, ...]]
    """Columns by the label protocol's name."""
    rows: Callable[[EpisodeFile, str], dict[str, np.ndarray]]
    """Columns of an episode, shape [T, width]."""
    labels: tuple[str, ...] = ("v3.1",)
    """Label protocols that it can hold."""

    def image_key(self, camera: str) -> str:
        """Feature of a camera's pictures."""
        return f"observation.images.{self.cameras[camera]}"


def state_names() -> list[str]:
    """Names of the canonical state's 64 numbers, as the original's datasets have them."""
    return [
        *(f"state.root_heading_canonical_rot6d.{i}" for i in range(6)),
        *(f"state.dof_pos.{joint}" for joint in _JOINTS),
        *(f"state.dof_vel.{joint}" for joint in _JOINTS),
    ]


def _arena_columns(labels: str) -> tuple[Column, ...]:
    return (
        Column("observation.state", "float32", tuple(state_names()), STATE, "state"),
        Column("action", "float32", tuple(action_names(labels)), protocol(labels).slots, "action"),
    )


def _arena_rows(episode: EpisodeFile, labels: str) -> dict[str, np.ndarray]:
    action = encode_v4(episode.action) if labels == "v4" else episode.action
    return {"observation.state": episode.state, "action": action}


def _sonic_columns(_: str) -> tuple[Column, ...]:
    body = {"left_leg": slice(0, 6), "right_leg": slice(6, 12), "waist": slice(12, 15), "left_arm": slice(15, 22)}
    body |= {"left_hand": slice(22, 29), "right_arm": slice(29, 36), "right_hand": slice(36, 43)}
    wrist = ("roll", "pitch", "yaw")
    quat = ("base_qw", "base_qx", "base_qy", "base_qz")
    gravity = ("gravity_x", "gravity_y", "gravity_z")
    found = [
        Column("observation.state", "float64", tuple(_SONIC_JOINTS), body, "state"),
        Column("observation.root_orientation", "float64", quat, {"root_orientation": slice(0, 4)}, "state"),
        Column("observation.projected_gravity", "float64", gravity, {"projected_gravity": slice(0, 3)}, "state"),
        Column("action.wbc", "float64", tuple(_SONIC_JOINTS), {f"wbc_{k}": v for k, v in body.items()}, "action"),
        Column("teleop.body_quat_w", "float32", ("qw", "qx", "qy", "qz"), {"body_quat_w": slice(0, 4)}, "action"),
    ]
    for side in ("left", "right"):
        hand = {f"{side}_hand_joints": slice(0, _HAND)}
        found.append(Column(f"teleop.{side}_hand_joints", "float32", tuple(_fingers(side)), hand, "action"))
        names = tuple(f"{side}_wrist_{axis}" for axis in wrist)
        part = {f"{side}_wrist_joints": slice(0, _WRIST)}
        found.append(Column(f"teleop.{side}_wrist_joints", "float32", names, part, "action"))
    return tuple(found)


def _sonic_rows(episode: EpisodeFile, _: str) -> dict[str, np.ndarray]:
    quat = episode.array("robot_root_orientation", episode.rows, 4).astype(np.float64)
    w, x, y, z = quat.T
    measured = _all_joints(episode)
    hands = {side: _hand_targets(episode, number) for number, side in enumerate(("left", "right"))}
    targets = joint_targets(episode).astype(np.float64)
    parts = [targets[:, :_LEFT_ARM_END], hands["left"], targets[:, _LEFT_ARM_END:], hands["right"]]
    reference = episode.array("human_joint_pos", episode.rows, len(_JOINTS))
    found = {
        "observation.state": measured.astype(np.float64),
        "observation.root_orientation": quat,
        # Direction of gravity in the pelvis' frame: minus the third row of its rotation matrix.
        "observation.projected_gravity": np.stack(
            [-2 * (x * z - w * y), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1], axis=1
        ),
        "action.wbc": np.concatenate(parts, axis=1),
        "teleop.body_quat_w": episode.array("human_body_quat_w", episode.rows, 4).astype(np.float32),
    }
    for side in ("left", "right"):
        wrist = [_JOINTS.index(f"{side}_wrist_{axis}_joint") for axis in ("roll", "pitch", "yaw")]
        found[f"teleop.{side}_hand_joints"] = hands[side].astype(np.float32)
        found[f"teleop.{side}_wrist_joints"] = reference[:, wrist].astype(np.float32)
    return found


def joint_targets(episode: EpisodeFile) -> np.ndarray:
    """Joint targets that the tracker gave [rad], MuJoCo order, shape [T, 29]."""
    names = ("robot_twist2_inference_qpos", "final_body_action_29dof")
    name = next((name for name in names if name in episode), names[1])
    return episode.array(name, episode.rows, len(_JOINTS))


def _hand_targets(episode: EpisodeFile, side: int) -> np.ndarray:
    """Finger targets [rad] of a hand in the model's order, shape [T, 7]."""
    closed = (g1.HAND_CLOSE_LEFT, g1.HAND_CLOSE_RIGHT)[side]
    pose = np.array([g1.HAND_OPEN, closed])[:, _TO_MODEL]
    command = episode.array("arena_executed_action", episode.rows, ACTION["hands"].stop)[:, ACTION["hands"]]
    chosen: np.ndarray = pose[(command[:, side] >= HAND_CLOSED).astype(int)]
    return chosen


def _all_joints(episode: EpisodeFile) -> np.ndarray:
    """All 43 measured joints [rad], from the world's positions, shape [T, 43].

    Raises:
        InputError: The world's positions do not hold the robot with hands that move.
    """
    body = episode.array("robot_qpos_before_decimation", episode.rows, len(_JOINTS))
    world = episode.array("arena_qpos", episode.rows, -1)
    for first in range(world.shape[1] - len(_SONIC_JOINTS) + 1):
        joints = world[:, first : first + len(_SONIC_JOINTS)]
        arm = joints[:, _LEFT_ARM_END + _HAND : _LEFT_ARM_END + _HAND + len(_JOINTS) - _LEFT_ARM_END]
        left = np.array_equal(joints[:, :_LEFT_ARM_END], body[:, :_LEFT_ARM_END])
        if left and np.array_equal(arm, body[:, _LEFT_ARM_END:]):
            return joints
    raise InputError(f"{episode.path}: arena_qpos has no robot with hands that move; --layout sonic needs one")


def _lerobot_columns(_: str) -> tuple[Column, ...]:
    joints = {"left_leg": slice(0, 6), "right_leg": slice(6, 12), "waist": slice(12, 15)}
    joints |= {"left_arm": slice(15, 22), "right_arm": slice(22, 29)}
    names = tuple(_UNITREE)
    return (
        Column("observation.state", "float32", names, joints, "state"),
        Column("action", "float32", names, joints, "action"),
    )


def _lerobot_rows(episode: EpisodeFile, _: str) -> dict[str, np.ndarray]:
    measured = episode.array("robot_qpos_before_decimation", episode.rows, len(_JOINTS))
    return {
        "observation.state": measured.astype(np.float32),
        "action": joint_targets(episode).astype(np.float32),
    }


_OTHER_CAMERAS = {"left_wrist": "left_wrist", "right_wrist": "right_wrist", "world": "world"}

LAYOUTS = {
    entry.name: entry
    for entry in (
        Layout(
            "arena",
            lambda labels: protocol(labels).robot_type,
            {"front": "front", **_OTHER_CAMERAS},
            _arena_columns,
            _arena_rows,
            ("v3.1", "v4"),
        ),
        Layout(
            "sonic", lambda _: "unitree_g1_sonic", {"front": "ego_view", **_OTHER_CAMERAS}, _sonic_columns, _sonic_rows
        ),
        Layout(
            "lerobot",
            lambda _: "unitree_g1",
            {"front": "head_camera", **_OTHER_CAMERAS},
            _lerobot_columns,
            _lerobot_rows,
        ),
    )
}
"""Layouts by the name that `--layout` takes."""


def layout(name: str, labels: str) -> Layout:
    """The layout of a name, which can hold labels of a protocol.

    Raises:
        InputError: There is no such layout, or it holds other actions.
    """
    if name not in LAYOUTS:
        raise InputError(f"--layout {name}: unknown, choose from {', '.join(LAYOUTS)}")
    protocol(labels)
    found = LAYOUTS[name]
    if labels not in found.labels:
        raise InputError(f"--labels {labels}: layout {name} holds joint targets, not actions; leave it out")
    return found


def modality(kind: Layout, labels: str, cameras: tuple[str, ...]) -> dict[str, object]:
    """Content of `meta/modality.json`: which numbers of which feature are what, as GR00T's loaders read it."""
    found: dict[str, dict[str, object]] = {"state": {}, "action": {}, "video": {}, "annotation": {}}
    for column in kind.columns(labels):
        for part, where in column.parts.items():
            entry: dict[str, object] = {"start": where.start, "end": where.stop, "original_key": column.key}
            if part in ("root_orientation", "body_quat_w"):
                entry["rotation_type"] = "quaternion"
            if part == "root_rot6d":
                entry["rotation_type"] = "rotation_6d"
            found[column.modality][part] = entry
    found["video"] = {kind.cameras[camera]: {"original_key": kind.image_key(camera)} for camera in cameras}
    found["annotation"] = {"human.task_description": {"original_key": "task_index"}}
    return dict(found)


REFERENCE_SOURCES = ("twist2", "sonic")
"""Trackers whose source of reference poses `vla_protocol` names."""
_MEANING: Mapping[str, Mapping[str, str]] = {
    "v3.1": {
        "action_layout": "root_xy_delta_z_rot6d_joints29_hands2",
        "rotation_6d_layout": "row",
        "action_semantics": "reference_pose_not_robot_current_residual",
        "root_xy_delta_frame": "current_reference_base_frame",
        "root_rotation_frame": "episode_reference_frame",
    },
    "v4": {
        "action_layout": "root_xy_velocity_z_roll_pitch_yaw_rate_reserved3_joints29_hands2",
        "action_semantics": "reference_velocity_command",
        "root_velocity_frame": "current_reference_base_frame",
    },
}
"""Metadata that the original's converter writes for v3.1 (`write_v31_protocol_metadata`), and as much of it for v4."""


def described_protocol(labels: str, trackers: list[str]) -> dict[str, object]:
    """Block `vla_protocol` of `meta/info.json`, with the keys that the original's converter writes.

    Args:
        labels: `v3.1` or `v4`.
        trackers: Trackers that executed the actions, without repeats.
    """
    kind = protocol(labels)
    # The original takes references from recordings of its trackers; here they are the actions that were decided.
    sources = {f"{name}_reference_source": "decided_action" if name in trackers else None for name in REFERENCE_SOURCES}
    return {
        "schema": kind.schema,
        "version": kind.name.removeprefix("v"),
        "action_dim": len(action_names(labels)),
        **_MEANING[labels],
        "fps": float(FPS),
        "control_dt": g1.TICK,
        "dt_source": "system_control_frequency_or_metadata",
        "backend_source": "+".join(trackers),
        # The draft of v4 demands where the period comes from (§4.3).
        **({"control_dt_source": "fixed control tick of arena_newton (robot.TICK)"} if labels == "v4" else {}),
        **sources,
    }


def described_slots(labels: str) -> dict[str, object]:
    """Slots of state and action for the block `arena` of `meta/info.json`: [first, end] of each part."""
    slots = protocol(labels).slots
    return {
        "state": {name: [part.start, part.stop] for name, part in STATE.items()},
        "action": {name: [part.start, part.stop] for name, part in slots.items()},
        "joints": list(_JOINTS),
        "state_frame": "heading of the robot at the start of the episode removed",
    }
