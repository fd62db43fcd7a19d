"""Factors of a model and a latency, fitted to a recording in windows; and all slopes of a tick at once."""

import pytest
import torch

from arena_newton.differentiable import EngineStep, RobotRecording, Windows
from arena_newton.errors import InputError
from arena_newton.physics.scene import load_scene
from tests.arena_newton.test_engine_step import stood

NAMES = ("friction", "mass:/World/Robot/torso_link,/World/Robot/pelvis", "kp")
TRUTH = torch.tensor([0.1, 0.2, -0.15, 1.3], dtype=torch.float64)
"""Logarithms of factors, and a latency [ticks]."""
TICKS = 20
NOISE = 3e-4


@pytest.fixture(scope="module")
def physics():
    """Two worlds in which the robot stands."""
    return stood(load_scene("football", worlds=2, device="cpu", native=True))


@pytest.fixture(scope="module")
def recorded(physics):
    """Another robot whose joints sway, as noisy sensors see it."""
    draws = torch.Generator().manual_seed(0)
    step, robot = EngineStep(physics, NAMES), physics.scene.robot
    state, dofs = step.state(), physics.mj_model.nv
    sent = torch.from_numpy(physics.ctrl.numpy()).double()[:1].repeat(TICKS, 1)
    sent[:, robot.joint_ctrl] += 0.03 * torch.randn(TICKS, len(robot.joint_ctrl), generator=draws).double().cumsum(0)
    late = [sent[max(tick - 1, 0)].lerp(sent[max(tick - 2, 0)], 0.3) for tick in range(TICKS)]
    states, factors = [state], TRUTH[:3].exp().repeat(2, 1)
    for targets in late:
        states.append(step(states[-1], targets.repeat(2, 1), factors))
    qpos, qvel = (torch.stack([row[0] for row in column]) for column in list(zip(*states, strict=True))[:2])
    qpos[:, robot.joint_qpos] += NOISE * torch.randn(TICKS + 1, len(robot.joint_qpos), generator=draws).double()
    qvel[:, robot.joint_qvel] += 10.0 * NOISE * torch.randn(TICKS + 1, len(robot.joint_qvel), generator=draws).double()
    noise = torch.tensor([[NOISE], [10.0 * NOISE]], dtype=torch.float64).repeat(1, dofs)
    noise[:, physics.scene.joint_qvel("/World/Ball") :][:, :6] = torch.inf
    return RobotRecording(qpos, qvel, sent, noise.flatten())


def test_all_slopes_of_a_tick_are_its_gradients(physics):
    """Rows of `jacobian` are the gradients of a tick's numbers, to speeds, targets and factors, in contact."""
    step, draws = EngineStep(physics, NAMES), torch.Generator().manual_seed(1)
    state, nv = step.state(), physics.mj_model.nv
    targets = torch.from_numpy(physics.ctrl.numpy()).double()
    weights = torch.randn(2, nv, generator=draws).double()
    leaves = [leaf.clone().requires_grad_() for leaf in (state.qvel, targets, torch.ones(2, 3).double())]
    after = step(state._replace(qvel=leaves[0]), *leaves[1:])
    gradients = torch.autograd.grad((weights * after.qvel).sum(), leaves)
    by_state, *others = step.jacobian(state, targets, torch.ones(2, 3).double())
    for gradient, slopes in zip(gradients, (by_state[..., nv:], *others), strict=True):
        assert gradient.abs().max() > 1e-3
        torch.testing.assert_close((weights[:, None] @ slopes[:, nv:])[:, 0], gradient, rtol=1e-6, atol=1e-9)


def test_a_robot_is_known_from_windows(physics, recorded):
    """Friction, mass, stiffness and latency come out within four standard errors, and noise alone is left."""
    windows, spread = Windows(physics, recorded, NAMES, ticks=7), torch.full((4,), 0.3).double()
    guess = torch.tensor([0.0, 0.0, 0.0, 0.5], dtype=torch.float64)
    *_, last = windows.fit(guess, spread)
    errors = (last.numbers - TRUTH).abs()
    assert (errors < 4.0 * torch.linalg.inv(last.information).diagonal().sqrt()).all(), errors
    noisy = len(physics.scene.robot.joint_qvel) / 49  # the pelvis and the fingers are as exact as the step itself
    assert errors.max() < 0.01 and last.misfit == pytest.approx(noisy, abs=0.15)
    assert last.surprise < -5.0  # fewer numbers are noisy than it is told
    halved = recorded._replace(noise=recorded.noise / 2.0)  # twice the noise that it is told: nothing explains it
    *_, wrong = Windows(physics, halved, NAMES, ticks=7).fit(last.numbers, last.information)
    assert wrong.surprise > 5.0
    *_, on = windows.fit(last.numbers, last.information)  # an earlier fit's knowledge counts as a measurement
    assert (on.information.diagonal() > 1.5 * last.information.diagonal()).all()
    assert windows.misfit(TRUTH) < windows.misfit(guess)
    assert len(list(windows.fit(guess, spread, iterations=2, starts=False))) <= 2


def test_a_window_astray_is_left_out(physics, recorded):
    """Targets that are wrong in one of two windows do not count in the end, and the numbers are those of the other."""
    targets = recorded.targets.clone()
    targets[12:16, physics.scene.robot.joint_ctrl[:6]] += 0.3
    windows = Windows(physics, recorded._replace(targets=targets), NAMES, ticks=7)
    *_, last = windows.fit(torch.tensor([0.0, 0.0, 0.0, 0.5]).double(), torch.full((4,), 0.3).double())
    assert last.kept.tolist() == [True, False] and last.misfit < 1.2
    assert (last.numbers - TRUTH).abs().max() < 0.15


def test_a_recording_that_is_too_short(physics, recorded):
    """Windows that reach beyond the recording are refused with both numbers."""
    with pytest.raises(InputError, match="20 ticks recorded, 24 needed"):
        Windows(physics, recorded, NAMES, ticks=10)
