"""The two engines step the same model and agree; worlds do not disturb each other; states come back bit for bit."""

import copy
import dataclasses

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

from arena_newton.errors import InputError
from arena_newton.physics import scene as scene_file
from arena_newton.physics.devices import torch_device
from arena_newton.physics.engines import make_physics, resolve_engine
from arena_newton.physics.scene import load_scene
from arena_newton.robot.g1 import DEFAULT_POSE, SONIC_DRIVE, PhysicsRate


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
    """Both engines at 5 ms × 4 on the football scene."""
    rate = PhysicsRate(0.005, 4)
    return make_physics(football_native, rate, "mujoco"), make_physics(football_warp, rate, "warp")


def test_same_forces_same_motion(football_native, football_warp, monkeypatch):
    """Under the same torques on trunk and knees the two engines' roots stay within 1e-5 m for 80 steps of 1 ms."""
    off = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    torque = np.random.default_rng(0).uniform(-3, 3, (4, 3))
    roots = []
    for scene, engine in ((football_native, "mujoco"), (football_warp, "warp")):
        for options in (scene.mj_model.opt, getattr(scene.solver.mjw_model, "opt", None)):
            if options is not None:
                monkeypatch.setattr(options, "disableflags", options.disableflags | off)
        physics = make_physics(scene, PhysicsRate(0.001, 20), engine)
        _standing(physics)
        links = [scene.link(name) for name in ("pelvis", "torso_link", "left_knee_link", "right_knee_link")]
        force = physics.external_force.numpy()
        force[:, links, 3:] = torque
        physics.external_force.assign(force)
        for _ in range(4):
            physics.step()
        roots.append(physics.qpos.numpy()[:, scene.robot.root_qpos :][:, :3].copy())
    assert roots[0][0, 2] < 0.78, "the robot should have fallen freely for a while"
    assert np.abs(roots[1] - roots[0][0]).max() < 1e-5


@pytest.fixture(scope="module")
def stood(both):
    """Per engine: mean joint error after 12 ticks of standing [rad], and the net force on the feet after 15 [N]."""
    found = []
    for physics in both:
        _standing(physics)
        physics.want_forces = True
        for _ in range(12):
            physics.step()
        q = physics.qpos.numpy()[0, physics.scene.robot.joint_qpos]
        for _ in range(3):
            physics.step()
        feet = [physics.scene.link(f"{side}_ankle_roll_link") for side in ("left", "right")]
        found.append((np.abs(q - np.array(DEFAULT_POSE)).mean(), physics.contact_force.numpy()[0, feet].sum()))
        physics.want_forces = False
    return found


def test_closed_loop_posture_agrees(stood):
    """Under the position drives both engines hold the default pose with the same error, within 10 %."""
    errors = [error for error, _ in stood]
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
    native.data[1].qpos[:] = np.nan
    for _ in range(3):
        native.step()
    q = native.qpos.numpy()
    assert not np.isfinite(q[1]).all()
    assert np.isfinite(q[[0, 2]]).all() and np.array_equal(q[0], q[2])
    _standing(native)


def test_contact_forces_carry_the_robot(both, stood):
    """Net contact forces on the feet sum to the robot's weight, on both engines."""
    for physics, (_, force) in zip(both, stood, strict=True):
        weight = 9.81 * physics.scene.mj_model.body_mass[list(physics.scene.robot.bodies)].sum()
        assert force == pytest.approx(weight, rel=0.25)


@pytest.mark.parametrize("condim", [None, 1, 3, 4, 6])
def test_native_forces_match_mujoco(football_native, condim):
    """Net contact forces and their normals are those of MuJoCo's mj_contactForce, for every kind of contact."""
    scene = dataclasses.replace(football_native, mj_model=copy.copy(football_native.mj_model))
    feet = {scene.link("left_ankle_roll_link"), scene.link("right_ankle_roll_link")}
    geoms = [g for g, body in enumerate(scene.mj_model.geom_bodyid) if body in feet]
    ground = [g for g, body in enumerate(scene.mj_model.geom_bodyid) if body == 0]
    if condim is not None:
        scene.mj_model.geom_condim[ground] = 1
        scene.mj_model.geom_condim[geoms[: len(geoms) // 2]] = condim
        scene.mj_model.geom_condim[geoms[len(geoms) // 2 :]] = 3
    native = make_physics(scene, PhysicsRate(0.005, 4), "mujoco")
    native.watch_pair(geoms, ground)
    native.want_forces = True
    _standing(native)
    for _ in range(8):
        native.step()
    data, wrench = native.data[0], np.zeros(6)
    total, normals = np.zeros((native.nbody, 3)), []
    assert data.ncon > 4 and (condim or 3) in {data.contact[c].dim for c in range(data.ncon)}
    for c in range(data.ncon):
        mujoco.mj_contactForce(native.models[0], data, c, wrench)
        force = data.contact[c].frame.reshape(3, 3).T @ wrench[:3]
        bodies = native.models[0].geom_bodyid[data.contact[c].geom]
        total[bodies[1]] += force
        total[bodies[0]] -= force
        if feet & set(bodies.tolist()):
            normals.append(wrench[0])
    assert np.linalg.norm(total, axis=1).max() > 50.0
    np.testing.assert_allclose(native.contact_force.numpy()[0], np.linalg.norm(total, axis=1), rtol=1e-6, atol=1e-4)
    assert native.pair_force.numpy()[0] == pytest.approx(sum(normals), rel=1e-6)


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


@pytest.fixture(scope="module", params=["mujoco", "warp"])
def door(request):
    """OpenDoor, two worlds."""
    scene = load_scene("open_door", worlds=2, device="cpu", native=request.param == "mujoco")
    return make_physics(scene, PhysicsRate(0.005, 4), request.param)


def _closed(physics):
    """Put the door at rest, closed and locked."""
    fixtures = (np.tile(physics.mocap_pos0, (2, 1, 1)), np.tile(physics.mocap_quat0, (2, 1, 1)))
    physics.reset_worlds(np.arange(2), physics.qpos0, *fixtures)


def _turn(physics, hinge, torque, worlds):
    """Let a torque [N·m] act about a hinge of the door in the listed worlds, from now on."""
    scene, at_rest = physics.scene, mujoco.MjData(physics.models[0])
    mujoco.mj_kinematics(physics.models[0], at_rest)
    joint = scene.joint_ids[f"/World/Door/{hinge}"]
    force = physics.external_force.numpy()
    force[worlds, scene.mj_model.jnt_bodyid[joint], 3:] = torque * at_rest.xaxis[joint]
    physics.external_force.assign(force)


def _bits(physics):
    """Copies of everything that a physics publishes per world."""
    views = "qpos qvel ctrl xpos xquat xipos contact_force pair_force latch_locked external_force"
    return {name: getattr(physics, name).numpy().copy() for name in views.split()}


def _same(a, b, worlds):
    return all(np.array_equal(a[name][worlds], b[name][worlds]) for name in a)


def test_the_physics_releases_the_latch(door):
    """A pressed handle unlocks the leaf without any judge, in its own world only, until it is locked again."""
    _closed(door)
    _turn(door, "LeafHinge", 10.0, [0, 1])
    _turn(door, "HandleHinge", -5.0, [1])
    for _ in range(10):
        door.step()
    leaf = door.qpos.numpy()[:, door.scene.joint_qpos("/World/Door/LeafHinge")]
    assert door.latch_locked.numpy().tolist() == [1, 0]
    assert abs(leaf[0]) < 0.005 < 0.02 < leaf[1]
    door.lock_latch(wp.array([0, 1], dtype=wp.int32, device=door.device))
    assert door.latch_locked.numpy().tolist() == [1, 1]


def test_a_snapshot_brings_everything_back(door):
    """After a restore a world repeats its ticks bit for bit, latch and forces included; the others go on."""
    _closed(door)
    _turn(door, "LeafHinge", 10.0, [0, 1])
    for _ in range(3):
        door.step()
    _turn(door, "HandleHinge", -5.0, [0, 1])
    kept, before = door.snapshot(), _bits(door)
    runs = []
    for _ in range(2):
        for _ in range(5):
            door.step()
        runs.append(_bits(door))
        door.add_velocity(np.ones((2, 6)))
        door.external_force.zero_()
        door.step()
        door.restore(kept)
        assert _same(_bits(door), before, [0, 1])
    assert _same(*runs, [0, 1]) and runs[0]["latch_locked"].tolist() == [0, 0]
    assert before["latch_locked"].tolist() == [1, 1], "the handle is pressed between snapshot and end"
    for _ in range(5):
        door.step()
    door.restore(kept, np.array([False, True]))
    now = _bits(door)
    assert _same(now, runs[0], [0]) and _same(now, before, [1])


def test_a_captured_tick_has_the_bits_of_its_launches(football_warp):
    """On the CPU the graph of a tick, which a physics plays, moves the worlds as the launches by themselves do."""
    runs = []
    for tick in ("step", "_launch_tick"):
        physics = make_physics(football_warp, PhysicsRate(0.005, 4), "warp")
        _standing(physics)
        with wp.ScopedDevice(physics.device):
            for _ in range(5):
                getattr(physics, tick)()
        runs.append(_bits(physics))
    assert _same(*runs, slice(None)) and runs[0]["contact_force"].any()


def test_an_idle_world_keeps_every_bit(door):
    """A world that is not active stands still bit for bit, later runs as if nothing had been, and disturbs nobody."""
    _closed(door)
    _turn(door, "LeafHinge", 10.0, [0, 1])
    _turn(door, "HandleHinge", -5.0, [1])
    for _ in range(3):
        door.step()
    kept, before = door.snapshot(), _bits(door)
    for _ in range(2):
        door.step()
    together = _bits(door)
    door.restore(kept)
    door.set_active(np.array([True, False]))
    for _ in range(2):
        door.step()
    apart = _bits(door)
    assert _same(apart, together, [0]) and _same(apart, before, [1])
    door.set_active(np.array([False, True]))
    for _ in range(2):
        door.step()
    assert _same(_bits(door), together, [0, 1])
    door.set_active(np.array([True, True]))


def test_velocity_is_added_in_the_masked_worlds(both):
    """The root of the masked worlds alone moves off, at the speed that was added, on both engines."""
    for physics in both:
        _standing(physics)
        before, root = physics.qvel.numpy().copy(), physics.scene.robot.root_qvel
        change = np.tile([0.5, 0.0, 0.0, 0.0, 0.0, 0.0], (physics.worlds, 1))
        mask = np.arange(physics.worlds) == 1
        physics.add_velocity(change, mask)
        added = physics.qvel.numpy() - before
        assert np.array_equal(added[:, root : root + 6], change * mask[:, None])
        x = physics.qpos.numpy()[:, physics.scene.robot.root_qpos].copy()
        physics.step()
        moved = physics.qpos.numpy()[:, physics.scene.robot.root_qpos] - x
        assert moved[1] > 0.005 and abs(moved[0]) < 0.001


def test_the_latch_is_found_by_its_label(tmp_path):
    """An equality that a layer brings with it is not taken for the latch, and stays active."""
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
    held = [int(scene.mj_model.eq_type[e]) for e in range(scene.mj_model.neq)]
    assert held[scene.latch.equality] == mujoco.mjtEq.mjEQ_JOINT
    assert int(scene.mj_model.eq_obj1id[scene.latch.equality]) == scene.joint_ids["/World/Door/LeafHinge"]


def test_a_scene_is_the_same_however_often_it_was_built(monkeypatch):
    """MuJoCo's model from a kept import, with other drives in between, is that of the first, byte for byte."""
    monkeypatch.setattr(scene_file, "_OWN", {})

    def model(**options):
        m = load_scene("open_door", device="cpu", native=True, **options).mj_model
        data = np.empty(mujoco.mj_sizeModel(m), np.uint8)
        mujoco.mj_saveModel(m, None, data)
        return data

    first, other, again = model(), model(drive=SONIC_DRIVE), model()
    assert np.array_equal(again, first) and not np.array_equal(other, first)


def test_an_unstable_world_writes_no_file(football_native, tmp_path, monkeypatch):
    """MuJoCo's warning of a broken state leaves no log file in the working folder."""
    monkeypatch.chdir(tmp_path)
    physics = make_physics(football_native, PhysicsRate(0.005, 4), "mujoco")
    physics.data[0].qpos[:] = np.nan
    physics.step()
    assert list(tmp_path.iterdir()) == []


def test_overflow_is_reported(football_warp):
    """A constraint buffer that is too small is flagged in the world that overflowed."""
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


def test_each_process_of_torchrun_has_a_gpu_of_its_own(monkeypatch):
    """Without a name the best device is taken, and one that is not there is refused."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert [str(torch_device(name)) for name in (None, "cpu", "cuda:1")] == ["cuda:0", "cpu", "cuda:1"]
    with pytest.raises(InputError, match="--device cuda:2: no such device, this machine has 2"):
        torch_device("cuda:2")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert [str(torch_device(name)) for name in ("auto", "cpu", "cuda")] == ["cuda:1", "cpu", "cuda:1"]
