"""OpenDoor, SitSofa, Boxing and VisNavi in both rule sets: NumPy twins, and both sides of every threshold."""

import numpy as np
import pytest
import warp as wp

from arena_newton.kernels.rules import success

WORLDS, BODIES = 400, 8
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
STAND = {"stand_height": 0.45, "stand_up": 0.60}
FEET = [1, 2, 3, 4]


def _stand(stage, twin):
    up = twin.matrix(stage.qpos[:, 6:10])[:, 2, 2]
    return np.minimum(stage.qpos[:, 5].astype(np.float64) - 0.45, up - 0.60)


def _lean(stage, twin, tilt=1.0):
    stage.qpos[:, 6:10] = twin.random_quats(stage.rng, stage.worlds, tilt=tilt)
    stage.qpos[:, 3:5] = stage.rng.uniform(-0.5, 0.5, (stage.worlds, 2))
    stage.qpos[:, 5] = stage.rng.uniform(0.4, 0.8, stage.worlds)


def _through_door(stage, doorway):
    """Success and margin of OpenDoor under `paper`."""
    return stage.judge(
        success.launch_open_door_paper,
        stage.xpos,
        stage.xquat,
        stage.qpos,
        root_qpos_adr=3,
        doorway=stage.boxes(doorway),
        half_width=0.55,
        min_y=0.02,
        **STAND,
    )


def _sits(stage, force, **options):
    """Success, margin and counter of SitSofa under `paper`."""
    options |= {"root_qpos_adr": 3, "min_force": 50.0, "max_root_z": 0.62}
    outputs = ("success", "margin", "counter")
    return stage.judge(success.launch_sit_sofa_paper, stage.qpos, force, outputs=outputs, **options)


def _in_seat(stage, force, bodies, seat):
    """Success and margin of SitSofa under `released`."""
    return stage.judge(
        success.launch_sit_sofa_released,
        stage.xpos,
        stage.xquat,
        force,
        bodies=stage.up(bodies, wp.int32),
        seat=stage.boxes(seat),
        below=0.10,
        above=0.35,
        min_force=5.0,
    )


def _punches(stage, palms, offsets, target, min_radius):
    """Success and margin of Boxing."""
    return stage.judge(
        success.launch_boxing,
        stage.xpos,
        stage.xquat,
        palm_body=stage.up(palms, wp.int32),
        palm_offset=wp.array(offsets, dtype=wp.vec3, device=stage.device),
        target=stage.boxes(target),
        min_radius=min_radius,
        pad=0.08,
    )


def _in_zone(stage, zone, round_zone=False):
    """Success and margin of VisNavi; the feet are bodies 1 to 4."""
    return stage.judge(
        success.launch_vis_navi,
        stage.xpos,
        stage.xquat,
        stage.qpos,
        root_qpos_adr=3,
        feet=stage.up(FEET, wp.int32),
        zone=stage.boxes(zone),
        round_zone=round_zone,
        **STAND,
    )


def test_open_door_paper_random(device, twin):
    """The root is measured in the doorway's frame; standing is the fourth and fifth slack."""
    quats = twin.random_quats(np.random.default_rng(5), WORLDS, BODIES, tilt=0.05)
    stage = twin.Stage(device, quats=quats)
    _lean(stage, twin)
    doorway = twin.Marker(2, (0.05, 0.0, 1.0), (0.9, 0.0, 0.0, 0.3), (0.5, 0.1, 1.0))
    ok, margin = _through_door(stage, doorway)
    centre, r = twin.box_pose(doorway, stage.xpos, quats)
    local = np.einsum("wij,wi->wj", r, stage.qpos[:, 3:6] - centre)
    expected = np.min([0.55 - np.abs(local[:, 0]), local[:, 1] - 0.02, _stand(stage, twin)], axis=0)
    twin.check(ok, margin, expected)


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
    stage = twin.Stage(device, worlds=1)
    stage.xpos[0, 2] = (-1.6, 2.3, 0)
    half = np.radians(tilt_deg) / 2
    stage.qpos[0, 3:10] = (*root, np.cos(half), 0, np.sin(half), 0)
    ok, margin = _through_door(stage, twin.Marker(2, (0, 0, 1), UPRIGHT, (0.5, 0.1, 1)))
    assert ok[0] == good and (margin[0] >= 0) == bool(good)


def test_open_door_released(device, twin):
    """Latch released, leaf at 60 degrees either way, standing: the margin's sign is the predicate's."""
    stage = twin.Stage(device)
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
    twin.check(ok, margin, np.minimum(angle - np.pi / 3, _stand(stage, twin)))
    assert ok[: len(edges)].tolist() == [good for *_, good in edges]
    assert not ok[latched == 1].any()


@pytest.mark.parametrize(
    ("force", "root_z", "good"),
    [(50.1, 0.6, 1), (49.9, 0.6, 0), (300.0, 0.619, 1), (300.0, 0.621, 0), (0.0, 0.5, 0)],
)
def test_sit_sofa_paper_thresholds(device, twin, force, root_z, good):
    """Fifty newtons and a low root, from the twenty-fifth tick in a row; one light tick starts over."""
    stage = twin.Stage(device, worlds=1)
    stage.qpos[0, 5] = root_z
    verdicts = []
    for t in range(52):
        ok, margin, _ = _sits(stage, np.full(1, 0.0 if t == 26 else force, np.float32), confirm_ticks=25)
        verdicts.append(int(ok[0]))
        assert (margin[0] >= 0) == (bool(good) and t != 26)
    assert verdicts == ([0] * 24 + [1] * 2 + [0] * 25 + [1] if good else [0] * 52)


def test_sit_sofa_paper_margin(device, twin):
    """The margin is the smaller of height slack and force slack over the stiffness."""
    stage = twin.Stage(device)
    stage.qpos[:, 5] = stage.rng.uniform(0.5, 0.7, WORLDS)
    force = stage.rng.uniform(0, 150, WORLDS).astype(np.float32)
    ok, margin, _ = _sits(stage, force, confirm_ticks=1, stiffness=400.0)
    twin.check(ok, margin, np.minimum(0.62 - np.float64(stage.qpos[:, 5]), (np.float64(force) - 50) / 400))


@pytest.mark.parametrize("count", [1, 2, 4])
def test_sit_sofa_released_random(device, twin, count):
    """The margin is the better of the best pressing body and the second deepest body in the seat volume."""
    quats = twin.random_quats(np.random.default_rng(6), WORLDS, BODIES)
    stage = twin.Stage(device, spread=0.8, quats=quats)
    bodies = [2, 7, 1, 5][:count]
    force = (stage.rng.uniform(0, 10, (WORLDS, BODIES)) * stage.rng.integers(0, 2, (WORLDS, BODIES))).astype(np.float32)
    seat = twin.Marker(3, (0.1, 0, 0.1), (0.8, 0.1, 0.2, 0.3), (0.4, 0.3, 0.2))
    ok, margin = _in_seat(stage, force, bodies, seat)
    low, high = twin.world_box(*twin.box_pose(seat, stage.xpos, quats), seat.half)
    low, high = low[:, None] - [0, 0, 0.10], high[:, None] + [0, 0, 0.35]
    depth = twin.inside(stage.xpos[:, bodies].astype(np.float64), low, high)
    pressing = np.minimum(depth, (force[:, bodies].astype(np.float64) - 5) / 500).max(1)
    expected = pressing if count == 1 else np.maximum(pressing, np.sort(depth, axis=1)[:, -2])
    twin.check(ok, margin, expected)


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
    stage = twin.Stage(device, worlds=1)
    stage.xpos[0, 1], stage.xpos[0, 2] = first, second
    forces = np.zeros((1, BODIES), np.float32)
    forces[0, 1] = force
    ok, _ = _in_seat(stage, forces, [1, 2], twin.Marker(0, (0, 0, 0.3), UPRIGHT, (0.9, 0.4, 0.1)))
    assert ok[0] == good


@pytest.mark.parametrize("min_radius", [0.0, 0.10])
def test_boxing_random(device, twin, min_radius):
    """The margin is the reach less the nearer palm's distance to the target's centre."""
    quats = twin.random_quats(np.random.default_rng(7), WORLDS, BODIES)
    stage = twin.Stage(device, spread=0.25, quats=quats)
    palms, offsets = [6, 1], np.float32([[0.08, 0.01, 0.0], [0.08, -0.01, 0.02]])
    target = twin.Marker(4, (0.01, 0.02, 0.0), UPRIGHT, (0.05, 0.04, 0.07))
    ok, margin = _punches(stage, palms, offsets, target, min_radius)
    points = stage.xpos[:, palms] + np.einsum("wpij,pj->wpi", twin.matrix(quats[:, palms]), offsets.astype(np.float64))
    centre, _ = twin.box_pose(target, stage.xpos, quats)
    twin.check(ok, margin, max(0.07, min_radius) + 0.08 - np.linalg.norm(points - centre[:, None], axis=-1).min(1))


@pytest.mark.parametrize(
    ("distance", "paper", "released"), [(0.129, 1, 1), (0.131, 0, 1), (0.179, 0, 1), (0.181, 0, 0)]
)
@pytest.mark.parametrize("palm", [0, 1])
def test_boxing_thresholds(device, twin, distance, paper, released, palm):
    """The 0.05 m sphere is reached within 0.13 m in `paper` and 0.18 m in `released`, by either hand."""
    stage = twin.Stage(device, worlds=1)
    stage.xpos[:] = 9.0
    stage.xpos[0, 4] = (1, 2, 0.8)
    stage.xpos[0, [6, 1][palm]] = np.array([1, 2, 0.8]) - [0.1, 0, distance]
    for min_radius, expected in ((0.0, paper), (0.10, released)):
        ok, _ = _punches(stage, [6, 1], [(0.1, 0, 0)] * 2, twin.Marker(4, (0, 0, 0), UPRIGHT, (0.05,) * 3), min_radius)
        assert ok[0] == expected


@pytest.mark.parametrize("ring", [False, True])
def test_vis_navi_random(device, twin, ring):
    """The margin is the smallest slack of the four feet in the zone's square or disc and of standing, at any height."""
    quats = twin.random_quats(np.random.default_rng(8), WORLDS, BODIES, tilt=1e-3)
    stage = twin.Stage(device, spread=0.35, quats=quats)
    _lean(stage, twin, tilt=0.9)
    stage.xpos[:, :, 2] *= 20
    stage.xpos[:, 7] *= 0.1
    zone = twin.Marker(7, (0.02, 0, 1), (0.9, 0, 0, 0.2), (0.48, 0.47, 1.0))
    ok, margin = _in_zone(stage, zone, ring)
    centre, r = twin.box_pose(zone, stage.xpos, quats)
    local = np.einsum("wij,wfi->wfj", r, stage.xpos[:, FEET] - centre[:, None])[..., :2]
    half = np.float64(np.float32(zone.half[:2]))
    slack = half.min() - np.linalg.norm(local, axis=2) if ring else twin.inside(local, -half, half)
    expected = np.minimum(slack.min(1), _stand(stage, twin))
    np.testing.assert_allclose(margin, expected, atol=4e-6)  # feet up to 7 m above the zone
    assert np.array_equal(ok, (margin >= 0).astype(int)) and 0.02 < ok.mean() < 0.98


@pytest.mark.parametrize("foot", range(4))
def test_vis_navi_needs_every_foot(device, twin, foot):
    """Any one of the four links outside the zone, or a robot that does not stand, is no success."""
    stage = twin.Stage(device, worlds=4)
    stage.xpos[:, 1:5] = 0.1
    stage.xpos[1, 1 + foot, 0], stage.xpos[2, 1 + foot, 1] = 0.501, 0.499
    stage.qpos[3, 5] = 0.449
    ok, _ = _in_zone(stage, twin.Marker(0, (0, 0, 1), UPRIGHT, (0.5, 0.5, 1)))
    assert ok.tolist() == [1, 0, 1, 0]


@pytest.mark.parametrize(("x", "y", "box", "disc"), [(0.45, 0.0, 1, 1), (0.36, 0.36, 1, 0), (0.33, 0.33, 1, 1)])
def test_vis_navi_ring_is_the_disc_in_the_box(device, twin, x, y, box, disc):
    """A foot in the box's corner is outside the ring whose diameter is the smaller side."""
    stage = twin.Stage(device, worlds=1)
    stage.xpos[:, 1:5] = 0.1
    stage.xpos[0, 3, :2] = x, y
    for ring, good in ((False, box), (True, disc)):
        ok, _ = _in_zone(stage, twin.Marker(0, (0, 0, 1), UPRIGHT, (0.6, 0.485, 1)), ring)
        assert ok[0] == good
