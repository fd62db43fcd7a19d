"""Changes of a variant that move, weigh or judge, against the task's own scene, in plain sentences."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdPhysics

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.usd_scenes.compiled import Reported, compiled, compiled_changes, own_compiled, release
from arena_newton.usd_scenes.shapes import open_stage

__all__ = ["differences"]

_ROBOT = "/World/Robot"
_MOST = 40
"""Most sentences that are reported; a scene with more changes is a different scene."""
_PHYSICAL = ("physics:", "mjc:", "newton:", "arena:", "drive:", "limit:", "physx")
"""Attributes of these namespaces move, weigh or judge."""
_SHAPE = ("size", "radius", "height", "width", "length", "axis", "points", "faceVertexIndices")
_LENS = ("focalLength", "horizontalAperture", "verticalAperture", "projection", "clippingRange")
_SKIPPED = ("arena:resolution",)
_TARGETS = ("physics:", "collection:colliders:")
"""Relationships of these namespaces count as well; those of a joint's bodies are reported under their short names."""
_FIRST = ("scene:", "gravity:", "collisions:")
"""Sentences that begin so come first, since they concern everything."""
_APART = 0.01
"""Difference of what is drawn and what collides from which it is reported [m]."""
_CLOSE = 1e-6
"""Relative difference of numbers that are the same."""


@dataclass
class _Part:
    """Compared properties of one prim."""

    kind: str
    """`gravity`, `collisions`, `robot`, `rule`, `joint`, `surface` or `object`: what a sentence begins with."""
    values: dict[str, Any] = field(default_factory=dict)
    """Attributes by name; `pose` is the pose in the body that carries the prim."""


def differences(path: str | Path, task: str) -> list[str]:
    """Changes that a layer makes to a task's gravity, collisions, robot, rules, joints, surfaces, masses and colliders.

    The layers are compared attribute by attribute, and so are the MuJoCo models that they are compiled to: what changes
    in other ways (a scaled parent, a collision group, another surface bound) shows there. Looks, lights and the world
    camera may change freely and are not reported.

    Args:
        path: A layer that passes `validate`.
        task: The task that it is a variant of.

    Returns:
        One sentence per change, such as `gravity: /World/physicsScene: physics:gravityMagnitude is 0, not 9.81`.

    Raises:
        InputError: The layer cannot be composed or built, or there is no such task.
    """
    if task not in tasks.names() or not (built_in := tasks.get(task).layer).is_file():
        raise InputError(f"unknown task {task!r}: it has no scene")
    theirs, ours = open_stage(path), open_stage(built_in, checked=False)
    if Path(path).resolve() == built_in.resolve():
        return []
    reported: dict[str, None] = {}
    own = _selection(theirs)
    if own and own != _selection(ours):
        reported[f"scene: selects the variant {own} by itself"] = None
        _select(ours, own)
    needed = [item.path for item in tasks.get(task).requires]
    for item in tasks.get(task).requires:
        if item.kind == "body" and (sentence := _drawn_apart(theirs, ours, item.path)) is not None:
            reported[sentence] = None
    for variant in ("base", "semantic"):
        selected = [own if own in _names(stage) else None for stage in (theirs, ours)]
        if variant != "base":
            if not all(variant in _names(stage) for stage in (theirs, ours)):
                continue
            selected = [variant, variant]
            for stage in (theirs, ours):
                _select(stage, variant)
        note = "" if variant == "base" else f" (variant {variant})"
        models = compiled(path, selected[0]), own_compiled(task, selected[1])
        sentences = _authored(_parts(theirs), _parts(ours), models[0].gravity == models[1].gravity)
        for sentence in (*sentences, *compiled_changes(*models, Reported(tuple(sentences)), needed)):
            if sentence not in reported:
                reported[sentence + note] = None
    release()
    sentences = sorted(reported, key=lambda text: not text.startswith(_FIRST))
    if len(sentences) > _MOST:
        return [*sentences[: _MOST - 1], f"and {len(sentences) - _MOST + 1} more changes"]
    return sentences


def _drawn_apart(theirs: Usd.Stage, ours: Usd.Stage, path: str) -> str | None:
    """Difference of a body's drawn size from that which collides, if more than in our own scene; else None."""
    drawn, solid = _extents(theirs, path)
    own_drawn, own_solid = _extents(ours, path)
    if np.abs((drawn - solid) - (own_drawn - own_solid)).max() <= _APART:
        return None
    sizes = [" x ".join(f"{n:.2f}" for n in size) for size in (drawn, solid)]
    return f"drawn: {path}: is drawn {sizes[0]} m large, its colliders are {sizes[1]} m"


def _extents(stage: Usd.Stage, path: str) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of what a body shows and of its colliders, along its axes [m]; authored extents may be out of date."""
    body, poses = stage.GetPrimAtPath(path), UsdGeom.XformCache()
    drawn, solid = Gf.Range3d(), Gf.Range3d()
    for prim in Usd.PrimRange(body, Usd.TraverseInstanceProxies()) if body else ():
        geom = UsdGeom.Gprim(prim)
        extent = UsdGeom.Boundable.ComputeExtentFromPlugins(geom, Usd.TimeCode.Default()) if geom else None
        if not extent:
            continue
        pose, _ = poses.ComputeRelativeTransform(prim, body)
        box = Gf.BBox3d(Gf.Range3d(Gf.Vec3d(extent[0]), Gf.Vec3d(extent[1])), pose).ComputeAlignedRange()
        if prim.HasAPI(UsdPhysics.CollisionAPI):
            solid.UnionWith(box)
        if geom.ComputeVisibility() != UsdGeom.Tokens.invisible:
            drawn.UnionWith(box)
    none = np.zeros(3)
    return tuple(none if box.IsEmpty() else np.array(box.GetSize()) for box in (drawn, solid))  # type: ignore[return-value]  # two


def _authored(theirs: dict[str, _Part], ours: dict[str, _Part], same_gravity: bool) -> list[str]:
    """Differences between the layers; a PhysicsScene has no effect where another one is used."""
    sentences = []
    stays = "; gravity stays" if same_gravity else ""
    for sentence in _compared(theirs, ours):
        if not sentence.startswith("gravity: "):
            sentences.append(sentence)
        elif sentence.endswith(" is new"):
            text = sentence.removeprefix("gravity: ").removesuffix(" is new")
            sentences.append(f"physics: {text} is one more PhysicsScene{stays}")
        else:
            sentences.append(sentence + (stays if "physics:gravity" in sentence else ""))
    return sentences


def _names(stage: Usd.Stage) -> list[str]:
    """Variants of `semantics`."""
    world = stage.GetPrimAtPath("/World")
    return list(world.GetVariantSet("semantics").GetVariantNames()) if world else []


def _selection(stage: Usd.Stage) -> str:
    world = stage.GetPrimAtPath("/World")
    return world.GetVariantSet("semantics").GetVariantSelection() if world else ""


def _select(stage: Usd.Stage, variant: str) -> None:
    world = stage.GetPrimAtPath("/World")
    if world and variant in world.GetVariantSet("semantics").GetVariantNames():
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            world.GetVariantSet("semantics").SetVariantSelection(variant)


def _parts(stage: Usd.Stage) -> dict[str, _Part]:
    """Every prim that counts, by its path."""
    poses = UsdGeom.XformCache()
    parts: dict[str, _Part] = {}
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        path = str(prim.GetPath())
        robot = path == _ROBOT or path.startswith(f"{_ROBOT}/")
        values = {
            attribute.GetName(): attribute.Get()
            for attribute in prim.GetAttributes()
            if attribute.GetName().startswith(_PHYSICAL) and attribute.HasAuthoredValue()
            if attribute.GetName() not in _SKIPPED
        }
        values |= {
            relation.GetName(): [str(target) for target in relation.GetTargets()]
            for relation in prim.GetRelationships()
            if relation.GetName().startswith(_TARGETS) and relation.HasAuthoredTargets()
            if relation.GetName() not in ("physics:body0", "physics:body1")
        }
        group, joint = prim.IsA(UsdPhysics.CollisionGroup), prim.IsA(UsdPhysics.Joint)
        collides = prim.HasAPI(UsdPhysics.CollisionAPI)
        body = prim.HasAPI(UsdPhysics.RigidBodyAPI)
        camera = robot and prim.IsA(UsdGeom.Camera)
        if collides or camera:
            names = _SHAPE if collides else _LENS
            values |= {name: prim.GetAttribute(name).Get() for name in names if prim.HasAttribute(name)}
        marker = prim.HasAttribute("arena:size")
        if not (values or collides or body or camera or group or joint):
            continue
        if collides or marker or camera or (robot and body):
            values["pose"] = _pose(prim, poses)
        if joint:
            for name in ("body0", "body1"):
                values[name] = [str(target) for target in prim.GetRelationship(f"physics:{name}").GetTargets()]
        kinds = {
            "gravity": prim.IsA(UsdPhysics.Scene),
            "collisions": group,
            "robot": robot,
            "rule": marker,
            "joint": joint,
            "surface": prim.HasAPI(UsdPhysics.MaterialAPI),
        }
        parts[path] = _Part(next((kind for kind, fits in kinds.items() if fits), "object"), values)
    return parts


def _pose(prim: Usd.Prim, poses: Any) -> tuple[float, ...]:
    """Matrix of a prim in the body that carries it, or in the world; a body of the robot in the robot."""
    carrier = prim.GetParent()
    inside = str(prim.GetPath()).startswith(_ROBOT)
    while carrier and not (inside and str(carrier.GetPath()) == _ROBOT):
        if carrier.HasAPI(UsdPhysics.RigidBodyAPI):
            break
        carrier = carrier.GetParent()
    matrix = poses.GetLocalToWorldTransform(prim)
    if carrier and not carrier.IsPseudoRoot():
        matrix = matrix * poses.GetLocalToWorldTransform(carrier).GetInverse()
    return tuple(value for row in matrix for value in row)


def _compared(theirs: dict[str, _Part], ours: dict[str, _Part]) -> Iterator[str]:
    for path, part in ours.items():
        if path not in theirs:
            yield f"{part.kind}: {path} is gone"
            continue
        changed = [
            _change(name, theirs[path].values.get(name), part.values.get(name))
            for name in (*part.values, *(name for name in theirs[path].values if name not in part.values))
        ]
        reported = [text for text in changed if text]
        if reported:
            yield f"{part.kind}: {path}: {', '.join(reported)}{_unscaled(theirs[path].values, part.values)}"
    for path, part in theirs.items():
        if path not in ours:
            what = "a new collision group" if part.kind == "collisions" else "new"
            yield f"{part.kind}: {path} is {what}"


def _change(name: str, new: Any, old: Any) -> str | None:
    if _same(new, old):
        return None
    if name == "pose" and new is not None and old is not None:
        moved = math.dist(new[12:15], old[12:15])
        return f"is moved by {moved:.3g} m" if moved > 1e-4 else "is turned or scaled"
    if new is None:
        return f"{name} is missing"
    if _long(new) or _long(old):
        return f"{name} differs"
    return f"{name} is {_shown(new)}, not {_shown(old)}" if old is not None else f"{name} is {_shown(new)}"


def _unscaled(new: dict[str, Any], old: dict[str, Any]) -> str:
    """A remark where a mass was changed and its inertia was not."""
    mass, inertia = "physics:mass", "physics:diagonalInertia"
    if mass not in old or inertia not in old or _same(new.get(mass), old[mass]):
        return ""
    return "; its inertia is not changed in proportion" if _same(new.get(inertia), old[inertia]) else ""


def _numbers(value: Any) -> np.ndarray | None:
    """The value as numbers, None if it is not about numbers."""
    if isinstance(value, Gf.Quatf | Gf.Quatd | Gf.Quath):
        value = (value.real, *value.imaginary)
    if value is None or isinstance(value, str | bool):
        return None
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def _same(a: Any, b: Any) -> bool:
    one, other = _numbers(a), _numbers(b)
    if one is None or other is None:
        return bool(a == b)
    if one.shape != other.shape:
        return False
    return bool((np.abs(one - other) <= _CLOSE * np.maximum(1.0, np.abs(other))).all())


def _long(value: Any) -> bool:
    return not isinstance(value, str) and hasattr(value, "__len__") and len(value) > 4


def _shown(value: Any) -> str:
    numbers = _numbers(value)
    if isinstance(value, list):
        return ", ".join(value) or "nothing"
    if numbers is None:
        return str(value)
    if numbers.ndim == 0:
        return f"{float(numbers):.6g}"
    return f"({', '.join(f'{float(number):.6g}' for number in numbers.ravel())})"
