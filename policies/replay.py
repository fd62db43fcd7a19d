"""The policy that plays a recording: a motion clip, turned into canonical actions, or a file of actions."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arena_newton.canonical import ACTION, ACTION_WIDTH
from arena_newton.errors import InputError
from arena_newton.policies.base import Chunk, Observation, Policy, world_mask
from arena_newton.policies.stand import stand_action
from arena_newton.robot import CANONICAL_TO_MUJOCO, TICK
from arena_newton.trackers.motions import Clip, load_actions, load_clip

__all__ = ["ReplayPolicy", "clip_actions", "from_spec", "startup_actions"]

_XY = ACTION["root_xy_delta"]
_ROT = ACTION["root_rot6d"]


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion product, wxyz."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrices of unit quaternions wxyz, shape [..., 3, 3]."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _slerp(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Spherical interpolation of unit quaternions along the shorter arc; shapes [n, 4], [n, 4], [n]."""
    dot = (a * b).sum(axis=-1, keepdims=True)
    b, dot = np.where(dot < 0, -b, b), np.abs(dot)
    angle = np.arccos(np.clip(dot, 0.0, 1.0))
    t = t[:, None]
    near = angle < 1e-6
    sine = np.where(near, 1.0, np.sin(angle))
    quat = np.where(near, a + t * (b - a), (np.sin((1 - t) * angle) * a + np.sin(t * angle) * b) / sine)
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def _inverse_heading(quat: np.ndarray) -> np.ndarray:
    """The rotation about z that removes a quaternion's heading (yaw = atan2(2(wz + xy), 1 - 2(y² + z²)))."""
    w, x, y, z = quat
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([np.cos(-yaw / 2), 0.0, 0.0, np.sin(-yaw / 2)])


def clip_actions(clip: Clip) -> np.ndarray:
    """Canonical actions of a clip at 50 Hz, float32, shape [ticks, 40].

    The displacement of a tick is given in the reference root frame of that tick (full orientation), the orientation
    without the clip's first heading, so that integrating the actions rebuilds the clip's path (schema v3.1 of the
    original). The first action holds no displacement; hands are open.
    """
    ticks = int(np.floor(clip.duration / TICK + 1e-9)) + 1
    at = np.minimum(np.arange(ticks) * TICK * clip.fps, len(clip.root_pos) - 1)
    low = np.minimum(at.astype(int), len(clip.root_pos) - 2)
    t = at - low
    pos = (1 - t)[:, None] * clip.root_pos[low] + t[:, None] * clip.root_pos[low + 1]
    joints = (1 - t)[:, None] * clip.joint_pos[low] + t[:, None] * clip.joint_pos[low + 1]
    quat = _slerp(clip.root_quat[low], clip.root_quat[low + 1], t)

    anchor = _inverse_heading(quat[0])
    quat = _multiply(np.broadcast_to(anchor, quat.shape), quat)
    moved = np.zeros_like(pos)
    moved[1:] = np.diff(pos, axis=0) @ _matrix(anchor).T
    rotation = _matrix(quat)

    actions = np.zeros((ticks, ACTION_WIDTH))
    actions[:, _XY] = np.einsum("tji,tj->ti", rotation, moved)[:, :2]
    actions[:, ACTION["root_z"]] = pos[:, 2:]
    actions[:, _ROT] = rotation[:, :, :2].reshape(ticks, 6)
    actions[:, ACTION["joint_pos"]] = joints[:, list(CANONICAL_TO_MUJOCO)]
    return actions.astype(np.float32)


def startup_actions(first: np.ndarray, *, stand: float, blend: float) -> np.ndarray:
    """Actions that lead from standing to a recording's first action without displacement.

    Args:
        first: The first action, shape [40].
        stand: Time that the robot stands [s].
        blend: Time in which height, orientation and joints move over linearly [s].

    Returns:
        float32, shape [ticks, 40].
    """
    standing = stand_action()
    waiting = np.repeat(standing[None], round(stand / TICK), axis=0)
    ticks = round(blend / TICK)
    share = (np.arange(1, ticks + 1) / (ticks + 1))[:, None].astype(np.float32)
    moving = (1 - share) * standing + share * first
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


class ReplayPolicy(Policy):
    """Plays actions from the start of each episode; afterwards it holds the last one without displacement."""

    chunk_size = 20

    def __init__(self, path: str | Path, *, startup_stand: float = 1.0, startup_blend: float = 1.0):
        """Read a recording.

        Args:
            path: A TWIST2/GMR clip (`.pkl`), or actions (`.npz`, array `action` of shape [ticks, 40]).
            startup_stand: Time of standing before a clip [s]; actions from an NPZ are played as they are.
            startup_blend: Time of moving from standing to a clip's first pose [s].

        Raises:
            InputError: The file is absent or unfit.
        """
        self.path = Path(path)
        self.name = f"replay-{self.path.stem}"
        self.trimmed = 0
        """Frames of a motion capture jump that were cut off the clip's start."""
        suffix = self.path.suffix.lower()
        if suffix not in (".pkl", ".npz"):
            raise InputError(f"--policy replay:{path}: expected a .pkl clip or an .npz file with an array action")
        if not self.path.is_file():
            raise InputError(f"--policy replay:{path}: no such file")
        if suffix == ".npz":
            self.actions = load_actions(self.path)
            startup_stand = startup_blend = 0.0
        else:
            clip = load_clip(self.path)
            self.trimmed = clip.trimmed
            actions = clip_actions(clip)
            lead = startup_actions(actions[0], stand=startup_stand, blend=startup_blend)
            self.actions = np.concatenate([lead, actions])
        self._startup = (startup_stand, startup_blend)
        self._hash = hashlib.sha256(self.path.read_bytes()).hexdigest()[:12]
        self._held = self.actions[-1].copy()
        self._held[_XY] = 0.0
        self._steps = np.zeros(0, dtype=np.int64)

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Any = None) -> None:
        """Rewind the worlds in `mask`."""
        self._grow(len(seeds))
        self._steps[world_mask(mask, len(seeds))] = 0

    def act(self, observation: Observation) -> Chunk:
        """The next actions of the worlds that ask."""
        worlds = len(observation.state)
        self._grow(worlds)
        asking = world_mask(observation.mask, worlds)
        ticks = self._steps[:, None] + np.arange(self.chunk_size)
        actions = self.actions[np.minimum(ticks, len(self.actions) - 1)]
        actions[ticks >= len(self.actions)] = self._held
        self._steps[asking] += self.chunk_size
        return Chunk(actions)

    def describe(self) -> dict[str, Any]:
        """File name and hash, and the times of the start."""
        stand, blend = self._startup
        return {
            "name": self.name,
            "file": self.path.name,
            "hash": self._hash,
            "ticks": len(self.actions),
            "trimmed": self.trimmed,
            "startup_stand": stand,
            "startup_blend": blend,
        }

    def _grow(self, worlds: int) -> None:
        if len(self._steps) != worlds:
            self._steps = np.zeros(worlds, dtype=np.int64)


def from_spec(argument: str | None) -> ReplayPolicy:
    """Make the policy for `--policy replay:<path>`.

    Raises:
        InputError: No path was given, or the file is unfit.
    """
    if not argument:
        raise InputError("--policy replay: needs a file, as in replay:walk.pkl or replay:actions.npz")
    return ReplayPolicy(argument)
