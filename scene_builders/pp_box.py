"""Author of the box scene: a table with a light box, and a steel shelf with one empty deck, in a dark hall.

Positions are the original's where its code gives them and measured in its clips otherwise.
"""

from pathlib import Path

from pxr import Usd

from arena_newton.tasks.pp_box import TASK
from scene_builders import author, rooms
from scene_builders.solids import Solids

__all__ = ["build"]

BOX_SIDE, BOX_MASS = 0.21, 0.05
"""Box [m], [kg]."""
TABLE_LOW, TABLE_HIGH = (-0.63, -6.22), (0.10, -3.78)
DECKS = (0.17, 0.67, 1.18, 1.68)
"""Upper surfaces of the decks [m]; the second is the empty one."""
TOP = 2.15
SHELF_HALF_X, SHELF_HALF_Y, PLINTH = 0.985, 0.30, 0.145
"""Half length, half depth and plinth height of the shelf [m]."""
POST, DECK = 0.03, 0.03
"""Half width of an upright and thickness of a deck [m]; our choice."""

# Cartons on the decks: deck, centre x, half sizes (x, y, z) [m]; read off the clips, the empty deck left out.
CARTONS = (
    (0, -0.66, (0.20, 0.20, 0.14)),
    (0, -0.18, (0.22, 0.22, 0.16)),
    (0, 0.30, (0.20, 0.18, 0.11)),
    (0, 0.70, (0.16, 0.20, 0.15)),
    (2, -0.58, (0.24, 0.20, 0.15)),
    (2, 0.02, (0.26, 0.22, 0.13)),
    (2, 0.62, (0.24, 0.20, 0.16)),
    (3, -0.40, (0.22, 0.20, 0.14)),
    (3, 0.06, (0.18, 0.18, 0.10)),
    (3, 0.60, (0.24, 0.20, 0.15)),
)


def carton_box(stage: Usd.Stage, cardboard: Usd.Prim) -> None:
    """The box to move: origin in the middle of its underside, by which the original places it; mass in its centre."""
    half, m = BOX_SIDE / 2, BOX_MASS
    author.rigid_body(
        stage,
        "/World/Box",
        # The middle of the base range, resting on the table.
        (-0.49, -4.775, rooms.BENCH_TOP),
        mass=m,
        inertia=[m * BOX_SIDE**2 / 6] * 3,
        com=(0, 0, half),
    )
    surface = author.physics_material(stage, "/World/Looks/BoxSurface")
    geom = author.box(stage, "/World/Box/Collider", (half, half, half), (0, 0, half), visual=False, surface=surface)
    rooms.contact(geom, condim=3)
    Solids().box((half, half, half), (0, 0, half)).write(stage, "/World/Box/Look", look=cardboard)


def shelf(stage: Usd.Stage, cardboard: Usd.Prim) -> None:
    """Four decks and a top between blue uprights, long side along x; first, third and fourth deck stocked."""
    # The middle of the range of its placement; every episode poses it again.
    author.fixture(stage, "/World/Shelf", (-2.2, -2.9, 0))
    frame = "/World/Shelf/Frame"
    blue = author.material(stage, "/World/Looks/upright", (0.01, 0.05, 0.19))
    black = author.material(stage, "/World/Looks/deck", (0.016, 0.016, 0.018))
    pale = author.material(stage, "/World/Looks/plinth", (0.55, 0.55, 0.54))
    hx, hy = SHELF_HALF_X, SHELF_HALF_Y
    for index, (sx, sy) in enumerate(((-1, -1), (1, -1), (-1, 1), (1, 1))):
        author.box(
            stage,
            f"{frame}/Upright_{index}",
            (POST, POST, TOP / 2),
            (sx * (hx - POST), sy * (hy - POST), TOP / 2),
            look=blue,
        )
    for index, height in enumerate((*DECKS, TOP)):
        name = f"Deck_{index}" if index < len(DECKS) else "Top"
        plate, middle = (hx - 0.005, hy - 0.005, DECK / 2), (0, 0, height - DECK / 2)
        author.box(stage, f"{frame}/{name}_Plate", plate, middle, look=black)
        author.marker(stage, f"{frame}/{name}", tuple(2 * h for h in plate), middle)
    lattice = Solids()
    for sx in (-1, 1):
        for low in (0.25, 0.75, 1.25, 1.75):
            for sy in (-1, 1):
                x, y = sx * (hx - POST), sy * (hy - 2 * POST)
                lattice.tube((x, y, low), (x, -y, low + 0.3), 0.01, sides=6)
    lattice.write(stage, f"{frame}/Lattice", look=blue)
    beams = Solids()
    for height in (*DECKS, TOP):
        for sy in (-1, 1):
            beams.box((hx - 2 * POST, 0.012, 0.035), (0, sy * (hy - 0.018), height - 0.035 - 0.001))
    beams.write(stage, f"{frame}/Beams", look=black)
    feet = Solids()
    for sx in (-1, 1):
        feet.box((POST + 0.02, hy, PLINTH / 4), (sx * (hx - POST), 0, PLINTH / 4))
    feet.write(stage, f"{frame}/Plinth", look=pale)
    stock = Solids()
    for index, (deck, x, half) in enumerate(CARTONS):
        centre = (x, 0.03, DECKS[deck] + half[2])
        stock.box(half, centre)
        author.box(stage, f"{frame}/Carton_{index}", half, centre, visual=False)
    stock.write(stage, f"{frame}/Stock", look=cardboard)


def clutter(stage: Usd.Stage) -> None:
    """More things on the table, along its far edge where the box never is: tins, a tool case, a carton."""
    author.xform(stage, "/World/Clutter", (0, 0, rooms.BENCH_TOP))
    red = author.material(stage, "/World/Looks/tin", (0.55, 0.04, 0.03))
    green = author.material(stage, "/World/Looks/case", (0.03, 0.25, 0.10))
    cardboard = stage.GetPrimAtPath("/World/Looks/cardboard")
    for index, y in enumerate((-5.75, -5.55, -4.15)):
        author.cylinder(stage, f"/World/Clutter/Tin_{index}", 0.05, 0.14, (0.0, y, 0.07), look=red)
    author.box(stage, "/World/Clutter/Case", (0.09, 0.19, 0.07), (-0.01, -4.55, 0.07), look=green)
    author.box(stage, "/World/Clutter/Carton", (0.08, 0.14, 0.10), (0.0, -5.15, 0.10), visual=False)
    Solids().box((0.08, 0.14, 0.10), (0.0, -5.15, 0.10)).write(stage, "/World/Clutter/CartonLook", look=cardboard)


def _on_table(stage: Usd.Stage, things: dict[str, tuple[str, author.Vec, float, author.Vec]]) -> None:
    """Solid things along the table's far edge: name → kind, half sizes [m], y [m] and colour, linear RGB."""
    author.xform(stage, "/World/Clutter", (0, 0, rooms.BENCH_TOP))
    for name, (kind, (hx, hy, hz), y, color) in things.items():
        path, centre, look = f"/World/Clutter/{name}", (0.0, y, hz), rooms.look(stage, name, color)
        if kind == "box":
            author.box(stage, path, (hx, hy, hz), centre, look=look)
        else:
            author.cylinder(stage, path, hx, 2 * hz, centre, look=look)


def _semantic_2(folder: Path) -> None:
    """A pharmacy: terrazzo, walls of drawers, blue table, white and teal shelf of medicine, first-aid box, jars."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.look(stage, "concrete", texture="terrazzo")
        rooms.look(stage, "charcoal", texture="drawers")
        rooms.look(stage, "bench_top", (0.2, 0.42, 0.6))
        rooms.look(stage, "bench_steel", (0.55, 0.57, 0.6))
        rooms.look(stage, "upright", (0.8, 0.8, 0.78))
        rooms.look(stage, "deck", (0.04, 0.3, 0.32))
        rooms.look(stage, "plinth", (0.04, 0.3, 0.32))
        rooms.look(stage, "cardboard", texture="medicine")
        rooms.paint(stage, {"/World/Box/Look": rooms.look(stage, "aid", texture="aid")})
        things: dict[str, tuple[str, author.Vec, float, author.Vec]] = {
            "Jar": ("round", (0.07, 0.07, 0.1), -5.85, (0.3, 0.12, 0.03)),
            "Scales": ("box", (0.08, 0.12, 0.04), -5.4, (0.08, 0.08, 0.09)),
            "Tissues": ("box", (0.06, 0.11, 0.05), -4.95, (0.6, 0.35, 0.5)),
            "Bottle": ("round", (0.045, 0.045, 0.11), -4.5, (0.03, 0.12, 0.4)),
            "Pills": ("round", (0.04, 0.04, 0.06), -4.2, (0.75, 0.28, 0.02)),
        }
        _on_table(stage, things)
        caps = Solids().box((0.07, 0.1, 0.008), (0.0, -5.4, 0.1)).tube((0, -5.4, 0.08), (0, -5.4, 0.095), 0.03)
        for y, radius, z in ((-5.85, 0.074, 0.2), (-4.5, 0.025, 0.22), (-4.2, 0.043, 0.12)):
            caps.tube((0, y, z), (0, y, z + 0.03), radius, sides=16).ring(0.0, radius, (0, y, z + 0.03))
        caps.write(stage, "/World/Clutter/Caps", look=rooms.look(stage, "Caps", (0.85, 0.85, 0.82)))


def _semantic_3(folder: Path) -> None:
    """A brewery: slate, amber tiles, a table of green copper, ochre shelf of blue crates, a pine chest, kegs."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "concrete", texture="slate")
        rooms.look(stage, "charcoal", texture="amber")
        rooms.look(stage, "bench_top", (0.12, 0.38, 0.3))
        rooms.look(stage, "bench_steel", (0.16, 0.06, 0.03))
        rooms.look(stage, "upright", (0.65, 0.4, 0.03))
        rooms.look(stage, "deck", (0.28, 0.1, 0.04))
        rooms.look(stage, "plinth", (0.1, 0.1, 0.1))
        rooms.look(stage, "cardboard", texture="bottles")
        rooms.paint(stage, {"/World/Box/Look": rooms.look(stage, "chest", texture="chest")})
        things: dict[str, tuple[str, author.Vec, float, author.Vec]] = {
            "Keg": ("round", (0.09, 0.09, 0.13), -5.8, (0.55, 0.57, 0.6)),
            "Tray": ("box", (0.08, 0.15, 0.015), -5.35, (0.5, 0.04, 0.04)),
            "Hops": ("box", (0.07, 0.09, 0.08), -4.95, (0.2, 0.35, 0.05)),
            "Bottle": ("round", (0.035, 0.035, 0.09), -4.55, (0.12, 0.04, 0.01)),
            "Mug": ("round", (0.05, 0.05, 0.07), -4.2, (0.8, 0.78, 0.7)),
        }
        _on_table(stage, things)
        dark = Solids().tube((0, -4.55, 0.18), (0, -4.55, 0.28), 0.035, taper=0.4)
        for z in (0.05, 0.2):
            dark.tube((0, -5.8, z), (0, -5.8, z + 0.02), 0.094, sides=20)
        dark.write(stage, "/World/Clutter/Hoops", look=rooms.look(stage, "Hoops", (0.1, 0.04, 0.015)))


def build(folder: Path) -> None:
    """Write `scene.usda` and `variants/` into `folder`."""
    stage = rooms.task_stage(folder, TASK, eye=(0.08792, -4.59362, 2.05127), gaze=(0.63441, 0.29145, 0.29887, 0.65058))
    looks = rooms.workshop(
        stage, low=(-5.6, -8.0), high=(2.0, 2.4), windows=[("-x", -4.2, 2.0, 1.1), ("+y", -3.6, 2.0, 0.3)]
    )
    cardboard = author.material(stage, "/World/Looks/cardboard", texture="../textures/cardboard.png")
    rooms.bench(stage, "/World/Table", TABLE_LOW, TABLE_HIGH)
    carton_box(stage, cardboard)
    shelf(stage, cardboard)
    for variant in ("base", "semantic"):
        rooms.bind_in(stage, variant, looks["base"])
    with rooms.edit(stage, "semantic"):
        clutter(stage)
    rooms.save(stage, folder)
    _semantic_2(folder)
    _semantic_3(folder)
