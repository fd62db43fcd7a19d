"""Check a scene or variant layer, the project's own or a user's, before anything is built from it.

What a task needs is in `TaskSpec.requires`; everything else follows from USD itself: units, mass and inertia of every
rigid body, and that nothing is loaded from outside the folder tree or over a network.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdUtils

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.tasks import Required
from arena_newton.tasks.base import Kind
from arena_newton.usd_scenes.compiled import compiled, lost_contacts, own_compiled, release
from arena_newton.usd_scenes.dependencies import (
    LAYERS,
    Dependencies,
    Problem,
    check_files,
    collect,
    layers,
    reason,
    search_context,
)
from arena_newton.usd_scenes.differences import differences
from arena_newton.usd_scenes.shapes import mesh_faults, shape_faults, type_faults

__all__ = ["Problem", "check", "check_files", "differences", "layers", "task_of", "validate"]

_FOLDER = Path(__file__).resolve().parent

COMMON = (
    Required("/World/physicsScene", "physics"),
    Required("/World/Robot", "robot"),
    Required("/World/WorldCamera", "camera"),
    Required("/World/Light", "light"),
)
"""Prims that every scene needs; `TaskSpec.requires` names those that a task needs in addition."""


def validate(path: str | Path, task: str | None = None) -> list[Problem]:
    """All faults of the layer at `path` as a scene of `task`.

    Args:
        task: Task name; by default the task whose folder the layer, or a layer it builds on, is stored in.

    Raises:
        InputError: `task` is not a task.
    """
    if task is not None and task not in tasks.names():
        raise InputError(f"unknown task {task!r}; tasks are {', '.join(tasks.names())}")
    # Composition warnings repeat on stderr what is reported here; the delegate swallows them.
    silence = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        return _validate(Path(path), task)
    except (Tf.ErrorException, UnicodeDecodeError) as error:
        return [Problem(str(path), "", f"cannot be composed: {reason(error)}")]
    finally:
        del silence


def check(path: str | Path, task: str | None = None) -> None:
    """Raise if `validate` finds anything.

    Raises:
        InputError: One line that names the file, the prim and the first fault, and how many more there are.
    """
    problems = validate(path, task)
    if problems:
        more = f" (and {len(problems) - 1} more; see `python -m arena_newton.usd_scenes validate`)"
        raise InputError(f"{problems[0]}{more if len(problems) > 1 else ''}")


def task_of(path: str | Path) -> str | None:
    """The task whose folder the layer, or a layer it builds on, is stored in; `None` if there is not exactly one."""
    return _deduce(collect(Path(path)).files)


def _validate(file: Path, task: str | None) -> list[Problem]:
    found = collect(file)
    if found.fatal:
        return found.problems
    problems = list(found.problems)
    task = task or _deduce(found.files)
    if task is None:
        problems.append(
            Problem(str(file), "", f"cannot tell the task from the folders; pass --task ({', '.join(tasks.names())})")
        )
    stage = Usd.Stage.Open(str(found.files[0]), search_context())
    problems += [*_units(stage, file), *_composition(stage, file)]
    world = stage.GetPrimAtPath("/World")
    if not world:
        return [*problems, Problem(str(file), "/World", "missing: the scene's default prim")]
    if stage.GetDefaultPrim() != world:
        problems.append(Problem(str(file), "/World", "is not the layer's defaultPrim"))
    problems += [Problem(str(file), prim, message) for prim, message in _selections(stage)]
    problems += [*_prims(stage, file, task), *_strangers(stage, file, found)]
    if not problems and task is not None:
        problems += _contacts(stage, file, found, task)
    return list(dict.fromkeys(problems))


_COLLISION_WORDS = ("filter", "group", "colli", "contype", "conaffinity", "enabled", "flag")
"""Parts of names of attributes and relationships that decide which colliders meet."""


def _contacts(stage: Usd.Stage, file: Path, found: Dependencies, task: str) -> Iterator[Problem]:
    """Needed things that no longer meet each other; built, since groups and filters have no simpler answer.

    Only a layer that itself mentions collisions is built.
    """
    if not _speaks_of_collisions(stage, found):
        return
    choice = stage.GetPrimAtPath("/World").GetVariantSet("semantics")
    own = choice.GetVariantSelection() or None
    reported: set[tuple[str, str]] = set()
    for variant in dict.fromkeys((own, *sorted(choice.GetVariantNames()))):
        needed = [
            item.path
            for item in tasks.get(task).requires
            if item.kind in ("body", "fixture", "collider") and _wanted(item, variant or "base")
        ]
        try:
            models = compiled(file, variant), own_compiled(task, variant)
        except InputError as error:
            yield Problem(str(file), "", str(error).removeprefix(f"{file}: "))
            break
        for prim, message in lost_contacts(*models, needed):
            if (prim, message) not in reported:
                yield Problem(str(file), prim, message + ("" if variant == own else f" (variant {variant})"))
            reported.add((prim, message))
    release()


def _speaks_of_collisions(stage: Usd.Stage, found: Dependencies) -> bool:
    layers = {layer.identifier: layer for layer in stage.GetUsedLayers() if not layer.anonymous}
    files = (path for path in found.files if path.suffix in LAYERS)
    layers |= {layer.identifier: layer for path in files if (layer := Sdf.Layer.FindOrOpen(str(path)))}
    names: list[str] = []

    def note(path: Sdf.Path) -> None:
        if path.IsPropertyPath():
            names.append(path.name.lower())

    for layer in layers.values():
        if not Path(layer.realPath).resolve().is_relative_to(_FOLDER):
            layer.Traverse(Sdf.Path.absoluteRootPath, note)
    return any(word in name for name in names for word in _COLLISION_WORDS)


def _prims(stage: Usd.Stage, file: Path, task: str | None) -> Iterator[Problem]:
    """Faults of the prims, in the authored selection and in every variant of `semantics`."""
    seen: set[tuple[str, str]] = set(_selections(stage))
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        choice = stage.GetPrimAtPath("/World").GetVariantSets().GetVariantSet("semantics")
        names = sorted(choice.GetVariantNames(), key=lambda name: name != "base") or ["base"]
        if len(names) > limits.VARIANTS:
            yield Problem(str(file), "/World", f"has {len(names)} variants of semantics: expected {limits.VARIANTS}")
            return
        for name in names:
            if len(names) > 1:
                choice.SetVariantSelection(name)
            for prim, message in _faults(stage, task, name):
                # A fault of every variant is reported once; a variant's own fault names the variant.
                if (prim, message) not in seen:
                    yield Problem(str(file), prim, message + ("" if name == names[0] else f" (variant {name})"))
                seen.add((prim, message))


def _faults(stage: Usd.Stage, task: str | None, variant: str) -> list[tuple[str, str]]:
    """Faults of the prims as they are selected now, as (prim path, message)."""
    wrong = list(type_faults(stage))
    if wrong:
        # The other tests read attributes as what they should be.
        return wrong
    needed = (*COMMON, *(tasks.get(task).requires if task else ()))
    missing = [fault for item in needed if _wanted(item, variant) and (fault := _fault(stage, item))]
    return [*missing, *_masses(stage), *_selections(stage), *mesh_faults(stage), *shape_faults(stage)]


def _wanted(item: Required, variant: str) -> bool:
    return not item.variants or variant in item.variants


def _selections(stage: Usd.Stage) -> Iterator[tuple[str, str]]:
    """Variant selections that name no variant; USD would silently compose the prim without any."""
    for prim in stage.TraverseAll():
        sets = prim.GetVariantSets()
        for name, selected in sets.GetAllVariantSelections().items():
            if not sets.HasVariantSet(name):
                yield str(prim.GetPath()), f'selects "{selected}" of the unknown variant set "{name}"'
                continue
            known = sets.GetVariantSet(name).GetVariantNames()
            if selected not in known:
                wanted = ", ".join(known) or "no selection"
                yield str(prim.GetPath()), f'variant {name} = "{selected}" is unknown: expected {wanted}'


def _composition(stage: Usd.Stage, file: Path) -> Iterator[Problem]:
    """Composition errors of USD: a reference to a prim that is not there, a cycle."""
    for error in stage.GetCompositionErrors():
        where = error.rootSite.path
        yield Problem(str(file), "" if where.IsAbsoluteRootPath() else str(where), reason(error))


def _strangers(stage: Usd.Stage, file: Path, found: Dependencies) -> Iterator[Problem]:
    """Layers that the stage uses and the search did not check; there should be no such layer."""
    for layer in stage.GetUsedLayers():
        path = layer.realPath.split("[", 1)[0]
        if not layer.anonymous and not (path and Path(path) in found.files):
            yield Problem(str(file), "", f"is composed from @{layer.identifier}@, which no asset path in it names")


def _fault(stage: Usd.Stage, item: Required) -> tuple[str, str] | None:
    """Fault of a required prim, as (prim path, message)."""
    prim = stage.GetPrimAtPath(item.path)
    wanted = _KIND_WORDS[item.kind]
    if not prim or not prim.IsActive() or not prim.IsDefined():
        return item.path, f"missing: expected {wanted}"
    message = _KIND_TESTS[item.kind](prim)
    return (item.path, f"{message}: expected {wanted}") if message else None


_KIND_WORDS: Mapping[Kind, str] = {
    "body": "a rigid body (PhysicsRigidBodyAPI) with at least one collision geom",
    "fixture": "an articulation root with a rigid body `Frame` held by a fixed joint `anchor`, and a collision geom",
    "target": "an articulation root with a rigid body `Frame` held by a fixed joint `anchor`",
    "hinge": "a revolute joint between two bodies",
    "latch": "a revolute joint between two bodies with the attribute `arena:latch` = true",
    "marker": "a marker: an Xform with the attribute `arena:size` (three positive lengths)",
    "collider": "static geometry with PhysicsCollisionAPI",
    "camera": "a UsdGeom.Camera",
    "light": "a light (UsdLux)",
    "physics": "a UsdPhysics.Scene",
    "robot": "the robot (a reference to g1.usda with the body `pelvis`)",
}


def _collides(prim: Usd.Prim) -> bool:
    return any(
        p.HasAPI(UsdPhysics.CollisionAPI) and UsdPhysics.CollisionAPI(p).GetCollisionEnabledAttr().Get()
        for p in Usd.PrimRange(prim, Usd.TraverseInstanceProxies())
    )


def _body_fault(prim: Usd.Prim) -> str | None:
    if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
        return "is not a rigid body"
    return _held_fault(prim) or (None if _collides(prim) else "has no collision geom")


def _held_fault(prim: Usd.Prim) -> str | None:
    """A rigid body that does not move by itself."""
    body = UsdPhysics.RigidBodyAPI(prim)
    if not body.GetRigidBodyEnabledAttr().Get():
        return "physics:rigidBodyEnabled is false"
    return "physics:kinematicEnabled is true" if body.GetKinematicEnabledAttr().Get() else None


def _target_fault(prim: Usd.Prim) -> str | None:
    frame, joint = prim.GetChild("Frame"), prim.GetChild("anchor")
    if not prim.HasAPI(UsdPhysics.ArticulationRootAPI):
        return "is not an articulation root"
    if not frame or not frame.HasAPI(UsdPhysics.RigidBodyAPI):
        return "has no rigid body Frame"
    if not joint or not joint.IsA(UsdPhysics.FixedJoint):
        return "has no fixed joint anchor"
    held = UsdPhysics.Joint(joint).GetBody1Rel().GetTargets()
    return None if frame.GetPath() in held else "its anchor does not hold Frame"


def _fixture_fault(prim: Usd.Prim) -> str | None:
    return _target_fault(prim) or (None if _collides(prim.GetChild("Frame")) else "has no collision geom")


def _hinge_fault(prim: Usd.Prim) -> str | None:
    if not prim.IsA(UsdPhysics.RevoluteJoint):
        return "is not a revolute joint"
    joint = UsdPhysics.Joint(prim)
    both = joint.GetBody0Rel().GetTargets() and joint.GetBody1Rel().GetTargets()
    return None if both else "does not join two bodies"


def _latch_fault(prim: Usd.Prim) -> str | None:
    latch = prim.GetAttribute("arena:latch")
    return _hinge_fault(prim) or (None if latch and latch.Get() else "has no attribute arena:latch = true")


def _marker_fault(prim: Usd.Prim) -> str | None:
    attribute = prim.GetAttribute("arena:size")
    size = attribute.Get() if attribute else None
    if size is None:
        return "has no attribute arena:size"
    try:
        lengths = [float(v) for v in size]
    except (TypeError, ValueError):
        return "arena:size is not three lengths"
    good = len(lengths) == 3 and all(math.isfinite(v) and v > 0 for v in lengths)
    return None if good else f"arena:size is {tuple(lengths)}"


def _collider_fault(prim: Usd.Prim) -> str | None:
    if prim.HasAPI(UsdPhysics.RigidBodyAPI):
        return "is a rigid body"
    return None if _collides(prim) else "has no collision geom"


def _kind_fault(fits: bool, prim: Usd.Prim) -> str | None:
    return None if fits else f"is a {prim.GetTypeName() or 'typeless prim'}"


def _robot_fault(prim: Usd.Prim) -> str | None:
    bodies = [p for p in Usd.PrimRange(prim) if p.HasAPI(UsdPhysics.RigidBodyAPI)]
    if all(p.GetName() != "pelvis" for p in bodies):
        return "has no rigid body pelvis"
    return next((f"{p.GetName()}: {fault}" for p in bodies if (fault := _held_fault(p))), None)


_KIND_TESTS: Mapping[Kind, Callable[[Usd.Prim], str | None]] = {
    "body": _body_fault,
    "fixture": _fixture_fault,
    "target": _target_fault,
    "hinge": _hinge_fault,
    "latch": _latch_fault,
    "marker": _marker_fault,
    "collider": _collider_fault,
    "camera": lambda prim: _kind_fault(prim.IsA(UsdGeom.Camera), prim),
    "light": lambda prim: _kind_fault(prim.HasAPI(UsdLux.LightAPI), prim),
    "physics": lambda prim: _kind_fault(prim.IsA(UsdPhysics.Scene), prim),
    "robot": _robot_fault,
}


def _masses(stage: Usd.Stage) -> Iterator[tuple[str, str]]:
    """Rigid bodies whose mass, inertia, centre of mass or principal axes are not authored."""
    for prim in stage.Traverse():
        if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
            continue
        api, path = UsdPhysics.MassAPI(prim), str(prim.GetPath())
        if not prim.HasAPI(UsdPhysics.MassAPI):
            yield path, "rigid body without PhysicsMassAPI: expected mass, inertia, centre of mass and principal axes"
            continue
        mass = api.GetMassAttr().Get()
        if not mass or not (math.isfinite(mass) and mass > 0):
            value = mass if api.GetMassAttr().HasAuthoredValue() else "missing"
            yield path, f"physics:mass is {value}: expected kg > 0"
        inertia = api.GetDiagonalInertiaAttr().Get()
        known = api.GetDiagonalInertiaAttr().HasAuthoredValue()
        if not known or not all(math.isfinite(value) and value > 0 for value in inertia):
            yield path, "physics:diagonalInertia is missing or not positive: expected three values in kg·m²"
        axes = api.GetPrincipalAxesAttr().Get()
        for attribute, numbers in (
            (api.GetCenterOfMassAttr(), api.GetCenterOfMassAttr().Get()),
            (api.GetPrincipalAxesAttr(), (axes.real, *axes.imaginary)),
        ):
            if not attribute.HasAuthoredValue():
                yield path, f"{attribute.GetName()} is missing: expected an authored value next to the inertia"
            elif not all(map(math.isfinite, numbers)):
                yield path, f"{attribute.GetName()} is not finite"
        if api.GetPrincipalAxesAttr().HasAuthoredValue() and abs(axes.GetLength() - 1) > 0.01:
            yield path, f"physics:principalAxes has length {axes.GetLength():g}: expected a unit quaternion"


def _units(stage: Usd.Stage, file: Path) -> Iterator[Problem]:
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        yield Problem(str(file), "", "metersPerUnit is missing (USD then means 0.01): expected 1")
    elif UsdGeom.GetStageMetersPerUnit(stage) != 1.0:
        yield Problem(str(file), "", f"metersPerUnit is {UsdGeom.GetStageMetersPerUnit(stage):g}: expected 1")
    if not stage.HasAuthoredMetadata("upAxis"):
        yield Problem(str(file), "", 'upAxis is missing (USD then means Y): expected "Z"')
    elif UsdGeom.GetStageUpAxis(stage) != UsdGeom.Tokens.z:
        yield Problem(str(file), "", f'upAxis is "{UsdGeom.GetStageUpAxis(stage)}": expected "Z"')
    if UsdPhysics.GetStageKilogramsPerUnit(stage) != 1.0:
        yield Problem(str(file), "", f"kilogramsPerUnit is {UsdPhysics.GetStageKilogramsPerUnit(stage):g}: expected 1")


def _deduce(files: list[Path]) -> str | None:
    """The one task among the names of the files' folders; the nearest file decides."""
    for file in files:
        names = [part for part in reversed(file.parent.parts) if part in tasks.names()]
        if names:
            return names[0]
    return None
