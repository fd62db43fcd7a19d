"""Conditions of predicates, against NumPy formulas of their own."""

import numpy as np
import pytest
import warp as wp

from arena_newton.kernels.rules import predicates, success_conditions
from arena_newton.kernels.rules.predicates import ANGLE, AWAY, CLEAR, MARGIN, NEAR, SLOW, TOWARD, UNLATCHED, UPRIGHT


def distance(point, marker, xpos, xquat, twin, horizontal):
    """Distance of points to a box, negative inside: to the closest point of the solid, or to the nearest face."""
    centre, turn = twin.box_pose(marker, xpos, xquat)
    v = np.einsum("wji,wj->wi", turn, point - centre)
    half, axes = np.array(marker.half), slice(2) if horizontal else slice(3)
    gap = v[:, axes] - np.clip(v[:, axes], -half[axes], half[axes])
    inside = (half[axes] - np.abs(v[:, axes])).min(1)
    return np.where(inside >= 0.0, -inside, np.linalg.norm(gap, axis=1))


def launch(stage, terms, limits, points, boxes, **state):
    """Predicates with one condition each, and the success flag, as booleans."""
    out = wp.full((stage.worlds, len(terms) + 1), 9, dtype=wp.int32, device=stage.device)
    given = {
        "latched": np.ones(stage.worlds, np.int32),
        "success": np.zeros(stage.worlds, np.int32),
        "margin": np.zeros(stage.worlds, np.float32),
        "qvel": np.zeros((stage.worlds, 20), np.float32),
        **state,
    }
    predicates.launch_predicates(
        stage.up(stage.xpos),
        stage.up(stage.xquat),
        stage.up(stage.qpos),
        stage.up(given["qvel"]),
        stage.up(given["latched"], wp.int32),
        stage.up(given["success"], wp.int32),
        stage.up(given["margin"]),
        first=stage.up(np.arange(len(terms) + 1), wp.int32),
        terms=stage.up(np.array(terms), wp.int32),
        limits=stage.up(np.array(limits)),
        point_body=stage.up([body for body, _ in points], wp.int32),
        point_pos=wp.array([wp.vec3(*pos) for _, pos in points], dtype=wp.vec3, device=stage.device),
        boxes=stage.boxes(*boxes),
        predicates=out,
    )
    return out.numpy()


@pytest.mark.parametrize("horizontal", [0, 1])
def test_near_and_clear_measure_the_distance_of_points_to_a_turned_box(twin, device, horizontal):
    """`NEAR` holds within the limit of either point, `CLEAR` outside it for both; a limit of 0 asks for the inside."""
    rng = np.random.default_rng(1)
    stage = twin.Stage(device, quats=twin.random_quats(rng, 400, 8))
    box = twin.Marker(3, (0.05, -0.02, 0.04), (0.9, 0.1, -0.3, 0.2), (0.15, 0.1, 0.2))
    points = [(1, (0.1, 0.0, 0.0)), (2, (0.0, -0.05, 0.02))]
    limits = (0.1, 0.0, 0.1)
    out = launch(stage, [(kind, horizontal, 0, 0, 2, 0, 1) for kind in (NEAR, NEAR, CLEAR)], limits, points, [box])
    world = [
        stage.xpos[:, body] + np.einsum("wij,j->wi", twin.matrix(stage.xquat[:, body]), pos) for body, pos in points
    ]
    nearest = np.min([distance(p, box, stage.xpos, stage.xquat, twin, horizontal) for p in world], axis=0)
    for column, expected in enumerate((nearest <= 0.1, nearest <= 0.0, nearest > 0.1)):
        clear = np.abs(nearest - limits[column]) > 1e-5
        assert np.array_equal(out[clear, column] == 1, expected[clear])
        assert 0.02 < expected.mean() < 0.98


def test_motion_facing_hinge_latch_margin_speed_and_tilt(twin, device):
    """Each further kind agrees with its formula, both ways."""
    rng = np.random.default_rng(2)
    worlds = 400
    stage = twin.Stage(device, quats=twin.random_quats(rng, worlds, 8))
    box = twin.Marker(0, (0.4, 0.3, 0.0), (1, 0, 0, 0), (0.1, 0.1, 0.1))
    stage.qpos[:, 4] = rng.uniform(-2, 2, worlds)
    state = {
        "qvel": rng.normal(size=(worlds, 20)).astype(np.float32),
        "latched": rng.integers(0, 2, worlds),
        "margin": rng.normal(size=worlds).astype(np.float32),
        "success": rng.integers(0, 2, worlds),
    }
    terms = [
        (TOWARD, 1, 6, 0, 1, 0, 1),
        (AWAY, 1, 0, 0, 1, 0, 1),
        (ANGLE, 0, 4, 0, 0, 0, 0),
        (UNLATCHED, 0, 0, 0, 0, 0, 0),
        (MARGIN, 0, 0, 0, 0, 0, 0),
        (SLOW, 0, 6, 0, 0, 0, 0),
        (SLOW, 1, 6, 0, 0, 0, 0),
        (UPRIGHT, 0, 0, 0, 1, 0, 0),
    ]
    out = launch(stage, terms, (0.3, 0.5, 1.0, 0.0, 0.0, 1.5, 1.0, 0.3), [(1, (0.0, 0.0, 0.0))], [box], **state)
    goal = np.array(box.pos[:2]) - stage.xpos[:, 1, :2]
    goal /= np.linalg.norm(goal, axis=1, keepdims=True)
    ahead = twin.matrix(stage.xquat[:, 1])[:, :2, 0]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    expected = (
        (state["qvel"][:, 6:8] * goal).sum(1) >= 0.3,
        -(ahead * goal).sum(1) >= 0.5,
        np.abs(stage.qpos[:, 4]) >= 1.0,
        state["latched"] == 0,
        state["margin"] >= 0.0,
        np.linalg.norm(state["qvel"][:, 6:9], axis=1) <= 1.5,
        np.linalg.norm(state["qvel"][:, 6:8], axis=1) <= 1.0,
        twin.matrix(stage.xquat[:, 1])[:, 2, 2] >= 0.3,
        state["success"] == 1,
    )
    for column, answer in enumerate(expected):
        assert (out[:, column] == answer).mean() > 0.995  # single precision at the limit
        assert 0.1 < answer.mean() < 0.9


def test_a_predicate_is_the_conjunction_of_its_conditions(twin, device):
    """Two conditions of one predicate must both hold."""
    stage = twin.Stage(device)
    box = twin.Marker(0, (0, 0, 0), (1, 0, 0, 0), (0.1, 0.1, 0.1))
    out = wp.zeros((stage.worlds, 2), dtype=wp.int32, device=device)
    latched = np.arange(stage.worlds) % 2
    predicates.launch_predicates(
        *(stage.up(a) for a in (stage.xpos, stage.xquat, stage.qpos, stage.qpos)),
        stage.up(latched, wp.int32),
        stage.up(latched, wp.int32),
        stage.up(np.zeros(stage.worlds)),
        first=stage.up([0, 2], wp.int32),
        terms=stage.up([(NEAR, 0, 0, 0, 1, 0, 1), (UNLATCHED, 0, 0, 0, 0, 0, 0)], wp.int32),
        limits=stage.up([0.1, 0.0]),
        point_body=stage.up([1], wp.int32),
        point_pos=wp.array([wp.vec3(0.0, 0.0, 0.0)], dtype=wp.vec3, device=device),
        boxes=stage.boxes(box),
        predicates=out,
    )
    near = distance(stage.xpos[:, 1].astype(float), box, stage.xpos, stage.xquat, twin, False) <= 0.1
    assert np.array_equal(out.numpy()[:, 0] == 1, near & (latched == 0)) and near.any() and not near.all()


def test_success_of_conditions_is_their_smallest_slack_for_some_ticks(twin, device):
    """The margin is the least of all slacks; success needs it at least 0 for so many ticks in a row, counted anew."""
    rng = np.random.default_rng(3)
    stage = twin.Stage(device)
    box = twin.Marker(0, (0, 0, 0), (1, 0, 0, 0), (0.4, 0.4, 0.4))
    speeds = rng.uniform(0.0, 0.4, (3, stage.worlds)).astype(np.float32)
    counter, success = (wp.zeros(stage.worlds, dtype=wp.int32, device=device) for _ in range(2))
    margin = wp.zeros(stage.worlds, dtype=wp.float32, device=device)
    gap = distance(stage.xpos[:, 1].astype(float), box, stage.xpos, stage.xquat, twin, False)
    run = np.zeros(stage.worlds, int)
    for speed in speeds:
        qvel = np.zeros((stage.worlds, 20), np.float32)
        qvel[:, 7] = speed
        success_conditions.launch_conditions(
            *(stage.up(a) for a in (stage.xpos, stage.xquat, stage.qpos, qvel)),
            stage.up(np.zeros(stage.worlds), wp.int32),
            ticks=2,
            terms=stage.up([(NEAR, 0, 0, 0, 1, 0, 1), (SLOW, 0, 6, 1, 1, 1, 1), (CLEAR, 0, 0, 0, 1, 0, 1)], wp.int32),
            limits=stage.up([0.3, 0.3, -0.3]),
            point_body=stage.up([1], wp.int32),
            point_pos=wp.array([wp.vec3(0.0, 0.0, 0.0)], dtype=wp.vec3, device=device),
            boxes=stage.boxes(box),
            counter=counter,
            success=success,
            margin=margin,
        )
        slack = np.minimum(np.minimum(0.3 - gap, 0.3 - speed), gap + 0.3)
        assert margin.numpy() == pytest.approx(slack, abs=1e-5)
        run = np.where(margin.numpy() >= 0.0, run + 1, 0)
        assert np.array_equal(success.numpy() == 1, run >= 2)
    assert 0 < success.numpy().sum() < stage.worlds
