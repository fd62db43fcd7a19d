"""The two protocols of action labels, 40 slots each: v3.1, what is executed, and v4, a command of root velocities.

A v3.1 action names the reference's orientation relative to the episode's heading, and its displacement of a tick. A v4
action names velocities and leaves the heading to whoever executes it: it is integrated from the yaw rate, beginning at
the episode's heading. The original's authors drafted v4 because the orientation labels of two trackers differ more than
their motions (`isaaclab_twist2_g1/docs/UNITREE_G1_GMT_CMD_V4_DATA_PROTOCOL.md` of github.com/Allenhetl/HumanoidArena at
70f0148); no data of it were published. Names, units and the first row are the draft's. Two things differ, so that
an episode's actions come back: velocities are in the frame of the reference root, the draft's in that of the measured
base, and the yaw rate is the difference of the reference's yaws (ZYX), the draft's the z component of its angular
velocity in the measured base.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from arena_newton.errors import InputError
from arena_newton.files.untrusted_files import numbers
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, ACTION_WIDTH, validate_action

__all__ = ["LABELS", "RATE_STEP", "V4", "LabelProtocol", "action_names", "encode_v4", "protocol"]

V4: dict[str, slice] = {
    "velocity_xy": slice(0, 2),
    "root_z": slice(2, 3),
    "roll_pitch": slice(3, 5),
    "yaw_rate": slice(5, 6),
    "reserved": slice(6, 9),
    "joint_pos": slice(9, 38),
    "hands": slice(38, 40),
}
"""Slots of v4: velocity of the reference root [m/s, its own frame], its height [m, world], roll and pitch (ZYX) [rad],
yaw rate [rad/s], three zeros, reference joint positions [rad], hands. Roll and pitch are those of v3.1's orientation,
and the yaw rate is the change of its yaw."""
RATE_STEP = 2.0**-20
"""Unit of yaw rates [rad/s]. Whole multiples add up exactly, in any order, so that the yaw of an episode does not drift
and does not depend on chunks and worlds; float32 holds those below 16 rad/s exactly."""


@dataclass(frozen=True)
class LabelProtocol:
    """Meaning of an action's 40 numbers."""

    name: str
    robot_type: str
    """Name in LeRobot's `info.json`; policy servers check that of v3.1."""
    schema: str
    """Name in the block `vla_protocol` of `info.json`."""
    slots: Mapping[str, slice]
    sentence: str

    def validate(self, actions: object, where: str) -> np.ndarray:
        """Check actions of this protocol and return them as float32.

        Args:
            actions: Array-like, shape [..., 40].
            where: What the message names as the origin.

        Returns:
            float32, shape [..., 40].

        Raises:
            InputError: Wrong width, no numbers, NaN or infinity, or of v3.1 an orientation that names no rotation.
        """
        if self.slots is ACTION:
            return validate_action(actions, where)
        array = numbers(np.asarray(actions), f"{where}: action", np.float32)
        if array.ndim == 0 or array.shape[-1] != ACTION_WIDTH:
            raise InputError(f"{where}: action has shape {list(array.shape)}, expected [..., {ACTION_WIDTH}]")
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            *row, column = bad[0].tolist()
            at = f", row {'/'.join(map(str, row))}" if row else ""
            name = action_names(self.name)[column]
            raise InputError(
                f"{where}{at}: {name} (index {column}) is {array[tuple(bad[0])]}, expected a finite number"
            )
        return array


LABELS: dict[str, LabelProtocol] = {
    "v3.1": LabelProtocol(
        "v3.1",
        "unitree_g1_refpose_v3_1",
        "unitree_g1_gmt_refpose_v3_1",
        ACTION,
        "root displacement of a tick and orientation, as they are executed",
    ),
    "v4": LabelProtocol(
        "v4", "unitree_g1_gmt_cmd_v4", "unitree_g1_gmt_cmd_v4", V4, "root velocity, roll, pitch and yaw rate"
    ),
}
"""Protocols by the name that `--labels` takes."""
_NAMES = {
    "v3.1": (
        *("action.root_ref_base_local_xy_delta.x", "action.root_ref_base_local_xy_delta.y", "action.root_z"),
        *(f"action.root_ref_rot6d.{i}" for i in range(6)),
    ),
    "v4": (
        *("action.root_base_local_vx", "action.root_base_local_vy", "action.root_z", "action.root_roll"),
        *("action.root_pitch", "action.root_yaw_rate", *(f"action.reserved_{i}" for i in range(3))),
    ),
}
"""Names of the first nine slots in LeRobot's datasets; those of v3.1 are the original's, of v4 the draft's (§5.2)."""


def protocol(name: str) -> LabelProtocol:
    """The protocol of a name.

    Raises:
        InputError: There is none.
    """
    if name not in LABELS:
        raise InputError(f"--labels {name}: unknown, choose from {', '.join(LABELS)}")
    return LABELS[name]


def action_names(name: str) -> list[str]:
    """Names of the 40 numbers in LeRobot's datasets."""
    joints = [f"action.joint_pos.{joint}" for joint in g1.CANONICAL_JOINTS]
    return [*_NAMES[protocol(name).name], *joints, "action.hand_binary.left", "action.hand_binary.right"]


def encode_v4(actions: np.ndarray, yaw0: float | None = None) -> np.ndarray:
    """Labels of v4 of an episode.

    The first row of an episode has no velocity and no yaw rate (§6.3 of the draft); the second one's rate takes the
    heading from where the episode begins, so that only the first row's displacement and heading do not come back.

    Args:
        actions: Actions of v3.1, tick by tick, shape [T, 40].
        yaw0: Yaw of the reference before the first of these ticks, in the episode's frame [rad], of rows that continue
            an episode; none where the episode begins with them, at yaw 0.

    Returns:
        float32, shape [T, 40]; `label_decoder.decode_v4` gives all actions but the first back, with an orthonormal
        orientation.

    Raises:
        InputError: The actions are unfit.
    """
    given = validate_action(actions, "actions")
    if given.ndim != 2:
        raise InputError(f"actions have shape {list(given.shape)}, expected [T, {ACTION_WIDTH}]")
    labels = given.copy()
    columns = given[:, ACTION["root_rot6d"]].astype(np.float64).reshape(-1, 3, 2)
    x = columns[..., 0] / np.linalg.norm(columns[..., 0], axis=1, keepdims=True)
    y = columns[..., 1] - x * (x * columns[..., 1]).sum(axis=1, keepdims=True)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    z = np.cross(x, y)
    begins, before = yaw0 is None, yaw0 or 0.0
    yaw = np.unwrap(np.concatenate([[before], np.arctan2(x[:, 1], x[:, 0])]))
    if begins:
        yaw[1:2] = before
    labels[:, V4["velocity_xy"]] = given[:, ACTION["root_xy_delta"]].astype(np.float64) / g1.TICK
    labels[:, V4["roll_pitch"]] = np.stack(
        [np.arctan2(y[:, 2], z[:, 2]), np.arctan2(-x[:, 2], np.hypot(x[:, 0], x[:, 1]))], axis=1
    )
    # Differences of rounded yaws, not rounded differences: errors do not add up.
    steps = np.diff(np.rint((yaw - before) / (g1.TICK * RATE_STEP)))
    labels[:, V4["yaw_rate"]] = steps[:, None] * RATE_STEP
    if begins:
        labels[:1, V4["velocity_xy"]] = 0.0
    labels[:, V4["reserved"]] = 0.0
    labels[:, V4["roll_pitch"]] += 0.0  # no minus zero
    return labels
