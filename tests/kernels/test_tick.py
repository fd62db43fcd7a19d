"""Bookkeeping of a tick: what reaches the actuators, which status wins, what is remembered of an episode."""

import itertools

import numpy as np
import pytest
import warp as wp

from arena_newton.kernels import tick


def _ints(values, device):
    return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=device)


@pytest.mark.parametrize("fingers", [0, 4])
def test_only_masked_worlds_reach_the_actuators(device, fingers):
    """Joints and hands of the masked worlds are written, with or without fingers; the others keep every bit."""
    rng = np.random.default_rng(0)
    targets, before = rng.normal(size=(3, 5)).astype(np.float32), rng.normal(size=(3, 12)).astype(np.float32)
    joints, hands = [3, 1, 0, 7, 5], [2, 4, 6, 8][:fingers]
    closed, opened = np.arange(fingers) + 10.0, np.arange(fingers) + 20.0
    ctrl = wp.array(before, dtype=wp.float32, device=device)
    tick.launch_write_ctrl(
        wp.array(targets, dtype=wp.float32, device=device),
        _ints(joints, device),
        wp.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], dtype=wp.float32, device=device),
        _ints(hands, device),
        wp.array(opened, dtype=wp.float32, device=device),
        wp.array(closed, dtype=wp.float32, device=device),
        _ints([1, 0, 1], device),
        ctrl,
    )
    expected = before.copy()
    expected[np.ix_([0, 2], joints)] = targets[[0, 2]]
    if fingers:
        expected[0, hands] = [10, 11, 22, 23]
        expected[2, hands] = closed
    assert np.array_equal(ctrl.numpy(), expected)


def test_status_has_one_order(device):
    """Errors win, of all that may hold at once, over success, success over a fall, a fall over events."""
    flags = np.array(list(itertools.product([0, 1], repeat=6)), np.int32)
    success, fallen, event, state, action, targets = flags.T
    status = _ints(np.full(len(flags), 99), device)
    tick.launch_status(*(_ints(f, device) for f in (success, fallen, 3 * event, state, action, targets)), status)
    ranked = [
        (action, tick.ERROR_ACTION),
        (targets, tick.ERROR_TARGETS),
        (state, tick.ERROR_STATE),
        (success, tick.SUCCESS),
        (fallen, tick.FALL),
        (event, tick.EVENT + 3),
    ]
    expected = np.select([flag != 0 for flag, _ in ranked], [code for _, code in ranked], tick.RUNNING)
    assert np.array_equal(status.numpy(), expected)


def test_first_ticks_are_kept(device):
    """The log holds the first tick of each predicate, contact, event and fall, of ticks that the world took part in."""
    rng = np.random.default_rng(1)
    worlds, n, start, length = 300, 3, -4, 30
    log = tick.EpisodeLog.allocate(worlds, n, device)
    tick.launch_clear_log(log, _ints(np.ones(worlds), device), start)
    now = np.full(worlds, start)
    fall, event, contact = ([None] * worlds for _ in range(3))
    first = [[None] * n for _ in range(worlds)]
    for _ in range(length):
        mask = rng.random(worlds) < 0.8
        fell, happened = (rng.integers(1, 4, worlds) * (rng.random(worlds) < 0.05) for _ in range(2))
        pressed, held = rng.random(worlds) < 0.05, rng.random((worlds, n)) < 0.05
        tick.launch_log(log, *(_ints(a, device) for a in (mask, fell, happened, pressed, held)))
        now += mask
        for w in np.flatnonzero(mask):
            if fell[w]:
                fall[w] = fall[w] or (fell[w], now[w])
            if now[w] > 0:
                event[w] = event[w] or ((happened[w], now[w]) if happened[w] else None)
                contact[w] = contact[w] or (now[w] if pressed[w] else None)
                first[w] = [f or (now[w] if h else None) for f, h in zip(first[w], held[w], strict=True)]

    def ticks(values):
        return np.array([[tick.NEVER if v is None else v for v in np.atleast_1d(row)] for row in values])

    assert np.array_equal(log.tick.numpy(), now)
    for pairs, kind, at in ((fall, log.fall_trigger, log.fall_tick), (event, log.event, log.event_tick)):
        kinds, when = kind.numpy(), at.numpy()
        assert np.array_equal(kinds, [0 if p is None else p[0] for p in pairs]) and (kinds == 0).any()
        assert all(when[w] == p[1] for w, p in enumerate(pairs) if p is not None)
    assert np.array_equal(log.contact_tick.numpy(), ticks(contact)[:, 0])
    assert np.array_equal(log.predicate_ticks.numpy(), ticks(first))


def test_a_cleared_log_starts_over(device):
    """Clearing forgets the masked worlds alone."""
    log = tick.EpisodeLog.allocate(2, 1, device)
    every, ones = _ints([1, 1], device), _ints([[1], [1]], device)
    tick.launch_clear_log(log, every, 0)
    for _ in range(3):
        tick.launch_log(log, every, every, every, every, ones)
    tick.launch_clear_log(log, _ints([0, 1], device), -7)
    assert log.tick.numpy().tolist() == [3, -7]
    assert log.predicate_ticks.numpy()[:, 0].tolist() == log.contact_tick.numpy().tolist() == [1, tick.NEVER]
    assert log.fall_trigger.numpy().tolist() == log.event.numpy().tolist() == [1, 0]
