"""Check a scene or variant layer, the project's own or a user's, before anything is built from it.

`REQUIRED` is the one table of what each task needs; everything else follows from USD itself: units, mass and inertia
of every rigid body, and that nothing is loaded from outside the folder tree or over a network.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError

if TYPE_CHECKING:
    from pxr import Sdf, Usd

__all__ = ["REQUIRED", "Problem", "Required", "check", "task_of", "validate"]


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a layer."""

    file: str
    """The layer that was checked, or the layer in its stack that holds the fault."""
    prim: str
    """Path of the prim, or of the property; empty for a fault of the whole layer."""
    message: str
    """What is wrong and what was expected."""

    def __str__(self) -> str:
        """One line: file, prim, message."""
        return f"{self.file}: {self.prim + ': ' if self.prim else ''}{self.message}"


@dataclass(frozen=True)
class Required:
    """A prim that a task cannot do without."""

    path: str
    kind: str
    """A key of `_KIND_WORDS`, which says what is expected."""
    variants: tuple[str, ...] = ()
    """Variants of `semantics` that need it; empty: all of them."""


COMMON = (
    Required("/World/physicsScene", "physics"),
    Required("/World/Robot", "robot"),
    Required("/World/WorldCamera", "camera"),
    Required("/World/Light", "light"),
)

REQUIRED: dict[str, tuple[Required, ...]] = {
    "football": (
        Required("/World/Ball", "body"),
        Required("/World/Goal", "collider"),
        Required("/World/Goal/Volume", "marker"),
        Required("/World/Pitch", "marker"),
        Required("/World/Distractor", "body", ("semantic_released",)),
    ),
    "double_desk": (
        Required("/World/Hammer", "body"),
        Required("/World/Basket", "fixture"),
        Required("/World/Basket/Frame/Inside", "marker"),
        Required("/World/RightDesk", "collider"),
        Required("/World/LeftDesk", "collider"),
        Required("/World/Sill", "collider"),
    ),
    "pp_box": (
        Required("/World/Box", "body"),
        Required("/World/Table", "collider"),
        Required("/World/Shelf", "fixture"),
        *(Required(f"/World/Shelf/Frame/{name}", "marker") for name in ("Deck_0", "Deck_1", "Deck_2", "Deck_3", "Top")),
    ),
    "open_door": (
        Required("/World/Door", "fixture"),
        Required("/World/Door/Frame/Doorway", "marker"),
        Required("/World/Door/Leaf", "body"),
        Required("/World/Door/Handle", "body"),
        Required("/World/Door/LeafHinge", "latch"),
        Required("/World/Door/HandleHinge", "hinge"),
    ),
    "sit_sofa": (
        Required("/World/Sofa", "collider"),
        Required("/World/Sofa/SeatCushion", "collider"),
        Required("/World/Sofa/Seat", "marker"),
        Required("/World/CoffeeTable", "collider"),
        Required("/World/Carton_1", "body"),
        Required("/World/Carton_2", "body"),
    ),
    "boxing": (
        Required("/World/Bag_1", "collider"),
        Required("/World/Bag_2", "collider"),
        Required("/World/Target", "target"),
        Required("/World/Target/Frame/Bounds", "marker"),
    ),
    "vis_navi": (
        *(Required(f"/World/{name}_{letter}", "body") for name in ("Beam", "Block") for letter in "abc"),
        Required("/World/TargetSign", "fixture"),
        Required("/World/TargetSign/Frame/Zone", "marker"),
    ),
}
"""What each task needs besides `COMMON`."""

_SCHEME = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]+:")
_DRIVE = re.compile(r"^[A-Za-z]:")
_LAYERS = {".usd", ".usda", ".usdc", ".usdz"}


def validate(path: str | Path, task: str | None = None) -> list[Problem]:
    """All faults of the layer at `path` as a scene of `task`.

    Args:
        path: A USD layer.
        task: Task name; by default the task whose folder the layer, or a layer it builds on, lies in.

    Raises:
        InputError: `task` is no task.
    """
    from pxr import UsdUtils

    if task is not None and task not in REQUIRED:
        raise InputError(f"unknown task {task!r}; tasks are {', '.join(REQUIRED)}")
    file = Path(path)
    if not file.is_file():
        return [Problem(str(path), "", "no such file")]
    # Composition warnings repeat on stderr what is reported here; the delegate swallows them.
    silence = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        return _validate(file, task)
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
    """The task whose folder the layer, or a layer it builds on, lies in; `None` if that is none or several."""
    return _deduce(_walk_layers(Path(path)).files)


def _validate(file: Path, task: str | None) -> list[Problem]:
    from pxr import Tf, Usd

    walk = _walk_layers(file)
    if walk.broken:
        return walk.problems
    problems = list(walk.problems)
    task = task or _deduce(walk.files)
    if task is None:
        problems.append(
            Problem(str(file), "", f"cannot tell the task from the folders; pass --task ({', '.join(REQUIRED)})")
        )
    try:
        stage = Usd.Stage.Open(str(file))
    except Tf.ErrorException as error:
        return [*problems, Problem(str(file), "", f"cannot be composed: {_first_line(error)}")]
    problems += _units(stage, file)
    world = stage.GetPrimAtPath("/World")
    if not world:
        return [*problems, Problem(str(file), "/World", "missing: the scene's default prim")]
    if stage.GetDefaultPrim() != world:
        problems.append(Problem(str(file), "/World", "is not the layer's defaultPrim"))
    return _unique(problems + list(_prims(stage, file, task, robot_lost=walk.lost)))


def _prims(stage: "Usd.Stage", file: Path, task: str | None, *, robot_lost: bool) -> Iterator[Problem]:
    """Faults of the prims, in the authored selection and in every variant of `semantics`."""
    from pxr import Usd

    seen: set[tuple[str, str]] = set()
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        choice = stage.GetPrimAtPath("/World").GetVariantSets().GetVariantSet("semantics")
        names = sorted(choice.GetVariantNames(), key=lambda name: name != "base") or ["base"]
        for name in names:
            if len(names) > 1:
                choice.SetVariantSelection(name)
            faults = [
                _fault(stage, item)
                for item in (*COMMON, *(REQUIRED[task] if task else ()))
                if not (item.variants and name not in item.variants) and not (item.kind == "robot" and robot_lost)
            ]
            for prim, message in [*(fault for fault in faults if fault), *_masses(stage)]:
                # A fault of every variant is told once; a variant's own fault names the variant.
                if (prim, message) not in seen:
                    yield Problem(str(file), prim, message + ("" if name == names[0] else f" (variant {name})"))
                seen.add((prim, message))


def _fault(stage: "Usd.Stage", item: Required) -> tuple[str, str] | None:
    """What a required prim lacks, as (prim path, message)."""
    prim = stage.GetPrimAtPath(item.path)
    wanted = _KIND_WORDS[item.kind]
    if not prim or not prim.IsActive() or not prim.IsDefined():
        return item.path, f"missing: expected {wanted}"
    message = _KIND_TESTS[item.kind](prim)
    return (item.path, f"{message}: expected {wanted}") if message else None


_KIND_WORDS = {
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


def _collides(prim: "Usd.Prim") -> bool:
    from pxr import Usd, UsdPhysics

    return any(p.HasAPI(UsdPhysics.CollisionAPI) for p in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))


def _body_fault(prim: "Usd.Prim") -> str | None:
    from pxr import UsdPhysics

    if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
        return "is not a rigid body"
    return None if _collides(prim) else "has no collision geom"


def _target_fault(prim: "Usd.Prim") -> str | None:
    from pxr import UsdPhysics

    frame, joint = prim.GetChild("Frame"), prim.GetChild("anchor")
    if not prim.HasAPI(UsdPhysics.ArticulationRootAPI):
        return "is not an articulation root"
    if not frame or not frame.HasAPI(UsdPhysics.RigidBodyAPI):
        return "has no rigid body Frame"
    if not joint or not joint.IsA(UsdPhysics.FixedJoint):
        return "has no fixed joint anchor"
    held = UsdPhysics.Joint(joint).GetBody1Rel().GetTargets()
    return None if frame.GetPath() in held else "its anchor does not hold Frame"


def _fixture_fault(prim: "Usd.Prim") -> str | None:
    return _target_fault(prim) or (None if _collides(prim.GetChild("Frame")) else "has no collision geom")


def _hinge_fault(prim: "Usd.Prim") -> str | None:
    from pxr import UsdPhysics

    if not prim.IsA(UsdPhysics.RevoluteJoint):
        return "is not a revolute joint"
    joint = UsdPhysics.Joint(prim)
    both = joint.GetBody0Rel().GetTargets() and joint.GetBody1Rel().GetTargets()
    return None if both else "does not join two bodies"


def _latch_fault(prim: "Usd.Prim") -> str | None:
    latch = prim.GetAttribute("arena:latch")
    return _hinge_fault(prim) or (None if latch and latch.Get() else "has no attribute arena:latch = true")


def _marker_fault(prim: "Usd.Prim") -> str | None:
    attribute = prim.GetAttribute("arena:size")
    size = attribute.Get() if attribute else None
    if size is None:
        return "has no attribute arena:size"
    try:
        lengths = [float(v) for v in size]
    except TypeError:
        return "arena:size is not three lengths"
    return None if len(lengths) == 3 and min(lengths) > 0 else f"arena:size is {tuple(lengths)}"


def _collider_fault(prim: "Usd.Prim") -> str | None:
    from pxr import UsdPhysics

    if prim.HasAPI(UsdPhysics.RigidBodyAPI):
        return "is a rigid body"
    return None if _collides(prim) else "has no collision geom"


def _camera_fault(prim: "Usd.Prim") -> str | None:
    from pxr import UsdGeom

    return None if prim.IsA(UsdGeom.Camera) else f"is a {prim.GetTypeName() or 'typeless prim'}"


def _light_fault(prim: "Usd.Prim") -> str | None:
    from pxr import UsdLux

    return None if prim.HasAPI(UsdLux.LightAPI) else f"is a {prim.GetTypeName() or 'typeless prim'}"


def _physics_fault(prim: "Usd.Prim") -> str | None:
    from pxr import UsdPhysics

    return None if prim.IsA(UsdPhysics.Scene) else f"is a {prim.GetTypeName() or 'typeless prim'}"


def _robot_fault(prim: "Usd.Prim") -> str | None:
    from pxr import Usd, UsdPhysics

    found = any(p.GetName() == "pelvis" and p.HasAPI(UsdPhysics.RigidBodyAPI) for p in Usd.PrimRange(prim))
    return None if found else "has no rigid body pelvis"


_KIND_TESTS = {
    "body": _body_fault,
    "fixture": _fixture_fault,
    "target": _target_fault,
    "hinge": _hinge_fault,
    "latch": _latch_fault,
    "marker": _marker_fault,
    "collider": _collider_fault,
    "camera": _camera_fault,
    "light": _light_fault,
    "physics": _physics_fault,
    "robot": _robot_fault,
}


def _masses(stage: "Usd.Stage") -> Iterator[tuple[str, str]]:
    """Rigid bodies whose mass, inertia, centre of mass or principal axes are not authored."""
    from pxr import UsdPhysics

    for prim in stage.Traverse():
        if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
            continue
        api, path = UsdPhysics.MassAPI(prim), str(prim.GetPath())
        if not prim.HasAPI(UsdPhysics.MassAPI):
            yield path, "rigid body without PhysicsMassAPI: expected mass, inertia, centre of mass and principal axes"
            continue
        mass = api.GetMassAttr().Get()
        if not mass or mass <= 0:
            value = mass if api.GetMassAttr().HasAuthoredValue() else "missing"
            yield path, f"physics:mass is {value}: expected kg > 0"
        inertia = api.GetDiagonalInertiaAttr().Get()
        if not api.GetDiagonalInertiaAttr().HasAuthoredValue() or min(inertia) <= 0:
            yield path, "physics:diagonalInertia is missing or not positive: expected three values in kg·m²"
        for attribute in (api.GetCenterOfMassAttr(), api.GetPrincipalAxesAttr()):
            if not attribute.HasAuthoredValue():
                yield path, f"{attribute.GetName()} is missing: expected an authored value beside the inertia"


def _units(stage: "Usd.Stage", file: Path) -> Iterator[Problem]:
    from pxr import UsdGeom, UsdPhysics

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


@dataclass
class _Walk:
    """What following every asset path of a layer found."""

    files: list[Path]
    problems: list[Problem]
    broken: bool = False
    """The first layer itself is unreadable."""
    lost: bool = False
    """A layer that another one builds on is missing, so prims may be missing for that reason alone."""


def _walk_layers(file: Path) -> _Walk:
    """Follow sublayers, references, payloads and asset values through the layer files, without composing anything."""
    from pxr import Sdf, Tf

    walk = _Walk([], [])
    queue, seen = [file.resolve()], set()
    while queue:
        path = queue.pop(0)
        if path in seen:
            continue
        seen.add(path)
        walk.files.append(path)
        shown = str(file) if len(seen) == 1 else str(path)
        try:
            layer = Sdf.Layer.FindOrOpen(str(path))
        except Tf.ErrorException as error:
            layer, reason = None, f"not a readable USD layer: {_first_line(error)}"
        else:
            reason = "not a readable USD layer"
        if layer is None:
            walk.problems.append(Problem(shown, "", reason))
            walk.broken |= len(seen) == 1
            continue
        if len(seen) > 1:
            walk.problems += _layer_units(layer, shown)
        for prim, asset, composes in _asset_paths(layer):
            fault, target = _locate(asset, path.parent)
            if fault:
                walk.problems.append(Problem(shown, prim, fault))
                walk.lost |= composes
            elif target is not None and target.suffix in _LAYERS:
                queue.append(target)
    return walk


def _locate(asset: str, folder: Path) -> tuple[str | None, Path | None]:
    """The fault of an asset path, or the file it means."""
    if asset.startswith(("/", "\\")) or _DRIVE.match(asset):
        return f"absolute asset path @{asset}@: expected a path relative to the layer", None
    if _SCHEME.match(asset):
        return f"remote asset path @{asset}@: expected a file next to the layer", None
    target = (folder / asset.split("[", 1)[0]).resolve()
    if not target.is_file():
        return f"asset @{asset}@ does not exist: expected {target}", None
    return None, target


def _asset_paths(layer: "Sdf.Layer") -> Iterator[tuple[str, str, bool]]:
    """Every asset path a layer names: (where, path, whether the layer is built on it)."""
    from pxr import Sdf

    found: list[tuple[str, str, bool]] = [("", asset, True) for asset in layer.subLayerPaths]

    def visit(path: "Sdf.Path") -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.VariantSpec):
            spec = spec.primSpec
        if isinstance(spec, Sdf.PrimSpec):
            for arcs in (spec.referenceList, spec.payloadList):
                for item in arcs.GetAddedOrExplicitItems():
                    found.append((_plain(path), item.assetPath, True))
            for _, clips in (spec.GetInfo("clips") if spec.HasInfo("clips") else {}).items():
                for value in clips.values():
                    found.extend((_plain(path), a, True) for a in _assets_in(value))
        elif isinstance(spec, Sdf.AttributeSpec):
            values = [spec.default, *(layer.QueryTimeSample(path, t) for t in layer.ListTimeSamplesForPath(path))]
            for value in values:
                found.extend((_plain(path), a, False) for a in _assets_in(value))

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    yield from (entry for entry in found if entry[1])


def _assets_in(value: object) -> list[str]:
    from pxr import Sdf

    if isinstance(value, Sdf.AssetPath):
        return [value.path]
    if isinstance(value, Sdf.AssetPathArray):
        return [item.path for item in value]
    return []


def _plain(path: "Sdf.Path") -> str:
    """A path as it reads in the stage, its variant selections left out."""
    return str(path.StripAllVariantSelections())


def _layer_units(layer: "Sdf.Layer", shown: str) -> Iterator[Problem]:
    """A layer that is built on must not speak other units: USD does not convert them."""
    info = layer.pseudoRoot
    for key, wanted in (("metersPerUnit", 1.0), ("upAxis", "Z"), ("kilogramsPerUnit", 1.0)):
        if info.HasInfo(key) and info.GetInfo(key) != wanted:
            yield Problem(shown, "", f"{key} is {info.GetInfo(key)}: expected {wanted} (USD does not convert units)")


def _deduce(files: list[Path]) -> str | None:
    """The one task among the names of the files' folders; the nearest file decides."""
    for file in files:
        names = [part for part in reversed(file.parent.parts) if part in REQUIRED]
        if names:
            return names[0]
    return None


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), "unknown error")


def _unique(problems: list[Problem]) -> list[Problem]:
    return list(dict.fromkeys(problems))
