"""Made recordings whose state is that of their joints, so that a dataset of them passes `verify`."""

import numpy as np

from arena_newton.robot import g1
from tests.arena_newton.data.made_episodes import make_episode

ROWS = 40


def consistent_episode(folder, rows=ROWS, *, repeat=0, heading=0.3, **more):
    """Write one recording of a robot with hands that leans and turns; returns its NPZ."""
    rng = np.random.default_rng(100 + repeat)
    joints = np.cumsum(rng.normal(0, 0.01, (rows, 29)), axis=0).astype(np.float32)
    speeds = rng.normal(0, 0.5, (rows, 29)).astype(np.float32)
    yaw, pitch = heading + 0.01 * np.arange(rows), 0.05 * np.sin(0.2 * np.arange(rows))
    half = np.stack([np.cos(pitch / 2), 0 * pitch, np.sin(pitch / 2), 0 * pitch], axis=1)
    c, s = np.cos(yaw / 2), np.sin(yaw / 2)
    # Turn about z, then lean about y.
    quat = np.stack([c * half[:, 0], -s * half[:, 2], c * half[:, 2], s * half[:, 0]], axis=1).astype(np.float32)
    state = np.zeros((rows, 64), np.float32)
    turned = yaw - heading
    state[:, 0], state[:, 2], state[:, 4] = (
        np.cos(turned) * np.cos(pitch),
        np.sin(turned) * np.cos(pitch),
        -np.sin(pitch),
    )
    state[:, 1], state[:, 3] = -np.sin(turned), np.cos(turned)
    order = [g1.MUJOCO_JOINTS.index(name) for name in g1.CANONICAL_JOINTS]
    state[:, 6:35], state[:, 35:] = joints[:, order], speeds[:, order]
    fingers = rng.normal(0, 0.1, (rows, 14)).astype(np.float32)
    root = np.zeros((rows, 7), np.float32)
    given = {
        "robot_qpos_before_decimation": joints,
        "robot_qvel_before_decimation": speeds,
        "robot_root_orientation": quat,
        "arena_state": state,
        "arena_initial_heading": np.float32(heading),
        "arena_qpos": np.concatenate([root, joints[:, :22], fingers[:, :7], joints[:, 22:], fingers[:, 7:]], axis=1),
    }
    return make_episode(folder, rows, repeat=repeat, **(given | more))
