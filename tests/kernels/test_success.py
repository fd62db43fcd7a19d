"""All predicates in both rule sets: random poses against NumPy twins, and both sides of every threshold."""

import itertools

import numpy as np
import pytest
import warp as wp

from arena_newton.kernels import success

WORLDS, BODIES = 400, 8
TOLERANCE = 2e-6
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
STAND = {"stand_height": 0.45, "stand_up": 0.60}


class Stage:
    """Random body poses on a device, and outputs that start dirty."""

    def __init__(self, device, worlds=WORLDS, seed=0, spread=0.3, quats=None):
        """Draws positions within `spread` of the origin."""
        rng = np.random.default_rng(seed)
        self.device, self.worlds, self.rng = device, worlds, rng
        self.xpos = rng.uniform(-spread, spread, (worlds, BODIES, 3)).astype(np.float32)
        self.xquat = np.tile(np.float32(UPRIGHT), (worlds, BODIES, 1)) if quats is None else quats
        self.qpos = np.zeros((worlds, 20), np.float32)
        self.qpos[:, 6:10] = UPRIGHT
        self.qpos[:, 5] = 0.75
        self.outputs = {
            name: wp.full(worlds, 9, dtype=dtype, device=device)
            for name, dtype in (("success", wp.int32), ("margin", wp.float32), ("event", wp.int32))
        }
        self.counter = wp.zeros(worlds, dtype=wp.int32, device=device)

    def up(self, values, dtype=wp.float32):
        """Uploads."""
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def boxes(self, *markers):
        """Uploads markers."""
        return success.Boxes.upload(markers, self.device)

    def judge(self, launch, *arrays, outputs=("success", "margin"), **options):
        """Runs a launch on uploaded arrays; gives its outputs as NumPy."""
        for name in outputs:
            options[name] = self.counter if name == "counter" else self.outputs[name]
        launch(*(self.up(a) if isinstance(a, np.ndarray) else a for a in arrays), **options)
        return [options[name].numpy().copy() for name in outputs]


def _check(verdict, margin, expected, mixed=True):
    """Margins agree, success is their sign, and the draw has some of both."""
    expected = np.asarray(expected)
    np.testing.assert_allclose(margin, expected, atol=TOLERANCE)
    clear = np.abs(expected) > 2 * TOLERANCE
    assert np.array_equal(verdict[clear], (expected[clear] >= 0).astype(int))
    assert np.array_equal(verdict, (margin >= 0).astype(int))
    if mixed:
        assert 0.02 < (expected >= 0).mean() < 0.98


def _corners(half):
    return np.array(list(itertools.product(*[(-h, h) for h in np.float32(half).astype(np.float64)])))


def _world_box(centre, rotation, half):
    """Lower and upper corner of the world-axis box, from the eight corners."""
    corners = centre[:, None] + _corners(half) @ np.swapaxes(rotation, 1, 2)
    return corners.min(1), corners.max(1)


def _inside(points, low, high):
    return np.minimum(points - low, high - points).min(-1)


def _stand(stage, twin):
    up = twin.matrix(stage.qpos[:, 6:10])[:, 2, 2]
    return np.minimum(stage.qpos[:, 5].astype(np.float64) - 0.45, up - 0.60)


def _lean(stage, twin, tilt=1.0):
    stage.qpos[:, 6:10] = twin.random_quats(stage.rng, stage.worlds, tilt=tilt)
    stage.qpos[:, 3:5] = stage.rng.uniform(-0.5, 0.5, (stage.worlds, 2))
    stage.qpos[:, 5] = stage.rng.uniform(0.4, 0.8, stage.worlds)


# Football


GOAL = {"pos": (0.05, 4.03, 0.925), "quat": UPRIGHT, "half": (2.55, 1.0, 0.925)}
PITCH = {"pos": (0, 0, 1.3), "quat": UPRIGHT, "half": (6.76, 5.96, 1.3)}
FOOTBALL = {"outputs": ("success", "margin", "event"), "ball_body": 2, "min_z": -0.5}


@pytest.mark.parametrize("rear_bound", [True, False])
@pytest.mark.parametrize("body", [0, 3])
def test_football_random(device, twin, rear_bound, body):
    """The margin is the smallest distance to the bounding faces of the goal, wherever its body stands."""
    quats = twin.random_quats(np.random.default_rng(1), WORLDS, BODIES)
    stage = Stage(device, spread=1.2, quats=quats)
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
    _check(ok, margin, _inside(local, low, high))
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
    stage = Stage(device, worlds=1)
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


# DoubleDesk


def test_double_desk_random(device, twin):
    """`paper` measures in the crate's frame, `released` in its world-axis box cut at a height."""
    quats = twin.random_quats(np.random.default_rng(2), WORLDS, BODIES)
    stage = Stage(device, spread=0.4, quats=quats)
    inside = twin.Marker(4, (0.0, 0.02, 0.05), (0.9, 0.2, 0.1, 0.4), (0.3007, 0.2009, 0.17))
    com = stage.rng.uniform(-0.4, 0.4, (WORLDS, BODIES, 3)).astype(np.float32)
    arrays, boxes = (stage.xpos, quats, com), stage.boxes(inside)
    centre, r = twin.box_pose(inside, stage.xpos, quats)
    half = np.float64(np.float32(inside.half))
    ok, margin = stage.judge(success.launch_double_desk_paper, *arrays, hammer_body=6, inside=boxes)
    local = np.einsum("wij,wi->wj", r, com[:, 6] - centre)
    _check(ok, margin, _inside(local, -half, half))
    ok, margin = stage.judge(success.launch_double_desk_released, *arrays, hammer_body=6, inside=boxes, min_z=-0.1)
    low, high = _world_box(centre, r, inside.half)
    expected = np.minimum(_inside(com[:, 6].astype(np.float64), low, high), com[:, 6, 2] + 0.1)
    _check(ok, margin, expected)


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
    stage = Stage(device, worlds=1)
    stage.xpos[0, 4] = (0, 0, 0.745)
    stage.xquat[0, 4] = (np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8))
    boxes = stage.boxes(twin.Marker(4, (0, 0, 0.085), UPRIGHT, (0.3007, 0.2009, 0.085)))
    centre = np.zeros((1, BODIES, 3), np.float32)
    centre[0, 6] = com
    arrays = (stage.xpos, stage.xquat, centre)
    ok, _ = stage.judge(success.launch_double_desk_paper, *arrays, hammer_body=6, inside=boxes)
    assert ok[0] == paper
    ok, _ = stage.judge(success.launch_double_desk_released, *arrays, hammer_body=6, inside=boxes, min_z=0.445)
    assert ok[0] == released


def test_double_desk_released_has_a_floor(device, twin):
    """Under `released` a hammer below 0.445 m is no success even inside the box."""
    stage = Stage(device, worlds=2)
    boxes = stage.boxes(twin.Marker(0, (0, 0, 0.5), UPRIGHT, (1, 1, 1)))
    com = np.zeros((2, BODIES, 3), np.float32)
    com[:, 6, 2] = 0.444, 0.446
    ok, margin = stage.judge(
        success.launch_double_desk_released, stage.xpos, stage.xquat, com, hammer_body=6, inside=boxes, min_z=0.445
    )
    assert ok.tolist() == [0, 1]
    np.testing.assert_allclose(margin, [-0.001, 0.001], atol=TOLERANCE)


# P&PBox


BOX_HALF = wp.vec3(0.105, 0.105, 0.105)
PAPER_BOX = {
    "box_body": 5,
    "box_qvel_adr": 4,
    "box_half": BOX_HALF,
    "height_tolerance": 0.06,
    "max_speed": 0.05,
    "tick": 0.02,
}


def _decks(twin, body=3):
    heights = (0.17, 0.648, 1.18)
    turn = (np.cos(0.1), 0, 0, np.sin(0.1))
    return [twin.Marker(body, (0.1, 0.0, h - 0.02), turn, (0.95, 0.3, 0.02)) for h in heights]


def test_pp_box_paper_random(device, twin):
    """The margin is the best deck's smallest slack of span, lowest corner and speed."""
    stage = Stage(device, quats=twin.random_quats(np.random.default_rng(3), WORLDS, BODIES, tilt=0.2))
    stage.xquat[:, 3] = twin.random_quats(stage.rng, WORLDS, tilt=1e-3)
    stage.xpos[:, 3, 2] = 0
    stage.xpos[:, 5, 2] = stage.rng.choice([0.29, 0.77, 1.3], WORLDS) + stage.rng.uniform(-0.05, 0.05, WORLDS)
    qvel = np.zeros((WORLDS, 10), np.float32)
    qvel[:, 4:7] = stage.rng.normal(scale=0.02, size=(WORLDS, 3))
    decks = _decks(twin)
    ok, margin, counter = stage.judge(
        success.launch_pp_box_paper,
        stage.xpos,
        stage.xquat,
        qvel,
        decks=stage.boxes(*decks),
        confirm_ticks=1,
        outputs=("success", "margin", "counter"),
        **PAPER_BOX | {"tick": 0.2},
    )
    p = stage.xpos[:, 5].astype(np.float64)
    bottom = _world_box(p, twin.matrix(stage.xquat[:, 5]), (0.105,) * 3)[0][:, 2]
    slacks = []
    for deck in decks:
        c, r = twin.box_pose(deck, stage.xpos, stage.xquat)
        half = np.float64(np.float32(deck.half))
        local = np.einsum("wij,wi->wj", r, p - c)[:, :2]
        top = (c + r @ np.array([0, 0, half[2]]))[:, 2]
        slacks.append(np.minimum(_inside(local, -half[:2], half[:2]), 0.06 - np.abs(bottom - top)))
    speed = np.linalg.norm(qvel[:, 4:7].astype(np.float64), axis=1)
    _check(ok, margin, np.minimum(np.max(slacks, 0), (0.05 - speed) * 0.2))
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
    stage = Stage(device, worlds=1)
    stage.xpos[0, 3], stage.xpos[0, 5] = 0, centre
    qvel = np.zeros((1, 10), np.float32)
    qvel[0, 4:7] = np.array([0.6, 0.0, -0.8]) * speed
    verdicts = []
    for _ in range(11):
        ok, margin, _ = stage.judge(
            success.launch_pp_box_paper,
            stage.xpos,
            stage.xquat,
            qvel,
            decks=stage.boxes(*_decks(twin)),
            confirm_ticks=10,
            outputs=("success", "margin", "counter"),
            **PAPER_BOX,
        )
        verdicts.append(int(ok[0]))
        assert (margin[0] >= 0) == bool(good)
    assert verdicts == ([0] * 9 + [1] * 2 if good else [0] * 11)


def test_pp_box_paper_counter_restarts(device, twin):
    """Nine good ticks, one fast tick and nine good ticks are no success."""
    stage = Stage(device, worlds=1)
    stage.xpos[0, 3], stage.xpos[0, 5] = 0, (0.1, 0, 0.753)
    for t in range(19):
        qvel = np.full((1, 10), 1.0 if t == 9 else 0.0, np.float32)
        ok, _, counter = stage.judge(
            success.launch_pp_box_paper,
            stage.xpos,
            stage.xquat,
            qvel,
            decks=stage.boxes(*_decks(twin)),
            confirm_ticks=10,
            outputs=("success", "margin", "counter"),
            **PAPER_BOX,
        )
        assert not ok[0] and counter[0] == (t + 1 if t < 9 else t - 9)


def test_pp_box_released_random(device, twin):
    """The margin is taken in the target deck's world-axis span less 0.105 m and at the plane's height alone."""
    stage = Stage(device, spread=0.8, quats=twin.random_quats(np.random.default_rng(4), WORLDS, BODIES, tilt=0.1))
    stage.xpos[:, 5, 2] = 0.753 + stage.rng.uniform(-0.08, 0.08, WORLDS)
    decks = _decks(twin)
    ok, margin = stage.judge(
        success.launch_pp_box_released,
        stage.xpos,
        stage.xquat,
        box_body=5,
        box_half=BOX_HALF,
        decks=stage.boxes(*decks),
        deck=1,
        plane_z=0.648,
        height_tolerance=0.06,
    )
    low, high = _world_box(*twin.box_pose(decks[1], stage.xpos, stage.xquat), decks[1].half)
    p = stage.xpos[:, 5].astype(np.float64)
    span = _inside(p[:, :2], low[:, :2] + 0.105, high[:, :2] - 0.105)
    _check(ok, margin, np.minimum(span, 0.06 - np.abs(p[:, 2] - 0.105 - 0.648)))


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
    stage = Stage(device, worlds=1)
    stage.xpos[0, 3], stage.xpos[0, 5] = 0, centre
    decks = [twin.Marker(3, (0, 0, h), UPRIGHT, (0.95, 0.3, 0.02)) for h in (0.15, 0.628, 1.16)]
    ok, _ = stage.judge(
        success.launch_pp_box_released,
        stage.xpos,
        stage.xquat,
        box_body=5,
        box_half=BOX_HALF,
        decks=stage.boxes(*decks),
        deck=1,
        plane_z=0.648,
        height_tolerance=0.06,
    )
    assert ok[0] == good


# OpenDoor


def test_open_door_paper_random(device, twin):
    """The root is measured in the doorway's frame; standing is the fourth and fifth slack."""
    quats = twin.random_quats(np.random.default_rng(5), WORLDS, BODIES, tilt=0.05)
    stage = Stage(device, quats=quats)
    _lean(stage, twin)
    doorway = twin.Marker(2, (0.05, 0.0, 1.0), (0.9, 0.0, 0.0, 0.3), (0.5, 0.1, 1.0))
    ok, margin = stage.judge(
        success.launch_open_door_paper,
        stage.xpos,
        quats,
        stage.qpos,
        root_qpos_adr=3,
        doorway=stage.boxes(doorway),
        half_width=0.55,
        min_y=0.02,
        **STAND,
    )
    centre, r = twin.box_pose(doorway, stage.xpos, quats)
    local = np.einsum("wij,wi->wj", r, stage.qpos[:, 3:6] - centre)
    expected = np.min([0.55 - np.abs(local[:, 0]), local[:, 1] - 0.02, _stand(stage, twin)], axis=0)
    _check(ok, margin, expected)


@pytest.mark.parametrize(
    ("root", "tilt_deg", "good"),
    [
        ((-1.6, 2.325, 0.75), 0, 1),
        ((-1.6, 2.315, 0.75), 0, 0),
        ((-1.051, 2.5, 0.75), 0, 1),
        ((-1.049, 2.5, 0.75), 0, 0),
        ((-2.149, 2.5, 0.75), 0, 1),
        ((-2.151, 2.5, 0.75), 0, 0),
        ((-1.6, 2.5, 0.451), 0, 1),
        ((-1.6, 2.5, 0.449), 0, 0),
        ((-1.6, 2.5, 0.75), 53.0, 1),
        ((-1.6, 2.5, 0.75), 53.2, 0),
    ],
)
def test_open_door_paper_thresholds(device, twin, root, tilt_deg, good):
    """Plane, width, height and lean (up-axis 0.60 is 53.13 degrees), each from both sides."""
    stage = Stage(device, worlds=1)
    stage.xpos[0, 2] = (-1.6, 2.3, 0)
    half = np.radians(tilt_deg) / 2
    stage.qpos[0, 3:10] = (*root, np.cos(half), 0, np.sin(half), 0)
    ok, margin = stage.judge(
        success.launch_open_door_paper,
        stage.xpos,
        stage.xquat,
        stage.qpos,
        root_qpos_adr=3,
        doorway=stage.boxes(twin.Marker(2, (0, 0, 1), UPRIGHT, (0.5, 0.1, 1))),
        half_width=0.55,
        min_y=0.02,
        **STAND,
    )
    assert ok[0] == good and (margin[0] >= 0) == bool(good)


def test_open_door_released(device, twin):
    """Latch released, leaf at 60 degrees either way, standing: the margin's sign is the predicate's."""
    stage = Stage(device)
    _lean(stage, twin, tilt=0.8)
    stage.qpos[:, 5] = np.maximum(stage.qpos[:, 5], 0.44)
    stage.qpos[:, 15] = stage.rng.uniform(-2, 2, WORLDS)
    latched = stage.rng.integers(0, 2, WORLDS)
    edges = [(59.9, 0, 0), (60.1, 0, 1), (-60.1, 0, 1), (60.1, 1, 0), (-59.9, 0, 0)]
    for row, (angle, latch, _) in enumerate(edges):
        stage.qpos[row, 3:10] = (0, 0, 0.75, *UPRIGHT)
        stage.qpos[row, 15], latched[row] = np.radians(angle), latch
    ok, margin = stage.judge(
        success.launch_open_door_released,
        stage.qpos,
        root_qpos_adr=3,
        leaf_qpos_adr=15,
        latched=stage.up(latched, wp.int32),
        min_angle=np.radians(60),
        **STAND,
    )
    angle = np.where(latched == 1, 0, np.abs(stage.qpos[:, 15].astype(np.float64)))
    _check(ok, margin, np.minimum(angle - np.pi / 3, _stand(stage, twin)))
    assert ok[: len(edges)].tolist() == [good for *_, good in edges]
    assert not ok[latched == 1].any()


# SitSofa


@pytest.mark.parametrize(
    ("force", "root_z", "good"),
    [(50.1, 0.6, 1), (49.9, 0.6, 0), (300.0, 0.619, 1), (300.0, 0.621, 0), (0.0, 0.5, 0)],
)
def test_sit_sofa_paper_thresholds(device, force, root_z, good):
    """Fifty newtons and a low root, from the twenty-fifth tick in a row; one light tick starts over."""
    stage = Stage(device, worlds=1)
    stage.qpos[0, 5] = root_z
    verdicts = []
    for t in range(52):
        ok, margin, _ = stage.judge(
            success.launch_sit_sofa_paper,
            stage.qpos,
            np.full(1, 0.0 if t == 26 else force, np.float32),
            root_qpos_adr=3,
            min_force=50.0,
            max_root_z=0.62,
            confirm_ticks=25,
            outputs=("success", "margin", "counter"),
        )
        verdicts.append(int(ok[0]))
        assert (margin[0] >= 0) == (bool(good) and t != 26)
    assert verdicts == ([0] * 24 + [1] * 2 + [0] * 25 + [1] if good else [0] * 52)


def test_sit_sofa_paper_margin(device):
    """The margin is the smaller of height slack and force slack over the stiffness."""
    stage = Stage(device)
    stage.qpos[:, 5] = stage.rng.uniform(0.5, 0.7, WORLDS)
    force = stage.rng.uniform(0, 150, WORLDS).astype(np.float32)
    ok, margin, _ = stage.judge(
        success.launch_sit_sofa_paper,
        stage.qpos,
        force,
        root_qpos_adr=3,
        min_force=50.0,
        max_root_z=0.62,
        confirm_ticks=1,
        stiffness=400.0,
        outputs=("success", "margin", "counter"),
    )
    _check(ok, margin, np.minimum(0.62 - np.float64(stage.qpos[:, 5]), (np.float64(force) - 50) / 400))


SEAT = {"below": 0.10, "above": 0.35, "min_force": 5.0}


@pytest.mark.parametrize("count", [1, 2, 4])
def test_sit_sofa_released_random(device, twin, count):
    """The margin is the better of the best pressing body and the second deepest body in the seat volume."""
    quats = twin.random_quats(np.random.default_rng(6), WORLDS, BODIES)
    stage = Stage(device, spread=0.8, quats=quats)
    bodies = [2, 7, 1, 5][:count]
    force = (stage.rng.uniform(0, 10, (WORLDS, BODIES)) * stage.rng.integers(0, 2, (WORLDS, BODIES))).astype(np.float32)
    seat = twin.Marker(3, (0.1, 0, 0.1), (0.8, 0.1, 0.2, 0.3), (0.4, 0.3, 0.2))
    ok, margin = stage.judge(
        success.launch_sit_sofa_released,
        stage.xpos,
        quats,
        force,
        bodies=stage.up(bodies, wp.int32),
        seat=stage.boxes(seat),
        **SEAT,
    )
    low, high = _world_box(*twin.box_pose(seat, stage.xpos, quats), seat.half)
    low, high = low[:, None] - [0, 0, 0.10], high[:, None] + [0, 0, 0.35]
    depth = _inside(stage.xpos[:, bodies].astype(np.float64), low, high)
    pressing = np.minimum(depth, (force[:, bodies].astype(np.float64) - 5) / 500).max(1)
    expected = pressing if count == 1 else np.maximum(pressing, np.sort(depth, axis=1)[:, -2])
    _check(ok, margin, expected)


@pytest.mark.parametrize(
    ("first", "second", "force", "good"),
    [
        ((0, 0, 0.5), (5, 0, 0), 5.1, 1),
        ((0, 0, 0.5), (5, 0, 0), 4.9, 0),
        ((0, 0, 0.5), (0.1, 0, 0.5), 0.0, 1),
        ((0, 0, 0.749), (5, 0, 0), 9.0, 1),
        ((0, 0, 0.751), (5, 0, 0), 9.0, 0),
        ((0, 0, 0.101), (5, 0, 0), 9.0, 1),
        ((0, 0, 0.099), (5, 0, 0), 9.0, 0),
        ((0.899, 0.3, 0.5), (5, 0, 0), 9.0, 1),
        ((0.901, 0.3, 0.5), (5, 0, 0), 9.0, 0),
        ((0, 0, 0.5), (0, 0.401, 0.5), 0.0, 0),
        ((0, 0, 0.5), (0, 0.399, 0.5), 0.0, 1),
    ],
)
def test_sit_sofa_released_thresholds(device, twin, first, second, force, good):
    """Force, both heights and both horizontal edges of the seat volume, from both sides."""
    stage = Stage(device, worlds=1)
    stage.xpos[0, 1], stage.xpos[0, 2] = first, second
    forces = np.zeros((1, BODIES), np.float32)
    forces[0, 1] = force
    ok, _ = stage.judge(
        success.launch_sit_sofa_released,
        stage.xpos,
        stage.xquat,
        forces,
        bodies=stage.up([1, 2], wp.int32),
        seat=stage.boxes(twin.Marker(0, (0, 0, 0.3), UPRIGHT, (0.9, 0.4, 0.1))),
        **SEAT,
    )
    assert ok[0] == good


# Boxing


@pytest.mark.parametrize("min_radius", [0.0, 0.10])
def test_boxing_random(device, twin, min_radius):
    """The margin is the reach less the nearer palm's distance to the target's centre."""
    quats = twin.random_quats(np.random.default_rng(7), WORLDS, BODIES)
    stage = Stage(device, spread=0.25, quats=quats)
    palms, offsets = [6, 1], np.float32([[0.08, 0.01, 0.0], [0.08, -0.01, 0.02]])
    target = twin.Marker(4, (0.01, 0.02, 0.0), UPRIGHT, (0.05, 0.04, 0.07))
    ok, margin = stage.judge(
        success.launch_boxing,
        stage.xpos,
        quats,
        palm_body=stage.up(palms, wp.int32),
        palm_offset=wp.array(offsets, dtype=wp.vec3, device=device),
        target=stage.boxes(target),
        min_radius=min_radius,
        pad=0.08,
    )
    points = stage.xpos[:, palms] + np.einsum("wpij,pj->wpi", twin.matrix(quats[:, palms]), offsets.astype(np.float64))
    centre, _ = twin.box_pose(target, stage.xpos, quats)
    _check(ok, margin, max(0.07, min_radius) + 0.08 - np.linalg.norm(points - centre[:, None], axis=-1).min(1))


@pytest.mark.parametrize(
    ("distance", "paper", "released"), [(0.129, 1, 1), (0.131, 0, 1), (0.179, 0, 1), (0.181, 0, 0)]
)
@pytest.mark.parametrize("palm", [0, 1])
def test_boxing_thresholds(device, twin, distance, paper, released, palm):
    """The 0.05 m sphere is reached within 0.13 m in `paper` and 0.18 m in `released`, by either hand."""
    stage = Stage(device, worlds=1)
    stage.xpos[:] = 9.0
    stage.xpos[0, 4] = (1, 2, 0.8)
    stage.xpos[0, [6, 1][palm]] = np.array([1, 2, 0.8]) - [0.1, 0, distance]
    for min_radius, expected in ((0.0, paper), (0.10, released)):
        ok, _ = stage.judge(
            success.launch_boxing,
            stage.xpos,
            stage.xquat,
            palm_body=stage.up([6, 1], wp.int32),
            palm_offset=wp.array([(0.1, 0, 0)] * 2, dtype=wp.vec3, device=device),
            target=stage.boxes(twin.Marker(4, (0, 0, 0), UPRIGHT, (0.05,) * 3)),
            min_radius=min_radius,
            pad=0.08,
        )
        assert ok[0] == expected


# VisNavi


def test_vis_navi_random(device, twin):
    """The margin is the smallest slack of the four feet in the zone's frame and of standing; height does not matter."""
    quats = twin.random_quats(np.random.default_rng(8), WORLDS, BODIES, tilt=1e-3)
    stage = Stage(device, spread=0.35, quats=quats)
    _lean(stage, twin, tilt=0.9)
    stage.xpos[:, :, 2] *= 20
    stage.xpos[:, 7] *= 0.1
    feet = [1, 2, 3, 4]
    zone = twin.Marker(7, (0.02, 0, 1), (0.9, 0, 0, 0.2), (0.48, 0.47, 1.0))
    ok, margin = stage.judge(
        success.launch_vis_navi,
        stage.xpos,
        quats,
        stage.qpos,
        root_qpos_adr=3,
        feet=stage.up(feet, wp.int32),
        zone=stage.boxes(zone),
        **STAND,
    )
    centre, r = twin.box_pose(zone, stage.xpos, quats)
    local = np.einsum("wij,wfi->wfj", r, stage.xpos[:, feet] - centre[:, None])[..., :2]
    half = np.float64(np.float32(zone.half[:2]))
    expected = np.minimum(_inside(local, -half, half).min(1), _stand(stage, twin))
    np.testing.assert_allclose(margin, expected, atol=4e-6)  # feet up to 7 m above the zone
    assert np.array_equal(ok, (margin >= 0).astype(int)) and 0.02 < ok.mean() < 0.98


@pytest.mark.parametrize("foot", range(4))
def test_vis_navi_needs_every_foot(device, twin, foot):
    """Any one of the four links outside the zone, or a robot that does not stand, is no success."""
    stage = Stage(device, worlds=4)
    stage.xpos[:, 1:5] = 0.1
    stage.xpos[1, 1 + foot, 0], stage.xpos[2, 1 + foot, 1] = 0.501, 0.499
    stage.qpos[3, 5] = 0.449
    ok, _ = stage.judge(
        success.launch_vis_navi,
        stage.xpos,
        stage.xquat,
        stage.qpos,
        root_qpos_adr=3,
        feet=stage.up([1, 2, 3, 4], wp.int32),
        zone=stage.boxes(twin.Marker(0, (0, 0, 1), UPRIGHT, (0.5, 0.5, 1))),
        **STAND,
    )
    assert ok.tolist() == [1, 0, 1, 0]
