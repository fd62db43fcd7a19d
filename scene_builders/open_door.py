"""Author OpenDoor: a partition with a latched, hinged leaf and a sprung lever handle.

Leaf, opening side, partition height and the pose before the first draw: spec of the original (measured on its clips).
Mass, hinge and lever: the values that scripted experts were shown to work with (leaf 15-25 kg, damping 1-3, lever
12 cm with a 2-3 N·m/rad spring, 6-7 cm off the leaf, pivot 7 cm from the free edge).

Frame axes: x along the partition, y away from the robot, z up; the leaf is centred on x = 0 and y = 0 is the frame
plane. The hinge is at the robot's left (−x); a positive leaf angle opens away from the robot (+y). A negative handle
angle is a lever pressed down. The lever is balanced about its pivot (the original's door has no gravity).
"""

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdPhysics

from arena_newton.tasks.open_door import TASK
from scene_builders import author, rooms, warehouse
from scene_builders.solids import Solids

POSITION = (-1.614, 2.314, 0.002)
LEAF_SIZE = (1.0, 0.04, 2.14)
LEAF_MASS = 20.0
"""[kg]"""
LEAF_CLEARANCE = 0.01
LEAF_LIMITS = (-2.0, 110.0)
"""[deg]"""
LEAF_DAMPING = 1.5
"""[N·m·s/rad]"""
LEAF_FRICTION = 0.5
"""[N·m]"""
PARTITION_HEIGHT = 2.55
PARTITION_THICKNESS = 0.10
PARTITION_X = (-6.6, 4.6)
"""Along the frame's x; longer than the room, so that no draw of the door opens a gap at its ends."""
GAP = 0.02
HANDLE_PIVOT = (0.43, -0.065, 0.95)
LEVER_LENGTH = 0.12
LEVER_RADIUS = 0.011
HANDLE_MASS = 0.3
HANDLE_SPRING = 2.5
"""[N·m/rad]"""
HANDLE_DAMPING = 0.1
"""[N·m·s/rad]"""
HANDLE_LIMITS = (-50.0, 2.0)
"""[deg]"""
DOORWAY = (1.10, 0.04, 2.15)
"""The passage a rule tests [m]: |x| ≤ 0.55 and |y| ≤ 0.02 in the frame."""


def _hinge(
    stage: Usd.Stage, name: str, parent: str, child: str, axis: str, at_parent: author.Vec, limits: author.Vec
) -> Usd.Prim:
    bodies = f"/World/Door/{parent}", f"/World/Door/{child}"
    joint = author.hinge(stage, f"/World/Door/{name}", *bodies, axis, limits, at_parent)
    # MuJoCo's own default stop; the importer's would let the leaf bounce between its limits.
    author.attribute(joint, "mjc:solreflimit", Gf.Vec2d(0.02, 1.0), Sdf.ValueTypeNames.Double2)
    return joint


_OPENING, _TOP = LEAF_SIZE[0] / 2 + GAP, LEAF_CLEARANCE + LEAF_SIZE[2] + GAP
"""Half width and height of the opening for the leaf [m]."""


def _panels() -> dict[str, tuple[author.Vec, author.Vec]]:
    """Half sizes and centres of the solids of the partition [m]."""
    (x0, x1), t, h = PARTITION_X, PARTITION_THICKNESS / 2, PARTITION_HEIGHT / 2
    return {
        "PanelLeft": (((-_OPENING - x0) / 2, t, h), ((x0 - _OPENING) / 2, 0, h)),
        "PanelRight": (((x1 - _OPENING) / 2, t, h), ((x1 + _OPENING) / 2, 0, h)),
        "Header": ((_OPENING, t, (PARTITION_HEIGHT - _TOP) / 2), (0, 0, (PARTITION_HEIGHT + _TOP) / 2)),
    }


def _partition(stage: Usd.Stage, frame: str, rough: Usd.Prim) -> None:
    """Left panel, right panel and header collide; seams, posts and the door casing are drawn only."""
    x0, x1 = PARTITION_X
    opening, top, t, h = _OPENING, _TOP, PARTITION_THICKNESS / 2, PARTITION_HEIGHT / 2
    panel = author.material(stage, "/World/Looks/Panel", (0.42, 0.43, 0.43))
    trim = author.material(stage, "/World/Looks/Trim", (0.30, 0.31, 0.31))
    bright = author.material(stage, "/World/Looks/Rail", (0.82, 0.82, 0.80))
    for name, (half, centre) in _panels().items():
        author.box(stage, f"{frame}/{name}", half, centre, look=panel, surface=rough)
    seams = [float(x) for x in np.arange(x0 + 0.2, x1, 1.25) if abs(x) > opening + 0.1]
    parts: list[tuple[author.Vec, author.Vec]] = [((0.012, t + 0.008, h), (x, 0, h)) for x in seams]
    parts += [((0.035, t + 0.012, top / 2 + 0.03), (k * (opening + 0.035), 0, top / 2 + 0.03)) for k in (-1, 1)]
    parts += [((opening, t + 0.012, 0.035), (0, 0, top + 0.035))]
    parts += [(((x1 - opening) / 2 - 0.05, t + 0.008, 0.02), ((x1 + opening) / 2, 0, 1.2))]
    warehouse.boxes(stage, f"{frame}/Casing", parts, look=trim)
    rail = [(((x1 - x0) / 2, t + 0.015, 0.02), ((x0 + x1) / 2, 0, PARTITION_HEIGHT + 0.02))]
    rail += [
        (((-opening - 0.07 - x0) / 2, t + 0.01, 0.045), ((x0 - opening - 0.07) / 2, 0, 0.045)),
        (((x1 - opening - 0.07) / 2, t + 0.01, 0.045), ((x1 + opening + 0.07) / 2, 0, 0.045)),
    ]
    warehouse.boxes(stage, f"{frame}/Rail", rail, look=bright)


def _leaf(stage: Usd.Stage, path: str, origin: author.Vec, rough: Usd.Prim) -> None:
    """The leaf's origin is its hinge line at the height of the frame's origin."""
    half = 0.5 * np.asarray(LEAF_SIZE)
    centre = (half[0], 0.0, LEAF_CLEARANCE + half[2])
    inertia = LEAF_MASS / 3.0 * (np.sum(half**2) - half**2)
    author.rigid_body(stage, path, origin, mass=LEAF_MASS, inertia=inertia, com=centre)
    author.box(stage, f"{path}/Solid", half, centre, visual=False, surface=rough)


def _tan_leaf(stage: Usd.Stage, path: str) -> None:
    """The leaf of the base look: tan with two framed panels."""
    half = 0.5 * np.asarray(LEAF_SIZE)
    cx, cz = half[0], LEAF_CLEARANCE + half[2]
    board = author.material(stage, "/World/Looks/Leaf", (0.36, 0.28, 0.21))
    dark = author.material(stage, "/World/Looks/LeafPanel", (0.25, 0.19, 0.14))
    warehouse.boxes(stage, f"{path}/Board", [(half, (cx, 0, cz))], look=board)
    lines = []
    for low, high in ((0.25, 0.85), (1.10, 1.95)):
        lines += [((0.30, half[1] + 0.002, 0.008), (cx, 0, z)) for z in (low, high)]
        lines += [((0.008, half[1] + 0.002, (high - low) / 2), (cx + k * 0.30, 0, (low + high) / 2)) for k in (-1, 1)]
    warehouse.boxes(stage, f"{path}/Mouldings", lines, look=dark)


def _blue_leaf(stage: Usd.Stage, path: str) -> None:
    """The leaf of the semantic look: blue steel with a window and hazard stripes."""
    half = 0.5 * np.asarray(LEAF_SIZE)
    cx, cz = half[0], LEAF_CLEARANCE + half[2]
    paint = author.material(stage, "/World/Looks/Leaf", (0.05, 0.16, 0.38))
    glass = author.material(stage, "/World/Looks/LeafGlass", (0.62, 0.74, 0.78), roughness=0.2)
    hazard = author.material(stage, "/World/Looks/LeafHazard", (0.8, 0.7, 0.1), texture="../textures/hazard.png")
    warehouse.boxes(stage, f"{path}/Board", [(half, (cx, 0, cz))], look=paint)
    warehouse.boxes(stage, f"{path}/Window", [((0.14, half[1] + 0.002, 0.35), (cx - 0.1, 0, 1.55))], look=glass)
    warehouse.boxes(
        stage, f"{path}/Stripes", [((half[0] - 0.03, half[1] + 0.002, 0.09), (cx, 0, 0.14))], look=hazard, tile=0.36
    )


def _handle(stage: Usd.Stage, path: str, origin: author.Vec, rough: Usd.Prim) -> None:
    chrome = author.material(stage, "/World/Looks/Chrome", (0.12, 0.12, 0.13), roughness=0.3, metallic=0.8)
    author.rigid_body(stage, path, origin, mass=HANDLE_MASS, inertia=(5e-4, 5e-4, 5e-4))
    straight, middle = LEVER_LENGTH - 2 * LEVER_RADIUS, -LEVER_LENGTH / 2
    author.capsule(stage, f"{path}/Lever", LEVER_RADIUS, straight, (middle, 0, 0), axis="X", look=chrome, surface=rough)
    # The twin on the far side, the spindle and the roses are drawn only.
    far = -2 * HANDLE_PIVOT[1]
    author.capsule(
        stage, f"{path}/FarLever", LEVER_RADIUS, straight, (middle, far, 0), axis="X", collide=False, look=chrome
    )
    author.cylinder(stage, f"{path}/Spindle", 0.009, far, (0, far / 2, 0), axis="Y", collide=False, look=chrome)
    leaf = LEAF_SIZE[1] / 2
    for name, y in (("Rose", far / 2 - leaf - 0.004), ("FarRose", far / 2 + leaf + 0.004)):
        author.cylinder(stage, f"{path}/{name}", 0.026, 0.008, (0, y, 0), axis="Y", collide=False, look=chrome)


def _chain(stage: Usd.Stage, rough: Usd.Prim) -> None:
    """Leaf on the frame, lever on the leaf; no contacts inside the door."""
    p = np.asarray(POSITION)
    hinge_in_frame = np.array([-LEAF_SIZE[0] / 2, 0.0, 0.0])
    pivot_in_leaf = np.asarray(HANDLE_PIVOT) - hinge_in_frame
    _leaf(stage, "/World/Door/Leaf", tuple(p + hinge_in_frame), rough)
    _handle(stage, "/World/Door/Handle", tuple(p + HANDLE_PIVOT), rough)
    leaf = _hinge(stage, "LeafHinge", "Frame", "Leaf", "Z", hinge_in_frame, LEAF_LIMITS)
    author.attribute(leaf, "arena:latch", True, Sdf.ValueTypeNames.Bool)
    # USD angles are degrees: damping and stiffness of a hinge are per degree, friction is a torque.
    author.attribute(leaf, "newton:damping", float(np.deg2rad(LEAF_DAMPING)), Sdf.ValueTypeNames.Float)
    author.attribute(leaf, "newton:friction", LEAF_FRICTION, Sdf.ValueTypeNames.Float)
    handle = _hinge(stage, "HandleHinge", "Leaf", "Handle", "Y", pivot_in_leaf, HANDLE_LIMITS)
    author.attribute(handle, "newton:damping", float(np.deg2rad(HANDLE_DAMPING)), Sdf.ValueTypeNames.Float)
    author.attribute(handle, "newton:armature", 0.001, Sdf.ValueTypeNames.Float)
    drive = UsdPhysics.DriveAPI.Apply(handle, "angular")
    drive.CreateTypeAttr("force")
    drive.CreateTargetPositionAttr(0.0)
    drive.CreateStiffnessAttr(float(np.deg2rad(HANDLE_SPRING)))  # N·m per degree
    drive.CreateDampingAttr(0.0)
    for body, others in (("Leaf", ("Frame", "Handle")), ("Handle", ("Frame",))):
        pairs = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(f"/World/Door/{body}"))
        pairs.CreateFilteredPairsRel().SetTargets([f"/World/Door/{name}" for name in others])


def _back_room(stage: Usd.Stage) -> None:
    """Behind the partition: a dark pit with a hazard stripe (drawn only)."""
    dark = author.material(stage, "/World/Looks/Pit", (0.02, 0.02, 0.02))
    hazard = author.material(stage, "/World/Looks/Hazard", (0.8, 0.7, 0.1), texture="../textures/hazard.png")
    author.quad(stage, "/World/Pit", 1.0, 0.45, (-0.55, 4.45, 0.003), look=dark)
    author.quad(stage, "/World/PitStripe", 1.1, 0.06, (-0.55, 3.92, 0.004), repeat=(9, 0.5), look=hazard)
    author.quad(stage, "/World/PitStripeSide", 0.06, 0.5, (-1.62, 4.45, 0.005), repeat=(0.5, 4), look=hazard)


def _on_panels(stage: Usd.Stage, name: str, height: float, out: float, look: Usd.Prim, tile: float) -> None:
    """Draw the partition up to `height` in another look, `out` outside its solids [m]; the header if it is as tall."""
    parts = []
    for panel, ((hx, hy, hz), (x, y, z)) in _panels().items():
        if panel != "Header":
            parts.append(((hx - 0.02, hy + out, height / 2), (x, y, height / 2)))  # ends behind the casing
        elif height >= PARTITION_HEIGHT:
            parts.append(((hx, hy + out, hz), (x, y, z)))
    warehouse.boxes(stage, f"/World/Door/Frame/{name}", parts, look=look, tile=tile)


def _semantic_2(folder: Path) -> None:
    """A barn: straw, dark timber, red boards with white posts, a pale door with green braces, bales."""
    with rooms.held_out(folder, "semantic-2") as stage:
        straw = rooms.look(stage, "Floor", texture="straw")
        rooms.look(stage, "Wall", (0.12, 0.055, 0.03))
        rooms.look(stage, "Skirting", (0.3, 0.28, 0.25))
        for name in ("Panel", "Trim", "Rail"):
            rooms.look(stage, name, (0.75, 0.72, 0.65))
        rooms.look(stage, "Leaf", (0.6, 0.5, 0.34))
        rooms.look(stage, "Chrome", (0.02, 0.02, 0.022), roughness=0.5)
        _on_panels(stage, "Boards", PARTITION_HEIGHT, 0.001, rooms.look(stage, "Boards", texture="barn"), 1.0)
        leaf, frame, y = "/World/Door/Leaf", "/World/Door/Frame", LEAF_SIZE[1] / 2 + 0.006
        rooms.without(stage, f"{leaf}/Mouldings")
        braces = Solids()
        for z in (0.14, 1.1, 2.02):
            braces.box((0.48, y, 0.07), (0.5, 0, z))
        for side in (-1, 1):
            for low, high in ((0.21, 1.03), (1.17, 1.95)):
                start, end = (0.1, side * (y - 0.002), low), (0.9, side * (y - 0.002), high)
                braces.cord(start, end, 0.13, (0, 1, 0))
        braces.write(stage, f"{leaf}/Braces", look=rooms.look(stage, "Braces", (0.02, 0.14, 0.06)))
        bales = [((0.5, 0.24, 0.22), (x, -0.36, z)) for x, z in ((-2.0, 0.22), (-3.1, 0.22), (-2.5, 0.66), (2.2, 0.22))]
        warehouse.boxes(stage, f"{frame}/Bales", bales, look=straw, tile=0.8)


def _semantic_3(folder: Path) -> None:
    """Swimming baths: sandy tiles, pool mosaic, a coral door with a porthole, a white lever, bench and lifebuoy."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "Floor", texture="sandy")
        rooms.look(stage, "Wall", (0.5, 0.72, 0.72))
        rooms.look(stage, "Skirting", (0.02, 0.1, 0.3))
        rooms.look(stage, "Panel", (0.02, 0.1, 0.3))
        rooms.look(stage, "Trim", (0.82, 0.82, 0.8))
        rooms.look(stage, "Rail", (0.02, 0.1, 0.3))
        rooms.look(stage, "Leaf", (0.7, 0.16, 0.1))
        bright = rooms.look(stage, "Chrome", (0.82, 0.82, 0.8), roughness=0.4)
        _on_panels(stage, "Mosaic", PARTITION_HEIGHT, 0.001, rooms.look(stage, "Mosaic", texture="pool"), 1.6)
        leaf, frame, width = "/World/Door/Leaf", "/World/Door/Frame", LEAF_SIZE[1]
        rooms.without(stage, f"{leaf}/Mouldings")
        pane = rooms.look(stage, "Pane", (0.03, 0.2, 0.3), roughness=0.2)
        for name, radius, depth, look in (("Rim", 0.19, width + 0.01, bright), ("Pane", 0.15, width + 0.014, pane)):
            author.cylinder(stage, f"{leaf}/{name}", radius, depth, (0.5, 0, 1.55), axis="Y", collide=False, look=look)
        kick = [((0.47, width / 2 + 0.002, 0.14), (0.5, 0, 0.18))]
        warehouse.boxes(stage, f"{leaf}/Kick", kick, look=bright)
        seat = [((0.6, 0.18, 0.03), (-1.9, -0.34, 0.42))]
        seat += [((0.03, 0.15, 0.195), (x, -0.34, 0.195)) for x in (-2.3, -1.5)]
        warehouse.boxes(stage, f"{frame}/Bench", seat, look=rooms.look(stage, "Bench", (0.75, 0.55, 0.3)))
        r = float(np.sqrt(0.5))
        author.xform(stage, f"{frame}/Lifebuoy", (1.5, -0.08, 1.3), (r, r, 0, 0))
        buoy = rooms.look(stage, "Lifebuoy", (0.85, 0.2, 0.02))
        Solids().ring(0.17, 0.32, (0, 0, 0)).write(stage, f"{frame}/Lifebuoy/Ring", look=buoy)
        bands = Solids()
        for turn in np.arange(4) * np.pi / 2:
            centre = (0.245 * np.cos(turn), 0.245 * np.sin(turn), 0)
            bands.box((0.08, 0.04, 0.004), centre, yaw=float(turn))
        bands.write(stage, f"{frame}/Lifebuoy/Bands", look=bright)


def build(folder: Path) -> None:
    """Write `scene.usda` and `variants/semantic.usda` into `folder`."""
    stage = rooms.task_stage(folder, TASK, eye=(0.26556, 1.33827, 3.77471), gaze=(0.6811, 0.21343, 0.20944, 0.66834))
    rough = author.physics_material(stage, "/World/Looks/Rough")
    warehouse.room_looks(stage)
    warehouse.room(stage, rough)
    _back_room(stage)
    author.fixture(stage, "/World/Door", POSITION)
    _partition(stage, "/World/Door/Frame", rough)
    author.marker(stage, "/World/Door/Frame/Doorway", DOORWAY, (0, 0, DOORWAY[2] / 2))
    _chain(stage, rough)
    with rooms.edit(stage, "base"):
        _tan_leaf(stage, "/World/Door/Leaf")
    with rooms.edit(stage, "semantic"):
        _blue_leaf(stage, "/World/Door/Leaf")
    rooms.save(stage, folder)
    _semantic_2(folder)
    _semantic_3(folder)
