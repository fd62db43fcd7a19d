"""Author of the box scene: a table with a light box, and a steel shelf with one empty deck, in a dark hall.

Positions are the original's where its code gives them and measured in its clips otherwise.
"""

from pathlib import Path

from pxr import Usd

from arena_newton.tasks.pp_box import TASK
from scene_builders import author, decor, rooms, warehouse
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


def _semantic_2(folder: Path) -> None:
    """A mail room: granulate floor, teal walls, wooden table, blue parcel among books, bottles and a red tray."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.look(stage, "concrete", texture="rubber")
        rooms.look(stage, "charcoal", (0.05, 0.2, 0.2))
        rooms.look(stage, "bench_top", (0.48, 0.3, 0.15))
        rooms.look(stage, "upright", (0.7, 0.2, 0.02))
        rooms.look(stage, "deck", (0.3, 0.3, 0.31))
        rooms.look(stage, "cardboard", texture="crate")
        rooms.paint(stage, {"/World/Box/Look": rooms.look(stage, "parcel", texture="parcel")})
        author.xform(stage, "/World/Clutter", (0, 0, rooms.BENCH_TOP))
        green = rooms.look(stage, "bottle", (0.02, 0.22, 0.08), roughness=0.2)
        for index, y in enumerate((-5.9, -5.7, -4.1)):
            author.cylinder(stage, f"/World/Clutter/Bottle_{index}", 0.04, 0.2, (0.0, y, 0.1), look=green)
        author.box(stage, "/World/Clutter/Books", (0.08, 0.13, 0.06), (0.0, -4.5, 0.06), visual=False)
        for index, color in enumerate(((0.55, 0.1, 0.1), (0.8, 0.7, 0.5), (0.1, 0.15, 0.4))):
            book = [((0.08 - 0.006 * index, 0.13 - 0.01 * index, 0.019), (0.0, -4.5, 0.02 + 0.04 * index))]
            warehouse.boxes(stage, f"/World/Clutter/Book_{index}", book, look=rooms.look(stage, f"book_{index}", color))
        tray = rooms.look(stage, "tray", (0.6, 0.05, 0.05))
        author.box(stage, "/World/Clutter/Tray", (0.08, 0.16, 0.03), (0.0, -5.2, 0.03), look=tray)


def _semantic_3(folder: Path) -> None:
    """A shop: paved floor, painted walls, pale table, wrapped gift among pots of plants, a bowl and a bread bin."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "concrete", texture="pavers")
        rooms.look(stage, "charcoal", texture="mural")
        rooms.look(stage, "bench_top", (0.62, 0.66, 0.6))
        rooms.look(stage, "bench_steel", (0.2, 0.05, 0.1))
        rooms.look(stage, "upright", (0.04, 0.2, 0.1))
        rooms.look(stage, "deck", (0.45, 0.3, 0.16))
        rooms.look(stage, "cardboard", texture="quilt")
        rooms.paint(stage, {"/World/Box/Look": rooms.look(stage, "gift", texture="gift")})
        author.xform(stage, "/World/Clutter", (0, 0, rooms.BENCH_TOP))
        for index, y in enumerate((-5.85, -4.05)):
            author.cylinder(stage, f"/World/Clutter/Pot_{index}", 0.05, 0.1, (0.0, y, 0.05), visual=False)
            decor.plant(stage, f"/World/Clutter/Plant_{index}", (0.0, y, 0.0), 0.3)
        bowl = rooms.look(stage, "bowl", (0.08, 0.3, 0.5), roughness=0.3)
        author.cylinder(stage, "/World/Clutter/Bowl", 0.09, 0.05, (0.0, -5.4, 0.025), look=bowl)
        tin = rooms.look(stage, "bread_bin", (0.75, 0.6, 0.2))
        author.box(stage, "/World/Clutter/BreadBin", (0.07, 0.15, 0.08), (0.0, -4.5, 0.08), look=tin)
        jar = rooms.look(stage, "jar", (0.75, 0.75, 0.78))
        author.cylinder(stage, "/World/Clutter/Jar", 0.05, 0.16, (0.0, -5.1, 0.08), look=jar)


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
