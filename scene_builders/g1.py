"""Writes `g1.usda`: the Unitree G1 with Dex3 hands, floating base, variant set `hands = {dex3, fixed}`.

Links stand flat under `/G1` at their poses for joint angles zero, joints under `/G1/joints`. Link and joint numbers are
in `usd_scenes/g1/links.py`, outer shapes in `shells.py`; collision shapes and frames are here. Drives are not authored:
the tracker that drives the robot brings its gains.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt

from arena_newton.robot.rotations import matrix_from_quat_np
from arena_newton.usd_scenes.g1.links import LINKS, PALM_OFFSET, Link
from scene_builders import author
from scene_builders.shells import HAND_SHAPES, LOOKS, SHAPES, Block, Loft, Rod, grid, merge

__all__ = ["build", "fuse", "zero_poses"]

ROOT = "/G1"
HEAD_CAMERA = ((0.0576235, 0.01753, 0.42987), 0.8307767239493009)
"""`d435_link` on `torso_link`: offset [m], pitch down [rad]; Unitree's public G1 model."""

ROS_FRONT = (0.5, -0.5, 0.5, -0.5)
"""Head camera on `d435_link`, looking along +z with y down (the original benchmark's camera configuration)."""

ROS_WRIST = (0.00539, 0.86024, 0.0424, 0.50809)
WRIST_OFFSET = -0.04012, 0.07441, 0.15711
"""Wrist cameras on `*_hand_camera_base_link`, same convention: quat, and offset with y towards the other hand [m]."""

HAND_BOXES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "thumb_1": ((0.0125, 0.028, 0.0125), (0.001, -0.024, 0.0)),
    "thumb_2": ((0.0078, 0.0285, 0.0115), (0.0, -0.0235, 0.0)),
    "middle_0": ((0.028, 0.0125, 0.0125), (0.024, -0.001, 0.0)),
    "middle_1": ((0.0285, 0.0078, 0.0115), (0.0235, 0.0, 0.0)),
    "index_0": ((0.028, 0.0125, 0.0125), (0.024, -0.001, 0.0)),
    "index_1": ((0.0285, 0.0078, 0.0115), (0.0235, 0.0, 0.0)),
}
"""Finger collision boxes of the left hand (half sizes, centre) [m] with which the hand grasped in all trials; no box on
thumb_0. The right hand mirrors y."""

PALM_BOX = ((0.0395, 0.0195, 0.041), (0.081, 0.0035, 0.0))
"""Palm collision box of the left hand on the wrist_yaw link, same source."""

HAND_SOLREF = (0.01, 1.0)
"""Contact time constant [s] and damping ratio of the hands' boxes, same source."""

FOOT_BOX = ((0.085, 0.030, 0.0125), (0.035, 0.0, -0.0225))
"""Foot collision box on the ankle_roll link: its sole spans the four contact points of the MJCF (x -0.05 to 0.12, y up
to 0.03, z -0.035)."""

CAPSULES: dict[str, tuple[float, tuple[float, float, float], tuple[float, float, float]]] = {
    "hip_roll_link": (0.050, (0.010, 0.003, 0.000), (0.004, 0.002, -0.075)),
    "hip_yaw_link": (0.048, (-0.034, -0.002, -0.030), (-0.066, 0.000, -0.130)),
    "knee_link": (0.040, (0.006, 0.000, -0.010), (-0.002, 0.000, -0.230)),
    "shoulder_roll_link": (0.037, (-0.002, 0.005, 0.000), (-0.003, 0.006, -0.085)),
    "shoulder_yaw_link": (0.034, (0.001, 0.000, -0.020), (0.0135, 0.000, -0.0805)),
    "elbow_link": (0.034, (0.005, 0.001, -0.006), (0.140, 0.002, -0.010)),
}
"""Limb collision capsules of the left side: radius, two ends [m]. The forearm's reaches over the wrist roll. The right
side mirrors y."""


def zero_poses() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Position [m] and quaternion wxyz of every link in the pelvis frame at joint angles zero."""
    poses: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for link in LINKS:
        quat = _unit(link.quat)
        if link.parent is None:
            poses[link.name] = (np.zeros(3), quat)
            continue
        position, parent = poses[link.parent]
        poses[link.name] = (position + matrix_from_quat_np(parent) @ np.asarray(link.offset), _multiply(parent, quat))
    return poses


def fuse(links: Sequence[Link]) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Lump links at joint angles zero into the first: mass [kg], centre [m], moments [kg·m²], principal quat wxyz.

    All results are in the first link's frame; the inertias move by the parallel-axis theorem.
    """
    poses = zero_poses()
    origin, base = poses[links[0].name]
    parts = []
    for link in links:
        position, quat = poses[link.name]
        rotation = matrix_from_quat_np(base).T @ matrix_from_quat_np(quat)
        axes = rotation @ matrix_from_quat_np(_unit(link.principal))
        center = matrix_from_quat_np(base).T @ (position - origin) + rotation @ np.asarray(link.com)
        parts.append((link.mass, center, axes @ np.diag(link.inertia) @ axes.T))
    mass = sum(m for m, _, _ in parts)
    center = sum(m * c for m, c, _ in parts) / mass
    total = np.zeros((3, 3))
    for m, c, inertia in parts:
        d = c - center
        total += inertia + m * (d @ d * np.eye(3) - np.outer(d, d))
    moments, axes = np.linalg.eigh(total)
    axes = axes * np.where(axes[np.abs(axes).argmax(0), range(3)] < 0, -1.0, 1.0)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    quat = Gf.Matrix3d(*axes.T.reshape(-1).tolist()).ExtractRotation().GetQuat()
    return mass, center, moments, np.array([quat.GetReal(), *quat.GetImaginary()])


def build(folder: Path) -> None:
    """Write `g1.usda` into `folder`."""
    stage = author.new_stage(folder / "g1.usda", ROOT, scene=False)
    robot = stage.GetDefaultPrim()
    UsdPhysics.ArticulationRootAPI.Apply(robot)
    robot.AddAppliedSchema("NewtonArticulationRootAPI")
    _attribute(robot, "newton:selfCollisionEnabled", False, Sdf.ValueTypeNames.Bool)
    UsdGeom.Scope.Define(stage, f"{ROOT}/Looks")
    looks = {
        name: author.material(stage, f"{ROOT}/Looks/{name}", color, roughness=roughness)
        for name, (color, roughness) in LOOKS.items()
    }
    skin = author.physics_material(stage, f"{ROOT}/Looks/skin")
    grip = author.physics_material(stage, f"{ROOT}/Looks/grip")

    poses = zero_poses()
    body = [link for link in LINKS if "_hand_" not in link.name]
    fingers = [link for link in LINKS if "_hand_" in link.name]
    for link in body:
        _link(stage, link, poses)
        _shapes(stage, f"{ROOT}/{link.name}", SHAPES.get(link.name, ()), looks)
    _body_collisions(stage, skin)
    _frames(stage)
    UsdGeom.Scope.Define(stage, f"{ROOT}/joints")
    for link in body:
        _joint(stage, link)

    hands = robot.GetVariantSets().AddVariantSet("hands")
    for variant in ("dex3", "fixed"):
        hands.AddVariant(variant)
        hands.SetVariantSelection(variant)
        with hands.GetVariantEditContext():
            if variant == "dex3":
                _dex3(stage, fingers, poses, looks, grip)
            else:
                _fixed(stage, fingers, poses, looks, grip)
    hands.SetVariantSelection("dex3")
    stage.GetRootLayer().Save()


def _dex3(stage: Usd.Stage, fingers: Sequence[Link], poses: dict, looks: dict[str, Usd.Prim], grip: Usd.Prim) -> None:
    """Moving fingers."""
    for side in ("left", "right"):
        wrist = next(link for link in LINKS if link.name == f"{side}_wrist_yaw_link")
        prim = stage.GetPrimAtPath(f"{ROOT}/{wrist.name}")
        author.massive(prim, wrist.mass, wrist.inertia, wrist.com, _unit(wrist.principal))
        _hand_box(stage, f"{ROOT}/{wrist.name}/palm_collision", PALM_BOX, side, grip)
    for link in fingers:
        _link(stage, link, poses)
        _shapes(stage, f"{ROOT}/{link.name}", HAND_SHAPES[link.name], looks)
        side, _, finger = link.name.removesuffix("_link").split("_", 2)
        if finger in HAND_BOXES:
            _hand_box(stage, f"{ROOT}/{link.name}/collision", HAND_BOXES[finger], side, grip)
    for link in fingers:
        _joint(stage, link)


def _fixed(stage: Usd.Stage, fingers: Sequence[Link], poses: dict, looks: dict[str, Usd.Prim], grip: Usd.Prim) -> None:
    """Open fingers as one piece with the wrist: their mass, boxes and shapes."""
    for side in ("left", "right"):
        wrist = next(link for link in LINKS if link.name == f"{side}_wrist_yaw_link")
        own = [link for link in fingers if link.name.startswith(side)]
        mass, com, inertia, principal = fuse([wrist, *own])
        author.massive(stage.GetPrimAtPath(f"{ROOT}/{wrist.name}"), mass, inertia, com, _unit(principal))
        _hand_box(stage, f"{ROOT}/{wrist.name}/palm_collision", PALM_BOX, side, grip)
        origin, base = poses[wrist.name]
        parts = []
        for link in own:
            position, quat = poses[link.name]
            if not np.allclose(base, quat):
                raise ValueError(f"{link.name}: the open hand's links are expected to be parallel to the wrist")
            offset = matrix_from_quat_np(base).T @ (position - origin)
            parts += [(points + offset, normals, faces) for points, normals, faces in map(grid, HAND_SHAPES[link.name])]
            finger = link.name.removesuffix("_link").split("_", 2)[2]
            if finger in HAND_BOXES:
                name = f"{ROOT}/{wrist.name}/{finger}_collision"
                _hand_box(stage, name, HAND_BOXES[finger], side, grip, offset)
        _mesh(stage, f"{ROOT}/{wrist.name}/fingers", *merge(parts), looks["hand"])


def _link(stage: Usd.Stage, link: Link, poses: dict) -> None:
    position, quat = poses[link.name]
    prim = author.xform(stage, f"{ROOT}/{link.name}", position, quat)
    UsdPhysics.RigidBodyAPI.Apply(prim)
    if not link.name.endswith("_wrist_yaw_link"):  # the wrist's mass depends on the hands variant
        author.massive(prim, link.mass, link.inertia, link.com, _unit(link.principal))


def _joint(stage: Usd.Stage, link: Link) -> None:
    """The hinge that carries `link`; its frame is the child's own, so that the axis is X, Y or Z."""
    hinge = link.hinge
    if hinge is None:
        return
    path, parent, child = f"{ROOT}/joints/{hinge.name}", f"{ROOT}/{link.parent}", f"{ROOT}/{link.name}"
    limits = np.rad2deg(hinge.limits)
    prim = author.hinge(stage, path, parent, child, hinge.axis, limits, link.offset, _unit(link.quat))
    prim.AddAppliedSchema("NewtonJointAPI")
    prim.AddAppliedSchema("MjcJointAPI")
    _attribute(prim, "newton:armature", hinge.armature, Sdf.ValueTypeNames.Float)
    _attribute(prim, "mjc:solreflimit", [0.02, 1.0], Sdf.ValueTypeNames.DoubleArray)
    _attribute(prim, "arena:effort", hinge.effort, Sdf.ValueTypeNames.Float)


def _attribute(prim: Usd.Prim, name: str, value: object, kind: Sdf.ValueTypeName) -> None:
    """Author a vendor attribute; not `custom`, so that the text is the same with and without that vendor's schemas."""
    prim.CreateAttribute(name, kind, False).Set(value)


def _shapes(stage: Usd.Stage, parent: str, shapes: Sequence[Loft | Block | Rod], looks: dict[str, Usd.Prim]) -> None:
    for k, shape in enumerate(shapes):
        path = f"{parent}/visual_{k}"
        if isinstance(shape, Rod):
            size, look = (shape.radius, shape.length), looks[shape.look]
            author.cylinder(stage, path, *size, shape.center, axis=shape.axis, collide=False, look=look)
        else:
            _mesh(stage, path, *grid(shape), looks[shape.look])


def _mesh(
    stage: Usd.Stage,
    path: str,
    points: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray | Sequence[Sequence[int]],
    look: Usd.Prim,
) -> None:
    geom = UsdGeom.Mesh(author.mesh(stage, path, _round(points), faces, look=look))
    geom.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.round(normals, 3).astype(np.float32)))
    geom.SetNormalsInterpolation(UsdGeom.Tokens.vertex)


def _body_collisions(stage: Usd.Stage, skin: Usd.Prim) -> None:
    """Invisible collision shapes of everything but the hands."""
    hidden: author.Finish = {"visual": False, "surface": skin}
    author.box(stage, f"{ROOT}/pelvis/collision", (0.060, 0.075, 0.055), (0.0, 0.0, -0.085), **hidden)
    torso = f"{ROOT}/torso_link"
    author.box(stage, f"{torso}/collision", (0.072, 0.095, 0.115), (0.006, 0.0, 0.165), **hidden)
    author.capsule(stage, f"{torso}/head_collision", 0.058, 0.045, (-0.006, 0.0, 0.415), **hidden)
    for side, s in (("left", 1.0), ("right", -1.0)):
        for name, (radius, *ends) in CAPSULES.items():
            a, b = (np.array(e) * (1.0, s, 1.0) for e in ends)
            length = float(np.linalg.norm(b - a))
            quat = _z_to((b - a) / length)
            path = f"{ROOT}/{side}_{name}/collision"
            author.capsule(stage, path, radius, length, _round((a + b) / 2), quat, **hidden)
        half, center = FOOT_BOX
        author.box(stage, f"{ROOT}/{side}_ankle_roll_link/collision", half, center, **hidden)


def _hand_box(
    stage: Usd.Stage,
    path: str,
    size: tuple[author.Vec, author.Vec],
    side: str,
    grip: Usd.Prim,
    offset: author.Vec = (0.0, 0.0, 0.0),
) -> None:
    half, (x, y, z) = size
    center = np.array([x, y if side == "left" else -y, z]) + offset
    prim = author.box(stage, path, half, _round(center), visual=False, surface=grip)
    prim.AddAppliedSchema("MjcCollisionAPI")
    _attribute(prim, "mjc:solref", list(HAND_SOLREF), Sdf.ValueTypeNames.DoubleArray)
    _attribute(prim, "mjc:condim", 3, Sdf.ValueTypeNames.Int)


def _frames(stage: Usd.Stage) -> None:
    """Head and wrist cameras, palms."""
    position, pitch = HEAD_CAMERA
    head = f"{ROOT}/torso_link/d435_link"
    author.xform(stage, head, position, (np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0))
    author.camera(stage, f"{head}/front_cam", (0, 0, 0), _from_ros(ROS_FRONT), focal=7.6, aperture=20.0)
    x, y = PALM_OFFSET
    dx, dy, dz = WRIST_OFFSET
    for side, s in (("left", 1.0), ("right", -1.0)):
        wrist = f"{ROOT}/{side}_wrist_yaw_link"
        author.xform(stage, f"{wrist}/{side}_hand_palm_link", (x, s * y, 0.0))
        base = f"{wrist}/{side}_hand_camera_base_link"
        author.xform(stage, base, (x, s * y, 0.0))
        quat = _from_ros(ROS_WRIST)
        author.camera(stage, f"{base}/{side}_wrist_cam", (dx, -s * dy, dz), quat, focal=12.0, aperture=20.0)


def _from_ros(quat: Sequence[float]) -> np.ndarray:
    """Rotation of a camera that looks along -z with y up, from that of one that looks along +z with y down."""
    return _multiply(_unit(quat), np.array([0.0, 1.0, 0.0, 0.0]))


def _unit(quat: author.Vec) -> np.ndarray:
    q = np.asarray(quat, dtype=float)
    return q / np.linalg.norm(q)


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    w, v = a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.concatenate([[w], v])


def _z_to(direction: np.ndarray) -> np.ndarray:
    """Shortest rotation that carries +z, up to sign, onto `direction` (a capsule has no preferred end)."""
    d = direction if direction[2] >= 0 else -direction
    return _unit([1.0 + d[2], -d[1], d[0], 0.0])


def _round(values: np.ndarray) -> np.ndarray:
    """Round to a hundredth of a millimetre, so that the text of the layer stays short [m]."""
    return np.round(np.asarray(values, dtype=float), 5) + 0.0
