"""Author VisNavi: walk between dropped beams and blocks into the yellow outline by the wet-floor sign.

Sizes of beams, blocks, outline and the poses before the first draw: spec of the original (measured on its clips).
Masses are our choice, the original's are not published: light crates that a robot can shove, not lift. So are the
origins, a beam's at its centre and a block's at the middle of its underside: then the heights from which the
original drops them form a ladder on which hardly any two touch (centred blocks overlap in 46 of 60 layouts).
"""

from pathlib import Path

import numpy as np
from pxr import Sdf, Usd

from arena_newton.tasks.vis_navi import TASK
from scene_builders import author, rooms, warehouse
from scene_builders.solids import Solids

BEAM_SIZE = (1.95, 0.38, 0.28)
BEAM_MASS = 12.0
BLOCK_SIZE = (0.5, 0.5, 0.8)
BLOCK_MASS = 10.0
PINK = (0.80, 0.33, 0.34)
YELLOW = (0.93, 0.78, 0.03)
SIGN_POSITION = (-2.0, -0.25, 0.0)
OUTLINE = 0.97
"""Outer edge of the painted square [m]: the original's region is the bounding box of that square."""
OUTLINE_CENTRE = (-0.05, -0.06)
OUTLINE_STRIPE = 0.05
ZONE_HEIGHT = 2.0

OBSTACLES = {
    "Beam_a": (-1.25, -4.05, 0.16),
    "Beam_b": (-2.45, -2.75, 0.56),
    "Beam_c": (-1.65, -2.15, 1.06),
    "Block_a": (-0.95, -3.15, 1.56),
    "Block_b": (-2.85, -1.85, 1.3),
    "Block_c": (-3.25, -3.45, 1.8),
}


def _obstacle(
    stage: Usd.Stage,
    name: str,
    position: author.Vec,
    size: author.Vec,
    mass: float,
    look: Usd.Prim,
    rough: Usd.Prim,
    *,
    on_base: bool,
) -> None:
    half = 0.5 * np.asarray(size)
    inertia = mass / 3.0 * (np.sum(half**2) - half**2)
    centre = (0.0, 0.0, half[2] if on_base else 0.0)
    author.rigid_body(stage, f"/World/{name}", position, mass=mass, inertia=inertia, com=centre)
    author.box(stage, f"/World/{name}/Geom", half, centre, look=look, surface=rough)


def _folding_sign(stage: Usd.Stage, parent: str) -> None:
    """Two leaning panels with a pictogram, standing on the far side of the outline."""
    yellow = author.material(stage, "/World/Looks/SignYellow", YELLOW)
    black = author.material(stage, "/World/Looks/SignBlack", (0.04, 0.04, 0.04))
    y, lean = OUTLINE_CENTRE[1] + OUTLINE / 2 - 0.02, np.deg2rad(9.0)
    for name, side in (("PanelFront", -1), ("PanelBack", 1)):
        quat = (float(np.cos(lean / 2)), side * float(np.sin(lean / 2)), 0.0, 0.0)
        half, centre = (0.15, 0.008, 0.31), (-0.05, y + side * 0.05, 0.306)
        author.box(stage, f"{parent}/{name}", half, centre, quat, collide=False, look=yellow)
    # Triangle and bar on the front panel, lifted 1 mm off it.
    q = (float(np.cos(lean / 2)), -float(np.sin(lean / 2)), 0.0, 0.0)
    author.mesh(
        stage,
        f"{parent}/Pictogram",
        [(-0.09, -0.0095, 0.02), (0.09, -0.0095, 0.02), (0, -0.0095, 0.18),
         (-0.10, -0.0095, -0.20), (0.10, -0.0095, -0.20), (0.10, -0.0095, -0.13), (-0.10, -0.0095, -0.13)],
        [(0, 1, 2), (3, 4, 5), (3, 5, 6)],
        (-0.05, y - 0.05, 0.306),
        q,
        look=black,
    )  # fmt: skip


def _outline(stage: Usd.Stage, parent: str) -> None:
    yellow = author.material(stage, "/World/Looks/OutlineYellow", YELLOW)
    (cx, cy), half, s = OUTLINE_CENTRE, OUTLINE / 2, OUTLINE_STRIPE / 2
    parts = [((half, s, 0.001), (cx, cy + k * (half - s), 0.002)) for k in (-1, 1)]
    parts += [((s, half, 0.001), (cx + k * (half - s), cy, 0.002)) for k in (-1, 1)]
    warehouse.boxes(stage, f"{parent}/Outline", parts, look=yellow)


def _ring_sign(stage: Usd.Stage, parent: str) -> None:
    """The semantic stand-in: a ring of the same diameter, painted in the instruction's yellow, and a round plate."""
    yellow = author.material(stage, "/World/Looks/OutlineYellow", YELLOW)
    orange = author.material(stage, "/World/Looks/SignOrange", (0.95, 0.36, 0.03))
    white = author.material(stage, "/World/Looks/SignWhite", (0.92, 0.92, 0.92))
    cx, cy = OUTLINE_CENTRE
    Solids().ring(OUTLINE / 2 - 1.4 * OUTLINE_STRIPE, OUTLINE / 2, (cx, cy, 0.003)).write(
        stage, f"{parent}/Ring", look=yellow
    )
    y, r = cy + OUTLINE / 2 - 0.02, float(np.sqrt(0.5))
    author.box(stage, f"{parent}/Post", (0.02, 0.02, 0.25), (-0.05, y + 0.02, 0.25), collide=False, look=white)
    author.cylinder(
        stage, f"{parent}/Plate", 0.16, 0.02, (-0.05, y, 0.46), (r, r, 0.0, 0.0), collide=False, look=orange
    )
    author.cylinder(
        stage, f"{parent}/PlateFace", 0.09, 0.024, (-0.05, y, 0.46), (r, r, 0.0, 0.0), collide=False, look=white
    )


def _cover(stage: Usd.Stage, look: Usd.Prim, tile: float) -> None:
    """Draw the obstacles with a texture that repeats every `tile` m, 1 mm outside their solids."""
    for name in OBSTACLES:
        beam = name.startswith("Beam")
        half = 0.5 * np.asarray(BEAM_SIZE if beam else BLOCK_SIZE)
        cover = [(half + 0.001, (0, 0, 0.0 if beam else half[2]))]
        warehouse.boxes(stage, f"/World/{name}/Cover", cover, look=look, tile=tile)


def _yellow(stage: Usd.Stage, color: author.Vec, stripe: float, cross: bool) -> str:
    """Replace sign and outline by a square of another yellow and width of `stripe` [m], crossed or not; the frame."""
    frame, (cx, cy), half, s = "/World/TargetSign/Frame", OUTLINE_CENTRE, OUTLINE / 2, stripe / 2
    rooms.without(stage, *(f"{frame}/{name}" for name in ("PanelFront", "PanelBack", "Pictogram", "Outline")))
    square = Solids()
    for k in (-1, 1):
        square.box((half, s, 0.001), (cx, cy + k * (half - s), 0.002))
        square.box((s, half, 0.001), (cx + k * (half - s), cy, 0.002))
        if cross:
            square.box((1.38 * half, s, 0.001), (cx, cy, 0.003), yaw=k * np.pi / 4)
    square.write(stage, f"{frame}/Square", look=rooms.look(stage, "OutlineYellow", color))
    return frame


def _semantic_2(folder: Path) -> None:
    """A museum: marble lozenges, teal walls, blocks of black marble, a broad yellow square and a notice."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.look(stage, "Floor", texture="marble")
        rooms.look(stage, "Wall", (0.03, 0.17, 0.2))
        rooms.look(stage, "Skirting", (0.5, 0.4, 0.25))
        _cover(stage, rooms.look(stage, "Stone", texture="veined"), 0.9)
        frame = _yellow(stage, (0.9, 0.66, 0.04), 0.1, cross=False)
        brass = rooms.look(stage, "Brass", (0.55, 0.36, 0.1), roughness=0.4)
        notice = rooms.look(stage, "Notice", (0.85, 0.83, 0.75))
        words = rooms.look(stage, "Words", (0.5, 0.03, 0.05))
        x, y = OUTLINE_CENTRE[0], OUTLINE_CENTRE[1] + OUTLINE / 2 - 0.02
        stand = [((0.012, 0.012, 0.18), (x, y, 0.18)), ((0.09, 0.05, 0.01), (x, y, 0.01))]
        warehouse.boxes(stage, f"{frame}/Stand", [*stand, ((0.15, 0.012, 0.14), (x, y, 0.46))], look=brass)
        warehouse.boxes(stage, f"{frame}/Notice", [((0.13, 0.014, 0.12), (x, y, 0.46))], look=notice)
        lines = [((0.09, 0.016, 0.016), (x, y, z)) for z in (0.4, 0.46, 0.52)]
        warehouse.boxes(stage, f"{frame}/Words", lines, look=words)


def _semantic_3(folder: Path) -> None:
    """A ship: teak deck, white walls with portholes, orange containers, a crossed yellow square and a warning sign."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "Floor", texture="teak")
        rooms.look(stage, "Wall", texture="portholes")
        rooms.look(stage, "Skirting", (0.05, 0.12, 0.3))
        _cover(stage, rooms.look(stage, "Container", texture="container"), 0.8)
        frame = _yellow(stage, (0.95, 0.82, 0.05), 0.07, cross=True)
        x, y = OUTLINE_CENTRE[0], OUTLINE_CENTRE[1] + OUTLINE / 2 - 0.02
        post = [((0.02, 0.02, 0.2), (x, y, 0.2)), ((0.12, 0.06, 0.015), (x, y, 0.015))]
        warehouse.boxes(stage, f"{frame}/Post", post, look=rooms.look(stage, "SignPost", (0.05, 0.12, 0.3)))
        for name, out, low, high, half, color in (
            ("Edge", 0.022, 0.24, 0.6, 0.2, (0.65, 0.03, 0.03)),
            ("Face", 0.024, 0.285, 0.53, 0.13, (0.9, 0.9, 0.88)),
        ):
            sides = [[(x + s * k * half, y + s * out, z) for k, z in ((1, low), (-1, low), (0, high))] for s in (-1, 1)]
            look = rooms.look(stage, f"Sign{name}", color)
            author.mesh(stage, f"{frame}/{name}", np.concatenate(sides), [(0, 2, 1), (3, 5, 4)], look=look)


def build(folder: Path) -> None:
    """Write `scene.usda` and `variants/semantic.usda` into `folder`."""
    stage = rooms.task_stage(folder, TASK, eye=(0.45796, -1.01443, 2.42268), gaze=(0.50211, 0.27898, 0.39756, 0.71555))
    rough = author.physics_material(stage, "/World/Looks/Rough")
    warehouse.room_looks(stage)
    warehouse.room(stage, rough)
    pink = author.material(stage, "/World/Looks/Pink", PINK)
    for name, position in OBSTACLES.items():
        beam = name.startswith("Beam")
        size, mass = (BEAM_SIZE, BEAM_MASS) if beam else (BLOCK_SIZE, BLOCK_MASS)
        _obstacle(stage, name, position, size, mass, pink, rough, on_base=not beam)

    author.fixture(stage, "/World/TargetSign", SIGN_POSITION)
    frame = "/World/TargetSign/Frame"
    (cx, cy), half = OUTLINE_CENTRE, OUTLINE / 2
    author.box(stage, f"{frame}/Body", (0.15, 0.05, 0.3), (-0.05, cy + half - 0.02, 0.305), visual=False, surface=rough)
    author.marker(stage, f"{frame}/Zone", (OUTLINE, OUTLINE, ZONE_HEIGHT), (cx, cy, ZONE_HEIGHT / 2))
    with rooms.edit(stage, "base"):
        _folding_sign(stage, frame)
        _outline(stage, frame)
    with rooms.edit(stage, "semantic"):
        _ring_sign(stage, frame)
        author.attribute(stage.GetPrimAtPath(f"{frame}/Zone"), "arena:round", True, Sdf.ValueTypeNames.Bool)
    rooms.save(stage, folder)
    _semantic_2(folder)
    _semantic_3(folder)
