"""OpenDoor, SitSofa, Boxing and VisNavi: what their files promise, in the model that the engines step."""

import itertools
import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from arena_newton import rule_sets, tasks
from arena_newton.physics.scene import SCENES, load_scene
from arena_newton.pictures.camera import Camera, WorldLights
from arena_newton.rules.modes import HELD_OUT
from arena_newton.tasks.semantic_mode import semantic_note, task_title
from tests.scenes import scene

TASKS = tuple(name for name in tasks.OWN if tasks.get(name).suite == "HSI")
OBSTACLES = tuple(f"/World/{kind}_{letter}" for kind in ("Beam", "Block") for letter in "abc")
LOOKS = ("semantic", *HELD_OUT)


def fresh(built, dt=0.005):
    """State with the robot out of everything's way."""
    m = built.mj_model
    m.opt.timestep = dt
    data = mujoco.MjData(m)
    data.qpos[built.robot.root_qpos : built.robot.root_qpos + 3] = (-6.3, -5.6, 0.8)
    return m, data


@pytest.mark.parametrize("task", tasks.OWN)
def test_scene_is_light_enough(task):
    """A scene with its robot holds fewer than 150 shapes and fewer than 60 solids of its own."""
    built = scene(task)
    assert built.model.shape_count < 150
    assert sum(not label.startswith("/World/Robot") for label in built.geom_labels) < (30 if task in TASKS else 60)


@pytest.mark.parametrize("task", TASKS)
def test_world_camera_sees_the_robot_and_the_goal(task):
    """The world camera's pose is the original's: robot and goal project into its picture."""
    from pxr import Gf, UsdGeom

    goal = {
        "open_door": (-1.614, 2.314, 1.0),
        "sit_sofa": (-3.2, -1.1, 0.4),
        "boxing": (-0.97, -3.55, 0.8),
        "vis_navi": (-2.05, -0.31, 0.0),
    }[task]
    stage = scene(task).stage
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/WorldCamera"))
    to_camera = UsdGeom.XformCache().GetLocalToWorldTransform(camera.GetPrim()).GetInverse()
    half = 0.5 * camera.GetHorizontalApertureAttr().Get() / camera.GetFocalLengthAttr().Get()
    for point in (tasks.get(task).spawn_position, goal):
        x, y, z = to_camera.Transform(Gf.Vec3d(*point))
        assert z < 0 and abs(x / z) < half and abs(y / z) < half * 9 / 16


def test_door_is_a_chain_under_a_posable_frame():
    """Frame is a mocap body that carries the leaf, which carries the handle."""
    built = scene("open_door")
    m = built.mj_model
    frame, leaf, handle = (built.body_id(f"/World/Door/{n}") for n in ("Frame", "Leaf", "Handle"))
    assert m.body_mocapid[frame] >= 0
    assert m.body_parentid[leaf] == frame and m.body_parentid[handle] == leaf
    assert m.body_mass[leaf] == pytest.approx(20.0)


def test_door_hinge_values_reach_the_model():
    """Damping, friction, spring and limits arrive in radians and newton metres."""
    built = scene("open_door")
    m = built.mj_model
    leaf, handle = (built.joint_ids[f"/World/Door/{n}"] for n in ("LeafHinge", "HandleHinge"))
    assert np.degrees(m.jnt_range[leaf]) == pytest.approx([-2, 110], abs=1e-4)
    assert np.degrees(m.jnt_range[handle]) == pytest.approx([-50, 2], abs=1e-4)
    assert m.dof_damping[m.jnt_dofadr[leaf]] == pytest.approx(1.5, rel=1e-5)
    assert m.dof_frictionloss[m.jnt_dofadr[leaf]] == pytest.approx(0.5)
    assert m.dof_damping[m.jnt_dofadr[handle]] == pytest.approx(0.1, rel=1e-5)
    spring = next(a for a in range(m.nu) if m.actuator_trnid[a, 0] == handle)
    assert m.actuator_gainprm[spring, 0] == pytest.approx(2.5, rel=1e-5)
    assert m.jnt_solref[leaf] == pytest.approx([0.02, 1.0])


def test_leaf_swings_through_its_frame():
    """Wherever the door is, the leaf meets neither frame nor lever; unlatched and pushed, it goes from stop to stop."""
    built = scene("open_door")
    q, v = built.joint_qpos("/World/Door/LeafHinge"), built.joint_qvel("/World/Door/LeafHinge")
    door, frame = built.geom_ids("/World/Door"), built.mocap_id("/World/Door")
    for shift in (-0.754, -0.8, 0), (0.55, 0.1, 0), (0, 0, 0):
        m, d = fresh(built)
        d.mocap_pos[frame] += shift
        for angle in np.radians(np.linspace(-2, 110, 57)):
            d.qpos[q] = angle
            mujoco.mj_kinematics(m, d)
            mujoco.mj_comPos(m, d)
            mujoco.mj_collision(m, d)
            assert not np.isin(d.contact.geom, door).any()
    m, d = fresh(built)
    d.eq_active[:] = 0
    angles = []
    for torque, steps in ((12.0, 450), (-12.0, 600)):
        for _ in range(steps):
            d.qfrc_applied[v] = torque
            mujoco.mj_step(m, d)
            assert not np.isin(d.contact.geom, door).any()
        angles.append(np.degrees(d.qpos[q]))
    assert angles[0] == pytest.approx(110, abs=1) and angles[1] == pytest.approx(-2, abs=1)
    # The hinge is at the robot's left and the leaf opens away from it.
    d.qpos[q] = np.pi / 2
    mujoco.mj_forward(m, d)
    solid = d.geom_xpos[built.geom_ids("/World/Door/Leaf")[0]] - d.mocap_pos[frame]
    assert solid[:2] == pytest.approx([-0.5, 0.5], abs=1e-3)


def test_latch_holds_against_a_hard_push():
    """Latched, the leaf gives way by less than half a degree under 60 N·m."""
    built = scene("open_door")
    m, d = fresh(built)
    for _ in range(200):
        d.qfrc_applied[built.joint_qvel("/World/Door/LeafHinge")] = 60.0
        mujoco.mj_step(m, d)
    assert abs(np.degrees(d.qpos[built.joint_qpos("/World/Door/LeafHinge")])) < 0.5


def test_lever_goes_down_to_negative_and_springs_back():
    """7 N on the lever's tip turn it past −20°, its tip goes down, and it returns when let go."""
    built = scene("open_door")
    m, d = fresh(built)
    handle, lever = built.body_id("/World/Door/Handle"), built.geom_ids("/World/Door/Handle")[0]
    q = built.joint_qpos("/World/Door/HandleHinge")
    mujoco.mj_forward(m, d)
    rest = d.geom_xpos[lever].copy()
    assert rest[2] == pytest.approx(0.952, abs=0.005) and rest[0] < d.xpos[handle][0]
    for _ in range(300):
        d.qfrc_applied[:] = 0
        tip = 2 * d.geom_xpos[lever] - d.xpos[handle]
        mujoco.mj_applyFT(m, d, np.array([0, 0, -9.0]), np.zeros(3), tip, handle, d.qfrc_applied)
        mujoco.mj_step(m, d)
    assert np.degrees(d.qpos[q]) < -20.0
    assert d.geom_xpos[lever][2] < rest[2] - 0.015
    d.qfrc_applied[:] = 0
    for _ in range(200):
        mujoco.mj_step(m, d)
    assert abs(np.degrees(d.qpos[q])) < 1.0


def test_doorway_is_centred_on_the_leaf():
    """The doorway's plane is the frame's y = 0 and its x centre the leaf's."""
    built = scene("open_door")
    way = built.marker("/World/Door/Frame/Doorway")
    assert way.body_id == built.body_id("/World/Door/Frame")
    assert way.pos[:2] == pytest.approx((0, 0)) and way.half[0] == pytest.approx(0.55)
    m, d = fresh(built)
    mujoco.mj_forward(m, d)
    leaf = d.geom_xpos[built.geom_ids("/World/Door/Leaf")[0]]
    assert leaf[:2] == pytest.approx([-1.614, 2.314], abs=1e-4)


def test_seat_is_the_measured_box():
    """Seat marker and cushion are the measured seat, top at 0.42 m, stiff, friction 1."""
    built = scene("sit_sofa")
    m, seat = built.mj_model, built.marker("/World/Sofa/Seat")
    low, high = np.subtract(seat.pos, seat.half), np.add(seat.pos, seat.half)
    assert low == pytest.approx([-4.17, -1.30, 0.30], abs=1e-5)
    assert high == pytest.approx([-2.38, -0.83, 0.42], abs=1e-5)
    (cushion,) = built.geom_ids("/World/Sofa/SeatCushion")
    assert m.geom_pos[cushion] == pytest.approx(seat.pos) and m.geom_size[cushion] == pytest.approx(seat.half)
    assert m.geom_solref[cushion] == pytest.approx([0.02, 1.0]) and m.geom_friction[cushion, 0] == pytest.approx(1.0)


def test_cartons_drop_and_rest():
    """Cartons of 0.05 kg come to rest on their undersides."""
    built = scene("sit_sofa")
    m, d = fresh(built)
    for _ in range(300):
        mujoco.mj_step(m, d)
    for name in ("/World/Carton_1", "/World/Carton_2"):
        assert m.body_mass[built.body_id(name)] == pytest.approx(0.05)
        q = d.qpos[built.joint_qpos(name) :][:7]
        assert q[2] == pytest.approx(0.21, abs=2e-3) and abs(q[3]) > 0.999
        assert np.abs(d.qvel[built.joint_qvel(name) :][:6]).max() < 0.01


@pytest.mark.parametrize(("variant", "edge"), [("base", 0.10), ("semantic", 0.10)])
def test_boxing_target_bounds_follow_the_look(variant, edge):
    """The bounds are the sphere's or the cube's, of equal extent (paper); the target cannot be touched."""
    built = scene("boxing", variant=variant)
    bounds = built.marker("/World/Target/Frame/Bounds")
    assert bounds.half == pytest.approx((edge / 2,) * 3)
    assert built.mocap_id("/World/Target") >= 0
    assert not any(label.startswith("/World/Target") for label in built.geom_labels)
    assert all(built.mj_model.geom_bodyid[g] == 0 for n in (1, 2) for g in built.geom_ids(f"/World/Bag_{n}"))


def test_dropped_obstacles_settle():
    """Beams and blocks are dynamic, fall from a drawn layout and come to rest on the floor or on each other."""
    built = scene("vis_navi")
    m, d = fresh(built)
    rng = np.random.default_rng(3)
    spans = [(-0.5, -0.4), (-2.2, -1.7), (-4.6, -4.5), (-1.8, -0.7), (-5.2, -4.0), (-3.1, -2.0)]  # original's layout
    for name, span, z in zip(OBSTACLES, spans, (0.16, 0.56, 1.06, 1.56, 1.3, 1.8), strict=True):
        yaw = rng.uniform(-0.785, 0.785)
        pose = (rng.uniform(*span), rng.uniform(-2.5, -1.2), z, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
        d.qpos[built.joint_qpos(name) :][:7] = pose
    for _ in range(800):
        mujoco.mj_step(m, d)
    for name in OBSTACLES:
        assert np.abs(d.qvel[built.joint_qvel(name) :][:6]).max() < 0.05, name
        assert 0.1 < d.qpos[built.joint_qpos(name) + 2] < 1.2


def test_zone_is_the_outline():
    """The zone is the yellow outline's 0.97 m square, offset from the sign's origin."""
    built = scene("vis_navi")
    zone = built.marker("/World/TargetSign/Frame/Zone")
    assert zone.pos[:2] == pytest.approx((-0.05, -0.06)) and zone.half[:2] == pytest.approx((0.485, 0.485))
    assert built.mocap_id("/World/TargetSign") >= 0 and len(built.geom_ids("/World/TargetSign")) == 1
    ring = scene("vis_navi", variant="semantic").marker("/World/TargetSign/Frame/Zone")
    assert (zone.round, ring.round) == (False, True) and ring.half == zone.half


def compiled(built):
    """Every array and number of the compiled model, as bytes, but those of names and of the search trees of geoms."""
    model = built.mj_model
    values = {name: getattr(model, name) for name in dir(model) if not name.startswith(("_", "name", "nname", "nbuf"))}
    kept = {name: value for name, value in values.items() if isinstance(value, np.ndarray | int | float)}
    return {name: np.asarray(value) for name, value in kept.items() if name != "signature"}


def scene_in(task, mode):
    """The scene of a mode under rules `paper`."""
    spec = tasks.get(task)
    return scene(task, variant=spec.variant(mode, rule_sets.get("paper")), layer=spec.own_layer(mode))


def assert_as_base(task, base, changed):
    """Hold a look's compiled model to that of base mode, but for the geoms that are clutter by its task."""
    models = compiled(base), compiled(changed)
    assert models[0].keys() == models[1].keys() and len(models[0]) > 200
    differing = {name for name in models[0] if models[0][name].tobytes() != models[1][name].tobytes()}
    added = [label for label in changed.geom_labels if label not in base.geom_labels]
    assert (tasks.get(task).semantic_change == "clutter") == bool(added)
    if added:  # things that are fixed to the world; bodies, joints and the geoms of base mode are as they were
        assert len(added) == 5 and all(label.startswith("/World/Clutter/") for label in added)
        assert all(name.startswith(("geom_", "bvh_", "nbvh", "ngeom", "body_")) for name in differing), differing
        kept = [changed.geom_labels.index(label) for label in base.geom_labels]
        for name in ("geom_pos", "geom_quat", "geom_size", "geom_type", "geom_friction", "geom_solref", "geom_condim"):
            assert models[0][name].tobytes() == models[1][name][kept].tobytes(), name
        assert differing & {name for name in differing if name.startswith("body_")} <= {
            f"body_{what}" for what in ("bvhadr", "bvhnum", "conaffinity", "contype", "geomadr", "geomnum")
        }
    else:
        assert differing == set()


def head_picture(scene):
    """Head camera's picture at the spawn pose, int [48, 64, 3]."""
    camera = Camera.from_scene(scene, "ego", 64, 48, WorldLights.allocate(1, scene.device, scene.stage))
    return camera.render(scene.model.state())[0].cpu().numpy().astype(int)


@pytest.mark.parametrize("task", tasks.OWN)
def test_semantic_modes_change_looks_and_clutter_alone(task):
    """Semantic modes compile to base mode's model to the last bit, but for their task's clutter; all look different.

    A held-out look changes a third of the head camera's picture, against every other mode.
    """
    scenes = {mode: scene_in(task, mode) for mode in ("base", *LOOKS)}
    for mode in LOOKS:
        assert_as_base(task, scenes["base"], scenes[mode])
        assert scenes[mode].model.shape_count < 150
    pictures = {mode: head_picture(built) for mode, built in scenes.items()}
    for first, second in itertools.combinations(pictures, 2):
        change = np.abs(pictures[first] - pictures[second]).max(axis=-1)
        assert change.any() and ((change > 16).mean() > 0.33 or not {first, second} & set(HELD_OUT)), (first, second)
    assert task_title(task) in semantic_note()


def test_variant_by_override_alone(tmp_path):
    """The example of docs/howto/bring/authoring.md: a layer over the scene paints, moves and adds without code."""
    own = os.path.relpath(SCENES.resolve() / "sit_sofa" / "scene.usda", tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "howto" / "bring" / "authoring.md").read_text()
    example = page.split("```usda\n")[1].split("```")[0].replace("../usd_scenes/sit_sofa/scene.usda", own)
    room = tmp_path / "my_room.usda"
    room.write_text(example)
    built = load_scene(room, device="cpu", native=True)
    assert built.geom_ids("/World/Stool")
    assert built.has_body("/World/Carton_1") and built.robot.root_body > 0
    shape = built.model.shape_label.index("/World/Sofa/SeatCover_0")
    red, green, blue = built.model.shape_color.numpy()[shape]
    assert green > 1.3 * max(red, blue)


def test_preview_writes_a_sheet(tmp_path):
    """One row per target with both views, not black and not uniform."""
    from PIL import Image

    from arena_newton.usd_scenes.preview import preview

    out = preview(["boxing"], tmp_path / "sheet.png", 64, HELD_OUT[0])
    picture = np.asarray(Image.open(out))
    assert picture.shape == (48 + 18 + 4, 64 + 85 + 12, 3)
    assert picture[20:64, 6:60].std() > 10 and picture[20:64, 75:140].std() > 10


def test_preview_refuses_what_it_does_not_know(tmp_path):
    """An unknown mode or scene is one clear error."""
    from arena_newton.errors import InputError
    from arena_newton.usd_scenes.preview import preview

    with pytest.raises(InputError, match="--mode night"):
        preview(["boxing"], tmp_path / "a.png", 64, "night")
    with pytest.raises(InputError, match="no_such_task"):
        preview(["no_such_task"], tmp_path / "a.png", 64, "base")
