"""Faults of a composed scene's geometry: what would crash or exhaust the importer, and what is not geometry at all."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdLux, UsdPhysics

from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.usd_scenes.dependencies import check_files, reason, search_context

__all__ = ["check_buildable", "mesh_faults", "open_stage", "shape_faults", "type_faults"]

_KINDS = ("Mesh", "Cube", "Sphere", "Capsule", "Cylinder", "Cone", "Plane")
"""Geometry that a scene may consist of; the importer makes other things of other kinds."""
_LENGTHS = {
    "Cube": ("size",),
    "Sphere": ("radius",),
    "Capsule": ("radius", "height"),
    "Cylinder": ("radius", "height"),
    "Cone": ("radius", "height"),
    "Plane": ("width", "length"),
}
_FLAT = 1e-5
"""A collision mesh is flat if it is thinner than this fraction of its length; its hull has no inside."""
_ROUNDING = 1e-3
"""Relative error of a stored inertia."""
_MASSES = (1e-5, 1e4)
"""Lightest and heaviest body that single-precision dynamics bears [kg]."""
_GRAVITY = 100.0
"""Largest gravity [m/s²]."""


def open_stage(path: str | Path, *, checked: bool = True) -> Usd.Stage:
    """Open a stage, the project's or a user's.

    Args:
        checked: Check its files first; only the project's own may do without.

    Raises:
        InputError: The stage cannot or must not be composed.
    """
    if checked:
        check_files(path)
    try:
        return Usd.Stage.Open(str(path), search_context())
    except (Tf.ErrorException, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a readable USD layer ({reason(error)})") from None


def check_buildable(stage: Usd.Stage, path: str | Path) -> None:
    """Raise if the stage, with the variants that are selected now, would crash or exhaust the importer.

    Raises:
        InputError: One line that names the file, the prim and the first fault.
    """
    for prim, message in itertools.chain(type_faults(stage), mesh_faults(stage)):
        raise InputError(f"{path}: {prim}: {message}")


def type_faults(stage: Usd.Stage) -> Iterator[tuple[str, str]]:
    """Attributes whose value is not of their schema's type, as (prim path, message); USD hands them on as they are."""
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        schema = prim.GetPrimDefinition()
        for attribute in prim.GetAuthoredAttributes():
            name, value = attribute.GetName(), attribute.Get()
            defined = schema.GetAttributeDefinition(name)
            if value is None or not (defined or name.startswith("xformOp:")):
                continue
            given = type(value).__name__
            if defined:
                expected = defined.GetTypeName()
                fits = _family(given) == _family(type(expected.defaultValue).__name__)
            else:
                expected = "a vector, a quaternion, a matrix or a number"
                fits = _family(given) in ("number", "Vec3", "Quat", "Matrix4")
            if not fits:
                yield str(prim.GetPath()), f"{name} holds a value of type {given}: expected {expected}"


def _family(name: str) -> str:
    """Types that stand for each other: single and double precision, whole and other numbers."""
    if name in ("int", "float", "bool"):
        return "number"
    plain = name.removesuffix("Array")
    return name.replace(plain, plain[:-1], 1) if plain.startswith(("Vec", "Quat", "Matrix")) else name


def mesh_faults(stage: Usd.Stage) -> Iterator[tuple[str, str]]:
    """Meshes whose indices lead out of their points or that are too large, and unknown kinds, as (prim path, message).

    The importer's compiled code follows indices on trust.
    """
    points = 0
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        kind = prim.GetTypeName()
        if prim.IsA(UsdGeom.PointInstancer) or (prim.IsA(UsdGeom.Gprim) and kind not in _KINDS):
            yield str(prim.GetPath()), f"is a {kind}: expected one of {', '.join(_KINDS)}"
        if kind != "Mesh":
            continue
        message, count = _mesh_fault(UsdGeom.Mesh(prim))
        points += count
        if message is None and points > limits.SCENE_POINTS:
            message = f"brings the meshes of the scene to {points} points, expected at most {limits.SCENE_POINTS}"
        if message is not None:
            yield str(prim.GetPath()), message
        if points > limits.SCENE_POINTS:
            return


def _mesh_fault(mesh: Usd.Typed) -> tuple[str | None, int]:
    """Fault of a mesh, and its number of points."""
    names = ("points", "faceVertexCounts", "faceVertexIndices")
    points, counts, indices = values = [mesh.GetPrim().GetAttribute(name).Get() for name in names]
    for name, value in zip(names, values, strict=True):
        if value is None:
            return f"{name} is missing: expected a value without time", 0
    many, corners = len(points), len(indices)
    most = max(many, corners, len(counts))
    if most > limits.MESH_POINTS:
        return f"has {most} points or corners, expected at most {limits.MESH_POINTS} for a mesh", many
    sides, at = np.asarray(counts, dtype=np.int64), np.asarray(indices, dtype=np.int64)
    if not many or not len(sides):
        return "has no points or no faces: expected a mesh", many
    if sides.min() < 3:
        return f"faceVertexCounts holds {sides.min()}: expected at least 3", many
    if sides.sum() != corners:
        return f"faceVertexCounts adds up to {sides.sum()}, but faceVertexIndices holds {corners}", many
    if at.min() < 0 or at.max() >= many:
        bad = at[(at < 0) | (at >= many)][0]
        return f"faceVertexIndices holds {bad}: expected 0 to {many - 1}", many
    return _primvar_fault(mesh, many, corners, len(sides)), many


def _primvar_fault(mesh: Usd.Typed, points: int, corners: int, faces: int) -> str | None:
    """Texture coordinates and normals: their number and their indices."""
    wanted = {"constant": 1, "uniform": faces, "varying": points, "vertex": points, "faceVarying": corners}
    for primvar in UsdGeom.PrimvarsAPI(mesh.GetPrim()).GetPrimvars():
        name, value = primvar.GetName(), primvar.Get()
        if value is None or not hasattr(value, "__len__") or isinstance(value, str):
            continue
        indices = primvar.GetIndices() if primvar.IsIndexed() else None
        count = len(value) if indices is None else len(indices)
        if max(len(value), count) > limits.MESH_POINTS:
            return f"{name} holds {max(len(value), count)} elements, expected at most {limits.MESH_POINTS}"
        if indices is not None:
            at = np.asarray(indices, dtype=np.int64)
            if len(at) and (at.min() < 0 or at.max() >= len(value)):
                bad = at[(at < 0) | (at >= len(value))][0]
                return f"{name}:indices holds {bad}: expected 0 to {len(value) - 1}"
        expected = wanted.get(primvar.GetInterpolation())
        if expected is not None and count != expected * primvar.GetElementSize():
            return f"{name} has {count} elements, expected {expected} ({primvar.GetInterpolation()})"
    normals = mesh.GetNormalsAttr().Get()
    expected = wanted.get(mesh.GetNormalsInterpolation())
    if normals is not None and len(normals) and expected is not None and len(normals) != expected:
        return f"normals has {len(normals)} elements, expected {expected} ({mesh.GetNormalsInterpolation()})"
    return None


def shape_faults(stage: Usd.Stage) -> Iterator[tuple[str, str]]:
    """Sizes, poses, lights, gravity and inertias that are impossible, as (prim path, message)."""
    poses = UsdGeom.XformCache()
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        faults: list[str | None] = []
        if prim.IsA(UsdGeom.Xformable):
            faults.append(_pose_fault(prim, poses))
        if prim.IsA(UsdGeom.Gprim):
            faults.append(_size_fault(prim))
            if prim.IsA(UsdGeom.Mesh) and prim.HasAPI(UsdPhysics.CollisionAPI):
                faults.append(_flat_fault(prim))
        if prim.HasAPI(UsdLux.LightAPI):
            faults.append(_light_fault(prim))
        if prim.IsA(UsdPhysics.Joint):
            faults.append(_joint_fault(prim))
        if prim.IsA(UsdPhysics.Scene):
            faults.append(_gravity_fault(prim))
        if prim.HasAPI(UsdPhysics.MassAPI):
            faults.append(_inertia_fault(prim))
        yield from ((str(prim.GetPath()), fault) for fault in faults if fault)


def _size_fault(prim: Usd.Prim) -> str | None:
    for name in _LENGTHS.get(prim.GetTypeName(), ()):
        value = prim.GetAttribute(name).Get()
        # A plane of width 0 is infinite.
        least = 0.0 if prim.GetTypeName() == "Plane" else math.ulp(0.0)
        if value is None or not least <= value <= 2 * limits.FARTHEST:
            return f"{name} is {value}: expected more than 0 and at most {2 * limits.FARTHEST:g} m"
    return None


def _pose_fault(prim: Usd.Prim, poses: object) -> str | None:
    for operation in UsdGeom.Xformable(prim).GetOrderedXformOps():
        value = operation.Get()
        if operation.GetOpType() == UsdGeom.XformOp.TypeOrient and value is not None and value.GetLength() < 1e-6:
            return f"{operation.GetOpName()} has length 0: expected a unit quaternion"
    matrix = poses.GetLocalToWorldTransform(prim)  # type: ignore[attr-defined]
    scales = [matrix.GetRow3(row).GetLength() for row in range(3)]
    if not all(1e-6 <= scale <= 1e6 for scale in scales):
        return f"is scaled by {', '.join(f'{scale:.3g}' for scale in scales)}: expected more than 0"
    position = matrix.ExtractTranslation()
    if not all(abs(value) <= limits.FARTHEST for value in position):
        where = ", ".join(f"{value:.3g}" for value in position)
        return f"lies at ({where}) m: expected at most {limits.FARTHEST:g} m from the origin"
    if prim.GetTypeName() == "Mesh":
        points = np.asarray(UsdGeom.Mesh(prim).GetPointsAttr().Get() or (), dtype=np.float64)
        if points.size and np.abs(points).max() * max(scales) > limits.FARTHEST:
            return f"has points {np.abs(points).max() * max(scales):.3g} m from its origin: expected at most 1000"
    return None


def _flat_fault(prim: Usd.Prim) -> str | None:
    """The hull of points in a plane or on a line has no inside that could carry a contact."""
    points = np.asarray(UsdGeom.Mesh(prim).GetPointsAttr().Get() or (), dtype=np.float64)
    if len(points) < 4:
        return f"is a collision mesh of {len(points)} points, which is flat: expected a solid, as a thin Cube"
    lengths = np.linalg.eigvalsh(np.cov(points.T))
    if lengths[0] <= _FLAT**2 * lengths[-1]:
        return "is a flat collision mesh: expected a solid, as a thin Cube"
    return None


def _light_fault(prim: Usd.Prim) -> str | None:
    light = UsdLux.LightAPI(prim)
    intensity, color = light.GetIntensityAttr().Get(), light.GetColorAttr().Get()
    if intensity is None or not 0.0 <= intensity <= 1e9:
        return f"inputs:intensity is {intensity}: expected at least 0"
    return None if color is None or min(color) >= 0.0 else f"inputs:color is {tuple(color)}: expected at least 0"


def _joint_fault(prim: Usd.Prim) -> str | None:
    joint = UsdPhysics.Joint(prim)
    for attribute in (joint.GetLocalRot0Attr(), joint.GetLocalRot1Attr()):
        turn = attribute.Get()
        if turn is not None and abs(turn.GetLength() - 1.0) > 0.01:
            return f"{attribute.GetName()} has length {turn.GetLength():g}: expected a unit quaternion"
    return None


def _gravity_fault(prim: Usd.Prim) -> str | None:
    attribute = prim.GetAttribute("physics:gravityMagnitude")
    value = attribute.Get() if attribute.HasAuthoredValue() else None
    return None if value is None or 0.0 <= value <= _GRAVITY else f"{attribute.GetName()} is {value:g}: expected m/s²"


def _inertia_fault(prim: Usd.Prim) -> str | None:
    """Inertia that no body of this mass can have; missing values are reported by `validate`."""
    api = UsdPhysics.MassAPI(prim)
    mass, inertia = api.GetMassAttr().Get(), api.GetDiagonalInertiaAttr().Get()
    if mass and mass > 0 and not _MASSES[0] <= mass <= _MASSES[1]:
        return f"physics:mass is {mass:g}: expected {_MASSES[0]:g} to {_MASSES[1]:g} kg"
    if not inertia or min(inertia) <= 0:
        return None
    low, middle, high = sorted(inertia)
    if high > (low + middle) * (1.0 + _ROUNDING):
        return f"physics:diagonalInertia is {tuple(inertia)}: no value can be more than the sum of the other two"
    # A fixture's frame is posed, not moved: its inertia has no effect.
    reach = 0.0 if prim.GetParent().HasAPI(UsdPhysics.ArticulationRootAPI) else _reach(prim)
    if mass and mass > 0 and reach and high > 2.0 * mass * reach**2:
        return (
            f"physics:diagonalInertia holds {high:g}: a mass of {mass:g} kg that reaches {reach:.3g} m has at most "
            f"{mass * reach**2:.3g} kg·m²"
        )
    return None


def _reach(prim: Usd.Prim) -> float:
    """Farthest that a body's geometry may be from its centre of mass [m]; 0 without geometry."""
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default", "render", "proxy", "guide"])
    bounds = box.ComputeLocalBound(prim).ComputeAlignedRange() if not prim.IsPseudoRoot() else None
    if bounds is None or bounds.IsEmpty():
        return 0.0
    return float(bounds.GetSize().GetLength())
