"""Small authoring vocabulary for the scene builders: bodies, geoms, materials, markers and cameras in USD.

Lengths [m], masses [kg], quaternions wxyz. Every function returns the prim it wrote.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdShade, Vt

from arena_newton.errors import InputError
from arena_newton.pictures.settings import DOME_COLOR, DOME_INTENSITY
from arena_newton.usd_scenes.dependencies import PACKAGE, search_context

Vec = Sequence[float] | np.ndarray
"""A vector or quaternion, of Python or NumPy numbers."""
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def new_stage(path: Path, default_prim: str = "/World", *, scene: bool = True) -> Usd.Stage:
    """Start a layer at `path` with metres, kilograms and z up, and a physics scene under the default prim."""
    path.parent.mkdir(parents=True, exist_ok=True)
    layer = Sdf.Layer.FindOrOpen(str(path)) if path.exists() else None
    if layer is not None:
        layer.Clear()
    stage = Usd.Stage.Open(layer, search_context()) if layer else Usd.Stage.CreateNew(str(path), search_context())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, default_prim)
    stage.SetDefaultPrim(root.GetPrim())
    if scene:
        physics = UsdPhysics.Scene.Define(stage, f"{default_prim}/physicsScene")
        physics.CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
        physics.CreateGravityMagnitudeAttr(9.81)
    return stage


def asset(stage: Usd.Stage, path: str) -> str:
    """Asset path of another part of `usd_scenes`, such as `../g1/g1.usda`, for the layer of a stage.

    It stays relative where the part is there; elsewhere, as from a task's own package, it is found by the search path.
    """
    beside = Path(stage.GetRootLayer().realPath).parent / path
    return path if beside.is_file() else PACKAGE + path.rpartition("../")[2]


def look_at(eye: Vec, point: Vec) -> tuple[float, float, float, float]:
    """Orientation of a camera at `eye` [m] that looks at a point [m] with its upper edge up; wxyz.

    Raises:
        InputError: The two are the same point, or one is not finite.
    """
    z = np.subtract(eye, point)
    if not 1e-9 < (far := float(np.linalg.norm(z))) < np.inf:
        raise InputError(f"look_at: from {eye} to {point} there is no direction, expected two finite points apart")
    z = z / far
    x = np.cross((0.0, 0.0, 1.0), z)
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
    quat = Gf.Matrix3d(*map(float, np.concatenate([x, np.cross(z, x), z]))).ExtractRotation().GetQuat()
    real, i, j, k = (round(value, 12) for value in (quat.GetReal(), *quat.GetImaginary()))  # processors differ beyond
    return real, i, j, k


def attribute(prim: Usd.Prim, name: str, value: object, kind: Sdf.ValueTypeName) -> Usd.Attribute:
    """Author a custom attribute such as `mjc:solref`."""
    attr = prim.CreateAttribute(name, kind)
    attr.Set(value)
    return attr


def _pose(prim: Usd.Prim, position: Vec, quat: Vec, scale: Vec | None = None) -> Usd.Prim:
    x = UsdGeom.Xformable(prim)
    x.ClearXformOpOrder()
    x.AddTranslateOp().Set(Gf.Vec3d(*map(float, position)))
    if tuple(quat) != IDENTITY:
        x.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(*map(float, quat)))
    if scale is not None:
        x.AddScaleOp().Set(Gf.Vec3f(*map(float, scale)))
    return prim


def xform(stage: Usd.Stage, path: str, position: Vec = (0, 0, 0), quat: Vec = IDENTITY) -> Usd.Prim:
    """A plain frame."""
    return _pose(UsdGeom.Xform.Define(stage, path).GetPrim(), position, quat)


def rigid_body(
    stage: Usd.Stage,
    path: str,
    position: Vec = (0, 0, 0),
    quat: Vec = IDENTITY,
    *,
    mass: float,
    inertia: Vec,
    com: Vec = (0, 0, 0),
) -> Usd.Prim:
    """A body whose principal axes are its own; mass [kg], diagonal inertia [kg·m²] and centre of mass [m] authored."""
    prim = xform(stage, path, position, quat)
    UsdPhysics.RigidBodyAPI.Apply(prim)
    return massive(prim, mass, inertia, com)


def massive(prim: Usd.Prim, mass: float, inertia: Vec, com: Vec, principal: Vec = IDENTITY) -> Usd.Prim:
    """Author mass [kg], diagonal inertia [kg·m²], centre of mass [m] and principal axes."""
    api = UsdPhysics.MassAPI.Apply(prim)
    api.CreateMassAttr(float(mass))
    api.CreateCenterOfMassAttr(Gf.Vec3f(*map(float, com)))
    api.CreateDiagonalInertiaAttr(Gf.Vec3f(*map(float, inertia)))
    api.CreatePrincipalAxesAttr(Gf.Quatf(*map(float, principal)))
    return prim


def anchor(stage: Usd.Stage, path: str, body: str, position: Vec) -> Usd.Prim:
    """A fixed joint from the world to `body`."""
    joint = UsdPhysics.FixedJoint.Define(stage, path)
    joint.CreateBody1Rel().SetTargets([body])
    return _joint_frames(joint, position, IDENTITY)


def hinge(
    stage: Usd.Stage, path: str, parent: str, child: str, axis: str, limits: Vec, position: Vec, quat: Vec = IDENTITY
) -> Usd.Prim:
    """A revolute joint about an `axis` of the child's own frame, which is posed in the parent's; limits [deg]."""
    joint = UsdPhysics.RevoluteJoint.Define(stage, path)
    joint.CreateBody0Rel().SetTargets([parent])
    joint.CreateBody1Rel().SetTargets([child])
    joint.CreateAxisAttr(axis)
    joint.CreateLowerLimitAttr(float(limits[0]))
    joint.CreateUpperLimitAttr(float(limits[1]))
    return _joint_frames(joint, position, quat)


def _joint_frames(joint: UsdPhysics.Joint, position: Vec, quat: Vec) -> Usd.Prim:
    joint.CreateLocalPos0Attr(Gf.Vec3f(*map(float, position)))
    joint.CreateLocalRot0Attr(Gf.Quatf(*map(float, quat)))
    joint.CreateLocalPos1Attr(Gf.Vec3f(0, 0, 0))
    joint.CreateLocalRot1Attr(Gf.Quatf(1, 0, 0, 0))
    return joint.GetPrim()


def fixture(stage: Usd.Stage, path: str, position: Vec) -> Usd.Prim:
    """An immovable body posed once per episode: articulation root, `Frame` body and its anchor; returns `Frame`."""
    root = xform(stage, path)
    UsdPhysics.ArticulationRootAPI.Apply(root)
    frame = rigid_body(stage, f"{path}/Frame", position, mass=1.0, inertia=(0.1, 0.1, 0.1))
    anchor(stage, f"{path}/anchor", f"{path}/Frame", position)
    return frame


class Finish(TypedDict, total=False):
    """Contact properties and look of a geom; by default it collides, is drawn, and has no material."""

    collide: bool
    visual: bool
    look: Usd.Prim
    surface: Usd.Prim


def _finish(
    prim: Usd.Prim,
    *,
    collide: bool = True,
    visual: bool = True,
    look: Usd.Prim | None = None,
    surface: Usd.Prim | None = None,
) -> Usd.Prim:
    if collide:
        UsdPhysics.CollisionAPI.Apply(prim)
    if not visual:
        UsdGeom.Imageable(prim).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    if look is not None:
        bind(prim, look)
    if surface is not None:
        bind_physics(prim, surface)
    return prim


def box(
    stage: Usd.Stage,
    path: str,
    half: Vec,
    position: Vec = (0, 0, 0),
    quat: Vec = IDENTITY,
    **finish: Unpack[Finish],
) -> Usd.Prim:
    """A box with half sizes `half` [m]."""
    geom = UsdGeom.Cube.Define(stage, path)
    geom.CreateSizeAttr(2.0)
    return _finish(_pose(geom.GetPrim(), position, quat, half), **finish)


def sphere(stage: Usd.Stage, path: str, radius: float, **finish: Unpack[Finish]) -> Usd.Prim:
    """A sphere of `radius` [m]."""
    geom = UsdGeom.Sphere.Define(stage, path)
    geom.CreateRadiusAttr(float(radius))
    return _finish(_pose(geom.GetPrim(), (0, 0, 0), IDENTITY), **finish)


def capsule(
    stage: Usd.Stage,
    path: str,
    radius: float,
    length: float,
    position: Vec = (0, 0, 0),
    quat: Vec = IDENTITY,
    axis: str = "Z",
    **finish: Unpack[Finish],
) -> Usd.Prim:
    """A capsule of `radius` [m] and cylinder `length` [m] (caps come on top) along local `axis`."""
    geom = UsdGeom.Capsule.Define(stage, path)
    geom.CreateRadiusAttr(float(radius))
    geom.CreateHeightAttr(float(length))
    geom.CreateAxisAttr(axis)
    return _finish(_pose(geom.GetPrim(), position, quat), **finish)


def cylinder(
    stage: Usd.Stage,
    path: str,
    radius: float,
    length: float,
    position: Vec = (0, 0, 0),
    quat: Vec = IDENTITY,
    axis: str = "Z",
    **finish: Unpack[Finish],
) -> Usd.Prim:
    """A cylinder of `radius` [m] and `length` [m] along local `axis`."""
    geom = UsdGeom.Cylinder.Define(stage, path)
    geom.CreateRadiusAttr(float(radius))
    geom.CreateHeightAttr(float(length))
    geom.CreateAxisAttr(axis)
    return _finish(_pose(geom.GetPrim(), position, quat), **finish)


def mesh(
    stage: Usd.Stage,
    path: str,
    points: np.ndarray | Sequence[Vec],
    faces: np.ndarray | Sequence[Sequence[int]],
    position: Vec = (0, 0, 0),
    quat: Vec = IDENTITY,
    *,
    uv: np.ndarray | Sequence[Vec] | None = None,
    look: Usd.Prim | None = None,
) -> Usd.Prim:
    """A visual triangle mesh; `points` [n,3] m, `faces` [m,3], `uv` [n,2] per vertex."""
    geom = UsdGeom.Mesh.Define(stage, path)
    faces = np.asarray(faces, dtype=np.int32)
    geom.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(points, dtype=np.float32)))
    geom.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, dtype=np.int32)))
    geom.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1)))
    geom.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    if uv is not None:
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        primvar = UsdGeom.PrimvarsAPI(geom).CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
        primvar.Set(Vt.Vec2fArray.FromNumpy(np.asarray(uv, dtype=np.float32)))
    return _finish(_pose(geom.GetPrim(), position, quat), collide=False, look=look)


def quad(
    stage: Usd.Stage,
    path: str,
    half_x: float,
    half_y: float,
    position: Vec,
    *,
    repeat: Vec = (1, 1),
    look: Usd.Prim | None = None,
) -> Usd.Prim:
    """A visual rectangle in the local xy plane facing +z, its texture repeated `repeat` times."""
    points = [(-half_x, -half_y, 0), (half_x, -half_y, 0), (half_x, half_y, 0), (-half_x, half_y, 0)]
    uv = [(0, 0), (repeat[0], 0), (repeat[0], repeat[1]), (0, repeat[1])]
    return mesh(stage, path, points, [(0, 1, 2), (0, 2, 3)], position, uv=uv, look=look)


def marker(stage: Usd.Stage, path: str, size: Vec, position: Vec = (0, 0, 0)) -> Usd.Prim:
    """A named oriented box (full extents `size` [m]) that rules read; never drawn, never touched."""
    prim = xform(stage, path, position)
    attribute(prim, "arena:size", Gf.Vec3f(*map(float, size)), Sdf.ValueTypeNames.Float3)
    return prim


def material(
    stage: Usd.Stage,
    path: str,
    color: Vec = (0.8, 0.8, 0.8),
    *,
    roughness: float = 0.8,
    metallic: float = 0.0,
    texture: str | None = None,
) -> Usd.Prim:
    """A UsdPreviewSurface look; `texture` is a path as of `asset` and replaces the colour."""
    look = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(float(roughness))
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(float(metallic))
    diffuse = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    diffuse.Set(Gf.Vec3f(*map(float, color)))
    if texture is not None:
        image = UsdShade.Shader.Define(stage, f"{path}/Texture")
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(asset(stage, texture)))
        image.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set("repeat")
        image.CreateInput("wrapT", Sdf.ValueTypeNames.Token).Set("repeat")
        reader = UsdShade.Shader.Define(stage, f"{path}/St")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        diffuse.ConnectToSource(image.ConnectableAPI(), "rgb")
    shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    look.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return look.GetPrim()


def bind(prim: Usd.Prim, look: Usd.Prim) -> Usd.Prim:
    """Bind a look to a prim."""
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(UsdShade.Material(look))
    return prim


def physics_material(stage: Usd.Stage, path: str, *, friction: float = 1.0, restitution: float = 0.0) -> Usd.Prim:
    """A physics material; friction 1 is the original's scene-wide value."""
    prim = UsdShade.Material.Define(stage, path).GetPrim()
    api = UsdPhysics.MaterialAPI.Apply(prim)
    api.CreateStaticFrictionAttr(friction)
    api.CreateDynamicFrictionAttr(friction)
    api.CreateRestitutionAttr(float(restitution))
    return prim


def bind_physics(prim: Usd.Prim, surface: Usd.Prim) -> Usd.Prim:
    """Bind a physics material to a collision geom."""
    binding = UsdShade.MaterialBindingAPI.Apply(prim)
    binding.Bind(UsdShade.Material(surface), UsdShade.Tokens.weakerThanDescendants, "physics")
    return prim


def camera(
    stage: Usd.Stage, path: str, position: Vec, quat: Vec, *, focal: float, aperture: float, size: Vec = (640, 480)
) -> Usd.Prim:
    """A pinhole camera looking along local −z with +y up; `focal` and horizontal `aperture` have one unit."""
    cam = UsdGeom.Camera.Define(stage, path)
    cam.CreateFocalLengthAttr(float(focal))
    cam.CreateHorizontalApertureAttr(float(aperture))
    cam.CreateVerticalApertureAttr(float(aperture) * size[1] / size[0])
    cam.CreateClippingRangeAttr(Gf.Vec2f(0.1, 1.0e5))
    prim = _pose(cam.GetPrim(), position, quat)
    attribute(prim, "arena:resolution", Gf.Vec2i(int(size[0]), int(size[1])), Sdf.ValueTypeNames.Int2)
    return prim


def dome_light(stage: Usd.Stage) -> Usd.Prim:
    """The uniform dome of every scene."""
    light = UsdLux.DomeLight.Define(stage, "/World/Light")
    light.CreateIntensityAttr(DOME_INTENSITY)
    light.CreateColorAttr(Gf.Vec3f(*DOME_COLOR))
    return light.GetPrim()
