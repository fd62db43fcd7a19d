"""Masked resets touch the masked worlds alone; broken worlds are found."""

import numpy as np
import pytest
import warp as wp

from arena_newton.kernels import reset


def _arrays(rng, device, worlds, mocap):
    shapes = [(worlds, 50), (worlds, 49), (worlds, 43), (worlds, mocap, 3), (worlds, mocap, 4)]
    return [wp.array(rng.normal(size=s).astype(np.float32), dtype=wp.float32, device=device) for s in shapes]


@pytest.mark.parametrize("mocap", [0, 2])
def test_reset_writes_masked_worlds_alone(device, mocap):
    """Masked worlds equal the initial state, the others their old state, bit for bit, with and without fixtures."""
    rng = np.random.default_rng(0)
    first, now = _arrays(rng, device, 5, mocap), _arrays(rng, device, 5, mocap)
    old = [a.numpy().copy() for a in now]
    flags = np.array([1, 0, 0, 1, 0])
    reset.launch_reset(wp.array(flags, dtype=wp.int32, device=device), *first, *now)
    for a, b, c in zip(now, first, old, strict=True):
        expected = np.where(flags.reshape(-1, *[1] * (a.ndim - 1)) == 1, b.numpy(), c)
        assert np.array_equal(a.numpy(), expected)


def test_reset_without_fixtures_takes_none(device):
    """A scene without fixtures passes None for their arrays."""
    rng = np.random.default_rng(1)
    first, now = _arrays(rng, device, 3, 0)[:3], _arrays(rng, device, 3, 0)[:3]
    mask = wp.full(3, 1, dtype=wp.int32, device=device)
    reset.launch_reset(mask, *first, None, None, *now, None, None)
    assert all(np.array_equal(a.numpy(), b.numpy()) for a, b in zip(now, first, strict=True))


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
