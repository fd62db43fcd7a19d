"""Clips as streams of canonical actions, and the transition from standing into them."""

from __future__ import annotations

import numpy as np
import torch

from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.g1 import TICK
from arena_newton.trackers.motions.frames import motion_actions
from arena_newton.trackers.motions.load import Clip, resample

__all__ = ["clip_actions", "startup_actions"]

_XY = ACTION["root_xy_delta"]
_ROT = ACTION["root_rot6d"]


def clip_actions(clip: Clip) -> np.ndarray:
    """Canonical actions of a clip at 50 Hz, float32, shape [ticks, 40].

    The displacement of a tick is given in the reference root frame of that tick (full orientation), the orientation
    without the clip's first heading, so that integrating the actions rebuilds the clip's path (schema v3.1 of the
    original). The first action holds no displacement; hands are open where the clip says nothing.
    """
    at = resample(clip, 1.0 / TICK)
    hands = np.zeros((len(at.root_pos), 2)) if at.hands is None else at.hands
    parts = (torch.from_numpy(np.array(v, dtype=np.float64)) for v in (at.root_pos, at.root_quat, at.joint_pos, hands))
    return motion_actions(*parts).numpy().astype(np.float32)


def startup_actions(first: np.ndarray, *, stand: float, blend: float) -> np.ndarray:
    """Actions that lead from standing to a recording's first action without displacement.

    Args:
        first: The first action, shape [40].
        stand: Time that the robot stands [s].
        blend: Time in which height, orientation and joints move over linearly [s].

    Returns:
        float32, shape [ticks, 40].
    """
    waiting = np.repeat(STAND_ACTION[None], round(stand / TICK), axis=0)
    ticks = round(blend / TICK)
    weight = (np.arange(1, ticks + 1) / (ticks + 1))[:, None].astype(np.float32)
    moving = (1 - weight) * STAND_ACTION + weight * first
    moving[:, _XY] = 0.0
    moving[:, _ROT] = _orthonormal(moving[:, _ROT])
    moving[:, ACTION["hands"]] = first[ACTION["hands"]]
    return np.concatenate([waiting, moving]).astype(np.float32)


def _orthonormal(rot6d: np.ndarray) -> np.ndarray:
    """The rotation next to each row-layout rot6d (first two columns, flattened by rows), shape [ticks, 6]."""
    columns = rot6d.reshape(-1, 3, 2)
    x = columns[:, :, 0] / np.linalg.norm(columns[:, :, 0], axis=1, keepdims=True)
    y = columns[:, :, 1] - (x * columns[:, :, 1]).sum(axis=1, keepdims=True) * x
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([x, y], axis=-1).reshape(-1, 6)
