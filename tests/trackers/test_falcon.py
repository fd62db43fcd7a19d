"""Packages bring trackers with one class and an entry point: FALCON, whose weights are its own; the example's."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from arena_newton import trackers
from arena_newton.errors import InputError
from arena_newton.testing import check_tracker
from arena_newton.trackers.evaluation.suite import Cell
from arena_newton.trackers.evaluation.suite_rollout import make_plan, play
from arena_newton.trackers.motions import primitives

PACKAGE = Path(__file__).parent / "falcon_package"


@pytest.fixture
def weights(shared):
    return shared / "reference/falcon/falcon_g1_29dof.onnx"


def test_package_uses_public_names():
    """The stranger's source touches nothing of ours that begins with an underscore."""
    source = (PACKAGE / "falcon_tracker/__init__.py").read_text()
    assert not re.search(r"\._[a-z]|import _[a-z]", source)


def test_registers(installed_falcon):
    """Installed, it is listed beside our own trackers and says what it needs."""
    assert "falcon" in trackers.names()
    with pytest.raises(InputError, match="g1_29dof.onnx"):
        trackers.get("falcon")


def test_observation(installed_falcon, weights):
    """575 numbers: five frames, oldest first, terms in the order of their names; arms ride on the reference."""
    tracker = trackers.get("falcon", weights)
    tracker.bind(2)
    command = trackers.TrackerCommand(torch.randn(2, 35), torch.randn(2, 29), torch.randn(2, 29), torch.randn(2, 4))
    quat = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.5**0.5, 0.5**0.5, 0.0, 0.0]])
    state = trackers.RobotState(quat, torch.randn(2, 3), torch.randn(2, 29), torch.randn(2, 29))
    tracker.prefill(command, state)
    targets = tracker.step(command, state)
    frames = tracker.observation().view(2, 5, 115)
    assert torch.equal(frames[:, 0], frames[:, 3])
    np.testing.assert_allclose(frames[:, 3, 98:101].numpy(), [[0.0, 0.0, -1.0], [0.0, -1.0, 0.0]], atol=1e-6)
    assert torch.equal(frames[:, 3, 101:], command.joints[:, 15:])
    torch.testing.assert_close(targets[:, 15:], command.joints[:, 15:] + 0.25 * tracker.last_action[:, 15:])


def test_stands_and_walks(installed_falcon, weights):
    """FALCON keeps the robot up in our physics for 4 s and walks forward on command, through the usual environment."""
    import dataclasses

    from arena_newton.env import STAND_ACTION, ArenaEnv

    env = ArenaEnv("football", tracker=trackers.get("falcon", weights), worlds=2, engine="mujoco", device="cpu")
    env.spec = dataclasses.replace(env.spec, spawn_position=(0.0, -15.0, 0.8))
    env.reset([0, 0])
    actions = torch.from_numpy(STAND_ACTION).repeat(2, 1)
    for _ in range(env.startup_ticks):
        env.step(actions)
    start = env.physics.qpos.numpy()[:, :2].copy()
    actions[1, 0] = 0.4 * 0.02
    for _ in range(200):
        env.step(actions)
    root = env.scene.robot.root_qpos
    qpos = env.physics.qpos.numpy()[:, root : root + 7]
    assert (qpos[:, 2] > 0.65).all(), f"fell: pelvis heights {qpos[:, 2]}"
    travelled = np.linalg.norm(qpos[:, :2] - start, axis=1)
    assert travelled[0] < 0.5 and 0.7 < travelled[1] < 2.2, travelled


def test_example_with_needs_conforms(installed_homing):
    """Installed, it is made by name and argument, keeps every promise and describes gain and window."""
    tracker = trackers.get("homing:0.25")
    assert all(result.ok for result in check_tracker(tracker))
    described = trackers.get("homing:0.25").describe()
    assert (described["gain"], described["lookahead"]) == (0.25, 2)
    with pytest.raises(InputError, match="--tracker homing:fast: expected a gain in 1/s"):
        trackers.get("homing:fast")


def test_example_with_needs_drifts_less(installed_homing):
    """State estimation pays: a walk ends nearer to its reference than TWIST2's, which sees no position."""
    plan = make_plan([Cell("walk", "walk", 4.0, primitives.walk(0.5, seconds=4.0, pause=0.0))], 3, 0)
    drift = {
        name: play(trackers.get(name), plan, device="cpu").measures["drift"].mean() for name in ("twist2", "homing")
    }
    assert drift["homing"] < 0.7 * drift["twist2"], drift
