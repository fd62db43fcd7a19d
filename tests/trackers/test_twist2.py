"""TWIST2 sees the observation that its network was trained on, world by world."""

import numpy as np
import pytest
import torch
from made_inputs import inputs
from onnx_files import twist2_like

from arena_newton import trackers
from arena_newton.robot.g1 import DEFAULT_POSE, TWIST2_DRIVE
from arena_newton.trackers.twist2 import OBSERVATION, Twist2Tracker


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return twist2_like(tmp_path_factory.mktemp("twist2") / "like.onnx")


def tracker_on(checkpoint, worlds: int) -> Twist2Tracker:
    tracker = trackers.get("twist2", checkpoint)
    tracker.bind(worlds)
    return tracker


class Oracle:
    """The observation of one world in NumPy, written from its description."""

    def __init__(self):
        self.history = [np.zeros(127)] * 10
        self.last = np.zeros(29)

    def observe(self, command, state, world):
        mimic = command.mimic[world].numpy().astype(float)
        w, x, y, z = state.quat[world].numpy().astype(float)
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        velocity = 0.05 * state.joint_vel[world].numpy().astype(float)
        velocity[[4, 5, 10, 11]] = 0.0
        joints = state.joint_pos[world].numpy() - np.array(DEFAULT_POSE)
        spin = 0.25 * state.ang_vel_body[world].numpy()
        self.frame = np.concatenate([mimic, spin, [roll, pitch], joints, velocity, self.last])
        return np.clip(np.concatenate([self.frame, *self.history, mimic]), -100, 100)

    def advance(self, raw):
        self.history = [*self.history[1:], self.frame]
        self.last = raw


def test_observation_and_targets(checkpoint):
    """1432 numbers: current frame, ten past frames oldest first without the current one, the command again."""
    worlds = 5
    tracker = tracker_on(checkpoint, worlds)
    oracles = [Oracle() for _ in range(worlds)]
    seen = []
    run = tracker._runner.run

    def spy():
        seen.append(tracker.observation().clone())
        return run()

    tracker._runner.run = spy
    for tick in range(14):
        command, state = inputs(tick, worlds)
        if tick == 9:
            tracker.reset(torch.tensor([False, True, False, False, True]))
            oracles[1], oracles[4] = Oracle(), Oracle()
        targets = tracker.step(command, state)
        for world, oracle in enumerate(oracles):
            expected = oracle.observe(command, state, world)
            np.testing.assert_allclose(seen[-1][world].numpy(), expected, atol=2e-5)
            raw = tracker.last_action[world].numpy().copy()
            oracle.advance(raw)
            goal = np.array(DEFAULT_POSE) + 0.5 * np.clip(raw, -10, 10)
            np.testing.assert_allclose(targets[world].numpy(), goal, atol=1e-6)
    assert seen[0].shape == (worlds, OBSERVATION) == (worlds, 1432)


def test_clips(checkpoint):
    """Observations are clipped to ±100, targets to ±10 raw; the last action is kept unclipped."""
    tracker = tracker_on(checkpoint, 2)
    tracker._runner.run = lambda: torch.full((2, 29), -25.0)
    command, state = inputs(0, 2)
    command.mimic[0, 3] = 1e6
    targets = tracker.step(command, state)
    np.testing.assert_allclose(targets.numpy(), np.tile(np.array(DEFAULT_POSE) - 5.0, (2, 1)), atol=1e-6)
    assert (tracker.last_action == -25.0).all()
    assert tracker.observation()[0, 3] == 100.0 and tracker.observation()[0, 1397 + 3] == 100.0


def test_nan_stays_in_its_world(checkpoint):
    """NaN in one world leaves the others' bits alone and is gone after that world's reset."""
    clean, dirty = tracker_on(checkpoint, 4), tracker_on(checkpoint, 4)
    others = torch.tensor([0, 1, 3])
    for tick in range(3):
        command, state = inputs(tick, 4)
        expected = clean.step(command, state).clone()
        state.joint_pos[2], state.quat[2] = float("nan"), float("nan")
        assert torch.equal(dirty.step(command, state)[others], expected[others])
    reset = torch.tensor([False, False, True, False])
    clean.reset(reset)
    dirty.reset(reset)
    command, state = inputs(9, 4)
    assert torch.equal(clean.step(command, state), dirty.step(command, state))


def test_prefill(checkpoint):
    """Prefill repeats the present frame ten times in the worlds of the mask and leaves the others alone."""
    tracker = tracker_on(checkpoint, 3)
    command, state = inputs(0, 3)
    tracker.prefill(command, state, torch.tensor([True, False, True]))
    history = tracker.observation()[:, 127:1397].view(3, 10, 127)
    frame = Oracle()
    frame.observe(command, state, 2)
    np.testing.assert_allclose(history[2].numpy(), np.tile(frame.frame, (10, 1)), atol=2e-5)
    assert (history[1] == 0).all() and (history[0] != 0).any()


def test_declares(checkpoint):
    """The tracker declares its drive, its rates, its checkpoint and what of the action it ignores."""
    tracker = tracker_on(checkpoint, 1)
    assert tracker.drive is TWIST2_DRIVE and tracker.ignores == ("absolute heading", "absolute position")
    assert (tracker.physics_rate.dt, tracker.physics_rate.substeps) == (0.001, 20)
    assert (tracker.fast_physics_rate.dt, tracker.fast_physics_rate.substeps) == (0.005, 4)
    assert len(tracker.describe()["checkpoint_hash"]) == 12
