"""Gradients beyond the kernels: of a ball's flight by Newton's solver, of the closed loop by central differences."""

import re
from pathlib import Path

import newton
import numpy as np
import pytest
import torch
import warp as wp

from arena_newton import ArenaEnv, trackers
from arena_newton.differentiable import (
    ReferenceState,
    RollingBall,
    ball_flight,
    central_differences,
    cross_entropy,
    play,
    reference_step,
)
from arena_newton.errors import InputError
from arena_newton.physics.ball import BALL
from arena_newton.robot import canonical
from arena_newton.robot.g1 import TICK

FOOTBALL = RollingBall(radius=0.11, mass=0.43, friction=0.7, restitution=0.1)
ON_GROUND = [0.0, 0.0, 0.11]


def flown(velocity, ticks, start=ON_GROUND, ball=FOOTBALL):
    """Path of one ball, shape [ticks + 1, 3]."""
    return ball_flight(torch.tensor([start]), torch.as_tensor(velocity).float()[None], ball, ticks=ticks)[:, 0]


def slopes(velocity, ticks, step):
    """Central differences of where a ball ends, shape [components of its velocity, axes]."""
    shift = step * torch.cat([torch.eye(3), -torch.eye(3)])
    moved = torch.as_tensor(velocity).float() + shift
    with torch.no_grad():
        end = ball_flight(torch.tensor([ON_GROUND] * 6), moved, FOOTBALL, ticks=ticks)[-1]
    return (end[:3] - end[3:]) / (2 * step)


@pytest.fixture(scope="module")
def pitch():
    """One world of football, whose engine steps at 5 ms as TWIST2's does; nobody touches the ball."""
    env = ArenaEnv("football", tracker=trackers.get("pd"), worlds=1, engine="mujoco", device="cpu", fast_physics=True)
    yield env
    env.close()


def kicked(env, velocity, ticks, spin=(0.0, 0.0, 0.0)):
    """Path of the engine's ball, shape [ticks + 1, 3], from a start on the ground."""
    env.reset([7], spawn=lambda seed: ((0.0, -5.0, 0.8), (1.0, 0.0, 0.0, 0.0)))
    data, body = env.physics.data[0], env.judge.ball
    address, speed = env.scene.joint_qpos(BALL), env.scene.joint_qvel(BALL)
    data.qvel[speed : speed + 6] = [*velocity, *spin]
    path = [data.qpos[address : address + 3].copy()]
    for _ in range(ticks):
        env.physics.step()
        path.append(env.physics.xpos.numpy()[0, body].copy())
    return np.array(path)


def test_a_free_ball_falls_as_the_formula_says():
    """In the air the path is x + v·t − g·t²/2 up to the integrator's half step, and its gradient to v is t."""
    velocity = torch.tensor([1.0, -2.0, 3.0], requires_grad=True)
    path = flown(velocity, 10, start=[0.0, 0.0, 2.0])
    t = 10 * TICK
    expected = torch.tensor([1.0 * t, -2.0 * t, 2.0 + 3.0 * t - 0.5 * 9.81 * t * (t + 0.001)])
    torch.testing.assert_close(path[-1].detach(), expected, atol=1e-4, rtol=0.0)
    for axis in range(3):
        (grad,) = torch.autograd.grad(path[-1, axis], velocity, retain_graph=True)
        torch.testing.assert_close(grad, t * torch.eye(3)[axis], atol=1e-5, rtol=0.0)


def test_a_rolling_ball_has_the_gradient_of_differences():
    """Through sliding and rolling, place and velocity at the start have the gradients of central differences."""
    velocity = torch.tensor([1.5, 5.0, 0.0], requires_grad=True)
    last, found = flown(velocity, 20)[-1], slopes(velocity.detach(), 20, 0.05)
    grads = [torch.autograd.grad(last[axis], velocity, retain_graph=axis == 0)[0] for axis in range(2)]
    for axis, grad in enumerate(grads):
        torch.testing.assert_close(grad[:2], found[:2, axis], atol=5e-3, rtol=0.0)
    assert 5 / 7 * 20 * TICK * 0.98 < float(grads[1][1]) < 20 * TICK


def test_balls_of_a_batch_do_not_meet():
    """Each ball of a batch flies as it flies alone, even from the same place."""
    velocity = torch.tensor([[1.0, 0.0, 2.0], [0.0, 3.0, 0.0], [-1.0, 0.0, 2.0]] * 2)
    together = ball_flight(torch.tensor([ON_GROUND] * 6), velocity, FOOTBALL, ticks=8)
    for ball in range(2, 5):
        assert torch.equal(together[:, ball], flown(velocity[ball], 8))


@pytest.mark.parametrize("restitution", [0.1, 0.75])
def test_a_dropped_ball_bounces_as_its_restitution_says(restitution):
    """Dropped from 1 m it rises to e² of it: the root of the ratio is e ± 0.03."""
    ball = RollingBall(radius=0.11, mass=0.43, friction=0.7, restitution=restitution)
    height = flown([0.0, 0.0, 0.0], 41, start=[0.0, 0.0, 1.11], ball=ball)[:, 2] - 0.11
    landed = int(height.argmin())
    assert float(height[landed + 1 :].max().clamp(min=0.0).sqrt()) == pytest.approx(restitution, abs=0.03)


def test_balls_go_where_the_engines_go(pitch):
    """Rolled balls stay within centimetres of the engine's for 1.5 s; one that spins on the spot comes as far ± 1 %."""
    starts = [([0, 2, 0], [0, 0, 0], 0.02), ([3, 3, 0], [0, 0, 0], 0.09), ([0, 0, 0], [0, 5, 0], 0.02)]
    real = np.stack([kicked(pitch, velocity, 75, spin) for velocity, spin, _ in starts], axis=1)
    ball = RollingBall.of(pitch.scene)
    assert (ball.radius, ball.restitution) == (pytest.approx(0.11), 0.1)
    velocity, spin = (torch.tensor([start[part] for start in starts]).float() for part in (0, 1))
    path = ball_flight(torch.tensor(real[0]).float(), velocity, ball, ticks=75, spin=spin).numpy()
    assert (np.linalg.norm(path - real, axis=2).max(axis=0) < [apart for _, _, apart in starts]).all()
    gone, expected = path[30, 2, 0] - path[0, 2, 0], real[30, 2, 0] - real[0, 2, 0]
    assert expected > 0.05 and gone == pytest.approx(expected, rel=0.01)


def test_a_landing_does_not_move_with_the_vertical_speed():
    """Behind a bounce one gradient is wrong, as the documentation warns with its numbers."""
    velocity = torch.tensor([0.0, 5.0, 2.0], requires_grad=True)
    end = flown(velocity, 50)[-1, 1]
    (grad,) = torch.autograd.grad(end, velocity)
    found = slopes(velocity.detach(), 50, 0.02)[:, 1]
    assert float(grad[1]) == pytest.approx(float(found[1]), rel=1e-3)
    assert abs(float(grad[2]) - float(found[2])) > 0.1
    page = (
        (Path(__file__).parents[2] / "docs" / "howto" / "program" / "gradient_examples.md")
        .read_text()
        .replace("−", "-")
    )
    told = re.search(r"\((\S+) against (\S+) by differences, 1 s .*?\((\S+) against (\S+)\)", page, re.DOTALL)
    assert told, "docs/howto/program/gradient_examples.md no longer says what a bounce does"
    measured = (grad[1], found[1], grad[2], found[2])
    assert [float(number) for number in told.groups()] == [pytest.approx(float(one), abs=0.006) for one in measured]


def test_shapes_that_do_not_fit_are_named():
    """Another shape than [n, 3] is one error that shows the shapes."""
    with pytest.raises(InputError, match=r"ball_flight: .*\[2, 3\], \[1, 3\]"):
        ball_flight(torch.zeros(2, 3), torch.zeros(1, 3), FOOTBALL, ticks=2)
    with pytest.raises(InputError, match="expected"):
        ball_flight(torch.zeros(0, 3), torch.zeros(0, 3), FOOTBALL, ticks=2)


def test_differences_of_a_known_function():
    """A quadratic's gradient is exact whatever the batch; points are as many as twice the parameters and one."""
    matrix = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    asked = []

    def function(points):
        asked.append(len(points))
        return ((points @ matrix) * points).sum(1)

    at = torch.tensor([1.0, -2.0], dtype=torch.float64)
    for rows in (1, 3, 8):
        asked.clear()
        found = central_differences(function, at, torch.tensor([0.1, 0.2]), rows=rows)
        torch.testing.assert_close(found.gradient, 2 * matrix @ at)
        torch.testing.assert_close(found.bend, torch.tensor([0.2, 0.2], dtype=torch.float64))
        assert asked == [rows] * -(-5 // rows)
        assert found.value == pytest.approx(4.0)


def test_the_cross_entropy_method_finds_a_minimum():
    """The mean of its best moves to the minimum of a quadratic; every generation has as many draws as were asked."""
    torch.manual_seed(0)
    wanted = torch.tensor([0.3, -0.5], dtype=torch.float64)
    search = cross_entropy(lambda points: (points - wanted).square().sum(1), 0.0 * wanted, 0.5, draws=60)
    *_, (mean, values) = (next(search) for _ in range(12))
    assert values.shape == (60,)
    torch.testing.assert_close(mean, wanted, atol=1e-2, rtol=0.0)


def test_a_kink_tells_itself():
    """`bend` is as large as the gradient's error if the slope changes within the step; elsewhere it is zero."""
    found = central_differences(lambda points: points.abs().sum(1), torch.tensor([0.0, 1.0]), 0.1, rows=5)
    torch.testing.assert_close(found.gradient, torch.tensor([0.0, 1.0]), atol=1e-6, rtol=0.0)
    torch.testing.assert_close(found.bend, torch.tensor([1.0, 0.0]), atol=1e-6, rtol=0.0)
    with pytest.raises(InputError, match=r"shape \[5, 2\] for 5 rows"):
        central_differences(lambda points: points, torch.tensor([0.0, 1.0]), 0.1, rows=5)


def test_the_estimate_is_the_exact_gradient_where_both_exist():
    """Differences of the reference's end after some ticks of the closed loop agree with the kernels' gradient."""
    env = ArenaEnv("football", tracker=trackers.get("pd"), worlds=5, engine="mujoco", device="cpu", fast_physics=True)
    stand = torch.tensor(canonical.STAND_ACTION)
    names = torch.tensor([0, 1, 5, 7])  # both displacements, and where the rotation's first column points
    weight = torch.tensor([1.0, -0.7, 0.3])
    at = stand[names] + torch.tensor([0.01, -0.02, 0.05, 0.1])
    states = []

    def ended(points):
        env.reset([11] * 5)
        for _ in range(env.startup_ticks):
            env.step(stand.repeat(5, 1))
        env.observe()
        states.append(ReferenceState.of(env.loop.reference))
        actions = stand.repeat(5, 1)
        actions[:, names] = points
        for _ in range(4):
            env.step(actions)
        return wp.to_torch(env.loop.reference.position) @ weight

    estimated = central_differences(ended, at, 2e-3, rows=5)
    leaf, state = at.clone().requires_grad_(), ReferenceState(*(field[:1] for field in states[0]))
    action = stand.index_put((names,), leaf)[None]
    for _ in range(4):
        _, state = reference_step(action, state)
    (exact,) = torch.autograd.grad((state.position @ weight).sum(), leaf)
    assert exact.abs().min() > 1e-3
    torch.testing.assert_close(estimated.gradient, exact, atol=2e-3, rtol=2e-3)
    env.close()


def test_a_fallen_world_reaches_nothing_more():
    """A world's margin is −inf from the tick of a fall or an error on, whatever its bodies do."""
    env = ArenaEnv("vis_navi", tracker=trackers.get("pd"), worlds=2, engine="mujoco", device="cpu", rules="released")
    actions = torch.tensor(canonical.STAND_ACTION).repeat(2, 6, 1)
    actions[1, 3] = torch.nan
    margin = play(env, actions, seed=5).margin
    assert margin[:, 0].isfinite().all() and margin[:3, 1].isfinite().all()
    assert margin[3:, 1].eq(-torch.inf).all()
    env.close()


def test_the_engines_solver_has_no_adjoints():
    """The modules of a step of mujoco_warp are compiled without adjoints: when that changes, the documentation must."""
    import mujoco_warp._src.collision_driver
    import mujoco_warp._src.constraint
    import mujoco_warp._src.forward
    import mujoco_warp._src.passive
    import mujoco_warp._src.smooth
    import mujoco_warp._src.solver  # noqa: F401

    for name in ("collision_driver", "constraint", "forward", "passive", "smooth", "solver"):
        assert wp.get_module(f"mujoco_warp._src.{name}").options["enable_backward"] is False


@pytest.mark.release
def test_newtons_featherstone_has_the_slope_of_the_wrong_sign():
    """A pendulum that a constant force pushes, without contact: when its slope is right, the documentation must change.

    The speed after a step is −h L f cos(q) / I. The step by Newton's adjoint has minus its slope, because the kernel
    `eval_rigid_tau` writes over the force that it reads, and runs backward from what it wrote.
    """
    angle, length, force, mass, inertia, step = 0.3, 0.5, 200.0, 1.0, 0.1, 0.01
    builder = newton.ModelBuilder(gravity=wp.vec3(0.0, 0.0, 0.0))
    diagonal = wp.mat33(np.eye(3, dtype=np.float32) * inertia)
    link = builder.add_link(mass=mass, inertia=diagonal, com=wp.vec3(0.0, 0.0, -length))
    builder.add_articulation([builder.add_joint_revolute(-1, link, axis=newton.Axis.Y)])
    model = builder.finalize(device="cpu", requires_grad=True)

    def pushed(angle):
        """State before a step and after it, and its tape."""
        solver = newton.solvers.SolverFeatherstone(model, angular_damping=0.0)
        before, after, tape = model.state(requires_grad=True), model.state(requires_grad=True), wp.Tape()
        before.joint_q.assign([angle])
        before.body_f.assign(np.array([[force, 0, 0, 0, 0, 0]], np.float32))
        with tape:
            newton.eval_fk(model, before.joint_q, before.joint_qd, before)
            solver.step(before, after, model.control(), None, step)
        return before, after, tape

    before, after, tape = pushed(angle)
    tape.backward(grads={after.joint_qd: wp.ones(1, dtype=wp.float32, device="cpu")})
    moved = [pushed(angle + shift)[1].joint_qd.numpy()[0] for shift in (-0.01, 0.01)]
    slope = step * length * force * np.sin(angle) / (inertia + mass * length**2)
    assert (moved[1] - moved[0]) / 0.02 == pytest.approx(slope, rel=1e-3)
    assert before.joint_q.grad.numpy()[0] == pytest.approx(-slope, rel=1e-3), (
        "mended: docs/howto/program/gradients.md must say so"
    )


def test_worlds_differ_by_their_actions_alone():
    """Played from one seed, equal actions reach equal bits and others another margin; what does not fit is named."""
    env = ArenaEnv("vis_navi", tracker=trackers.get("pd"), worlds=3, engine="mujoco", device="cpu", rules="released")
    actions = torch.tensor(canonical.STAND_ACTION).repeat(3, 12, 1)
    actions[1, :, canonical.ACTION["joint_pos"]] += 0.3
    played = play(env, actions, seed=5)
    assert torch.equal(played.xpos[:, 0], played.xpos[:, 2]) and played.xpos.shape[:2] == (12, 3)
    assert played.best[0] == played.best[2] != played.best[1] and played.margin.isfinite().all()
    assert not env.active.any()
    with pytest.raises(InputError, match=r"shape \[2, 12, 40\] for 3 worlds"):
        play(env, actions[:2], seed=5)
    env.close()


def test_the_documented_programs_run():
    """The blocks of docs/howto/program/gradients.md give finite slopes: of a tick, a closed loop, speed and height."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "howto" / "program" / "gradients.md").read_text()
    tick, loop, estimate = re.findall(r"^```python\n(.*?)^```$", page, flags=re.DOTALL | re.MULTILINE)
    world: dict = {"__name__": "docs_gradients"}
    exec(compile(tick, "docs/howto/program/gradients.md", "exec"), world)
    for leaf in (world["targets"], world["factors"]):
        assert leaf.grad.isfinite().all() and leaf.grad[0].abs().max() > 0.0
    exec(compile(loop, "docs/howto/program/gradients.md", "exec"), world)
    for leaf in (world["plan"], world["qpos"], world["rolled"].factors):
        assert leaf.grad.isfinite().all()
    assert world["qpos"].grad.abs().max() > 0.1
    exec(compile(estimate, "docs/howto/program/gradients.md", "exec"), world)
    found = world["found"]
    assert found.gradient.shape == found.bend.shape == (2,) and found.gradient.isfinite().all()
    assert found.gradient[0] != 0.0
