"""The canonical vectors by name: 64D state, 40D action (schema v3.1), 35D mimic command; and validation of an action.

State and action hold their joints in canonical order, the mimic command in MuJoCo (TWIST2) order.
"""

import itertools

import numpy as np

from arena_newton.errors import InputError
from arena_newton.robot import g1

__all__ = [
    "ACTION",
    "ACTION_WIDTH",
    "HAND_CLOSED",
    "IDENTITY_ROT6D",
    "MIMIC",
    "MIMIC_WIDTH",
    "STAND_ACTION",
    "STATE",
    "STATE_WIDTH",
    "element_name",
    "validate_action",
]


def _laid_out(**widths: int) -> dict[str, slice]:
    """Parts of a vector by name, one behind the other."""
    ends = list(itertools.accumulate(widths.values()))
    return {name: slice(end - width, end) for (name, width), end in zip(widths.items(), ends, strict=True)}


_JOINTS = len(g1.MUJOCO_JOINTS)
STATE: dict[str, slice] = _laid_out(root_rot6d=6, joint_pos=_JOINTS, joint_vel=_JOINTS)
"""State: root orientation without the episode's initial heading, joint positions [rad], joint velocities [rad/s]."""
STATE_WIDTH = STATE["joint_vel"].stop

ACTION: dict[str, slice] = _laid_out(root_xy_delta=2, root_z=1, root_rot6d=6, joint_pos=_JOINTS, hands=2)
"""Action: reference root displacement [m/step, reference root frame], reference root height [m, world], reference root
orientation without the episode's initial heading, reference joint positions [rad], left and right hand."""
ACTION_WIDTH = ACTION["hands"].stop

MIMIC: dict[str, slice] = _laid_out(velocity_xy=2, root_z=1, roll_pitch=2, yaw_rate=1, joint_pos=_JOINTS)
"""Mimic command: velocity [m/s, reference root frame], height [m], roll, pitch, yaw rate [rad, rad/s], joints [rad]."""
MIMIC_WIDTH = MIMIC["joint_pos"].stop

IDENTITY_ROT6D: tuple[float, ...] = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)
"""Row layout: the first two columns of the rotation matrix, flattened row by row."""
_DEFAULT_JOINTS = [g1.DEFAULT_POSE[i] for i in g1.CANONICAL_TO_MUJOCO]
STAND_ACTION = np.array([0.0, 0.0, g1.SPAWN_HEIGHT, *IDENTITY_ROT6D, *_DEFAULT_JOINTS, 0.0, 0.0], dtype=np.float32)
"""Action of standing still: TWIST2's command when there is no input (root height 0.8 m, default pose)."""
HAND_CLOSED = 0.5
"""A hand value at or above this closes the hand."""
_MIN_CROSS = 1e-6
"""Smallest length of the cross product of the two rot6d columns that still names a rotation."""


def element_name(index: int) -> str:
    """Name of one number of the action, e.g. `joint_pos[left_knee_joint]`."""
    for name, part in ACTION.items():
        if part.start <= index < part.stop:
            k = index - part.start
            if name == "joint_pos":
                return f"joint_pos[{g1.CANONICAL_JOINTS[k]}]"
            if name == "hands":
                return f"hands[{('left', 'right')[k]}]"
            return name if part.stop - part.start == 1 else f"{name}[{k}]"
    raise IndexError(f"action index {index} is outside 0..{ACTION_WIDTH - 1}")


def validate_action(action: object, where: str) -> np.ndarray:
    """Checks canonical actions and returns them as float32.

    Args:
        action: Array-like, shape [..., 40].
        where: What the message names as the origin, e.g. `policy remote, world 3` or a file name.

    Returns:
        float32, shape [..., 40].

    Raises:
        InputError: Wrong width, no numbers, NaN or infinity, or a root_rot6d that names no rotation.
    """
    try:
        with np.errstate(over="ignore"):
            array = np.asarray(action, dtype=np.float32)
    except (TypeError, ValueError):
        raise InputError(f"{where}: action is not an array of numbers, expected shape [..., {ACTION_WIDTH}]") from None
    if array.ndim == 0 or array.shape[-1] != ACTION_WIDTH:
        width = array.shape[-1] if array.ndim else "a single"
        layout = ", ".join(f"{name} {part.start}:{part.stop}" for name, part in ACTION.items())
        raise InputError(f"{where}: action has {width} numbers, expected {ACTION_WIDTH} ({layout})")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        *row, column = (int(i) for i in bad[0])
        value = array[tuple(bad[0])]
        raise InputError(
            f"{where}{_row(row)}: action {element_name(column)} (index {column}) is {value}, expected a finite number"
        )
    part = ACTION["root_rot6d"]
    rot = array[..., part].astype(np.float64)
    cross = np.linalg.norm(np.cross(rot[..., 0::2], rot[..., 1::2]), axis=-1)
    flat = np.argwhere(np.atleast_1d(cross < _MIN_CROSS))
    if len(flat):
        row = [int(i) for i in flat[0]] if array.ndim > 1 else []
        raise InputError(
            f"{where}{_row(row)}: action root_rot6d (indices {part.start}:{part.stop}) names no rotation: its two "
            f"columns are zero or parallel, expected e.g. {list(IDENTITY_ROT6D)}"
        )
    return array


def _row(row: list[int]) -> str:
    return f", row {'/'.join(map(str, row))}" if row else ""
