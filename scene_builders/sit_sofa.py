"""Author SitSofa: a living room with carpet, sofa, coffee table and two light cartons on the path.

Sofa, table and carton sizes: spec of the original (measured on its clips). The seat is stiff (solref 0.02 s,
friction 1): experts sit on it as well as on a soft one, and it is cheaper to simulate.
"""

from pathlib import Path

import numpy as np
from pxr import Usd

from arena_newton.tasks.sit_sofa import TASK
from scene_builders import author, decor, rooms, warehouse
from scene_builders.solids import Solids

SOFA_X = (-4.34, -2.28)
SOFA_Y = (-1.65, -0.83)
SEAT_X = (-4.17, -2.38)
SEAT_Y = (-1.30, -0.83)
SEAT_Z = (0.30, 0.42)
ARM_Z = 0.59
BACK_Z = 0.85
TABLE_X = (-3.87, -2.54)
TABLE_Y = (-0.24, 0.48)
TABLE_Z = 0.30
CARTON_EDGE = 0.42
CARTON_MASS = 0.05
CARTONS = {"Carton_1": (-1.45, -0.68, 0.31), "Carton_2": (-1.35, 0.06, 0.31)}
"""Centres before the first draw: the original puts undersides at z 0.10 m, and the cartons drop."""


def _span(x: author.Vec, y: author.Vec, z: author.Vec) -> tuple[author.Vec, author.Vec]:
    """Half sizes and centre of the box between the bounds."""
    low, high = np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])
    return tuple((high - low) / 2), tuple((high + low) / 2)


def _sofa(stage: Usd.Stage, rough: Usd.Prim) -> None:
    path = "/World/Sofa"
    author.xform(stage, path)
    look = stage.GetPrimAtPath("/World/Looks/Sofa")
    seat = author.box(stage, f"{path}/SeatCushion", *_span(SEAT_X, SEAT_Y, SEAT_Z), visual=False, surface=rough)
    rooms.contact(seat, solref=(0.02, 1.0))
    half, centre = _span(SEAT_X, SEAT_Y, SEAT_Z)
    author.marker(stage, f"{path}/Seat", tuple(2 * h for h in half), centre)
    solids = {
        "Base": _span(SEAT_X, (SOFA_Y[0], SOFA_Y[1] - 0.03), (0.06, SEAT_Z[0])),
        "Back": _span(SEAT_X, (SOFA_Y[0], SEAT_Y[0]), (SEAT_Z[0], BACK_Z)),
        "ArmLeft": _span((SOFA_X[0], SEAT_X[0]), SOFA_Y, (0.06, ARM_Z)),
        "ArmRight": _span((SEAT_X[1], SOFA_X[1]), SOFA_Y, (0.06, ARM_Z)),
    }
    for name, (h, c) in solids.items():
        author.box(stage, f"{path}/{name}", h, c, visual=False, surface=rough)
        if name.startswith("Arm"):
            warehouse.rounded_box(stage, f"{path}/{name}Cover", h, c, radius=0.05, look=look)
    warehouse.rounded_box(stage, f"{path}/BaseCover", *solids["Base"], radius=0.02, look=look)
    warehouse.rounded_box(
        stage,
        f"{path}/BackCover",
        *_span(SEAT_X, (SOFA_Y[0], SOFA_Y[0] + 0.16), (SEAT_Z[0], 0.80)),
        radius=0.05,
        look=look,
    )
    edges = np.linspace(*SEAT_X, 4)
    for i in range(3):
        x = (edges[i] + 0.004, edges[i + 1] - 0.004)
        warehouse.rounded_box(stage, f"{path}/SeatCover_{i}", *_span(x, SEAT_Y, SEAT_Z), radius=0.04, look=look)
        warehouse.rounded_box(
            stage,
            f"{path}/BackCover_{i}",
            *_span(x, (SOFA_Y[0] + 0.15, SEAT_Y[0]), (SEAT_Z[1] - 0.04, BACK_Z)),
            radius=0.07,
            look=look,
        )
    feet = author.material(stage, "/World/Looks/Feet", (0.08, 0.07, 0.06))
    parts = [((0.03, 0.03, 0.03), (x, y, 0.03)) for x in (-4.26, -2.36) for y in (-1.57, -0.91)]
    warehouse.boxes(stage, f"{path}/Feet", parts, look=feet)


def _table(stage: Usd.Stage, rough: Usd.Prim) -> None:
    path = "/World/CoffeeTable"
    author.xform(stage, path)
    look = stage.GetPrimAtPath("/World/Looks/Table")
    author.box(stage, f"{path}/Solid", *_span(TABLE_X, TABLE_Y, (0.0, TABLE_Z)), visual=False, surface=rough)
    inner = ((TABLE_X[0] + 0.05, TABLE_X[1] - 0.05), (TABLE_Y[0] + 0.05, TABLE_Y[1] - 0.05))
    parts = [
        _span(TABLE_X, TABLE_Y, (TABLE_Z - 0.07, TABLE_Z)),
        _span(*inner, (0.08, TABLE_Z - 0.07)),
        _span(TABLE_X, TABLE_Y, (0.0, 0.08)),
    ]
    warehouse.boxes(stage, f"{path}/Body", parts, look=look)


def _carton(
    stage: Usd.Stage, name: str, position: author.Vec, looks: tuple[Usd.Prim, Usd.Prim], rough: Usd.Prim
) -> None:
    path, half = f"/World/{name}", CARTON_EDGE / 2
    # A thin-walled cube: 5/18 m a².
    inertia = (5.0 / 18.0 * CARTON_MASS * CARTON_EDGE**2,) * 3
    author.rigid_body(stage, path, position, mass=CARTON_MASS, inertia=inertia)
    author.box(stage, f"{path}/Solid", (half,) * 3, visual=False, surface=rough)
    warehouse.boxes(stage, f"{path}/Board", [((half,) * 3, (0, 0, 0))], look=looks[0], tile=CARTON_EDGE)
    tape = [((0.03, half + 0.001, half + 0.001), (0, 0, 0))]
    warehouse.boxes(stage, f"{path}/Tape", tape, look=looks[1])


def _look(stage: Usd.Stage, name: str, color: author.Vec, texture: str | None = None) -> None:
    path = None if texture is None else f"../textures/{texture}.png"
    author.material(stage, f"/World/Looks/{name}", color, texture=path)


def _semantic_2(folder: Path) -> None:
    """A cabin: flagstones, log walls, a tartan sofa on a fleece, a pine table, wrapped presents and a fir."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.look(stage, "Floor", texture="flags")
        rooms.look(stage, "Wall", texture="logs")
        rooms.look(stage, "Skirting", (0.1, 0.045, 0.02))
        rooms.look(stage, "Sofa", texture="tartan")
        rooms.look(stage, "Feet", (0.1, 0.05, 0.02))
        rooms.look(stage, "Table", (0.5, 0.27, 0.1))
        rooms.look(stage, "Cardboard", texture="wrapping")
        rooms.look(stage, "Tape", (0.7, 0.42, 0.05))
        rooms.look(stage, "Carpet", texture="fleece")
        decor.conifer(stage, "/World/Fir", (-1.6, -2.1, 0), 1.9, needles=(0.03, 0.16, 0.07))


def _semantic_3(folder: Path) -> None:
    """A flat by the sea: blue boards, striped walls, a coral sofa with a cushion, sailor's rug, hatboxes and a lamp."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "Floor", texture="deck")
        rooms.look(stage, "Wall", texture="awning")
        rooms.look(stage, "Skirting", (0.85, 0.83, 0.78))
        rooms.look(stage, "Sofa", (0.8, 0.22, 0.13))
        rooms.look(stage, "Feet", (0.6, 0.45, 0.28))
        rooms.look(stage, "Table", (0.02, 0.12, 0.14))
        rooms.look(stage, "Cardboard", texture="hatbox")
        rooms.look(stage, "Tape", (0.5, 0.1, 0.2))
        rug = rooms.look(stage, "Carpet", texture="sailor")
        half, seat = (0.2, 0.07, 0.17), (-3.95, SEAT_Y[0] + 0.08, SEAT_Z[1] + 0.17)
        warehouse.rounded_box(stage, "/World/Sofa/Cushion", half, seat, radius=0.06, look=rug)
        x, y = -1.8, -1.7
        pole = Solids().tube((x, y, 0), (x, y, 1.4), 0.015).tube((x, y, 0), (x, y, 0.03), 0.16, taper=0.8, sides=16)
        pole.write(stage, "/World/LampPole", look=rooms.look(stage, "LampPole", (0.1, 0.09, 0.08)))
        shade = Solids().tube((x, y, 1.25), (x, y, 1.6), 0.24, taper=0.6, sides=16)
        shade.write(stage, "/World/LampShade", look=rooms.look(stage, "LampShade", (0.15, 0.5, 0.45)))


def build(folder: Path) -> None:
    """Write `scene.usda` and `variants/semantic.usda` into `folder`."""
    stage = rooms.task_stage(
        folder, TASK, eye=(-5.00612, 1.22158, 2.27319), gaze=(-0.43051, -0.25339, 0.43941, 0.74657)
    )
    rough = author.physics_material(stage, "/World/Looks/Rough")
    with rooms.edit(stage, "base"):
        warehouse.room_looks(stage)
        _look(stage, "Carpet", (0.30, 0.30, 0.31))
        _look(stage, "Sofa", (0.80, 0.79, 0.77), "fabric")
        _look(stage, "Table", (0.88, 0.88, 0.88))
    with rooms.edit(stage, "semantic"):
        warehouse.room_looks(stage, floor="tiles", wall="brick", skirting=(0.25, 0.16, 0.10))
        _look(stage, "Carpet", (0.5, 0.3, 0.3), "carpet")
        _look(stage, "Sofa", (0.10, 0.19, 0.33))
        _look(stage, "Table", (0.22, 0.12, 0.06))
    warehouse.room(stage, rough)
    author.quad(
        stage, "/World/Carpet", 1.6, 1.25, (-3.25, -0.15, 0.004), repeat=(3.2, 2.5),
        look=stage.GetPrimAtPath("/World/Looks/Carpet"),
    )  # fmt: skip
    _sofa(stage, rough)
    _table(stage, rough)
    board = author.material(stage, "/World/Looks/Cardboard", (0.62, 0.45, 0.28), texture="../textures/cardboard.png")
    tape = author.material(stage, "/World/Looks/Tape", (0.50, 0.36, 0.20))
    for name, position in CARTONS.items():
        _carton(stage, name, position, (board, tape), rough)
    rooms.save(stage, folder)
    _semantic_2(folder)
    _semantic_3(folder)
