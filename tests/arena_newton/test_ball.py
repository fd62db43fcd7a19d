"""Football's ball bounces as the rule set says, at both physics rates and on both engines."""

import dataclasses

import numpy as np
import pytest

from arena_newton import rule_sets
from arena_newton.physics.ball import BALL, BALL_SKIN, SKIN_HEIGHT, ball_solref, set_restitution
from arena_newton.physics.engines import make_physics
from arena_newton.physics.scene import load_scene
from arena_newton.robot.g1 import PhysicsRate
from tests.scenes import scene

HEIGHTS = np.array([0.3, 1.0, 3.0])
"""[m]."""
PHASES = np.array([0.05, 0.35, 0.65, 0.95])
"""Fractions of a physics step at which the ball meets the ground."""
RADIUS, GRAVITY = 0.11, 9.81
RATES = {0.001: PhysicsRate(0.001, 1), 0.005: PhysicsRate(0.005, 1)}


@pytest.fixture(scope="module", params=["mujoco", "warp"])
def drops(request):
    """Engine and a scene with one world for each height and phase."""
    worlds = len(HEIGHTS) * len(PHASES)
    built = load_scene(
        "football", worlds=worlds, device="cpu", native=request.param == "mujoco", rules=rule_sets.get("paper")
    )
    return request.param, built


def thrown(drops, restitution: float, dt: float, height, velocity):
    """Physics whose balls start at these heights over the grass [m] with these velocities [worlds, 6], and q̇'s address.

    The robots are out of the way.
    """
    engine, built = drops
    built = dataclasses.replace(built, ball_restitution=restitution)
    physics = make_physics(built, RATES[dt], engine, 1)
    q, v = built.joint_qpos(BALL), built.joint_qvel(BALL)
    qpos, worlds = physics.qpos0.copy(), np.arange(physics.worlds)
    qpos[:, built.robot.root_qpos] += 50.0
    qpos[:, q : q + 2] = 3.5, -4.0
    qpos[:, q + 2] = RADIUS + height
    none = np.zeros((physics.worlds, 0, 3)), np.zeros((physics.worlds, 0, 4))
    physics.reset_worlds(worlds, qpos, *none)
    if engine == "mujoco":
        for w in worlds:
            physics.data[w].qvel[v : v + 6] = velocity[w]
    else:
        qvel = physics.qvel.numpy()
        qvel[:, v : v + 6] = velocity
        physics.qvel.assign(qvel)
    return physics, q, v


def bounce(drops, restitution: float, dt: float, steps: int) -> np.ndarray:
    """Speed of parting over speed of approach, shape [heights, phases]."""
    speed = np.repeat(np.sqrt(2 * GRAVITY * HEIGHTS), len(PHASES))
    phase = np.tile(PHASES, len(HEIGHTS))
    # After one free step the ball is a part of a step's way above the ground, after the next one in it.
    physics, _, v = thrown(drops, restitution, dt, speed * dt * (2.0 - phase), np.outer(-speed, np.eye(6)[2]))
    fastest, slowest = np.full(physics.worlds, -np.inf), np.zeros(physics.worlds)
    for _ in range(steps):
        physics.step()
        vertical = physics.qvel.numpy()[:, v + 2]
        fastest, slowest = np.maximum(fastest, vertical), np.minimum(slowest, vertical)
    return (fastest / -slowest).reshape(len(HEIGHTS), len(PHASES))


@pytest.mark.parametrize("rate", [0.001, 0.005])
@pytest.mark.parametrize("rule_set", ["paper", "released"])
def test_the_ball_bounces_as_the_rule_says(drops, rule_set, rate):
    """Dropped from 0.3, 1 and 3 m it leaves with the stated part of its speed ± 0.03, wherever in a step it lands."""
    restitution = rule_sets.get(rule_set).ball_restitution
    assert bounce(drops, restitution, rate, 8) == pytest.approx(restitution, abs=0.03)


@pytest.mark.parametrize("rate", [0.001, 0.005])
@pytest.mark.parametrize("rule_set", ["paper", "released"])
def test_the_ball_rises_by_the_square_of_its_restitution(rule_set, rate):
    """Dropped from rest it rises to e² of each height: the root of their ratio is e ± 0.03."""
    import mujoco

    built = scene("football", rules=rule_set)
    set_restitution(built, built.ball_restitution, rate)
    model, data = built.mj_model, mujoco.MjData(built.mj_model)
    model.opt.timestep = rate
    q, v = built.joint_qpos(BALL), built.joint_qvel(BALL)
    for height in HEIGHTS:
        mujoco.mj_resetData(model, data)
        data.qpos[built.robot.root_qpos] += 50.0
        data.qpos[q : q + 3] = (3.5, -4.0, RADIUS + height)
        while data.qpos[q + 2] > RADIUS:
            mujoco.mj_step(model, data)
        mujoco.mj_step(model, data)
        while data.qvel[v + 2] > 0.0:
            mujoco.mj_step(model, data)
        rise = np.sqrt(max(data.qpos[q + 2] - RADIUS, 0.0) / height)
        assert rise == pytest.approx(built.ball_restitution, abs=0.03), height


def on_the_grass(built, rate):
    """The ball at rest on the pitch, its contacts set for a physics step, and the robot out of the way."""
    import mujoco

    set_restitution(built, built.ball_restitution, rate)
    built.mj_model.opt.timestep = rate
    data = mujoco.MjData(built.mj_model)
    data.qpos[built.robot.root_qpos] += 50.0
    at = built.joint_qpos(BALL)
    data.qpos[at : at + 3] = (3.5, -4.0, RADIUS)
    return data


@pytest.mark.parametrize("rule_set", ["paper", "released"])
def test_a_bouncing_ball_also_rolls_and_rests(rule_set):
    """The contact that bounces takes no speed from a rolling ball and keeps a resting one on the grass."""
    import mujoco

    built = scene("football", rules=rule_set)
    model, q, v = built.mj_model, built.joint_qpos(BALL), built.joint_qvel(BALL)
    for rate in RATES:
        data = on_the_grass(built, rate)
        data.qvel[v : v + 6] = (0, 0.9, 0, -0.9 / RADIUS, 0, 0)
        mujoco.mj_step(model, data, round(2.0 / rate))
        assert data.qvel[v + 1] == pytest.approx(0.9, abs=0.01)
        assert RADIUS - 1e-4 < data.qpos[q + 2] < RADIUS + SKIN_HEIGHT + 1e-4


@pytest.mark.parametrize("rule_set", ["paper", "released"])
def test_a_sliding_ball_stays_down(rule_set):
    """A ball that slides over the grass at 3 m/s, as after a kick, hops less than 5 mm and takes up its roll."""
    import mujoco

    built = scene("football", rules=rule_set)
    model, q, v = built.mj_model, built.joint_qpos(BALL), built.joint_qvel(BALL)
    for rate in RATES:
        data = on_the_grass(built, rate)
        data.qvel[v + 1] = 3.0
        top = 0.0
        for _ in range(round(0.8 / rate)):
            mujoco.mj_step(model, data)
            top = max(top, float(data.qpos[q + 2]) - RADIUS)
        assert top < 5e-3
        assert data.qvel[v + 1] == pytest.approx(3.0 * 5 / 7, abs=0.05), "of a solid sphere five sevenths are left"


def test_the_ball_rests_rolls_and_slides_alike_on_both_engines(drops):
    """At rest it stays on the grass, rolling it keeps its speed, sliding at 3 m/s it stays down and starts to roll."""
    starts = np.zeros((3, 6))
    starts[1:, 1] = 0.9, 3.0
    starts[1, 3] = -0.9 / RADIUS
    physics, q, v = thrown(drops, 0.1, 0.005, 0.0, np.repeat(starts, drops[1].worlds // 3, axis=0))
    top = 0.0
    for _ in range(50):
        physics.step()
        top = np.maximum(top, physics.qpos.numpy()[:, q + 2] - RADIUS)
    height, speed = physics.qpos.numpy()[:, q + 2] - RADIUS, physics.qvel.numpy()[:, v + 1]
    resting, rolling, sliding = np.split(np.arange(physics.worlds), 3)
    assert (height > -3e-4).all() and (height < SKIN_HEIGHT + 3e-4).all() and (top < 5e-3).all()
    assert speed[resting] == pytest.approx(0.0, abs=0.01)
    assert speed[rolling] == pytest.approx(0.9, abs=0.01)
    assert speed[sliding] == pytest.approx(3.0 * 5 / 7, abs=0.25), "without friction it would keep 3 m/s"


def test_scene_keeps_the_rule_sets_restitution():
    """A scene is built with the contact of its rule set at its model's own step, and says which it is."""
    built = load_scene("football", device="cpu", native=True, rules=rule_sets.get("released"))
    geom, skin = built.geom_ids(BALL)
    assert built.geom_labels[skin] == BALL_SKIN
    assert built.mj_model.geom_condim[[geom, skin]].tolist() == [1, 3]
    assert built.ball_restitution == 0.75
    assert built.mj_model.geom_solref[geom] == pytest.approx(ball_solref(0.75, built.mj_model.opt.timestep))
    assert scene("football").ball_restitution is None
