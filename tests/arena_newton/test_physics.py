"""The two engines step the same model and agree; worlds do not touch each other."""

import dataclasses

import numpy as np
import pytest

from arena_newton.errors import InputError
from arena_newton.physics import make_physics, resolve_engine
from arena_newton.robot import DEFAULT_POSE, PhysicsRate


def _standing(physics):
    h = physics.scene.robot
    qpos = physics.qpos0.copy()
    qpos[:, h.root_qpos : h.root_qpos + 7] = [0, -2, 0.8, 1, 0, 0, 0]
    qpos[:, h.joint_qpos] = DEFAULT_POSE
    worlds = np.arange(physics.worlds)
    mocap = (np.tile(physics.mocap_pos0, (len(worlds), 1, 1)), np.tile(physics.mocap_quat0, (len(worlds), 1, 1)))
    physics.reset_worlds(worlds, qpos, *mocap)
    ctrl = np.zeros((physics.worlds, physics.nu), np.float32)
    ctrl[:, h.joint_ctrl] = DEFAULT_POSE
    physics.ctrl.assign(ctrl)


@pytest.fixture(scope="module")
def both(football_native, football_warp):
    """Both engines at 1 ms × 20 on the football scene."""
    rate = PhysicsRate(0.001, 20)
    return make_physics(football_native, rate, "mujoco"), make_physics(football_warp, rate, "warp")


def test_same_torques_same_motion(both):
    """With the same torques the two engines' roots stay within 1e-5 m for 200 steps of 1 ms."""
    import mujoco

    native, batched = both
    rng = np.random.default_rng(0)
    torque = np.zeros(native.nv)
    torque[native.scene.robot.joint_qvel] = rng.uniform(-3, 3, 29)
    off = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    saved = native._m.opt.disableflags, batched._m.opt.disableflags
    native._m.opt.disableflags |= off
    batched._m.opt.disableflags |= off
    try:
        for physics in both:
            _standing(physics)
        for data in native._data:
            data.qfrc_applied[:] = torque
        batched._d.qfrc_applied.assign(np.tile(torque.astype(np.float32), (batched.worlds, 1)))
        for _ in range(10):
            for physics in both:
                physics.step()
        root = native.scene.robot.root_qpos
        a = native.qpos.numpy()[0, root : root + 3]
        b = batched.qpos.numpy()[:, root : root + 3]
        assert a[2] < 0.75, "the robot should have fallen freely for a while"
        assert np.abs(b - a).max() < 1e-5
    finally:
        native._m.opt.disableflags, batched._m.opt.disableflags = saved
        for data in native._data:
            data.qfrc_applied[:] = 0
        batched._d.qfrc_applied.zero_()


def test_closed_loop_posture_agrees(both):
    """Under the position drives both engines hold the default pose with the same error, within 10 %."""
    errors = []
    for physics in both:
        _standing(physics)
        for _ in range(12):
            physics.step()
        q = physics.qpos.numpy()[0, physics.scene.robot.joint_qpos]
        errors.append(np.abs(q - np.array(DEFAULT_POSE)).mean())
    assert errors[0] > 1e-4
    assert abs(errors[0] - errors[1]) < 0.1 * errors[0]


def test_reset_leaves_no_trace(both):
    """A world that is reset runs exactly as a world that never ran (engine mujoco, bit for bit)."""
    native, _ = both
    _standing(native)
    for _ in range(5):
        native.step()
    first = native.qpos.numpy().copy()
    native.ctrl.assign(native.ctrl.numpy() + 0.5)
    for _ in range(3):
        native.step()
    _standing(native)
    for _ in range(5):
        native.step()
    assert np.array_equal(first, native.qpos.numpy())
    assert np.array_equal(first[0], first[2])


def test_nan_stays_in_its_world(both):
    """A NaN in one world leaves the others as they were (engine mujoco)."""
    native, _ = both
    _standing(native)
    native._data[1].qpos[:] = np.nan
    for _ in range(3):
        native.step()
    q = native.qpos.numpy()
    assert not np.isfinite(q[1]).all()
    assert np.isfinite(q[[0, 2]]).all() and np.array_equal(q[0], q[2])
    _standing(native)


def test_contact_forces_carry_the_robot(both):
    """Net contact forces on the feet sum to the robot's weight, on both engines."""
    for physics in both:
        _standing(physics)
        physics.want_forces = True
        for _ in range(15):
            physics.step()
        feet = [physics.scene.link(f"{side}_ankle_roll_link") for side in ("left", "right")]
        weight = 9.81 * physics.scene.mj_model.body_mass[list(physics.scene.robot.bodies)].sum()
        force = physics.contact_force.numpy()[0, feet].sum()
        assert force == pytest.approx(weight, rel=0.25)
        physics.want_forces = False


def test_native_forces_match_mujoco(both):
    """The vectorised net contact forces equal those from MuJoCo's own mj_contactForce."""
    import mujoco

    native, _ = both
    _standing(native)
    for _ in range(15):
        native.step()
    data, wrench = native._data[0], np.zeros(6)
    total = np.zeros((native.nbody, 3))
    for c in range(data.ncon):
        assert data.contact[c].dim == 3
        mujoco.mj_contactForce(native._m, data, c, wrench)
        force = data.contact[c].frame.reshape(3, 3).T @ wrench[:3]
        total[native._m.geom_bodyid[data.contact[c].geom[1]]] += force
        total[native._m.geom_bodyid[data.contact[c].geom[0]]] -= force
    assert data.ncon > 4
    assert np.allclose(native._body_forces(data), np.linalg.norm(total, axis=1), atol=1e-9)


@pytest.mark.parametrize("condim", [1, 3, 4, 6])
def test_native_forces_match_for_every_condim(football_native, condim):
    """Contacts without friction, with torsion and with rolling give MuJoCo's forces too, also where kinds are mixed."""
    import copy

    import mujoco

    scene = dataclasses.replace(football_native, mj_model=copy.copy(football_native.mj_model))
    feet = {scene.link("left_ankle_roll_link"), scene.link("right_ankle_roll_link")}
    geoms = [g for g, body in enumerate(scene.mj_model.geom_bodyid) if body in feet]
    ground = [g for g, body in enumerate(scene.mj_model.geom_bodyid) if body == 0]
    scene.mj_model.geom_condim[ground] = 1
    scene.mj_model.geom_condim[geoms[: len(geoms) // 2]] = condim
    scene.mj_model.geom_condim[geoms[len(geoms) // 2 :]] = 3
    native = make_physics(scene, PhysicsRate(0.005, 4), "mujoco")
    _standing(native)
    for _ in range(8):
        native.step()
    data, wrench = native._data[0], np.zeros(6)
    total, normals = np.zeros((native.nbody, 3)), []
    assert condim in {data.contact[c].dim for c in range(data.ncon)}
    for c in range(data.ncon):
        mujoco.mj_contactForce(native._m, data, c, wrench)
        normals.append(wrench[0])
        force = data.contact[c].frame.reshape(3, 3).T @ wrench[:3]
        total[native._m.geom_bodyid[data.contact[c].geom[1]]] += force
        total[native._m.geom_bodyid[data.contact[c].geom[0]]] -= force
    assert np.linalg.norm(total, axis=1).max() > 50.0
    assert np.allclose(native._body_forces(data), np.linalg.norm(total, axis=1), atol=1e-9)
    assert np.allclose(native._contact_forces(data, slice(None))[0], normals, atol=1e-9)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_two_physics_over_one_scene(football_native, football_warp, engine):
    """Each keeps its own rate and state: a later one, slower and stepped in between, changes no bit of the first."""
    scene = football_native if engine == "mujoco" else football_warp

    def run(disturbed):
        first = make_physics(scene, PhysicsRate(0.001, 5), engine)
        other = make_physics(scene, PhysicsRate(0.005, 1), engine) if disturbed else None
        _standing(first)
        for _ in range(3):
            first.step()
            if other is not None:
                other.step()
        return first.qpos.numpy().copy()

    assert np.array_equal(run(False), run(True))


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_the_physics_releases_the_latch(door, engine):
    """A pressed handle unlocks the leaf without any judge, in its own world only, until it is locked again."""
    import warp as wp

    scene = door[engine]
    physics = make_physics(scene, PhysicsRate(0.005, 4), engine)
    mocap = (np.tile(physics.mocap_pos0, (2, 1, 1)), np.tile(physics.mocap_quat0, (2, 1, 1)))
    physics.reset_worlds(np.arange(2), physics.qpos0, *mocap)
    force = np.zeros((2, physics.nv), np.float32)
    force[:, scene.joint_qvel("/World/Door/LeafHinge")] = 10.0
    force[1, scene.joint_qvel("/World/Door/HandleHinge")] = -5.0
    if engine == "mujoco":
        for data, row in zip(physics._data, force, strict=True):
            data.qfrc_applied[:] = row
    else:
        physics._d.qfrc_applied.assign(force)
    for _ in range(10):
        physics.step()
    leaf = physics.qpos.numpy()[:, scene.joint_qpos("/World/Door/LeafHinge")]
    assert physics.latch_locked.numpy().tolist() == [1, 0]
    assert abs(leaf[0]) < 0.005 < 0.02 < leaf[1]
    physics.lock_latch(wp.array([0, 1], dtype=wp.int32, device=physics.device))
    assert physics.latch_locked.numpy().tolist() == [1, 1]


@pytest.fixture(scope="module")
def door():
    """OpenDoor for both engines, two worlds."""
    from arena_newton.scene import load_scene

    return {"mujoco": load_scene("open_door", worlds=2, native=True), "warp": load_scene("open_door", worlds=2)}


def test_the_latch_is_found_by_its_label(tmp_path):
    """An equality that a layer brings with it is not taken for the latch, and stays active."""
    from arena_newton.scene import load_scene

    path = tmp_path / "door.usda"
    path.write_text(
        """#usda 1.0
(
    defaultPrim = "World"
    subLayers = [@arena_newton/usd_scenes/open_door/scene.usda@]
)

over "World"
{
    over "Door"
    {
        def PhysicsFixedJoint "Tie" (
            prepend apiSchemas = ["MjcEqualityWeldAPI"]
        )
        {
            rel physics:body0 = </World/Door/Frame>
            rel physics:body1 = </World/Door/Handle>
        }
    }
}
"""
    )
    scene = load_scene("open_door", native=True, variant_file=path)
    assert scene.mj_model.neq == 2 and scene.latch.equality == 1, "the layer's weld comes first"
    import mujoco

    held = [int(scene.mj_model.eq_type[e]) for e in range(scene.mj_model.neq)]
    assert held[scene.latch.equality] == mujoco.mjtEq.mjEQ_JOINT
    assert int(scene.mj_model.eq_obj1id[scene.latch.equality]) == scene.joint("/World/Door/LeafHinge")


def test_an_unstable_world_writes_no_file(football_native, tmp_path, monkeypatch):
    """MuJoCo's warning of a broken state leaves no log file in the working folder."""
    monkeypatch.chdir(tmp_path)
    physics = make_physics(football_native, PhysicsRate(0.005, 4), "mujoco")
    physics._data[0].qpos[:] = np.nan
    physics.step()
    assert list(tmp_path.iterdir()) == []


def test_overflow_is_reported(football_warp):
    """A constraint buffer that is too small is flagged in the world that overflowed."""
    from arena_newton.scene import load_scene

    scene = load_scene("football", worlds=2, device="cpu", constraints_per_world=8, contacts_per_world=4)
    physics = make_physics(scene, PhysicsRate(0.005, 4), "warp")
    _standing(physics)
    for _ in range(5):
        physics.step()
    assert physics.overflowed(0) and physics.overflowed(1)


@pytest.mark.parametrize(
    ("engine", "device", "named"),
    [("bullet", None, "--engine bullet"), ("auto", "tpu", "--device tpu"), ("mujoco", "cuda:0", "--device cuda:0")],
)
def test_bad_engine_or_device_is_named(engine, device, named):
    """An unknown engine or a missing device gives one error that names the flag."""
    with pytest.raises(InputError, match=named):
        resolve_engine(engine, device)
