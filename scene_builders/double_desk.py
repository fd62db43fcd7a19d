"""Author of the two-desk scene: two benches, the sill between them, hammer and crate in a dark hall.

Positions are the original's where its code gives them and measured in its clips otherwise (±3–5 cm); the hammer is the
one that was measured to be graspable with the Dex3 hand.
"""

from pathlib import Path

import numpy as np
from pxr import Usd

from arena_newton.tasks.double_desk import TASK
from scene_builders import author, decor, rooms
from scene_builders.solids import Solids

__all__ = ["build"]

STIFF = (0.01, 1.0)
"""solref of hammer and benches [s, 1]: with MuJoCo's default the grasp penetrates 3–5 mm."""
HANDLE_RADIUS, HANDLE_LENGTH, HANDLE_MASS = 0.0165, 0.30, 0.13
HEAD_HALF, HEAD_MASS = (0.05, 0.015, 0.015), 0.22
"""Head: 0.10 m across the handle, 0.03 m along it and 0.03 m high, flush with the handle's end."""
DESKS = {"RightDesk": ((-3.8, -3.68), (-1.35, -2.93)), "LeftDesk": ((-3.9, -0.40), (-1.41, 0.33))}
"""Lower and upper corner (x, y) of each bench [m]."""
ROOM_LOW, ROOM_HIGH = (-5.6, -6.0), (2.0, 2.4)
CRATE_HALF_X, CRATE_HALF_Y, CRATE_HEIGHT, PLATE = 0.3007, 0.2009, 0.17, 0.012
"""Outer half sizes, height and plate thickness of the crate [m] (thickness: our choice)."""


def hammer_inertia() -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass [m] and diagonal inertia about it [kg·m²], handle along y, uniform capsule and box."""
    cylinder = HANDLE_LENGTH - 2 * HANDLE_RADIUS
    r, m = HANDLE_RADIUS, HANDLE_MASS
    fraction = cylinder / (cylinder + 4 / 3 * r)
    tube, caps = m * fraction, m * (1 - fraction)
    along = tube * r**2 / 2 + caps * 0.4 * r**2
    across = tube * (cylinder**2 / 12 + r**2 / 4) + caps * (0.4 * r**2 + cylinder**2 / 4 + 3 / 8 * cylinder * r)
    handle = np.array([across, along, across])
    a, b, c = 2 * np.asarray(HEAD_HALF)
    head = HEAD_MASS / 12 * np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2])
    head_y = HANDLE_LENGTH / 2 - HEAD_HALF[1]
    com_y = HEAD_MASS * head_y / (HANDLE_MASS + HEAD_MASS)
    shift = np.array([1.0, 0.0, 1.0]) * (HANDLE_MASS * com_y**2 + HEAD_MASS * (head_y - com_y) ** 2)
    return np.array([0.0, com_y, 0.0]), handle + head + shift


def hammer(stage: Usd.Stage) -> None:
    """The hammer: origin in the middle of the handle, handle along y, head at +y; along world x by default."""
    com, inertia = hammer_inertia()
    author.rigid_body(
        stage,
        "/World/Hammer",
        # The original's x, y and orientation, at the height where it rests.
        (-3.13704, -3.00979, rooms.BENCH_TOP + HANDLE_RADIUS + 0.001),
        (0.7139051, 0, 0, -0.7002425),
        mass=HANDLE_MASS + HEAD_MASS,
        inertia=inertia,
        com=com,
    )
    surface = author.physics_material(stage, "/World/Looks/HammerSurface")
    yellow = author.material(stage, "/World/Looks/handle", (0.62, 0.38, 0.10))
    iron = author.material(stage, "/World/Looks/iron", (0.10, 0.10, 0.11), metallic=0.8, roughness=0.4)
    straight, end = HANDLE_LENGTH - 2 * HANDLE_RADIUS, (0, HANDLE_LENGTH / 2 - HEAD_HALF[1], 0)
    path = "/World/Hammer"
    handle = author.capsule(stage, f"{path}/Handle", HANDLE_RADIUS, straight, axis="Y", look=yellow, surface=surface)
    head = author.box(stage, f"{path}/Head", HEAD_HALF, end, look=iron, surface=surface)
    for geom in (handle, head):
        rooms.contact(geom, solref=STIFF, condim=3)


def plates() -> dict[str, tuple[author.Vec, author.Vec]]:
    """Half sizes and centres of the crate's five plates [m]."""
    hx, hy, h, t = CRATE_HALF_X, CRATE_HALF_Y, CRATE_HEIGHT, PLATE
    return {
        "Bottom": ((hx, hy, t / 2), (0, 0, t / 2)),
        **{name: ((t / 2, hy, h / 2), (sx * (hx - t / 2), 0, h / 2)) for name, sx in (("Left", -1), ("Right", 1))},
        **{name: ((hx - t, t / 2, h / 2), (0, sy * (hy - t / 2), h / 2)) for name, sy in (("Near", -1), ("Far", 1))},
    }


def crate(stage: Usd.Stage) -> None:
    """The crate: four walls and a bottom, open above; origin in the middle of its underside."""
    author.fixture(stage, "/World/Basket", (-2.8, -0.1, rooms.BENCH_TOP))
    hx, hy, h = CRATE_HALF_X, CRATE_HALF_Y, CRATE_HEIGHT
    plastic = author.material(stage, "/World/Looks/crate", (0.16, 0.17, 0.18))
    frame = "/World/Basket/Frame"
    for name, (half, centre) in plates().items():
        author.box(stage, f"{frame}/{name}", half, centre, look=plastic)
    trim = Solids()
    for sy in (-1, 1):
        trim.box((hx + 0.008, 0.008, 0.012), (0, sy * hy, h - 0.012))
        for x in np.linspace(-0.24, 0.24, 5):
            trim.box((0.012, 0.004, h / 2 - 0.03), (x, sy * (hy + 0.004), h / 2))
    for sx in (-1, 1):
        trim.box((0.008, hy + 0.008, 0.012), (sx * hx, 0, h - 0.012))
        trim.box((0.005, 0.06, 0.014), (sx * (hx + 0.005), 0, h - 0.06))
    trim.write(stage, f"{frame}/Trim", look=author.material(stage, "/World/Looks/crate_trim", (0.38, 0.39, 0.40)))
    author.marker(stage, f"{frame}/Inside", (2 * hx, 2 * hy, h), (0, 0, h / 2))


def _hammer_looks(
    stage: Usd.Stage, handle: author.Vec, head: author.Vec, grip: author.Vec, spans: list[tuple[float, float]]
) -> None:
    """Colours of handle, head and grip, linear RGB; the grip is drawn around `spans` of the handle, along y [m]."""
    rooms.look(stage, "handle", handle)
    rooms.look(stage, "iron", head, roughness=0.4)
    sleeve = Solids()
    for low, high in spans:
        sleeve.tube((0, low, 0), (0, high, 0), HANDLE_RADIUS + 0.0005, sides=24)
    sleeve.write(stage, "/World/Hammer/Grip", look=rooms.look(stage, "grip", grip))


def _semantic_2(folder: Path) -> None:
    """A garage: checked floor, corrugated walls, chipboard on yellow legs, red basket, blue hammer, tyres and drums."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.look(stage, "concrete", texture="checks")
        rooms.look(stage, "charcoal", texture="sheet")
        rooms.look(stage, "glass", (0.1, 0.16, 0.25))
        rooms.look(stage, "bench_steel", (0.75, 0.46, 0.02))
        rooms.look(stage, "sill", (0.1, 0.1, 0.11))
        rooms.look(stage, "crate", (0.6, 0.05, 0.03))
        rooms.look(stage, "crate_trim", (0.04, 0.04, 0.05))
        spans = [(y - 0.012, y + 0.012) for y in (-0.12, -0.07)]
        _hammer_looks(stage, (0.02, 0.09, 0.5), (0.5, 0.51, 0.53), (0.02, 0.02, 0.02), spans)
        board = rooms.look(stage, "chipboard", texture="chipboard")
        for name, corners in DESKS.items():
            rooms.bench_cover(stage, f"/World/{name}", *corners, look=board, tile=0.8)
        tyres, drums = Solids(), Solids()
        for x, y, count in ((1.4, -0.7, 3), (1.3, -1.6, 2), (1.4, -4.6, 4)):
            for number in range(count):
                z = 0.22 * number
                tyres.tube((x, y, z), (x, y, z + 0.2), 0.33, sides=20).ring(0.17, 0.33, (x, y, z + 0.2))
        for x, y in ((1.5, -2.6), (1.4, 0.9)):
            drums.tube((x, y, 0), (x, y, 0.88), 0.29, sides=20).ring(0.0, 0.29, (x, y, 0.88))
        tyres.write(stage, "/World/Tyres", look=rooms.look(stage, "tyre", (0.025, 0.025, 0.028)))
        drums.write(stage, "/World/Drums", look=rooms.look(stage, "drum", (0.04, 0.3, 0.2)))


def _semantic_3(folder: Path) -> None:
    """A greenhouse: mossy slabs, glass walls, grey slats on dark green legs, pine basket, red hammer, tomato plants."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "concrete", texture="slabs")
        rooms.look(stage, "charcoal", texture="panes")
        rooms.look(stage, "glass", (0.8, 0.9, 0.95))
        rooms.look(stage, "bench_steel", (0.02, 0.13, 0.06))
        rooms.look(stage, "sill", (0.45, 0.16, 0.08))
        rooms.look(stage, "crate", (0.6, 0.38, 0.17))
        rooms.look(stage, "crate_trim", (0.3, 0.15, 0.05))
        _hammer_looks(stage, (0.55, 0.03, 0.03), (0.05, 0.05, 0.06), (0.85, 0.82, 0.7), [(-0.14, -0.05)])
        slats = rooms.look(stage, "slats", texture="slats")
        for name, corners in DESKS.items():
            rooms.bench_cover(stage, f"/World/{name}", *corners, look=slats, tile=0.8)
        tomato = rooms.look(stage, "tomato", texture="tomato")
        for number, y in enumerate((-4.8, -3.7, -2.6, -1.2, -0.2, 0.9)):
            decor.topiary(stage, f"/World/Plant_{number}", (1.5, y, 0), 1.2 + 0.3 * (number % 2), crown=tomato)


def build(folder: Path) -> None:
    """Write `scene.usda` and `variants/` into `folder`."""
    stage = rooms.task_stage(folder, TASK, eye=(-0.55955, -2.63763, 2.16241), gaze=(0.70287, 0.42371, 0.29498, 0.48932))
    looks = rooms.workshop(stage, low=ROOM_LOW, high=ROOM_HIGH, windows=[("+y", -3.4, 1.6, 0.3)])
    for name, corners in DESKS.items():
        rooms.bench(stage, f"/World/{name}", *corners, solref=STIFF)
    # The low step between the desks, from the back wall past the benches; measured 0.05–0.09 m high.
    pale = author.material(stage, "/World/Looks/sill", (0.7, 0.7, 0.68))
    author.box(stage, "/World/Sill", (3.05, 0.0475, 0.035), (-2.55, -1.5225, 0.035), look=pale)
    hammer(stage)
    crate(stage)
    for variant, bindings in looks.items():
        rooms.bind_in(stage, variant, bindings)
    rooms.save(stage, folder)
    _semantic_2(folder)
    _semantic_3(folder)
