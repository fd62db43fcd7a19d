"""Tasks: draws equal the original's, are put where the rule set says, and depend on the seed alone."""

import dataclasses
import math
import random
from pathlib import Path

import numpy as np
import pytest

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.rules import seeding
from arena_newton.rules.modes import BUILT_IN, HELD_OUT
from arena_newton.rules.rule_types import PoseRange
from arena_newton.tasks.base import light_direction, widened
from tests.scenes import scene

PAPER, RELEASED = rule_sets.get("paper"), rule_sets.get("released")


def seed_of(task: str, group_seed: int = 0, repeat: int = 0) -> int:
    """Episode seed of a task."""
    return seeding.episode_seed(tasks.get(task).gym_id, group_seed, repeat)


def draw(task: str, mode: str = "base", rule_set=PAPER, repeat: int = 0):
    """Draws of an episode of group seed 0."""
    return tasks.get(task).draw(seed_of(task, 0, repeat), mode, rule_set)


def yaw_of(quat) -> float:
    """Yaw of a rotation about z."""
    return 2.0 * math.atan2(quat[3], quat[0])


@pytest.mark.parametrize(
    ("task", "record", "expected"),
    [
        ("football", "football", {"x": -0.421282, "y": 0.138644}),
        ("double_desk", "hammer", {"yaw": -0.317236, "x": -2.788149, "y": -3.016924}),
        ("double_desk", "basket", {"yaw": -0.524900, "x": -3.573021, "y": -0.122363}),
    ],
)
@pytest.mark.parametrize("rule_set", [PAPER, RELEASED], ids=lambda r: r.name)
@pytest.mark.parametrize("mode", ["base", "semantic", "visual"])
def test_samples_equal_the_recorded_ones(task, record, expected, rule_set, mode):
    """Samples of group seed 0, repeat 0 equal those of the original's result files, whatever the rule set."""
    sample = draw(task, mode, rule_set).sampled[record]
    for axis, value in expected.items():
        assert sample[axis] == pytest.approx(value, abs=5e-7)


@pytest.mark.parametrize("task", tasks.OWN)
@pytest.mark.parametrize("mode", BUILT_IN)
@pytest.mark.parametrize("rule_set", [PAPER, RELEASED], ids=lambda r: r.name)
def test_draws_are_pure_complete_and_in_range(task, mode, rule_set):
    """Two draws with one seed are equal, every object is placed, samples keep to their ranges."""
    spec = tasks.get(task)
    for repeat in range(5):
        first, second = draw(task, mode, rule_set, repeat), draw(task, mode, rule_set, repeat)
        assert first == second
        assert set(first.placed) == {o.prim for o in spec.objects}
        assert all(p.startswith("/World/") for p in first.placed)
        for pose in first.placed.values():
            assert math.hypot(*pose.quat) == pytest.approx(1.0, abs=1e-12)
        for rule in rule_set.task(task).objects:
            ranges = rule.execution if mode == "execution" else rule.base
            sample = first.sampled[rule.record]
            if isinstance(ranges, PoseRange):
                for axis in ("x", "y", "z", "yaw"):
                    if getattr(ranges, axis) is not None:
                        assert min(getattr(ranges, axis)) <= sample[axis] <= max(getattr(ranges, axis))
    assert draw(task, mode, rule_set, 0).sampled != draw(task, mode, rule_set, 1).sampled


def test_basket_and_sign_follow_the_rule_set():
    """`paper` puts them at the sample, `released` at initial position + 0.01 × sample; yaw acts in both."""
    for task, record, prim, init in (
        ("double_desk", "basket", "/World/Basket", (-2.8, -0.1, 0.745)),
        ("vis_navi", "target_sign", "/World/TargetSign", (-2.0, -0.25, 0.0)),
    ):
        ours, theirs = draw(task), draw(task, rule_set=RELEASED)
        sample = ours.sampled[record]
        assert theirs.sampled[record] == sample
        nominal = [sample[k] for k in "xyz"]
        assert ours.placed[prim].pos == pytest.approx(nominal)
        assert theirs.placed[prim].pos == pytest.approx([o + 0.01 * v for o, v in zip(init, nominal, strict=True)])
        assert yaw_of(ours.placed[prim].quat) == pytest.approx(sample["yaw"])
        assert yaw_of(theirs.placed[prim].quat) == pytest.approx(sample["yaw"])


@pytest.mark.parametrize(
    ("task", "prim", "mode", "x", "y"),
    [
        ("double_desk", "/World/Basket", "base", (-2.836, -2.820), (-0.103, -0.100)),
        ("double_desk", "/World/Basket", "execution", (-2.85, -2.82), (-0.103, -0.100)),
        ("vis_navi", "/World/TargetSign", "base", (-2.03, -2.015), (-0.2512, -0.242)),
        ("vis_navi", "/World/TargetSign", "execution", (-2.05, -2.0), (-0.2512, -0.20)),
        ("pp_box", "/World/Shelf", "base", (-2.9, -1.5), (-3.45, -2.35)),
        ("pp_box", "/World/Shelf", "execution", (-3.18, -1.5), (-3.45, -2.15)),
        ("open_door", "/World/Door", "base", (-2.368, -1.064), (1.514, 2.414)),
        ("open_door", "/World/Door", "execution", (-2.514, -0.954), (1.354, 2.434)),
    ],
)
def test_released_placement_is_the_effective_one(task, prim, mode, x, y):
    """World positions lie in the effective ranges that were derived and measured for the original, and fill them."""
    spots = np.array([draw(task, mode, RELEASED, k).placed[prim].pos for k in range(60)])
    slack = 1e-9
    assert x[0] - slack <= spots[:, 0].min() and spots[:, 0].max() <= x[1] + slack
    assert y[0] - slack <= spots[:, 1].min() and spots[:, 1].max() <= y[1] + slack
    assert np.ptp(spots[:, 0]) > 0.8 * (x[1] - x[0])


def test_shelf_and_door_are_offsets_in_both_sets():
    """Shelf and door are placed alike by both rule sets."""
    for task in ("pp_box", "open_door"):
        for mode in BUILT_IN:
            assert draw(task, mode).placed == draw(task, mode, RELEASED).placed


def test_cubes_stand_above_their_support():
    """The box (origin at its base) starts 5 mm above the table top 0.745 m, cartons (at the centre) drop 0.1 m."""
    assert draw("pp_box").placed["/World/Box"].pos[2] == pytest.approx(0.75)
    for carton in ("/World/Carton_1", "/World/Carton_2"):
        assert draw("sit_sofa").placed[carton].pos[2] - 0.21 == pytest.approx(0.1)


def test_hammer_yaw_turns_its_initial_orientation():
    """Yaw multiplies the initial orientation from the left."""
    draws = draw("double_desk")
    initial = 2.0 * math.atan2(-0.7002425, 0.7139051)
    assert yaw_of(draws.placed["/World/Hammer"].quat) == pytest.approx(initial + draws.sampled["hammer"]["yaw"])


def test_boxing_target_lies_on_a_bag():
    """The target is 0.15 m from the axis of the drawn bag at the drawn height, and both bags occur."""
    bags = set()
    for repeat in range(20):
        draws = draw("boxing", "execution", repeat=repeat)
        sample = draws.sampled["boxing_target"]
        axis = ((-0.97, -3.7), (-3.0, -3.7))[sample["bag"] - 1]
        x, y, z = draws.placed["/World/Target"].pos
        assert math.hypot(x - axis[0], y - axis[1]) == pytest.approx(0.15)
        assert 0.65 <= z <= 0.95
        bags.add(sample["bag"])
    assert bags == {1, 2}


def test_obstacles_share_one_generator():
    """The six obstacles are drawn one after the other, each x, y, yaw, from the object seed alone."""
    sampled = draw("vis_navi").sampled
    rng = np.random.default_rng(seeding.object_seed(seed_of("vis_navi")))
    for rule in PAPER.task("vis_navi").objects[:6]:
        sample = sampled[rule.record]
        expected = [rng.uniform(*r) for r in (rule.base.x, rule.base.y, rule.base.yaw)]
        assert [sample["x"], sample["y"], sample["yaw"]] == expected
        assert sample["z"] == rule.base.z[0]


def test_paper_execution_ranges_contain_the_base_ranges():
    """Under `paper` no execution range is shifted or void: each contains the base range, and some axis is wider."""
    for task in PAPER.tasks:
        for rule in task.objects:
            grew = False
            for axis in ("x", "y", "z"):
                if not hasattr(rule.base, axis):
                    continue
                base, wide = getattr(rule.base, axis), getattr(rule.execution, axis)
                assert wide[0] <= base[0] and wide[1] >= base[1], (rule.record, axis)
                grew |= wide != base
            assert grew, rule.record


def test_paper_widens_shifted_and_void_ranges_by_footballs_share():
    """Hammer, cartons, basket and sign grow by 1.45 / 1.2 about the base range where the original shifts or voids."""
    hammer = PAPER.task("double_desk").object("hammer")
    assert hammer.execution.x == pytest.approx((-2.8 - 0.4 * 1.45 / 1.2, -2.8 + 0.4 * 1.45 / 1.2))
    assert hammer.execution.y == hammer.base.y
    sign = PAPER.task("vis_navi").object("target_sign")
    assert (sign.execution.x, sign.execution.y) == (widened(sign.base.x), widened(sign.base.y))
    carton = PAPER.task("sit_sofa").object("carton_obstacle_01")
    assert (carton.execution.x, carton.execution.y) == ((-2.33, -1.7), widened((0.6, 0.8)))
    ball = PAPER.task("football").object("football")
    assert ball.execution.x == (-1.45, 1.45)
    assert widened((-1.2, 1.2)) == pytest.approx((-1.45, 1.45))


def test_light_of_visual_mode_is_drawn_from_the_episode_seed():
    """Order yaw (void), pitch, roll, intensity, r, g, b from random.Random(seed XOR key)."""
    seed = seed_of("football")
    rng = random.Random(seed ^ 0x1A2B3C4D)
    light = tasks.get("football").draw(seed, "visual", PAPER).light
    assert (light.yaw_deg, light.pitch_deg, light.roll_deg) == (0.0, rng.uniform(-20, 20), rng.uniform(-20, 20))
    assert light.intensity == rng.uniform(3000, 7000)
    assert light.color == tuple(rng.uniform(0.65, 0.85) for _ in range(3))
    assert light.direction == light_direction(light.yaw_deg, light.pitch_deg, light.roll_deg)
    assert np.linalg.norm(light.direction) == pytest.approx(1.0)


def test_light_direction_turns_x_then_y_then_z():
    """Roll, then pitch, then yaw turn a light that shines down."""
    assert light_direction(0.0, 0.0, 0.0) == pytest.approx((0.0, 0.0, -1.0))
    assert light_direction(0.0, 0.0, 90.0) == pytest.approx((0.0, 1.0, 0.0))
    assert light_direction(0.0, 90.0, 0.0) == pytest.approx((-1.0, 0.0, 0.0))
    assert light_direction(90.0, 90.0, 0.0) == pytest.approx((0.0, -1.0, 0.0))
    r, p, y = np.radians([12.0, -7.0, 33.0])
    rx = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    ry = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    rz = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    assert light_direction(33.0, -7.0, 12.0) == pytest.approx(rz @ ry @ rx @ [0.0, 0.0, -1.0])


def test_light_outside_visual_mode():
    """`paper` keeps the dome; `released` has a fixed distant light in DoubleDesk and P&PBox."""
    for task in tasks.OWN:
        for mode in ("base", "execution", "semantic"):
            assert draw(task, mode).light is None
            fixed = draw(task, mode, RELEASED).light
            if task in ("double_desk", "pp_box"):
                assert (fixed.direction, fixed.intensity, fixed.color) == ((0, 0, -1), 5000.0, (0.75, 0.75, 0.75))
            else:
                assert fixed is None


def test_variants():
    """Semantic mode selects the semantic variant, Football's under `released` the one with the second ball."""
    for task in tasks.OWN:
        spec = tasks.get(task)
        for mode in ("base", "execution", "visual"):
            assert spec.variant(mode, PAPER) == spec.variant(mode, RELEASED) == "base"
        assert spec.variant("semantic", PAPER) == "semantic"
    assert tasks.get("football").variant("semantic", RELEASED) == "semantic_released"


def test_held_out_looks_are_layers_of_their_own():
    """A held-out mode selects a layer next to the scene, in each task of the package; a task without one says so."""
    for spec in map(tasks.get, tasks.PAPER):
        assert all(spec.own_layer(mode) is None for mode in BUILT_IN if mode not in HELD_OUT)
        layers = [spec.own_layer(mode) for mode in HELD_OUT]
        assert [path.stem for path in layers] == list(HELD_OUT) and all(path.is_file() for path in layers)
        assert {spec.variant(mode, PAPER) for mode in HELD_OUT} == {"base"}
    bare = dataclasses.replace(tasks.get("boxing"), name="bare", scene=Path("bare/scene.usda"))
    with pytest.raises(InputError, match=r"--mode semantic-2: task bare has no bare/variants/semantic-2.usda"):
        bare.own_layer("semantic-2")


def test_unknown_task_and_mode_are_refused():
    """One clear line that names what there is."""
    with pytest.raises(InputError, match=r"--task golf: unknown task; known are boxing, .*, vis_navi"):
        tasks.get("golf")
    with pytest.raises(InputError, match="--mode night: unknown"):
        tasks.get("boxing").draw(1, "night", PAPER)
    with pytest.raises(InputError, match="--mode night: unknown"):
        tasks.get("boxing").variant("night", PAPER)


def test_a_changed_rule_set_is_honoured():
    """A draw reads the rule set it is given, not the built-in one."""
    football = PAPER.task("football")
    near = dataclasses.replace(football.objects[0].base, x=(0.5, 0.5))
    own = dataclasses.replace(football, objects=(dataclasses.replace(football.objects[0], base=near),))
    mine = dataclasses.replace(PAPER, tasks=(own, *PAPER.tasks[1:]))
    assert draw("football", rule_set=mine).placed["/World/Ball"].pos[0] == 0.5


def stage_of(task: str):
    """The task's stage."""
    from pxr import Usd

    from arena_newton.physics.scene import scene_path

    return Usd.Stage.Open(str(scene_path(task)))


@pytest.mark.parametrize("task", tasks.OWN)
def test_scene_agrees_with_the_task(task):
    """The stage has every randomised prim, and its robot stands where the task spawns it."""
    from pxr import Gf, UsdGeom

    stage, spec = stage_of(task), tasks.get(task)
    for o in spec.objects:
        assert stage.GetPrimAtPath(o.prim), o.prim
    robot = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/World/Robot"))
    assert tuple(robot.ExtractTranslation()) == pytest.approx(spec.spawn_position, abs=1e-6)
    turn = Gf.Transform(robot).GetRotation().GetQuat()
    dot = turn.GetReal() * spec.spawn_quat[0] + sum(np.array(turn.GetImaginary()) * spec.spawn_quat[1:])
    assert abs(dot) == pytest.approx(1.0, abs=1e-6)


def test_cube_origins_are_where_placement_expects_them():
    """Placed at the sampled height, the bottoms of box, cartons and blocks are at that height."""
    from pxr import Usd, UsdGeom

    for task, prim, sampled_z in (
        ("pp_box", "/World/Box", 0.75),
        ("sit_sofa", "/World/Carton_1", 0.1),
        ("sit_sofa", "/World/Carton_2", 0.1),
        ("vis_navi", "/World/Block_a", 1.56),
        ("vis_navi", "/World/Block_b", 1.3),
        ("vis_navi", "/World/Block_c", 1.8),
    ):
        stage = stage_of(task)
        cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
        bottom = cache.ComputeUntransformedBound(stage.GetPrimAtPath(prim)).ComputeAlignedRange().GetMin()[2]
        assert draw(task).placed[prim].pos[2] + bottom == pytest.approx(sampled_z, abs=2e-3), prim


def test_latch_stays_released_until_reset():
    """The handle releases at its angle, letting go does not lock again, a reset locks the masked worlds only."""
    import warp as wp

    from arena_newton.kernels.rules import latch

    release = math.radians(-20.0)
    qpos = wp.zeros((3, 2), dtype=wp.float32, device="cpu")
    locked = wp.full(3, 1, dtype=wp.int32, device="cpu")
    qpos.assign(np.array([[9.0, -0.3], [9.0, -0.36], [9.0, -0.5]], dtype=np.float32))
    latch.launch_release(qpos, 1, release, locked)
    assert locked.numpy().tolist() == [1, 0, 0]
    qpos.zero_()
    latch.launch_release(qpos, 1, release, locked)
    assert locked.numpy().tolist() == [1, 0, 0]
    latch.launch_lock(wp.array([0, 1, 0], dtype=wp.int32, device="cpu"), locked)
    assert locked.numpy().tolist() == [1, 1, 0]


LID = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    subLayers = [@{scene}@]
)

over "World"
{{
    over "Box"
    {{
        def Cube "Lid" (
            prepend apiSchemas = ["PhysicsCollisionAPI"]
        )
        {{
            double size = 2
            double3 xformOp:translate = (0.02, 0, 0.23)
            float3 xformOp:scale = (0.125, 0.105, 0.02)
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        }}
    }}
}}
"""


def test_a_box_of_several_solids_is_judged_whole(tmp_path):
    """P&PBox's centre and half sizes are those of the box around all its solids, here a cube and a wider lid."""
    from arena_newton.physics.scene import load_scene

    layer = tmp_path / "lid.usda"
    layer.write_text(LID.format(scene="arena_newton/usd_scenes/pp_box/scene.usda"))
    for variant_file, centre, half in (
        (None, (0.0, 0.0, 0.105), (0.105, 0.105, 0.105)),
        (layer, (0.02, 0.0, 0.125), (0.125, 0.105, 0.125)),
    ):
        built = load_scene("pp_box", variant_file=variant_file, device="cpu", native=True)
        box = tasks.get("pp_box").judge(built, PAPER).box
        assert box.pos.numpy()[0] == pytest.approx(centre, abs=1e-6)
        assert box.half.numpy()[0] == pytest.approx(half, abs=1e-6)


def test_the_pelvis_alone_counts_as_two_on_the_sofa():
    """`released` lists the pelvis with its contour, which the original's robot carries as a body in its place."""
    counted = tasks.get("sit_sofa").judge(scene("sit_sofa"), RELEASED).touching.numpy().tolist()
    assert counted.count(scene("sit_sofa").link("pelvis")) == 2 and len(counted) == 11 and len(set(counted)) == 10


@pytest.mark.parametrize(("variant", "rule_set", "ring"), [("semantic", RELEASED, True), ("semantic", PAPER, False)])
def test_only_released_reads_the_ring_as_a_disc(variant, rule_set, ring):
    """The semantic sign's zone is a disc for `released`, its bounding box for `paper`."""
    assert tasks.get("vis_navi").judge(scene("vis_navi", variant), rule_set).round is ring
