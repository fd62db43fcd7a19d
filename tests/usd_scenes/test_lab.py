"""The lab scene: a robot on open ground, supports that wait to be placed, a ball in one variant; on both engines."""

import numpy as np
import pytest
import warp as wp

from arena_newton import rule_sets, tasks
from arena_newton.physics.engines import make_physics
from arena_newton.physics.scene import load_scene
from arena_newton.robot import g1
from scene_builders.__main__ import build_all, main, parts
from scene_builders.lab import BALL_RADIUS, PARKED, SUPPORTS

RATE = g1.PhysicsRate(dt=0.005, substeps=4)
_LOADED: dict[str, object] = {}


def lab(engine: str, variant: str = "ball"):
    """One load per engine for the whole file."""
    key = f"{engine} {variant}"
    if key not in _LOADED:
        scene = load_scene(
            "lab",
            worlds=2,
            device="cpu",
            hands="fixed",
            variant=variant,
            rules=rule_sets.get("paper"),
            native=engine == "mujoco",
        )
        _LOADED[key] = (scene, make_physics(scene, RATE, engine, threads=1))
    return _LOADED[key]


def start(engine: str, placed: dict[str, tuple[float, float, float]], root: tuple[float, float, float], ball=None):
    """Both worlds at rest with supports at `placed`, the robot at `root` and the ball somewhere."""
    scene, physics = lab(engine)
    qpos = physics.qpos0.copy()
    h = scene.robot
    qpos[:, h.root_qpos : h.root_qpos + 3] = root
    qpos[:, h.joint_qpos] = g1.DEFAULT_POSE
    if ball is not None:
        at = scene.joint_qpos("/World/Ball")
        qpos[:, at : at + 3] = ball
    position = np.tile(physics.mocap_pos0, (2, 1, 1))
    for name, pose in placed.items():
        position[:, scene.mocap_id(f"/World/{name}")] = pose
    physics.reset_worlds(np.arange(2), qpos, position, np.tile(physics.mocap_quat0, (2, 1, 1)))
    ctrl = physics.ctrl.numpy()
    ctrl[:, h.joint_ctrl] = g1.DEFAULT_POSE
    physics.ctrl.assign(ctrl)
    return scene, physics


def test_the_lab_is_built_but_is_no_task():
    """The lab is a part of the build, and neither the task list nor an evaluation offers it."""
    assert "lab" in parts()
    assert "lab" not in tasks.names()


def test_a_part_that_nobody_builds_is_one_line(capsys):
    """An unknown name is code 2 and one line that names the parts."""
    assert main(["tennis"]) == 2
    assert capsys.readouterr().err.startswith(
        "error: unknown part 'tennis'; parts are textures, patterns, g1, football,"
    )


def test_committed_layer_is_what_the_author_writes(tmp_path):
    """The committed scene is the author's output, byte for byte."""
    from arena_newton.physics.scene import scene_path

    *_, written = build_all(tmp_path, ["textures", "g1", "lab"])
    assert (written / "scene.usda").read_text() == scene_path("lab").read_text()


def test_base_has_no_ball_and_few_geoms():
    """Without its variant there is no ball; the lab adds one plane and three boxes to the robot."""
    scene, _ = lab("mujoco", "base")
    assert not scene.has_body("/World/Ball")
    assert sum(not label.startswith("/World/Robot") for label in scene.geom_labels) == 4
    assert scene.mj_model.qpos0[:7] == pytest.approx([0, 0, 0.8, 1, 0, 0, 0])


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_supports_wait_out_of_reach_and_top_out_at_their_pose(engine):
    """A parked support touches nothing; the origin of its frame is the centre of its top face."""
    scene, physics = start(engine, {}, (0, 0, g1.SPAWN_HEIGHT))
    m = scene.mj_model
    for name, size in SUPPORTS.items():
        assert physics.mocap_pos0[scene.mocap_id(f"/World/{name}")] == pytest.approx(PARKED[name])
        (geom,) = scene.geom_ids(f"/World/{name}")
        assert 2 * m.geom_size[geom] == pytest.approx(size, abs=1e-6)
        assert m.geom_pos[geom] == pytest.approx([0, 0, -size[2] / 2], abs=1e-6)
    supports = [g for name in SUPPORTS for g in scene.geom_ids(f"/World/{name}")]
    rest = [g for g in range(m.ngeom) if g not in supports]
    physics.watch_pair(supports, rest)
    for _ in range(4):
        physics.step()
        assert float(physics.pair_force.numpy().max()) == 0.0


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_each_support_carries_the_robot_at_the_height_it_is_posed(engine):
    """Feet on a support posed at 0.09 m, with most of the box in the floor, stand 0.09 m higher."""
    for name in SUPPORTS:
        scene, physics = start(engine, {name: (0.035, 0.0, 0.09)}, (0, 0, g1.SPAWN_HEIGHT + 0.09))
        for _ in range(8):  # without it they would have fallen 12 cm
            physics.step()
        feet = [scene.link(f"{side}_ankle_roll_link") for side in ("left", "right")]
        heights = physics.xpos.numpy()[:, feet, 2]
        assert heights == pytest.approx(np.full((2, 2), 0.09 + 0.035), abs=0.015), name


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_ball_lies_where_it_is_put_and_bounces_off_a_foot(engine):
    """The ball rests on the floor, and one that flies at a robot's toes is sent back."""
    scene, physics = start(engine, {}, (0, 0, g1.SPAWN_HEIGHT), ball=(0.6, 0.0, BALL_RADIUS))
    at = scene.joint_qpos("/World/Ball")
    for _ in range(4):
        physics.step()
    assert physics.qpos.numpy()[:, at : at + 3] == pytest.approx(np.tile([0.6, 0.0, BALL_RADIUS], (2, 1)), abs=2e-3)
    scene, physics = start(engine, {}, (0, 0, g1.SPAWN_HEIGHT), ball=(0.35, 0.118, BALL_RADIUS))
    speed = np.zeros((physics.worlds, physics.nv), np.float32)
    speed[:, scene.joint_qvel("/World/Ball")] = -2.0
    if engine == "mujoco":
        for data, row in zip(physics._data, speed, strict=True):
            data.qvel[:] = row
    else:
        physics.qvel.assign(speed)
    for _ in range(10):
        physics.step()
    assert np.all(physics.qpos.numpy()[:, at] > 0.2)
    assert np.all(physics.qvel.numpy()[:, scene.joint_qvel("/World/Ball")] > 0.02)


def test_engines_agree_on_the_first_tenth_of_a_second():
    """The same drop on both engines ends within a millimetre."""
    roots = []
    for engine in ("mujoco", "warp"):
        scene, physics = start(engine, {"Sill": (0.035, 0.0, 0.05)}, (0, 0, g1.SPAWN_HEIGHT + 0.05))
        for _ in range(5):
            physics.step()
        roots.append(wp.clone(physics.qpos).numpy()[:, : scene.robot.root_qpos + 7])
    assert roots[0] == pytest.approx(roots[1], abs=1e-3)
