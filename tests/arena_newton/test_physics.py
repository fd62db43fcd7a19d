"""The two engines step the same model and agree; worlds do not touch each other."""

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
