"""Common to several scenes: stage with robot, camera and light, floor, workshop room and its benches."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from arena_newton.errors import InputError
from arena_newton.tasks import TaskSpec
from scene_builders import author
from scene_builders.author import Vec
from scene_builders.solids import Solids

__all__ = [
    "SEMANTICS",
    "bench",
    "bench_cover",
    "bind_in",
    "contact",
    "edit",
    "floor",
    "held_out",
    "look",
    "paint",
    "save",
    "task_stage",
    "without",
    "workshop",
]

SEMANTICS = "semantics"
"""Name of the variant set on `/World` that holds the changed looks."""

BENCH_TOP = 0.745
"""Upper surface of the benches [m] (measured in the original's clips; both desk scenes use the same bench)."""
BENCH_TOP_HALF = 0.02
"""Half thickness of their tops [m]."""


def task_stage(folder: Path, task: TaskSpec, *, eye: Vec, gaze: Vec) -> Usd.Stage:
    """The scene of a task with the looks `base` and `semantic`; see `scene_stage`."""
    return scene_stage(folder, task.spawn_position, task.spawn_quat, eye=eye, gaze=gaze, variants=("base", "semantic"))


def scene_stage(folder: Path, spawn: Vec, facing: Vec, *, eye: Vec, gaze: Vec, variants: Sequence[str]) -> Usd.Stage:
    """A layer `scene.usda` with physics, robot, world camera, dome light and variants.

    Args:
        spawn: Robot position [m].
        facing: Robot orientation, wxyz.
        eye: Position of the world camera [m].
        gaze: Orientation of the world camera, wxyz, looking along its −z.
        variants: Names of the variants of `semantics`; the first is selected.
    """
    stage = author.new_stage(folder / "scene.usda")
    robot = author.xform(stage, "/World/Robot", spawn, facing)
    robot.GetReferences().AddReference(author.asset(stage, "../g1/g1.usda"))
    # 1920×1080, focal 12, aperture 27: horizontal field of view 96.7° (the original's world camera).
    author.camera(stage, "/World/WorldCamera", eye, gaze, focal=12.0, aperture=27.0, size=(1920, 1080))
    author.dome_light(stage)
    UsdGeom.Scope.Define(stage, "/World/Looks")
    choice = stage.GetDefaultPrim().GetVariantSets().AddVariantSet(SEMANTICS)
    for name in variants:
        choice.AddVariant(name)
    choice.SetVariantSelection(variants[0])
    return stage


@contextmanager
def edit(stage: Usd.Stage, variant: str) -> Iterator[None]:
    """Author into one variant of `semantics`; the selection afterwards is the one before.

    Whatever differs between variants is authored inside each of them: opinions outside a variant set are stronger.

    Raises:
        InputError: The stage has no such variant.
    """
    choice = stage.GetDefaultPrim().GetVariantSets().GetVariantSet(SEMANTICS)
    if variant not in choice.GetVariantNames():
        known = ", ".join(choice.GetVariantNames())
        raise InputError(f"{stage.GetRootLayer().identifier}: no variant {variant!r}, choose from {known}")
    selected = choice.GetVariantSelection()
    choice.SetVariantSelection(variant)
    with choice.GetVariantEditContext():
        yield
    choice.SetVariantSelection(selected)


def bind_in(stage: Usd.Stage, variant: str, looks: dict[str, Usd.Prim]) -> None:
    """Bind looks to prims inside one variant of `semantics`; `looks` maps prim path to look."""
    with edit(stage, variant):
        paint(stage, looks)


def paint(stage: Usd.Stage, looks: dict[str, Usd.Prim]) -> None:
    """Bind looks to prims; `looks` maps prim path to look."""
    for path, bound in looks.items():
        author.bind(stage.OverridePrim(path), bound)


def save(stage: Usd.Stage, folder: Path) -> None:
    """Write the scene and, next to it, `variants/<name>.usda` per further variant: the same scene with it selected.

    Raises:
        InputError: A variant is empty: its look was not authored.
    """
    layer = stage.GetRootLayer()
    variants = layer.GetPrimAtPath("/World").variantSets[SEMANTICS].variants
    for name, variant in variants.items():
        if not (variant.primSpec.nameChildren or variant.primSpec.properties):
            raise InputError(f"{layer.identifier}: variant {name} is empty; its look is authored with `rooms.edit`")
    selected = stage.GetDefaultPrim().GetVariantSet(SEMANTICS).GetVariantSelection()
    layer.Save()
    for name in variants.keys():
        if name != selected:
            variant_layer(folder / "variants" / f"{name}.usda", name)


def variant_layer(path: Path, variant: str) -> None:
    """Write a layer that is the scene of the folder above with another variant selected, as a user's own room does."""
    layer = _over_scene(path)
    layer.GetPrimAtPath("/World").variantSelections[SEMANTICS] = variant
    layer.Save()


@contextmanager
def held_out(folder: Path, mode: str) -> Iterator[Usd.Stage]:
    """The layer of a held-out mode over the scene in `folder`, `variants/<mode>.usda`, written when the block ends.

    Its opinions are stronger than all of the scene, whose variant `base` stays selected. What it authors is drawn: in
    P&PBox alone it adds colliders.
    """
    layer = _over_scene(folder / "variants" / f"{mode}.usda")
    yield Usd.Stage.Open(layer)
    layer.Save()


def look(
    stage: Usd.Stage,
    name: str,
    color: Vec = (0.8, 0.8, 0.8),
    *,
    texture: str | None = None,
    roughness: float = 0.8,
    metallic: float = 0.0,
) -> Usd.Prim:
    """Make over the look `name` in the layer of a held-out mode, or add it; `texture` is one of the mode's patterns."""
    path = None if texture is None else f"../../patterns/{Path(stage.GetRootLayer().identifier).stem}/{texture}.png"
    prim = author.material(stage, f"/World/Looks/{name}", color, roughness=roughness, metallic=metallic, texture=path)
    if path is None:
        UsdShade.Shader(prim.GetChild("Surface")).GetInput("diffuseColor").DisconnectSource()
    return prim


def without(stage: Usd.Stage, *paths: str) -> None:
    """Switch off prims of the scene below."""
    for path in paths:
        stage.OverridePrim(path).SetActive(False)


def _over_scene(path: Path) -> Sdf.Layer:
    path.parent.mkdir(parents=True, exist_ok=True)
    layer = Sdf.Layer.FindOrOpen(str(path)) if path.exists() else Sdf.Layer.CreateNew(str(path))
    layer.Clear()
    layer.subLayerPaths.append("../scene.usda")
    layer.defaultPrim = "World"
    root = layer.pseudoRoot
    # Stage metadata does not come through a sublayer and must be repeated.
    root.SetInfo("metersPerUnit", 1.0)
    root.SetInfo("kilogramsPerUnit", 1.0)
    root.SetInfo("upAxis", "Z")
    Sdf.CreatePrimInLayer(layer, "/World")
    return layer


def contact(
    prim: Usd.Prim, *, solref: Vec | None = None, condim: int | None = None, priority: int | None = None
) -> Usd.Prim:
    """Author MuJoCo contact parameters on a collision geom; returns the prim."""
    if solref is not None:
        author.attribute(prim, "mjc:solref", Gf.Vec2d(*map(float, solref)), Sdf.ValueTypeNames.Double2)
    if condim is not None:
        author.attribute(prim, "mjc:condim", condim, Sdf.ValueTypeNames.Int)
    if priority is not None:
        author.attribute(prim, "mjc:priority", priority, Sdf.ValueTypeNames.Int)
    return prim


def floor(stage: Usd.Stage, half: Vec, centre: Vec, *, tile: float) -> Usd.Prim:
    """The ground: an invisible collision plane at z = 0 and a textured rectangle on it; returns the rectangle.

    The original's scene-wide friction is 1.0 with the maximum of both sides taken, hence 1.0 here.
    """
    surface = author.physics_material(stage, "/World/Looks/GroundSurface")
    plane = UsdGeom.Plane.Define(stage, "/World/Ground")
    plane.CreateAxisAttr("Z")
    plane.CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    UsdPhysics.CollisionAPI.Apply(plane.GetPrim())
    author.bind_physics(plane.GetPrim(), surface)
    repeat = (2 * half[0] / tile, 2 * half[1] / tile)
    return author.quad(stage, "/World/Floor", half[0], half[1], (centre[0], centre[1], 0.0), repeat=repeat)


def workshop(
    stage: Usd.Stage, *, low: Vec, high: Vec, windows: Sequence[tuple[str, float, float, float]]
) -> dict[str, dict[str, Usd.Prim]]:
    """The dark hall of the two desk scenes: concrete floor, charcoal walls, black window frames.

    Returns the looks of its surfaces (prim path to look) under `base` and `semantic`, for `bind_in`.

    Args:
        stage: The scene.
        low: Lower corner (x, y) of the room [m].
        high: Upper corner (x, y).
        windows: Per window the wall (`-x`, `+x`, `-y`, `+y`), its centre along the wall, width and lower edge [m].
    """
    top, thick = 4.0, 0.05
    (x0, y0), (x1, y1) = low, high
    floor(stage, ((x1 - x0) / 2, (y1 - y0) / 2), ((x0 + x1) / 2, (y0 + y1) / 2), tile=2.0)
    walls = {
        "-x": ((thick, (y1 - y0) / 2, top / 2), (x0 - thick, (y0 + y1) / 2, top / 2)),
        "+x": ((thick, (y1 - y0) / 2, top / 2), (x1 + thick, (y0 + y1) / 2, top / 2)),
        "-y": (((x1 - x0) / 2, thick, top / 2), ((x0 + x1) / 2, y0 - thick, top / 2)),
        "+y": (((x1 - x0) / 2, thick, top / 2), ((x0 + x1) / 2, y1 + thick, top / 2)),
    }
    author.xform(stage, "/World/Room")
    # Visual only: no task comes within a metre of a wall, and every collider costs contact search.
    shell = Solids()
    for half, centre in walls.values():
        shell.box(half, centre, tile=1.6)
    shell.write(stage, "/World/Room/Walls")
    frames, panes = Solids(), Solids()
    for wall, at, width, sill in windows:
        axis = 1 if wall[1] == "x" else 0
        plane, inward = {"-x": (x0, 1), "+x": (x1, -1), "-y": (y0, 1), "+y": (y1, -1)}[wall]

        def at_wall(
            along: float, height: float, out: float, axis: int = axis, plane: float = plane, inward: int = inward
        ) -> np.ndarray:
            off = plane + inward * out
            return np.array([along, off, height] if axis == 0 else [off, along, height])

        def bar(half_along: float, half_height: float, out: float, axis: int = axis) -> tuple[float, float, float]:
            return (half_along, out, half_height) if axis == 0 else (out, half_along, half_height)

        head = 3.3
        middle, half_height = (head + sill) / 2, (head - sill) / 2
        for along in (at - width / 2, at, at + width / 2):
            frames.box(bar(0.04, half_height, 0.05), at_wall(along, middle, 0.05))
        for height in (sill, sill + (head - sill) * 0.36, head):
            frames.box(bar(width / 2 + 0.04, 0.04, 0.05), at_wall(at, height, 0.05))
        panes.box(bar(width / 2, half_height, 0.01), at_wall(at, middle, 0.02))
    black = author.material(stage, "/World/Looks/black", (0.01, 0.01, 0.01))
    frames.write(stage, "/World/Room/WindowFrames", look=black)
    panes.write(stage, "/World/Room/Panes")
    return {
        "base": {
            "/World/Floor": author.material(stage, "/World/Looks/concrete", texture="../textures/concrete.png"),
            "/World/Room/Walls": author.material(stage, "/World/Looks/charcoal", (0.05, 0.05, 0.046)),
            "/World/Room/Panes": author.material(stage, "/World/Looks/glass", (0.3, 0.32, 0.33), roughness=0.1),
        },
        "semantic": {
            "/World/Floor": author.material(stage, "/World/Looks/wood", texture="../textures/wood.png"),
            "/World/Room/Walls": author.material(stage, "/World/Looks/brick", texture="../textures/brick.png"),
            "/World/Room/Panes": author.material(stage, "/World/Looks/sky", (0.35, 0.55, 0.8), roughness=0.1),
        },
    }


def bench(stage: Usd.Stage, path: str, low: Vec, high: Vec, *, solref: Vec | None = None) -> None:
    """A steel work bench over the rectangle `low`…`high` [m]: pale top at 0.745 m, black legs, lower shelf.

    `solref` sets the contact stiffness of the top (the hammer needs a stiff one).
    """
    top, leg = 2 * BENCH_TOP_HALF, 0.03
    (x0, y0), (x1, y1) = low, high
    cx, cy, hx, hy = (x0 + x1) / 2, (y0 + y1) / 2, (x1 - x0) / 2, (y1 - y0) / 2
    pale = author.material(stage, "/World/Looks/bench_top", (0.52, 0.52, 0.50))
    black = author.material(stage, "/World/Looks/bench_steel", (0.012, 0.012, 0.013))
    author.xform(stage, path, (cx, cy, 0.0))
    slab = author.box(stage, f"{path}/Top", (hx, hy, top / 2), (0, 0, BENCH_TOP - top / 2), look=pale)
    contact(slab, solref=solref)
    for index, (sx, sy) in enumerate(((-1, -1), (1, -1), (-1, 1), (1, 1))):
        author.box(
            stage,
            f"{path}/Leg_{index}",
            (leg, leg, (BENCH_TOP - top) / 2),
            (sx * (hx - 0.06), sy * (hy - 0.06), (BENCH_TOP - top) / 2),
            look=black,
        )
    author.box(stage, f"{path}/Shelf", (hx - 0.04, hy - 0.05, 0.015), (0, 0, 0.18), look=black)
    # Apron under the top and back panel: visual only (the top's edge is what a hand meets).
    trim = Solids()
    for sy in (-1, 1):
        trim.box((hx - 0.04, 0.012, 0.05), (0, sy * (hy - 0.05), BENCH_TOP - top - 0.05))
    for sx in (-1, 1):
        trim.box((0.012, hy - 0.05, 0.05), (sx * (hx - 0.05), 0, BENCH_TOP - top - 0.05))
    trim.write(stage, f"{path}/Apron", look=black)


def bench_cover(stage: Usd.Stage, path: str, low: Vec, high: Vec, *, look: Usd.Prim, tile: float) -> None:
    """A textured board drawn 1 mm outside the top of the `bench` at `path`, of the same corners [m]."""
    half = (*(np.subtract(high, low) / 2 + 0.001), BENCH_TOP_HALF + 0.001)
    Solids().box(half, (0, 0, BENCH_TOP - BENCH_TOP_HALF), tile=tile).write(stage, f"{path}/Cover", look=look)
