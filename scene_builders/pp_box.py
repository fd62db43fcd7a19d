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
    """A library: green carpet, walls of books, mahogany table, cream shelf of archive boxes, red box, desk things."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.look(stage, "concrete", texture="felt")
        rooms.look(stage, "charcoal", texture="books")
        rooms.look(stage, "bench_steel", (0.1, 0.035, 0.02))
        rooms.look(stage, "upright", (0.75, 0.68, 0.5))
        rooms.look(stage, "deck", (0.3, 0.16, 0.06))
        rooms.look(stage, "plinth", (0.2, 0.1, 0.04))
        rooms.look(stage, "cardboard", texture="archive")
        rooms.paint(stage, {"/World/Box/Look": rooms.look(stage, "folio", texture="folio")})
        top = rooms.look(stage, "mahogany", texture="mahogany")
        rooms.bench_cover(stage, "/World/Table", TABLE_LOW, TABLE_HIGH, look=top, tile=0.9)
        things: dict[str, tuple[str, author.Vec, float, author.Vec]] = {
            "GlobeFoot": ("round", (0.08, 0.08, 0.03), -5.85, (0.35, 0.2, 0.06)),
            "CardIndex": ("box", (0.08, 0.14, 0.07), -5.45, (0.5, 0.3, 0.12)),
            "PaperTray": ("box", (0.08, 0.11, 0.02), -4.95, (0.85, 0.85, 0.8)),
            "LampFoot": ("round", (0.06, 0.06, 0.12), -4.55, (0.6, 0.42, 0.1)),
            "InkPot": ("round", (0.035, 0.035, 0.04), -4.2, (0.02, 0.03, 0.12)),
        }
        _on_table(stage, things)
        author.xform(stage, "/World/Clutter/Globe", (0.0, -5.85, 0.17))
        Solids().ball(0.11).write(stage, "/World/Clutter/Globe/Ball", look=rooms.look(stage, "Globe", (0.06, 0.3, 0.5)))
        shade = Solids().tube((-0.05, -4.68, 0.29), (-0.05, -4.42, 0.29), 0.07, sides=16)
        shade.write(stage, "/World/Clutter/LampShade", look=rooms.look(stage, "LampShade", (0.03, 0.3, 0.1)))


def _semantic_3(folder: Path) -> None:
    """A toy shop: pastel mats, a sky with clouds, lemon table, red and white shelf of dotted boxes, box with a star."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "concrete", texture="puzzle")
        rooms.look(stage, "charcoal", texture="clouds")
        rooms.look(stage, "bench_top", (0.85, 0.72, 0.12))
        rooms.look(stage, "bench_steel", (0.75, 0.75, 0.74))
        rooms.look(stage, "upright", (0.62, 0.03, 0.04))
        rooms.look(stage, "deck", (0.8, 0.8, 0.78))
        rooms.look(stage, "plinth", (0.62, 0.03, 0.04))
        rooms.look(stage, "cardboard", texture="dots")
        rooms.paint(stage, {"/World/Box/Look": rooms.look(stage, "star", texture="star")})
        things: dict[str, tuple[str, author.Vec, float, author.Vec]] = {
            "Drum": ("round", (0.085, 0.085, 0.07), -5.85, (0.65, 0.04, 0.05)),
            "Engine": ("box", (0.05, 0.12, 0.05), -5.45, (0.03, 0.2, 0.5)),
            "Blocks": ("box", (0.07, 0.07, 0.07), -5.05, (0.1, 0.45, 0.12)),
            "Tower": ("round", (0.06, 0.06, 0.11), -4.55, (0.75, 0.3, 0.03)),
            "Tin": ("box", (0.06, 0.09, 0.05), -4.15, (0.45, 0.1, 0.45)),
        }
        _on_table(stage, things)
        white = Solids().box((0.045, 0.045, 0.045), (0.0, -5.05, 0.185), yaw=0.5)
        white.tube((0.0, -5.38, 0.1), (0.0, -5.38, 0.17), 0.025).tube((0.0, -5.85, 0.06), (0.0, -5.85, 0.08), 0.088)
        white.write(stage, "/World/Clutter/Trim", look=rooms.look(stage, "Trim", (0.85, 0.8, 0.65)))


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
