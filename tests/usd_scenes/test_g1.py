"""The G1 layer against Unitree's model as TWIST2 publishes it for MuJoCo, and against its own builder."""

import re
from pathlib import Path

import mujoco
import newton
import numpy as np
import pytest

from arena_newton.robot.g1 import HAND_JOINTS, MUJOCO_JOINTS
from arena_newton.tasks.base import SCENES

PATH = SCENES / "g1" / "g1.usda"

ORACLE = Path(__file__).parents[2] / ".." / "shared" / "reference" / "g1"
WITH_HANDS = ORACLE / "g1_sim2sim_29dof_with_hands.xml"
PLAIN = ORACLE / "g1_sim2sim_29dof.xml"
needs_oracle = pytest.mark.skipif(not WITH_HANDS.exists(), reason=f"the oracle MJCF is not there: {WITH_HANDS}")

GRASP_BOXES = {
    "wrist_yaw_link": ((0.0395, 0.0195, 0.041), (0.081, 0.0035, 0.0)),
    "hand_thumb_1_link": ((0.0125, 0.028, 0.0125), (0.001, -0.024, 0.0)),
    "hand_thumb_2_link": ((0.0078, 0.0285, 0.0115), (0.0, -0.0235, 0.0)),
    "hand_middle_0_link": ((0.028, 0.0125, 0.0125), (0.024, -0.001, 0.0)),
    "hand_middle_1_link": ((0.0285, 0.0078, 0.0115), (0.0235, 0.0, 0.0)),
    "hand_index_0_link": ((0.028, 0.0125, 0.0125), (0.024, -0.001, 0.0)),
    "hand_index_1_link": ((0.0285, 0.0078, 0.0115), (0.0235, 0.0, 0.0)),
}
"""Half sizes and centres [m] of the left hand's boxes that grasped the hammer in 100 of 100 trials."""


LINK_MASSES = {
    "pelvis": 3.814,
    "torso_link": 7.818,
    "left_hip_yaw_link": 1.702,
    "right_knee_link": 1.932,
    "left_ankle_roll_link": 0.608,
    "right_shoulder_yaw_link": 0.734,
    "left_elbow_link": 0.6,
    "right_wrist_yaw_link": 0.457415,
    "left_hand_thumb_1_link": 0.0588507,
    "right_hand_index_1_link": 0.0203063,
}
"""Masses [kg] as `g1_sim2sim_29dof_with_hands.xml` of TWIST2 states them."""
TOTAL_MASS = 34.3952352
"""Mass [kg] of all links of the same file."""
TABLE_LINKS = (
    "left_ankle_roll_link",
    "right_ankle_roll_link",
    "torso_link",
    "left_hand_thumb_2_link",
    "right_hand_index_1_link",
)
CROUCH = {
    f"{side}_{joint}_joint": angle
    for side in ("left", "right")
    for joint, angle in (
        ("hip_pitch", -0.9),
        ("knee", 1.5),
        ("ankle_pitch", -0.6),
        ("shoulder_pitch", -0.8),
        ("elbow", 0.4),
    )
}
TURN = {
    "waist_yaw_joint": 0.7,
    "waist_roll_joint": -0.2,
    "waist_pitch_joint": 0.3,
    "left_hip_roll_joint": 0.4,
    "left_hip_yaw_joint": -0.5,
    "right_hip_yaw_joint": 0.6,
    "right_ankle_roll_joint": -0.2,
    "left_shoulder_roll_joint": 1.0,
    "left_shoulder_yaw_joint": -0.6,
    "right_shoulder_roll_joint": -0.8,
    "right_shoulder_yaw_joint": 0.5,
    "left_wrist_roll_joint": 0.9,
    "right_wrist_pitch_joint": -0.7,
    "right_wrist_yaw_joint": 0.5,
    "left_wrist_yaw_joint": -0.4,
    "left_hand_thumb_0_joint": 0.5,
    "left_hand_thumb_1_joint": 0.6,
    "right_hand_index_0_joint": 0.9,
    "right_hand_index_1_joint": 0.8,
}
POSTURES = {
    "zero": (
        {},
        (
            (-0.000002, 0.118506, -0.756864),
            (-0.000002, -0.118506, -0.756864),
            (-0.003964, 0.0, 0.044),
            (0.264262, 0.086549, 0.095226),
            (0.364777, -0.153218, 0.123724),
        ),
    ),
    "crouch": (
        CROUCH,
        (
            (0.094265, 0.118506, -0.5771),
            (0.094265, -0.118506, -0.5771),
            (-0.003964, 0.0, 0.044),
            (0.366739, 0.01572, 0.246147),
            (0.46105, -0.059318, 0.313714),
        ),
    ),
    "turn": (
        TURN,
        (
            (0.004168, 0.416252, -0.680863),
            (0.024108, -0.193546, -0.752603),
            (-0.003031, -0.002553, 0.044),
            (-0.029027, 0.295843, -0.108923),
            (0.174903, 0.083587, 0.049213),
        ),
    ),
}
"""Joint angles [rad], and where MuJoCo puts the origins of `TABLE_LINKS` [m] in the same file, pelvis at the origin."""


def _stage(hands: str = "dex3"):
    from pxr import Usd

    stage = Usd.Stage.Open(str(PATH))
    stage.SetEditTarget(stage.GetSessionLayer())  # the file's own layer is every other test's too
    stage.GetDefaultPrim().GetVariantSet("hands").SetVariantSelection(hands)
    return stage


def _compile(hands: str):
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.rigid_gap = 0.0
    builder.add_usd(_stage(hands), enable_self_collisions=False, collapse_fixed_joints=False)
    model = builder.finalize(device="cpu")
    return model, newton.solvers.SolverMuJoCo(model).mj_model


@pytest.fixture(scope="module")
def dex3():
    """The Newton model and the MuJoCo model that it compiles to, with moving fingers."""
    return _compile("dex3")


@pytest.fixture(scope="module")
def fixed():
    """The same with fused fingers."""
    return _compile("fixed")


def _oracle(path: Path, *, weld_hands: bool = False):
    """The MJCF without its meshes (they are not there) and with jointless bodies fused into their parents."""
    text = path.read_text()
    text = re.sub(r'<mesh [^>]*/>|<geom [^>]*mesh="[^>]*/>', "", text)
    if weld_hands:
        text = re.sub(r"<joint name=\"\w+_hand_[^>]*/>|<position [^>]*/>|<keyframe>.*</keyframe>", "", text, flags=re.S)
    return mujoco.MjModel.from_xml_string(text.replace("<compiler ", '<compiler fusestatic="true" ', 1))


def _bodies(model) -> dict[str, int]:
    return {re.sub(r".*(/|G1_)", "", model.body(i).name): i for i in range(1, model.nbody)}


def _joints(model) -> dict[str, int]:
    """Hinges by bare name, in the model's order."""
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    names = (model.joint(i).name for i in range(model.njnt))
    return {re.sub(r".*joints[_/]", "", n): i for i, n in enumerate(names) if model.jnt_type[i] == hinge}


def _inertia(model, body: int) -> np.ndarray:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body] / np.linalg.norm(model.body_iquat[body]))
    rotation = rotation.reshape(3, 3)
    return rotation @ np.diag(model.body_inertia[body]) @ rotation.T


def _same_mass(mine, oracle) -> None:
    ours, theirs = _bodies(mine), _bodies(oracle)
    assert set(ours) == set(theirs)
    assert mine.body_mass.sum() == pytest.approx(oracle.body_mass.sum(), rel=1e-6)
    for name, i in theirs.items():
        k = ours[name]
        assert mine.body_mass[k] == pytest.approx(oracle.body_mass[i], rel=1e-6), name
        np.testing.assert_allclose(mine.body_ipos[k], oracle.body_ipos[i], atol=1e-7, err_msg=name)
        bound = 1e-5 * oracle.body_inertia[i].min()
        np.testing.assert_allclose(_inertia(mine, k), _inertia(oracle, i), atol=bound, err_msg=name)


def test_layer_is_what_the_builder_writes(tmp_path):
    """The committed g1.usda is the builder's output, byte for byte."""
    from scene_builders.g1 import build

    build(tmp_path)
    assert (tmp_path / "g1.usda").read_text() == PATH.read_text()


def test_layer_states_units_variants_and_no_drives():
    """Metres, kilograms, z up, default prim /G1, two hands variants, no drives, no asset paths."""
    from pxr import UsdGeom, UsdPhysics

    stage = _stage()
    assert str(stage.GetDefaultPrim().GetPath()) == "/G1"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    variants = stage.GetDefaultPrim().GetVariantSet("hands")
    assert sorted(variants.GetVariantNames()) == ["dex3", "fixed"]
    text = PATH.read_text()
    assert "DriveAPI" not in text
    assert "@" not in text


def test_masses_are_those_of_the_table(dex3):
    """Total mass and ten links' masses, without the oracle's file."""
    model = dex3[1]
    bodies = _bodies(model)
    assert model.body_mass.sum() == pytest.approx(TOTAL_MASS, rel=1e-6)
    for name, mass in LINK_MASSES.items():
        assert model.body_mass[bodies[name]] == pytest.approx(mass, rel=1e-5), name


@pytest.mark.parametrize("posture", POSTURES)
def test_forward_kinematics_of_the_table(dex3, posture):
    """Five links in three postures are where the oracle puts them, without the oracle's file."""
    model = dex3[1]
    angles, places = POSTURES[posture]
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    joints, bodies = _joints(model), _bodies(model)
    for name, angle in angles.items():
        data.qpos[model.jnt_qposadr[joints[name]]] = angle
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose([data.xpos[bodies[name]] for name in TABLE_LINKS], places, atol=1e-5)


@needs_oracle
def test_mass_and_inertia_of_every_link(dex3):
    """Total mass, and every link's mass, centre and inertia tensor, are the oracle's."""
    _same_mass(dex3[1], _oracle(WITH_HANDS))


@needs_oracle
def test_fixed_hands_lump_the_fingers_into_the_wrist(dex3, fixed):
    """Fused fingers keep the mass and give the wrist the inertia that MuJoCo computes for welded fingers."""
    assert fixed[1].body_mass.sum() == pytest.approx(dex3[1].body_mass.sum(), rel=1e-6)
    assert tuple(_joints(fixed[1])) == MUJOCO_JOINTS
    _same_mass(fixed[1], _oracle(WITH_HANDS, weld_hands=True))


def test_joints_come_depth_first(dex3):
    """The 29 body joints stand in the trackers' order, each hand's fingers right after its wrist."""
    names = list(_joints(dex3[1]))
    assert tuple(n for n in names if "_hand_" not in n) == MUJOCO_JOINTS
    assert sorted(n for n in names if "_hand_" in n) == sorted(HAND_JOINTS)
    for side in ("left", "right"):
        start = names.index(f"{side}_wrist_yaw_joint") + 1
        fingers = names[start : start + 7]
        assert all(n.startswith(f"{side}_hand_") for n in fingers)
        for finger in ("thumb", "middle", "index"):
            own = [n for n in fingers if finger in n]
            assert own == sorted(own)
    assert dex3[1].jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE


@needs_oracle
def test_joint_limits_axes_armature_and_effort(dex3):
    """Limits, axes and torque limits are the oracle's; armatures those of its file without hands, 0.01 for fingers."""
    model, oracle, plain = dex3[1], _oracle(WITH_HANDS), _oracle(PLAIN)
    stage = _stage()
    ours = _joints(model)
    theirs = _joints(oracle)
    assert set(ours) == set(theirs)
    for name, i in theirs.items():
        k = ours[name]
        assert model.jnt_limited[k]
        np.testing.assert_allclose(model.jnt_range[k], oracle.jnt_range[i], atol=1e-6, err_msg=name)
        np.testing.assert_allclose(model.jnt_axis[k], oracle.jnt_axis[i], atol=1e-6, err_msg=name)
        np.testing.assert_allclose(model.jnt_pos[k], 0.0, atol=1e-7, err_msg=name)
        np.testing.assert_allclose(model.jnt_solref[k], oracle.jnt_solref[i], err_msg=name)
        armature = 0.01 if "_hand_" in name else plain.joint(name).armature[0]
        assert model.dof_armature[model.jnt_dofadr[k]] == pytest.approx(armature, rel=1e-6), name
        effort = stage.GetPrimAtPath(f"/G1/joints/{name}").GetAttribute("arena:effort").Get()
        assert effort == pytest.approx(oracle.jnt_actfrcrange[i][1], rel=1e-6), name


@needs_oracle
@pytest.mark.parametrize("hands", ["dex3", "fixed"])
def test_forward_kinematics_of_1000_postures(hands, request):
    """Every link is where the oracle puts it within 1e-5 m and 1e-5 rad, over 1,000 random postures."""
    model = request.getfixturevalue(hands)[1]
    oracle = _oracle(WITH_HANDS, weld_hands=hands == "fixed")
    mine, theirs = mujoco.MjData(model), mujoco.MjData(oracle)
    ours = _bodies(model)
    pairs = [(ours[name], i) for name, i in _bodies(oracle).items()]
    k, i = np.array(pairs).T
    hinges = _joints(oracle)
    mine_adr = [model.jnt_qposadr[j] for j in (_joints(model)[n] for n in hinges)]
    their_adr = [oracle.jnt_qposadr[j] for j in hinges.values()]
    low, high = oracle.jnt_range[list(hinges.values())].T
    rng = np.random.default_rng(29)
    position = angle = 0.0
    for _ in range(1000):
        root = np.concatenate([rng.uniform(-2, 2, 3), rng.normal(size=4)])
        root[3:] /= np.linalg.norm(root[3:])
        posture = rng.uniform(low, high)
        mine.qpos[:7] = theirs.qpos[:7] = root
        mine.qpos[mine_adr] = theirs.qpos[their_adr] = posture
        mujoco.mj_kinematics(model, mine)
        mujoco.mj_kinematics(oracle, theirs)
        position = max(position, np.linalg.norm(mine.xpos[k] - theirs.xpos[i], axis=1).max())
        # the chord between two unit quaternions is half the angle between the frames
        a, b = mine.xquat[k], theirs.xquat[i]
        chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
        angle = max(angle, 2 * chord.max())
    assert position < 1e-5
    assert angle < 1e-5


def test_the_robot_never_touches_itself(dex3):
    """No posture within the limits makes a contact between the robot's own links."""
    model = dex3[1]
    data = mujoco.MjData(model)
    rng = np.random.default_rng(7)
    for _ in range(50):
        data.qpos[:7] = (0, 0, 1, 1, 0, 0, 0)
        for j in _joints(model).values():
            data.qpos[model.jnt_qposadr[j]] = rng.uniform(*model.jnt_range[j])
        mujoco.mj_fwdPosition(model, data)
        assert data.ncon == 0


def test_hands_have_the_boxes_that_grasp(dex3):
    """Palm and finger boxes, friction and contact solver of the hands are the measured set; thumb_0 has none."""
    model = dex3[1]
    bodies = _bodies(model)
    for side, mirror in (("left", 1.0), ("right", -1.0)):
        for link, (half, (x, y, z)) in GRASP_BOXES.items():
            geoms = np.flatnonzero(model.geom_bodyid == bodies[f"{side}_{link}"])
            assert len(geoms) == 1, link
            g = geoms[0]
            assert model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX
            np.testing.assert_allclose(model.geom_size[g], half, atol=1e-6)
            np.testing.assert_allclose(model.geom_pos[g], (x, mirror * y, z), atol=1e-6)
            np.testing.assert_allclose(model.geom_solref[g], (0.01, 1.0), atol=1e-7)
            assert model.geom_condim[g] == 3
            assert model.geom_friction[g, 0] == pytest.approx(1.0)
            assert model.geom_margin[g] == 0.0
        assert not (model.geom_bodyid == bodies[f"{side}_hand_thumb_0_link"]).any()


@needs_oracle
def test_soles_span_the_contact_points(dex3):
    """The foot box's sole is a rectangle around the oracle's four contact points, at their height."""
    model, oracle = dex3[1], _oracle(WITH_HANDS)
    for side in ("left", "right"):
        g = np.flatnonzero(model.geom_bodyid == _bodies(model)[f"{side}_ankle_roll_link"])[0]
        points = oracle.geom_pos[oracle.geom_bodyid == _bodies(oracle)[f"{side}_ankle_roll_link"]]
        low, high = model.geom_pos[g] - model.geom_size[g], model.geom_pos[g] + model.geom_size[g]
        np.testing.assert_allclose(low[:2], points.min(0)[:2], atol=1e-6)
        np.testing.assert_allclose(high[:2], points.max(0)[:2], atol=1e-6)
        assert low[2] == pytest.approx(points[0, 2] - 0.005, abs=1e-6)


def test_shapes_are_drawn_or_touched_never_both(dex3, fixed):
    """Collision shapes are invisible, outer shapes do not collide, and there are at most 70 of the latter."""
    for model, _ in (dex3, fixed):
        flags = model.shape_flags.numpy()
        drawn = (flags & int(newton.ShapeFlags.VISIBLE)) != 0
        touched = (flags & int(newton.ShapeFlags.COLLIDE_SHAPES)) != 0
        assert not (drawn & touched).any()
        assert (drawn | touched).all()
        assert 40 <= drawn.sum() <= 70


def test_head_camera_looks_48_degrees_down_and_nothing_covers_it():
    """The head camera sits at Unitree's d435 pose, looks along its x axis, sees 105.5 degrees, inside no shell."""
    from pxr import UsdGeom

    stage = _stage()
    cache = UsdGeom.XformCache()
    torso = cache.GetLocalToWorldTransform(stage.GetPrimAtPath("/G1/torso_link"))
    prim = stage.GetPrimAtPath("/G1/torso_link/d435_link/front_cam")
    pose = np.array(cache.GetLocalToWorldTransform(prim) * torso.GetInverse())
    np.testing.assert_allclose(pose[3, :3], (0.0576235, 0.01753, 0.42987), atol=1e-9)
    pitch = 0.8307767239493009
    np.testing.assert_allclose(-pose[2, :3], (np.cos(pitch), 0.0, -np.sin(pitch)), atol=1e-9)
    np.testing.assert_allclose(pose[1, :3], (np.sin(pitch), 0.0, np.cos(pitch)), atol=1e-9)
    camera = UsdGeom.Camera(prim)
    focal, aperture = camera.GetFocalLengthAttr().Get(), camera.GetHorizontalApertureAttr().Get()
    assert np.rad2deg(2 * np.arctan(aperture / focal / 2)) == pytest.approx(105.5, abs=0.05)
    for child in stage.GetPrimAtPath("/G1/torso_link").GetChildren():
        if not child.IsA(UsdGeom.Mesh):
            continue
        mesh = UsdGeom.Mesh(child)
        points = np.array(mesh.GetPointsAttr().Get(), dtype=float) - pose[3, :3]
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        assert abs(_winding(points, faces)) < 0.01, child.GetPath()
        assert np.linalg.norm(points, axis=1).min() > 0.008, child.GetPath()


def _winding(points: np.ndarray, faces: np.ndarray) -> float:
    """Winding number of a closed mesh about the origin: 1 inside, 0 outside (van Oosterom and Strackee, 1983)."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = (np.einsum("ij,ij->i", u, v) * w for u, v, w in ((a, b, lc), (b, c, la), (c, a, lb)))
    return float(2 * np.arctan2(volume, la * lb * lc + sum(dots)).sum() / (4 * np.pi))


def test_every_shell_is_closed_and_faces_outward():
    """Every mesh has positive volume and no open edge, so that no camera looks through it."""
    from pxr import UsdGeom

    stage = _stage()
    meshes = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    assert meshes
    for prim in meshes:
        points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(), dtype=float)
        faces = np.array(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        a, b, c = (points[faces[:, k]] for k in range(3))
        assert np.einsum("ij,ij->i", a - points.mean(0), np.cross(b - points.mean(0), c - points.mean(0))).sum() > 0
        unique, merged = np.unique(np.round(points, 6), axis=0, return_inverse=True)
        merged = merged.reshape(-1)[faces]
        edges = np.concatenate([merged[:, [0, 1]], merged[:, [1, 2]], merged[:, [2, 0]]])
        codes = edges[:, 0] * len(unique) + edges[:, 1]
        back = edges[:, 1] * len(unique) + edges[:, 0]
        assert np.array_equal(np.sort(codes), np.sort(back)), prim.GetPath()


def test_frames_and_cameras_exist_in_both_variants():
    """Palms, wrist cameras and the head camera stand under their links whichever hands are chosen."""
    from pxr import UsdGeom

    for hands in ("dex3", "fixed"):
        stage = _stage(hands)
        for side in ("left", "right"):
            wrist = f"/G1/{side}_wrist_yaw_link"
            assert stage.GetPrimAtPath(f"{wrist}/{side}_hand_palm_link").IsA(UsdGeom.Xform)
            camera = stage.GetPrimAtPath(f"{wrist}/{side}_hand_camera_base_link/{side}_wrist_cam")
            assert camera.IsA(UsdGeom.Camera)
        assert stage.GetPrimAtPath("/G1/torso_link/d435_link/front_cam").IsA(UsdGeom.Camera)
