"""Gradients through a tick of engine `mujoco`: against differences, in every scene, and what has none."""

import re
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from arena_newton import tasks
from arena_newton.differentiable import EngineState, EngineStep
from arena_newton.differentiable.implicit import ImplicitWorld, Inputs, check
from arena_newton.errors import InputError
from arena_newton.physics.engines import make_physics
from arena_newton.physics.scene import load_scene
from arena_newton.robot.g1 import DEFAULT_POSE, PhysicsRate
from tests.scenes import scene

RATE = PhysicsRate(0.005, 4)
PARAMETERS = ("friction", "mass", "mass:/World/Robot/torso_link", "kp", "kd:/World/Robot/joints/left_knee_joint")


def stood(built, ticks=15, **options):
    """Physics of a robot that stood for some ticks in its default pose."""
    physics = make_physics(built, RATE, "mujoco", **options)
    robot, qpos = built.robot, physics.qpos0.copy()
    qpos[:, robot.root_qpos : robot.root_qpos + 7] = [0, -2, 0.8, 1, 0, 0, 0]
    qpos[:, robot.joint_qpos] = DEFAULT_POSE
    fixtures = (np.stack([part] * built.worlds) for part in (physics.mocap_pos0, physics.mocap_quat0))
    physics.reset_worlds(np.arange(built.worlds), qpos, *fixtures)
    ctrl = np.zeros((built.worlds, physics.nu), np.float32)
    ctrl[:, robot.joint_ctrl] = DEFAULT_POSE
    physics.ctrl.assign(ctrl)
    for _ in range(ticks):
        physics.step()
    return physics


def moved(model, qpos, direction):
    """Positions after a move along a tangent direction, shape [1, nq]."""
    row = qpos.numpy()[0].copy()
    mujoco.mj_integratePos(model, row, direction, 1.0)
    return torch.from_numpy(row)[None]


def cosine(a, b):
    """Cosine of the angle between two gradients."""
    return float(torch.nn.functional.cosine_similarity(torch.as_tensor(a), torch.as_tensor(b), dim=0))


@pytest.mark.parametrize("task", tasks.OWN)
def test_a_tick_has_the_slopes_of_differences(task):
    """In every scene, slopes to positions, velocities and targets are those of differences: in contact, things spin."""
    built, rng = scene(task), np.random.default_rng(3)
    physics = stood(built)
    model, exact, precise = physics.mj_model, EngineStep(physics), EngineStep(physics, converged=True)
    state = exact.state()
    assert physics.data[0].ncon >= 4
    for dof in model.jnt_dofadr[(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)].tolist():
        if dof != built.robot.root_qvel:
            state.qvel[0, dof + 3 : dof + 6] = torch.tensor([2.0, -1.0, 1.5])
    targets = physics.data[0].ctrl + 0.05 * rng.normal(size=(1, model.nu))
    targets[0, built.robot.joint_ctrl[3]] += 5.0  # the left knee's torque is at its limit
    leaves = [leaf.clone().requires_grad_() for leaf in (state.qpos, state.qvel, torch.from_numpy(targets))]
    weights = [torch.from_numpy(rng.normal(size=leaf.shape)) for leaf in leaves[:2]]

    def number(step, qpos, qvel, targets):
        after = step(EngineState(qpos, qvel, state.carried), targets)
        return (weights[0] * after.qpos).sum() + 0.1 * (weights[1] * after.qvel).sum()

    gradients = torch.autograd.grad(number(exact, *leaves), leaves)
    assert gradients[2][0, built.robot.joint_ctrl[3]] == 0.0
    given, width = [leaf.detach() for leaf in leaves], 1e-6
    for part, size in enumerate((model.nv, model.nv, model.nu)):
        slopes, estimates = [], []
        for direction in rng.normal(size=(8, size)):
            ends = [list(given), list(given)]
            for points, shift in zip(ends, (-width * direction, width * direction), strict=True):
                points[part] = moved(model, given[0], shift) if part == 0 else given[part] + shift
            below, above = (float(number(precise, *points)) for points in ends)
            estimates.append((above - below) / (2 * width))
            slopes.append(float((gradients[part] * (ends[1][part] - ends[0][part])).sum()) / (2 * width))
        assert cosine(slopes, estimates) >= 0.99999, ("positions", "velocities", "targets")[part]
        assert np.linalg.norm(slopes) == pytest.approx(np.linalg.norm(estimates), rel=1e-3)


def test_factors_of_the_model_over_a_run():
    """Through five ticks, friction, masses and gains have the slopes of centred differences of the whole run."""
    built = scene("football")
    physics = stood(built)
    exact, precise = EngineStep(physics, PARAMETERS), EngineStep(physics, PARAMETERS, converged=True)
    start, targets = exact.state(), torch.from_numpy(physics.data[0].ctrl.copy())[None]
    targets[0, built.robot.joint_ctrl[:6]] += 0.2

    def ended(step, factors):
        state = start
        for _ in range(5):
            state = step(state, targets, factors)
        return state.qpos[0, :3].sum() + state.qvel[0, :6].sum()

    factors = torch.ones(1, len(PARAMETERS), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(ended(exact, factors), factors)
    with torch.no_grad():
        moves = 1e-5 * torch.eye(len(PARAMETERS), dtype=torch.float64)
        estimate = [(ended(precise, 1 + move[None]) - ended(precise, 1 - move[None])) / 2e-5 for move in moves]
    assert gradient.abs().min() > 1e-4
    torch.testing.assert_close(gradient[0], torch.stack(estimate), rtol=1e-3, atol=1e-5)


def test_the_mass_of_what_spins_does_not_matter():
    """A hammer that spins in the air about a centre that is not its origin moves alike at any mass: the slope is 0."""
    built = scene("double_desk")
    physics = stood(built, ticks=1)
    step = EngineStep(physics, ("mass:/World/Hammer",))
    begin, targets = step.state(), torch.from_numpy(physics.data[0].ctrl.copy())[None]
    speed = built.joint_qvel("/World/Hammer")
    begin.qpos[0, built.joint_qpos("/World/Hammer") + 2] += 1.0
    begin.qvel[0, speed + 3 : speed + 6] = torch.tensor([2.0, -3.0, 4.0])
    factor = torch.ones(1, 1, dtype=torch.float64, requires_grad=True)
    after = step(begin, targets, factor).qvel[0, speed : speed + 6]
    (gradient,) = torch.autograd.grad(after.sum(), factor)
    assert (after - begin.qvel[0, speed : speed + 6])[3:].abs().max() > 1e-3  # the axis turns
    assert abs(float(gradient)) < 1e-8


def test_a_rigid_part_joined_to_what_spins_has_the_slopes_of_differences():
    """The engine integrates a free joint that is its tree's only one with -dC/dv, however many bodies it carries."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option integrator="implicitfast" timestep="0.005"/><worldbody><body pos="0 0 2"><freejoint/>'
        '<geom type="box" size=".05 .1 .2" pos=".02 .03 -.04" euler="20 30 40"/>'
        '<body pos=".3 0 .1" euler="10 20 30"><geom type="box" size=".1 .05 .04"/></body></body></worldbody></mujoco>'
    )
    check(model)
    data, spin = mujoco.MjData(model), np.array([0.0, 0.0, 0.0, 7.0, -5.0, 9.0])
    carried = np.empty(mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION)))
    mujoco.mj_getState(model, data, carried, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    world = ImplicitWorld(model, SimpleNamespace(latch=None), 1, [])
    slopes = world.jacobian(Inputs(data.qpos.copy(), spin, carried, np.zeros(0), np.zeros(0)))[0]

    def after(move):
        one = mujoco.MjData(model)
        one.qvel[:] = spin + move
        mujoco.mj_step(model, one)
        return one.qvel

    found = np.stack([(after(move) - after(-move)) / 2e-6 for move in 1e-6 * np.eye(6)], axis=1)
    np.testing.assert_allclose(slopes[6:, 6:], found, atol=1e-6)


def test_friction_moves_a_ball_that_hops_on_the_grass():
    """A ball at rest hops on its two contacts: its height has the slope of differences in friction, none in mass."""
    built = scene("football")
    physics = stood(built, ticks=1)
    names = ("friction", "mass:/World/Ball")
    exact, precise = EngineStep(physics, names), EngineStep(physics, names, converged=True)
    begin, targets = exact.state(), torch.from_numpy(physics.data[0].ctrl.copy())[None]
    height, speed = built.joint_qpos("/World/Ball") + 2, built.joint_qvel("/World/Ball")
    begin.qpos[0, height], begin.qvel[0, speed : speed + 6] = 0.11, 0.0

    def ended(step, factors):
        state = begin
        for _ in range(3):
            state = step(state, targets, factors)
        return state.qpos[0, height]

    factors = torch.ones(1, 2, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(ended(exact, factors), factors)
    with torch.no_grad():
        ends = [ended(precise, torch.tensor([[1 + side, 1.0]], dtype=torch.float64)) for side in (1e-7, -1e-7)]
    assert float(gradient[0, 0]) == pytest.approx(float(ends[0] - ends[1]) / 2e-7, rel=1e-2)
    assert abs(float(gradient[0, 1])) < 1e-6 * abs(float(gradient[0, 0]))


def test_forward_is_the_engine_and_threads_change_nothing():
    """Ticks are the engine's bit for bit, factors of 1 included; one thread and two give equal bits and gradients."""
    built = load_scene("football", worlds=2, device="cpu", native=True)
    found = []
    for threads in (1, 2):
        physics = stood(built, threads=threads)
        step = EngineStep(physics, PARAMETERS)
        state, targets = step.state(), torch.from_numpy(physics.ctrl.numpy().copy()).double()
        targets[1] += 0.0625
        physics.ctrl.assign(targets.numpy().astype(np.float32))
        targets = torch.from_numpy(physics.ctrl.numpy().copy()).requires_grad_()
        for _ in range(2):
            state = step(state, targets)
            physics.step()
        for world, data in enumerate(physics.data):
            assert np.array_equal(state.qpos[world].detach().numpy(), data.qpos)
            assert np.array_equal(state.qvel[world].detach().numpy(), data.qvel)
        found.append(torch.autograd.grad(state.qpos.square().sum(), targets)[0])
    assert torch.equal(*found) and not torch.equal(found[0][0], found[0][1])


def test_a_pressed_handle_releases_the_latch_for_the_next_tick():
    """The latch that a tick released stays open in the ticks after it, as in the engine."""
    built = scene("open_door")
    physics = stood(built, ticks=2)
    data, latch = physics.data[0], built.latch
    data.qpos[latch.handle_qpos] = latch.release_angle - 0.3
    step = EngineStep(physics)
    state, targets = step.state(), torch.from_numpy(physics.ctrl.numpy().copy())
    for _ in range(3):
        state = step(state, targets)
        physics.step()
    assert not physics.latch_locked.numpy()[0] and not data.eq_active[latch.equality]
    assert np.array_equal(state.qpos[0].numpy(), data.qpos)


JOINT = "<worldbody><body><geom size='.1'/><joint name='j' type='hinge'/></body></worldbody>"
DRIVE = "<actuator><position joint='j'/></actuator>"
IMPLICIT = "<option integrator='implicitfast'/>"
TENDON = "<tendon><fixed><joint joint='j' coef='1'/></fixed></tendon>"
MOTOR = "<actuator><motor joint='j'/></actuator>"
SPEED = "<actuator><velocity joint='j' kv='2'/></actuator>"
SLOW = "<actuator><position joint='j' timeconst='.1'/></actuator>"
ROUND = "<option integrator='implicitfast' cone='elliptic'/>"
AIR = "<option integrator='implicitfast' density='1.2'/>"


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (JOINT + DRIVE, "an integrator other than implicitfast"),
        (IMPLICIT + JOINT + DRIVE + TENDON, "a tendon"),
        (IMPLICIT + JOINT + MOTOR, "actuator 0, not a joint's position drive"),
        (IMPLICIT + JOINT + DRIVE.replace("</actuator>", "") + SPEED[10:], "actuator 1, not a joint's position drive"),
        (IMPLICIT + JOINT + SLOW, "an activation state"),
        (AIR + JOINT + DRIVE, "a fluid"),
        (ROUND + JOINT + DRIVE, "elliptic friction cones"),
    ],
)
def test_a_model_with_parts_that_have_no_gradient(parts, words):
    """A part of a model whose gradient is not known is refused by its name; without it the model is taken."""
    check(mujoco.MjModel.from_xml_string(f"<mujoco>{IMPLICIT}{JOINT}{DRIVE}</mujoco>"))
    with pytest.raises(InputError, match=re.escape(words)):
        check(mujoco.MjModel.from_xml_string(f"<mujoco>{parts}</mujoco>"))


def test_what_else_has_no_gradient():
    """Engine `warp`, unknown parameters and prims, outer forces, other shapes and factors are refused by name."""
    built = scene("football")
    physics = make_physics(built, RATE, "mujoco")
    with pytest.raises(InputError, match="engine warp has no gradient here: use engine mujoco"):
        EngineStep(SimpleNamespace(engine="warp"))
    with pytest.raises(InputError, match="parameter colour: must begin with mass, friction, kp or kd"):
        EngineStep(physics, ["colour"])
    for name in ("mass:/World/Nothing", "kp:/World/Ball"):
        with pytest.raises(InputError, match=f"parameter {name}: .* has nothing of the kind"):
            EngineStep(physics, [name])
    step = EngineStep(physics)
    state = step.state()
    with pytest.raises(InputError, match=r"targets of shape \[1, 29\], not \[1, 43\]"):
        step(state, torch.zeros(1, 29))
    with pytest.raises(InputError, match="a factor of the model is not above 0"):
        EngineStep(physics, ["kp"])(state, torch.zeros(1, 43), torch.zeros(1, 1))
    physics.external_force.assign(np.ones((1, physics.nbody, 6), np.float32))
    with pytest.raises(InputError, match="an external force acts on a body"):
        step.state()
