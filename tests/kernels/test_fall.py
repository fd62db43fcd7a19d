"""Both fall rules, on random histories against a NumPy twin and on each side of every threshold."""

import numpy as np
import pytest
import warp as wp

from arena_newton.kernels.rules import fall

RULE = {"soft_tilt_deg": 60.0, "hard_tilt_deg": 75.0, "force_threshold": 50.0, "confirm_ticks": 5}
CRITICAL = [1, 4]


def _quat(tilt_deg, toward=0.3):
    half = np.radians(np.asarray(tilt_deg, np.float64)) / 2
    return np.stack(
        [np.cos(half), np.sin(half) * np.cos(toward), np.sin(half) * np.sin(toward), np.zeros_like(half)], -1
    )


def _judge(device, tilts, forces, at_once):
    """Fallen, trigger, pressed [3, ticks, worlds] of tilt [ticks, worlds] and force [ticks, worlds, bodies]."""
    worlds = tilts.shape[1]
    critical = wp.array(CRITICAL, dtype=wp.int32, device=device)
    streak = wp.zeros(worlds, dtype=wp.int32, device=device)
    outputs = [wp.full(worlds, 7, dtype=wp.int32, device=device) for _ in range(3)]
    rows = []
    for tilt, force in zip(tilts, forces, strict=True):
        qpos = np.zeros((worlds, 9), np.float32)
        qpos[:, 5:9] = _quat(tilt)
        fall.launch_fall(
            wp.array(qpos, dtype=wp.float32, device=device),
            2,
            wp.array(np.float32(force), dtype=wp.float32, device=device),
            critical,
            streak,
            *outputs,
            at_once=at_once,
            **RULE,
        )
        rows.append([output.numpy().copy() for output in outputs])
    return np.swapaxes(np.array(rows), 0, 1)


def _twin(tilts, forces, at_once):
    """The same by windows over the whole history."""
    pressed = forces[..., CRITICAL].max(-1) >= 50
    soft, hard = tilts > 60, tilts > 75
    severe = hard | (soft & pressed)
    counted = soft if at_once else severe
    window = np.stack([np.r_[np.zeros((k, tilts.shape[1]), bool), counted[: len(counted) - k]] for k in range(5)])
    fallen = window.all(0) | (severe if at_once else False)
    trigger = np.select([hard, soft & pressed], [fall.TILT, fall.CONTACT], fall.TILT_HELD)
    return fallen, np.where(fallen, trigger, fall.NO_FALL), soft & pressed


@pytest.mark.parametrize("at_once", [True, False])
def test_random_histories(device, at_once):
    """Random tilts and forces give the verdicts, triggers and contacts of the twin at every tick."""
    rng = np.random.default_rng(0)
    tilts = np.repeat(rng.uniform(40, 90, (20, 200)), 3, 0) + rng.uniform(-4, 4, (60, 200))
    forces = rng.uniform(0, 54, (60, 200, 6))
    out = _judge(device, tilts, forces, at_once)
    expected = _twin(tilts, forces, at_once)
    for name, ours, twin in zip(("fallen", "trigger", "pressed"), out, expected, strict=True):
        assert np.array_equal(ours, twin.astype(int)), name
    assert 0.02 < expected[0].mean() < 0.98
    seen = {fall.NO_FALL, fall.TILT, fall.CONTACT} | ({fall.TILT_HELD} if at_once else set())
    assert set(np.unique(out[1])) == seen


@pytest.mark.parametrize(
    ("tilt", "force", "body", "paper", "released"),
    [
        (59.9, 500.0, 1, None, None),
        (60.1, 49.9, 1, 5, None),
        (60.1, 50.0, 1, 1, 5),
        (60.1, 50.0, 4, 1, 5),
        (60.1, 500.0, 2, 5, None),
        (74.9, 0.0, 1, 5, None),
        (75.1, 0.0, 1, 1, 5),
        (180.0, 0.0, 1, 1, 5),
        (0.0, 500.0, 1, None, None),
    ],
)
def test_thresholds(device, tilt, force, body, paper, released):
    """Held for eight ticks, each state is a fall from the tick that its rule says, or never."""
    tilts, forces = np.full((8, 1), tilt), np.zeros((8, 1, 6))
    forces[..., body] = force
    for at_once, first in ((True, paper), (False, released)):
        expected = [0] * 8 if first is None else [0] * (first - 1) + [1] * (9 - first)
        assert _judge(device, tilts, forces, at_once)[0, :, 0].tolist() == expected


def test_a_good_tick_resets_the_streak(device):
    """Four candidate ticks, one upright tick and four more are no fall in either rule."""
    tilts = np.array([80.0] * 4 + [10.0] + [80.0] * 4)[:, None]
    assert not _judge(device, tilts, np.zeros((9, 1, 6)), False)[0].any()
    assert not _judge(device, np.minimum(tilts, 65), np.zeros((9, 1, 6)), True)[0].any()
