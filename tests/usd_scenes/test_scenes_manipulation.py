"""The football, two-desk and box scenes: what the layers say and how their things behave in MuJoCo."""

import re

import numpy as np
import pytest
from pxr import Gf

from arena_newton import tasks
from arena_newton.errors import InputError
from scene_builders import author, patterns, rooms, textures, warehouse
from scene_builders.__main__ import build_all
from tests.scenes import scene

SCENES = tuple(name for name in tasks.OWN if tasks.get(name).suite == "HOI")


def start(task: str, *, dt: float = 0.005, variant: str = "base"):
    """MuJoCo model and data with the robot set aside, where it may fall."""
    import mujoco

    built = scene(task, variant)
    model, data = built.mj_model, mujoco.MjData(built.mj_model)
    model.opt.timestep = dt
    data.qpos[built.robot.root_qpos] += 100.0
    return built, model, data


def run(model, data, seconds: float) -> None:
    """Step for some time."""
    import mujoco

    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)


@pytest.mark.parametrize(
    ("task", "prim", "mass"),
    [("football", "/World/Ball", 0.43), ("double_desk", "/World/Hammer", 0.35), ("pp_box", "/World/Box", 0.05)],
)
def test_things_to_handle_are_free_bodies_of_the_right_mass(task, prim, mass):
    """Ball, hammer and box have a free joint and the original's mass."""
    import mujoco

    built = scene(task)
    body = built.body_id(prim)
    joint = built.mj_model.body_jntadr[body]
    assert built.mj_model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
    assert built.mj_model.body_mass[body] == pytest.approx(mass, rel=1e-6)


@pytest.mark.parametrize(("task", "prim"), [("double_desk", "/World/Basket"), ("pp_box", "/World/Shelf")])
def test_fixtures_can_be_posed(task, prim):
    """Crate and shelf are mocap bodies: immovable, yet posed per episode and world."""
    assert scene(task).mocap_id(prim) >= 0


def test_hammer_inertia_is_that_of_its_geoms():
    """The authored centre of mass and inertia equal MuJoCo's own for a capsule of 0.13 kg and a box of 0.22 kg."""
    import mujoco

    oracle = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><freejoint/>
        <geom type="capsule" fromto="0 -0.1335 0 0 0.1335 0" size="0.0165" mass="0.13"/>
        <geom type="box" size="0.05 0.015 0.015" pos="0 0.135 0" mass="0.22"/></body></worldbody></mujoco>"""
    )
    built = scene("double_desk")
    body = built.body_id("/World/Hammer")
    np.testing.assert_allclose(built.mj_model.body_ipos[body], oracle.body_ipos[1], atol=1e-6)
    np.testing.assert_allclose(np.sort(built.mj_model.body_inertia[body]), np.sort(oracle.body_inertia[1]), rtol=2e-3)


@pytest.mark.parametrize("dt", [0.001, 0.005])
def test_ball_rolls_without_losing_speed(dt):
    """A ball that rolls at 0.9 m/s still moves above 0.6 m/s after 3 m, at both physics rates."""
    built, model, data = start("football", dt=dt)
    qpos, qvel = built.joint_qpos("/World/Ball"), built.joint_qvel("/World/Ball")
    data.qpos[qpos : qpos + 3] = (3.5, -4.0, 0.11)
    data.qvel[qvel : qvel + 6] = (0, 0.9, 0, -0.9 / 0.11, 0, 0)
    for _ in range(round(6.0 / dt)):
        run(model, data, dt)
        if data.qpos[qpos + 1] >= -1.0:
            break
    assert data.qpos[qpos + 1] >= -1.0
    assert data.qvel[qvel + 1] > 0.85


def test_ball_contact_parameters_reach_mujoco():
    """The ball keeps its friction 0.7, condim 3 and priority 1 on its way from USD."""
    built = scene("football")
    (geom,) = built.geom_ids("/World/Ball")
    assert built.mj_model.geom_friction[geom, 0] == pytest.approx(0.7)
    assert built.mj_model.geom_condim[geom] == 3
    assert built.mj_model.geom_priority[geom] == 1


@pytest.mark.parametrize(("x", "passes"), [(0.0, True), (-2.5, False), (2.55, False)])
def test_goal_mouth_is_open_between_its_posts(x, passes):
    """A ball shot at the middle crosses the line, one shot at a post comes back."""
    built, model, data = start("football")
    qpos, qvel = built.joint_qpos("/World/Ball"), built.joint_qvel("/World/Ball")
    data.qpos[qpos : qpos + 3] = (x, 1.0, 0.11)
    data.qvel[qvel : qvel + 6] = (0, 4.0, 0, -4.0 / 0.11, 0, 0)
    run(model, data, 0.8)
    assert (data.qpos[qpos + 1] > 3.03) == passes


def test_goal_volume_and_pitch_are_those_of_the_rules():
    """The markers hold −2.5 < x < 2.6, 3.03 < y < 5.03, 0 < z < 1.85 and the inside of the backdrop walls."""
    built = scene("football")
    volume, pitch = built.marker("/World/Goal/Volume"), built.marker("/World/Pitch")
    np.testing.assert_allclose(np.subtract(volume.pos, volume.half), (-2.5, 3.03, 0), atol=1e-6)
    np.testing.assert_allclose(np.add(volume.pos, volume.half), (2.6, 5.03, 1.85), atol=1e-6)
    np.testing.assert_allclose(np.add(pitch.pos, pitch.half)[:2], (6.76, 5.96), atol=1e-6)
    assert np.subtract(pitch.pos, pitch.half)[2] == pytest.approx(-0.5)


def test_only_the_released_variant_drops_a_second_ball():
    """The 1 kg distractor is in `semantic_released` alone, and falls to the grass there."""
    assert not scene("football").has_body("/World/Distractor")
    assert not scene("football", "semantic").has_body("/World/Distractor")
    built, model, data = start("football", variant="semantic_released")
    body, qpos = built.body_id("/World/Distractor"), built.joint_qpos("/World/Distractor")
    assert model.body_mass[body] == pytest.approx(1.0)
    np.testing.assert_allclose(data.qpos[qpos : qpos + 3], (-0.037, 0.496, 0.929), atol=1e-6)
    run(model, data, 2.0)
    assert data.qpos[qpos + 2] == pytest.approx(0.12, abs=0.005)


@pytest.mark.parametrize("yaw", [-0.35, 0.0, 0.35])
def test_hammer_rests_on_its_desk(yaw):
    """Dropped where episodes start (z 0.8), the hammer comes to rest on the bench, lying on its handle or head."""
    import mujoco

    built, model, data = start("double_desk")
    qpos, qvel = built.joint_qpos("/World/Hammer"), built.joint_qvel("/World/Hammer")
    turn, default = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]), np.array([0.7139051, 0, 0, -0.7002425])
    data.qpos[qpos : qpos + 3] = (-2.8, -3.05, 0.8)
    mujoco.mju_mulQuat(data.qpos[qpos + 3 : qpos + 7], turn, default)
    run(model, data, 3.0)
    assert data.qpos[qpos + 2] == pytest.approx(0.745 + 0.0165, abs=0.004)
    assert np.abs(data.qvel[qvel : qvel + 6]).max() < 0.05
    np.testing.assert_allclose(data.qpos[qpos : qpos + 2], (-2.8, -3.05), atol=0.05)


@pytest.mark.parametrize("yaw", [0.0, 0.6])
def test_crate_catches_the_hammer(yaw):
    """The hammer dropped over the posed crate stays inside the crate's box."""
    built, model, data = start("double_desk")
    crate, qpos = built.mocap_id("/World/Basket"), built.joint_qpos("/World/Hammer")
    data.mocap_pos[crate] = (-2.4, -0.05, 0.7525)
    data.mocap_quat[crate] = (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
    data.qpos[qpos : qpos + 3] = (-2.4, -0.05, 1.05)
    quarter = yaw - np.pi / 2
    data.qpos[qpos + 3 : qpos + 7] = (np.cos(quarter / 2), 0, 0, np.sin(quarter / 2))
    run(model, data, 2.0)
    inside = built.marker("/World/Basket/Frame/Inside")
    np.testing.assert_allclose(inside.half, (0.3007, 0.2009, 0.085), atol=1e-6)
    away = data.xipos[built.body_id("/World/Hammer")] - data.mocap_pos[crate]
    local = data.xmat[inside.body_id].reshape(3, 3).T @ away - np.asarray(inside.pos)
    assert (np.abs(local) < inside.half).all()


def test_box_rests_on_the_table():
    """The box placed as an episode places it (origin at z 0.75) settles on the table."""
    built, model, data = start("pp_box")
    body, qpos = built.body_id("/World/Box"), built.joint_qpos("/World/Box")
    data.qpos[qpos : qpos + 3] = (-0.5, -4.5, 0.75)
    run(model, data, 1.0)
    np.testing.assert_allclose(data.xipos[body], (-0.5, -4.5, 0.745 + 0.105), atol=0.003)


@pytest.mark.parametrize("height", [0.67, 2.15])
def test_box_rests_on_a_deck_of_the_posed_shelf(height):
    """The shelf carries the box on its empty deck and its top, wherever it was put."""
    built, model, data = start("pp_box")
    body, qpos, mocap = built.body_id("/World/Box"), built.joint_qpos("/World/Box"), built.mocap_id("/World/Shelf")
    data.mocap_pos[mocap] = (-2.0, -2.8, 0.0)
    data.mocap_quat[mocap] = (np.cos(0.1), 0, 0, np.sin(0.1))
    data.qpos[qpos : qpos + 3] = (-2.2, -2.84, height + 0.01)
    run(model, data, 1.0)
    assert data.xipos[body][2] == pytest.approx(height + 0.105, abs=0.003)


def test_deck_markers_are_the_decks():
    """Each deck marker is its plate, and its top face the deck's measured height."""
    built = scene("pp_box")
    names = ("Deck_0", "Deck_1", "Deck_2", "Deck_3", "Top")
    markers = [built.marker(f"/World/Shelf/Frame/{name}") for name in names]
    heights = [m.pos[2] + m.half[2] for m in markers]
    np.testing.assert_allclose(heights, (0.17, 0.67, 1.18, 1.68, 2.15), atol=1e-6)
    for name, marker in zip(names, markers, strict=True):
        (plate,) = built.geom_ids(f"/World/Shelf/Frame/{name}_Plate")
        assert marker.half == pytest.approx(built.mj_model.geom_size[plate]) == (0.98, 0.295, 0.015)
        assert marker.pos == pytest.approx(built.mj_model.geom_pos[plate])


def test_stocked_decks_leave_the_second_one_empty():
    """Cartons stand on the first, third and fourth deck; none reaches into the empty deck's room."""
    built = scene("pp_box")
    model = built.mj_model
    spans = [
        (model.geom_pos[g, 2] - model.geom_size[g, 2], model.geom_pos[g, 2] + model.geom_size[g, 2])
        for g, label in enumerate(built.geom_labels)
        if "/Shelf/Frame/Carton_" in label
    ]
    assert len(spans) == 10
    assert all(high < 0.67 - 0.03 or low > 1.17 for low, high in spans)


def test_layers_are_what_their_authors_write(tmp_path):
    """Building again gives the stored scenes, variants and textures, byte for byte."""
    build_all(tmp_path, ["textures", "patterns", "g1", *tasks.OWN])
    files = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
    assert len(files) >= len(textures.TEXTURES) + 2 * len(tasks.OWN)
    for file in files:
        assert (tmp_path / file).read_bytes() == (tasks.base.SCENES / file).read_bytes(), file


def test_a_scene_built_elsewhere_finds_the_parts_of_this_package(tmp_path):
    """Robot and textures are named by the search path where they are not beside the layer; the layer composes."""
    stage = rooms.task_stage(tmp_path, tasks.get("boxing"), eye=(0, 0, 2), gaze=author.look_at((0, 0, 2), (3, 0, 2)))
    warehouse.room_looks(stage)
    stage.GetRootLayer().Save()
    text = (tmp_path / "scene.usda").read_text()
    assert set(re.findall("@(.*?)@", text)) == {
        "arena_newton/usd_scenes/g1/g1.usda",
        "arena_newton/usd_scenes/textures/concrete.png",
    }
    assert stage.GetPrimAtPath("/World/Robot/pelvis")


def test_a_camera_looks_at_a_point():
    """A camera's -z points from the eye to the point, its y-axis as far upwards as that allows."""
    for point in ((4.0, 1.0, 0.5), (-1.0, -3.0, 2.0), (0.0, 0.0, 0.0)):
        turn = Gf.Rotation(Gf.Quatd(*author.look_at((0.0, 0.0, 2.0), point)))
        ahead = np.array(point) - (0.0, 0.0, 2.0)
        assert np.array(turn.TransformDir(Gf.Vec3d(0, 0, -1))) == pytest.approx(ahead / np.linalg.norm(ahead))
        assert turn.TransformDir(Gf.Vec3d(1, 0, 0))[2] == pytest.approx(0.0, abs=1e-9)
        assert turn.TransformDir(Gf.Vec3d(0, 1, 0))[2] >= -1e-9
    for nowhere in ((0.0, 0.0, 2.0), (float("nan"), 0.0, 0.0), (float("inf"), 0.0, 0.0)):
        with pytest.raises(InputError, match="there is no direction"):
            author.look_at((0.0, 0.0, 2.0), nowhere)


def test_a_forgotten_or_misspelled_look_is_refused(tmp_path):
    """A scene with a variant that nobody authored is not written, and an edit names the variants that there are."""
    stage = rooms.task_stage(tmp_path, tasks.get("pp_box"), eye=(0, 0, 1), gaze=(1, 0, 0, 0))
    with rooms.edit(stage, "base"):
        author.xform(stage, "/World/Chair")
    with pytest.raises(InputError, match="variant semantic is empty"):
        rooms.save(stage, tmp_path)
    with pytest.raises(InputError, match="no variant 'third', choose from base, semantic"), rooms.edit(stage, "third"):
        pass


def test_textures_are_small(tmp_path):
    """Every texture is at most 256 pixels wide and high and 32 KiB long."""
    from PIL import Image

    for path in (*textures.build(tmp_path), *patterns.build(tmp_path)):
        assert max(Image.open(path).size) <= 256
        assert path.stat().st_size <= 32 * 1024


def test_scenes_name_no_path_of_a_machine():
    """The stored layers contain relative asset paths only."""
    for task in tasks.OWN:
        for layer in (tasks.base.SCENES / task).rglob("*.usda"):
            assert "@/" not in layer.read_text(), layer
