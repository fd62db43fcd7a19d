"""Counters of the masked worlds alone are cleared; broken worlds are found."""

import numpy as np
import warp as wp

from arena_newton.kernels import reset


def test_clear(device):
    """Counters of masked worlds become zero."""
    counter = wp.array([3, 4, 5], dtype=wp.int32, device=device)
    reset.launch_clear(wp.array([0, 1, 0], dtype=wp.int32, device=device), counter)
    assert counter.numpy().tolist() == [3, 0, 5]


def test_nonfinite_worlds_are_flagged(device):
    """NaN, infinities and numbers beyond MuJoCo's bound are flagged in either array; large but legal ones are not."""
    qpos, qvel = np.zeros((9, 12), np.float32), np.zeros((9, 11), np.float32)
    qpos[1, 11], qvel[2, 10], qpos[3, 0], qvel[4, 0] = np.nan, np.nan, np.inf, -np.inf
    qpos[5, 3], qvel[6, 3], qpos[7, 2], qvel[8, 2] = 1.1e10, -1.1e10, 0.9e10, -0.9e10
    bad = wp.full(9, 5, dtype=wp.int32, device=device)
    arrays = [wp.array(a, dtype=wp.float32, device=device) for a in (qpos, qvel)]
    reset.launch_nonfinite(*arrays, bad)
    assert bad.numpy().tolist() == [0, 1, 1, 1, 1, 1, 1, 0, 0]
