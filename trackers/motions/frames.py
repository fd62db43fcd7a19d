"""Frames of a motion, canonical 40D actions and 35D mimic commands: each made from the other, batched, in torch.

A frame is a root position [m], a root orientation (wxyz), 29 joints in MuJoCo order [rad] and two hands, at
50 Hz; frame k is where the robot should be after tick k. The formulas are those of `kernels.canonical`, which executes
the actions: what it integrates from the actions of a motion is the motion again.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from arena_newton.robot.canonical import ACTION, ACTION_WIDTH, HAND_CLOSED, MIMIC, MIMIC_WIDTH
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, MUJOCO_TO_CANONICAL, TICK
from arena_newton.robot.rotations import (
    heading,
    matrix_from_quat,
    quat_apply,
    quat_conjugate,
    quat_from_rot6d,
    quat_from_yaw,
    quat_multiply,
    roll_pitch,
    wrap_angle,
)

__all__ = ["MotionClip", "actions_to_motion", "frame_action", "frame_mimic", "motion_actions", "motion_mimic"]

_LEVEL_FLOOR = 1e-6
"""Below this |R22| height does not determine the displacement along the root's z axis (`kernels.canonical`)."""


class MotionClip(NamedTuple):
    """Frames in a row; leading axes are a batch."""

    root_pos: Tensor
    """Root position [m], shape [..., ticks, 3]."""
    root_quat: Tensor
    """Root orientation, wxyz, shape [..., ticks, 4]."""
    joint_pos: Tensor
    """Joint positions [rad], MuJoCo order, shape [..., ticks, 29]."""
    hands: Tensor
    """Left and right hand, 1 closed, 0 open, shape [..., ticks, 2]."""


@lru_cache(maxsize=16)
def _order(indices: tuple[int, ...], device: torch.device) -> Tensor:
    """Indices on a device, uploaded once: a list would be uploaded at every use, which a CUDA graph cannot hold."""
    return torch.tensor(indices, dtype=torch.int64, device=device)


def frame_action(
    previous_pos: Tensor, root_pos: Tensor, root_quat: Tensor, joint_pos: Tensor, hands: Tensor, heading0: Tensor
) -> Tensor:
    """Canonical action of one frame.

    Args:
        previous_pos: Root position one tick earlier [m], shape [..., 3]; the same as `root_pos` on the first tick.
        root_pos: Root position [m], shape [..., 3].
        root_quat: Root orientation, wxyz, shape [..., 4].
        joint_pos: Joint positions [rad], MuJoCo order, shape [..., 29].
        hands: Left and right hand, closed from 0.5, shape [..., 2].
        heading0: Heading that is taken out of the orientation [rad], shape [...].

    Returns:
        Shape [..., 40].
    """
    action = torch.empty(*joint_pos.shape[:-1], ACTION_WIDTH, dtype=joint_pos.dtype, device=joint_pos.device)
    moved = quat_apply(quat_conjugate(root_quat), root_pos - previous_pos)
    rotation = matrix_from_quat(quat_multiply(quat_from_yaw(-heading0), root_quat))
    action[..., ACTION["root_xy_delta"]] = moved[..., :2]
    action[..., ACTION["root_z"]] = root_pos[..., 2:]
    action[..., ACTION["root_rot6d"]] = rotation[..., :2].flatten(-2)
    action[..., ACTION["joint_pos"]] = joint_pos.index_select(-1, _order(CANONICAL_TO_MUJOCO, joint_pos.device))
    action[..., ACTION["hands"]] = hands
    return action


def frame_mimic(
    previous_pos: Tensor, previous_quat: Tensor, root_pos: Tensor, root_quat: Tensor, joint_pos: Tensor
) -> Tensor:
    """Mimic command of one frame, shape [..., 35]: what `kernels.canonical` makes of the frame's action.

    The frame is that of `frame_action`; `previous_quat`, wxyz, shape [..., 4], is the root one tick earlier.
    """
    mimic = torch.empty(*joint_pos.shape[:-1], MIMIC_WIDTH, dtype=joint_pos.dtype, device=joint_pos.device)
    moved = quat_apply(quat_conjugate(root_quat), root_pos - previous_pos)
    mimic[..., MIMIC["velocity_xy"]] = moved[..., :2] / TICK
    mimic[..., MIMIC["root_z"]] = root_pos[..., 2:]
    mimic[..., MIMIC["roll_pitch"]] = roll_pitch(root_quat)
    mimic[..., MIMIC["yaw_rate"]] = (wrap_angle(heading(root_quat) - heading(previous_quat)) / TICK)[..., None]
    mimic[..., MIMIC["joint_pos"]] = joint_pos
    return mimic


def _delayed(values: Tensor) -> Tensor:
    """Values one tick earlier, the first repeated; the ticks are the last axis but one."""
    return torch.cat([values[..., :1, :], values[..., :-1, :]], dim=-2)


def motion_actions(root_pos: Tensor, root_quat: Tensor, joint_pos: Tensor, hands: Tensor | None = None) -> Tensor:
    """Canonical actions of a motion (`MotionClip`), without its first heading, shape [..., ticks, 40].

    The first action holds no displacement; hands are open by default.
    """
    hands = joint_pos.new_zeros(*joint_pos.shape[:-1], 2) if hands is None else hands
    start = heading(root_quat[..., :1, :]).expand(joint_pos.shape[:-1])
    return frame_action(_delayed(root_pos), root_pos, root_quat, joint_pos, hands, start)


def motion_mimic(root_pos: Tensor, root_quat: Tensor, joint_pos: Tensor) -> Tensor:
    """Mimic commands of a motion, shape [..., ticks, 35]; velocities of the first frame are zero."""
    return frame_mimic(_delayed(root_pos), _delayed(root_quat), root_pos, root_quat, joint_pos)


def actions_to_motion(actions: Tensor, root_xy: Tensor | None = None, yaw: Tensor | None = None) -> MotionClip:
    """The motion that canonical actions integrate to.

    Args:
        actions: Shape [..., ticks, 40].
        root_xy: Where the first displacement starts [m], shape [..., 2]; the origin by default.
        yaw: Heading that the orientations are relative to [rad], shape [...]; 0 by default.

    Returns:
        Frames of the same number of ticks.
    """
    batch = actions.shape[:-2]
    root_xy = actions.new_zeros(*batch, 2) if root_xy is None else root_xy
    yaw = actions.new_zeros(batch) if yaw is None else yaw
    quat = quat_from_rot6d(actions[..., ACTION["root_rot6d"]])
    quat = quat_multiply(quat_from_yaw(yaw)[..., None, :].expand_as(quat), quat)
    rotation = matrix_from_quat(quat)
    moved = actions[..., ACTION["root_xy_delta"]]
    z = actions[..., ACTION["root_z"]]
    rise = (z - _delayed(z))[..., 0]
    # Height fixes the displacement along the root's z axis, and with it that in the world's plane.
    level = rotation[..., 2, 2]
    along = rise - rotation[..., 2, 0] * moved[..., 0] - rotation[..., 2, 1] * moved[..., 1]
    standing = level.abs() > _LEVEL_FLOOR
    along = torch.where(standing, along / torch.where(standing, level, torch.ones_like(level)), torch.zeros_like(along))
    local = torch.cat([moved, along[..., None]], dim=-1)
    xy = root_xy[..., None, :] + (rotation @ local[..., None])[..., :2, 0].cumsum(dim=-2)
    return MotionClip(
        torch.cat([xy, z], dim=-1),
        quat,
        actions[..., ACTION["joint_pos"]].index_select(-1, _order(MUJOCO_TO_CANONICAL, actions.device)),
        (actions[..., ACTION["hands"]] >= HAND_CLOSED).to(actions.dtype),
    )
