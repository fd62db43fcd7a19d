"""Football, DoubleDesk and P&PBox in both rule sets: NumPy twins, and both sides of every threshold."""

import numpy as np
import pytest

from arena_newton.kernels.rules import success

WORLDS, BODIES = 400, 8
UPRIGHT = (1.0, 0.0, 0.0, 0.0)

GOAL = {"pos": (0.05, 4.03, 0.925), "quat": UPRIGHT, "half": (2.55, 1.0, 0.925)}
PITCH = {"pos": (0, 0, 1.3), "quat": UPRIGHT, "half": (6.76, 5.96, 1.3)}
FOOTBALL = {"outputs": ("success", "margin", "event"), "ball_body": 2, "min_z": -0.5}


@pytest.mark.parametrize("rear_bound", [True, False])
@pytest.mark.parametrize("body", [0, 3])
def test_football_random(device, twin, rear_bound, body):
    """The margin is the smallest distance to the bounding faces of the goal, wherever its body stands."""
    quats = twin.random_quats(np.random.default_rng(1), WORLDS, BODIES)
    stage = twin.Stage(device, spread=1.2, quats=quats)
    goal = twin.Marker(body, (0.1, -0.2, 0.05), (0.9, 0.1, -0.3, 0.2), (0.8, 0.6, 0.7))
    options = {"goal": stage.boxes(goal), "pitch": stage.boxes(twin.Marker(0, **PITCH))}
    ok, margin, event = stage.judge(
        success.launch_football,
        stage.xpos,
        quats,
        rear_bound=rear_bound,
        judge_out=False,
        **options,
        **FOOTBALL,
    )
    centre, r = twin.box_pose(goal, stage.xpos, quats)
    low, high = -np.float32(goal.half).astype(np.float64), np.float64(np.float32(goal.half))
    if not rear_bound:
        high = high + [0, 99, 0]
    local = np.einsum("wij,wi->wj", r, stage.xpos[:, 2] - centre)
    twin.check(ok, margin, twin.inside(local, low, high))
    assert not event.any()


@pytest.mark.parametrize(
    ("ball", "paper", "released", "out"),
    [
        ((0, 3.031, 0.11), 1, 1, 0),
        ((0, 3.029, 0.11), 0, 0, 0),
        ((-2.499, 4, 0.11), 1, 1, 0),
        ((-2.501, 4, 0.11), 0, 0, 0),
        ((2.599, 4, 0.11), 1, 1, 0),
        ((2.601, 4, 0.11), 0, 0, 0),
        ((0, 4, 1.849), 1, 1, 0),
        ((0, 4, 1.851), 0, 0, 0),
        ((0, 4, -0.001), 0, 0, 0),
        ((0, 5.029, 0.11), 1, 1, 0),
        ((0, 5.031, 0.11), 0, 1, 0),
        ((0, 5.961, 0.11), 0, 1, 1),
        ((3, -5.961, 0.11), 0, 0, 1),
        ((6.759, 0, 0.11), 0, 0, 0),
        ((6.761, 0, 0.11), 0, 0, 1),
        ((0, 0, -0.499), 0, 0, 0),
        ((0, 0, -0.501), 0, 0, 1),
        ((0, 0, 50), 0, 0, 0),
    ],
)
def test_football_thresholds(device, twin, ball, paper, released, out):
    """Each face of the goal, each wall and the drop below the floor, from both sides; a goal is never out."""
    stage = twin.Stage(device, worlds=1)
    stage.xpos[0, 2] = ball
    options = {"goal": stage.boxes(twin.Marker(0, **GOAL)), "pitch": stage.boxes(twin.Marker(0, **PITCH))}
    for rear_bound, judge_out, expected in ((True, True, (paper, out)), (False, False, (released, 0))):
        ok, margin, event = stage.judge(
            success.launch_football,
            stage.xpos,
            stage.xquat,
            rear_bound=rear_bound,
            judge_out=judge_out,
            **options,
            **FOOTBALL,
        )
        assert (ok[0], event[0]) == expected
        assert (margin[0] >= 0) == bool(ok[0])


def test_double_desk_random(device, twin):
    """`paper` measures in the crate's frame, `released` in its world-axis box cut at a height."""
    quats = twin.random_quats(np.random.default_rng(2), WORLDS, BODIES)
    stage = twin.Stage(device, spread=0.4, quats=quats)
    inside = twin.Marker(4, (0.0, 0.02, 0.05), (0.9, 0.2, 0.1, 0.4), (0.3007, 0.2009, 0.17))
    com = stage.rng.uniform(-0.4, 0.4, (WORLDS, BODIES, 3)).astype(np.float32)
    arrays, boxes = (stage.xpos, quats, com), stage.boxes(inside)
    centre, r = twin.box_pose(inside, stage.xpos, quats)
    half = np.float64(np.float32(inside.half))
    ok, margin = stage.judge(success.launch_double_desk, *arrays, hammer_body=6, inside=boxes)
    local = np.einsum("wij,wi->wj", r, com[:, 6] - centre)
    twin.check(ok, margin, twin.inside(local, -half, half))
    ok, margin = stage.judge(success.launch_double_desk, *arrays, hammer_body=6, inside=boxes, min_z=-0.1)
    low, high = twin.world_box(centre, r, inside.half)
    expected = np.minimum(twin.inside(com[:, 6].astype(np.float64), low, high), com[:, 6, 2] + 0.1)
    twin.check(ok, margin, expected)


@pytest.mark.parametrize(
    ("com", "paper", "released"),
    [
        ((0.0, 0.0, 0.76), 1, 1),
        ((0.0, 0.0, 0.744), 0, 0),
        ((0.0, 0.0, 0.916), 0, 0),
        ((0.29, 0.29, 0.80), 0, 1),  # beyond the turned crate, within its world-axis box (half 0.3546)
        ((0.355, 0.0, 0.80), 0, 0),
        ((0.1, 0.1, 0.80), 1, 1),
        ((0.2125, 0.2125, 0.80), 1, 1),
        ((0.2128, 0.2128, 0.80), 0, 1),
    ],
)
def test_double_desk_thresholds(device, twin, com, paper, released):
    """A crate turned by 45 degrees on the bench: its own box and its world-axis box part at the corners."""
    stage = twin.Stage(device, worlds=1)
    stage.xpos[0, 4] = (0, 0, 0.745)
    stage.xquat[0, 4] = (np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8))
    boxes = stage.boxes(twin.Marker(4, (0, 0, 0.085), UPRIGHT, (0.3007, 0.2009, 0.085)))
    centre = np.zeros((1, BODIES, 3), np.float32)
    centre[0, 6] = com
    arrays = (stage.xpos, stage.xquat, centre)
    ok, _ = stage.judge(success.launch_double_desk, *arrays, hammer_body=6, inside=boxes)
    assert ok[0] == paper
    ok, _ = stage.judge(success.launch_double_desk, *arrays, hammer_body=6, inside=boxes, min_z=0.445)
    assert ok[0] == released


def test_double_desk_released_has_a_floor(device, twin):
    """Under `released` a hammer below 0.445 m is no success even inside the box."""
    stage = twin.Stage(device, worlds=2)
    boxes = stage.boxes(twin.Marker(0, (0, 0, 0.5), UPRIGHT, (1, 1, 1)))
    com = np.zeros((2, BODIES, 3), np.float32)
    com[:, 6, 2] = 0.444, 0.446
    ok, margin = stage.judge(
        success.launch_double_desk, stage.xpos, stage.xquat, com, hammer_body=6, inside=boxes, min_z=0.445
    )
    assert ok.tolist() == [0, 1]
    np.testing.assert_allclose(margin, [-0.001, 0.001], atol=2e-6)


def _box(twin):
    """The box to move: body 5, its origin at its centre."""
    return twin.Marker(5, (0, 0, 0), UPRIGHT, (0.105, 0.105, 0.105))


def _paper(stage, box, decks, qvel=None, force=None, tick=0.02, confirm_ticks=10):
    """Success, margin and counter under `paper` of a box that rests and that no robot touches by default."""
    return stage.judge(
        success.launch_pp_box_paper,
        stage.xpos,
        stage.xquat,
        np.zeros((stage.worlds, 10), np.float32) if qvel is None else qvel,
        np.zeros(stage.worlds, np.float32) if force is None else force,
        box=stage.boxes(box),
        decks=stage.boxes(*decks),
        box_qvel_adr=4,
        height_tolerance=0.06,
        max_speed=0.05,
        tick=tick,
        confirm_ticks=confirm_ticks,
        outputs=("success", "margin", "counter"),
    )


def _released(stage, twin, decks):
    """Success and margin of the box on the middle deck under `released`."""
    return stage.judge(
        success.launch_pp_box_released,
        stage.xpos,
        stage.xquat,
        box=stage.boxes(_box(twin)),
        decks=stage.boxes(*decks),
        deck=1,
        plane_below=0.02,
        height_tolerance=0.06,
    )


def _decks(twin, body=3):
    heights = (0.17, 0.648, 1.18)
    turn = (np.cos(0.1), 0, 0, np.sin(0.1))
    return [twin.Marker(body, (0.1, 0.0, h - 0.02), turn, (0.95, 0.3, 0.02)) for h in heights]


def test_pp_box_paper_random(device, twin):
    """The margin is the best deck's smallest slack of span, lowest corner and speed."""
    stage = twin.Stage(device, quats=twin.random_quats(np.random.default_rng(3), WORLDS, BODIES, tilt=0.2))
    stage.xquat[:, 3] = twin.random_quats(stage.rng, WORLDS, tilt=1e-3)
    stage.xpos[:, 3, 2] = 0
    stage.xpos[:, 5, 2] = stage.rng.choice([0.29, 0.77, 1.3], WORLDS) + stage.rng.uniform(-0.05, 0.05, WORLDS)
    qvel = np.zeros((WORLDS, 10), np.float32)
    qvel[:, 4:7] = stage.rng.normal(scale=0.02, size=(WORLDS, 3))
    decks = _decks(twin)
    ok, margin, counter = _paper(stage, _box(twin), decks, qvel, tick=0.2, confirm_ticks=1)
    p = stage.xpos[:, 5].astype(np.float64)
    bottom = twin.world_box(p, twin.matrix(stage.xquat[:, 5]), (0.105,) * 3)[0][:, 2]
    slacks = []
    for deck in decks:
        c, r = twin.box_pose(deck, stage.xpos, stage.xquat)
        half = np.float64(np.float32(deck.half))
        local = np.einsum("wij,wi->wj", r, p - c)[:, :2]
        top = (c + r @ np.array([0, 0, half[2]]))[:, 2]
        slacks.append(np.minimum(twin.inside(local, -half[:2], half[:2]), 0.06 - np.abs(bottom - top)))
    speed = np.linalg.norm(qvel[:, 4:7].astype(np.float64), axis=1)
    twin.check(ok, margin, np.minimum(np.max(slacks, 0), (0.05 - speed) * 0.2))
    assert np.array_equal(counter, ok)


@pytest.mark.parametrize(
    ("centre", "speed", "good"),
    [
        ((0.1, 0.0, 0.753), 0.0, 1),
        ((0.1, 0.0, 0.812), 0.0, 1),
        ((0.1, 0.0, 0.814), 0.0, 0),
        ((0.1, 0.0, 0.694), 0.0, 1),
        ((0.1, 0.0, 0.692), 0.0, 0),
        ((0.1, 0.0, 0.275), 0.0, 1),
        ((0.1, 0.0, 1.285), 0.0, 1),
        ((0.1, 0.0, 1.0), 0.0, 0),
        ((1.2, 0.0, 0.753), 0.0, 0),
        ((0.1, 0.31, 0.753), 0.0, 0),
        ((0.1, 0.30, 0.753), 0.0, 1),
        ((0.1, 0.0, 0.753), 0.049, 1),
        ((0.1, 0.0, 0.753), 0.051, 0),
    ],
)
def test_pp_box_paper_thresholds(device, twin, centre, speed, good):
    """Any deck counts, within its span and 0.06 m, below 0.05 m/s, from the tenth tick in a row."""
    stage = twin.Stage(device, worlds=1)
    stage.xpos[0, 3], stage.xpos[0, 5] = 0, centre
    qvel = np.zeros((1, 10), np.float32)
    qvel[0, 4:7] = np.array([0.6, 0.0, -0.8]) * speed
    verdicts = []
    for _ in range(11):
        ok, margin, _ = _paper(stage, _box(twin), _decks(twin), qvel)
        verdicts.append(int(ok[0]))
        assert (margin[0] >= 0) == bool(good)
    assert verdicts == ([0] * 9 + [1] * 2 if good else [0] * 11)


def test_pp_box_paper_counter_restarts(device, twin):
    """Nine good ticks, one fast tick and nine good ticks are no success."""
    stage = twin.Stage(device, worlds=1)
    stage.xpos[0, 3], stage.xpos[0, 5] = 0, (0.1, 0, 0.753)
    for t in range(19):
        qvel = np.full((1, 10), 1.0 if t == 9 else 0.0, np.float32)
        ok, _, counter = _paper(stage, _box(twin), _decks(twin), qvel)
        assert not ok[0] and counter[0] == (t + 1 if t < 9 else t - 9)


def test_pp_box_paper_asks_for_open_hands(device, twin):
    """Any force of the robot on a box at rest restarts the count, and the margin says how far off letting go is."""
    stage = twin.Stage(device, worlds=1)
    stage.xpos[0, 3], stage.xpos[0, 5] = 0, (0.1, 0, 0.753)
    counts = []
    for t in range(21):
        force = np.array([0.001 if t < 4 else 10.0 if t == 10 else 0.0], np.float32)
        ok, margin, counter = _paper(stage, _box(twin), _decks(twin), force=force)
        counts.append(int(counter[0]))
        assert ok[0] == (t == 20)
        np.testing.assert_allclose(min(margin[0], 0.0), -force[0] / 500.0, atol=1e-9)
    assert counts == [0] * 4 + list(range(1, 7)) + list(range(11))


def test_pp_box_released_random(device, twin):
    """The margin is taken in the target deck's world-axis span less 0.105 m, at the plane so far below its top."""
    stage = twin.Stage(device, spread=0.8, quats=twin.random_quats(np.random.default_rng(4), WORLDS, BODIES, tilt=0.1))
    stage.xpos[:, 5, 2] = 0.753 + stage.rng.uniform(-0.08, 0.08, WORLDS)
    decks = _decks(twin)
    ok, margin = _released(stage, twin, decks)
    low, high = twin.world_box(*twin.box_pose(decks[1], stage.xpos, stage.xquat), decks[1].half)
    p = stage.xpos[:, 5].astype(np.float64)
    span = twin.inside(p[:, :2], low[:, :2] + 0.105, high[:, :2] - 0.105)
    twin.check(ok, margin, np.minimum(span, 0.06 - np.abs(p[:, 2] - 0.105 - (high[:, 2] - 0.02))))


@pytest.mark.parametrize(
    ("centre", "good"),
    [
        ((0.0, 0.0, 0.753), 1),
        ((0.0, 0.0, 0.812), 1),
        ((0.0, 0.0, 0.814), 0),
        ((0.0, 0.0, 0.692), 0),
        ((0.0, 0.0, 1.285), 0),
        ((0.844, 0.0, 0.753), 1),
        ((0.846, 0.0, 0.753), 0),
        ((0.0, 0.194, 0.753), 1),
        ((0.0, 0.196, 0.753), 0),
    ],
)
def test_pp_box_released_thresholds(device, twin, centre, good):
    """One layer, 0.06 m about it, the span shrunk by the box's half."""
    stage = twin.Stage(device, worlds=1)
    stage.xpos[0, 3], stage.xpos[0, 5] = 0, centre
    decks = [twin.Marker(3, (0, 0, h), UPRIGHT, (0.95, 0.3, 0.02)) for h in (0.15, 0.648, 1.16)]
    ok, _ = _released(stage, twin, decks)
    assert ok[0] == good


def test_pp_box_of_another_origin_and_turn(device, twin):
    """The box is judged by its own centre and half sizes in its body, wherever the body's origin lies."""
    stage = twin.Stage(device, quats=twin.random_quats(np.random.default_rng(9), WORLDS, BODIES, tilt=0.2))
    stage.xquat[:, 3], stage.xpos[:, 3] = UPRIGHT, 0
    stage.xpos[:, 5, 2] = 0.75 + stage.rng.uniform(-0.1, 0.1, WORLDS)
    decks, box = _decks(twin), twin.Marker(5, (0.02, -0.03, 0.1), (0.95, 0.1, 0, 0.2), (0.2, 0.1, 0.06))
    ok, margin, _ = _paper(stage, box, decks, tick=9.0, confirm_ticks=1)
    centre, turn = twin.box_pose(box, stage.xpos, stage.xquat)
    bottom = twin.world_box(centre, turn, box.half)[0][:, 2]
    slacks = []
    for deck in decks:
        c, r = twin.box_pose(deck, stage.xpos, stage.xquat)
        local = np.einsum("wij,wi->wj", r, centre - c)[:, :2]
        half = np.float64(np.float32(deck.half))
        span = twin.inside(local, -half[:2], half[:2])
        slacks.append(np.minimum(span, 0.06 - np.abs(bottom - c[:, 2] - half[2])))
    twin.check(ok, margin, np.max(slacks, 0))
