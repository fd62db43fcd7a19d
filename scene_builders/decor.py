"""Furniture of held-out looks: drawn things that stand aside of every task, touched by nothing."""

from pxr import Usd

from scene_builders import author, rooms, warehouse
from scene_builders.author import Vec
from scene_builders.solids import Solids

__all__ = ["dado", "parasol", "stool", "topiary"]


def dado(stage: Usd.Stage, path: str, low: Vec, high: Vec, height: float, *, look: Usd.Prim, tile: float = 1.0) -> None:
    """Panelling, tiles or mats along the walls of the room `low`…`high` (x, y) up to `height`, 1 cm before them [m]."""
    (x0, y0), (x1, y1), t, h = low, high, 0.005, height / 2
    parts = [(((x1 - x0) / 2, t, h), ((x0 + x1) / 2, y, h)) for y in (y0 + t, y1 - t)]
    parts += [((t, (y1 - y0) / 2, h), (x, (y0 + y1) / 2, h)) for x in (x0 + t, x1 - t)]
    warehouse.boxes(stage, path, parts, look=look, tile=tile)


def parasol(stage: Usd.Stage, path: str, position: Vec, color: Vec) -> None:
    """A sunshade on a pole in a heavy foot."""
    author.xform(stage, path, position)
    pole = Solids().tube((0, 0, 0), (0, 0, 2.2), 0.025).tube((0, 0, 0), (0, 0, 0.12), 0.3, taper=0.5)
    pole.write(stage, f"{path}/Pole", look=rooms.look(stage, "ParasolPole", (0.8, 0.78, 0.7)))
    roof = Solids().tube((0, 0, 1.75), (0, 0, 2.2), 1.1, taper=0.02, sides=8)
    roof.write(stage, f"{path}/Roof", look=rooms.look(stage, f"{path.rpartition('/')[2]}Roof", color))


def stool(stage: Usd.Stage, path: str, positions: list[Vec], *, seat: Vec, legs: Vec) -> None:
    """Round stools on four splayed legs, in the colours of seats and legs, linear RGB."""
    seats, bars = Solids(), Solids()
    for x, y in positions:
        seats.tube((x, y, 0.44), (x, y, 0.48), 0.17, sides=16).ring(0.0, 0.17, (x, y, 0.48))
        for sx, sy in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
            bars.tube((x + 0.16 * sx, y + 0.16 * sy, 0), (x + 0.09 * sx, y + 0.09 * sy, 0.44), 0.015, sides=6)
    seats.write(stage, f"{path}Seats", look=rooms.look(stage, "StoolSeat", seat))
    bars.write(stage, f"{path}Legs", look=rooms.look(stage, "StoolLegs", legs))


def topiary(stage: Usd.Stage, path: str, position: Vec, height: float, *, crown: Usd.Prim) -> None:
    """A tree clipped to a ball in a square tub, `height` [m] tall."""
    author.xform(stage, path, position)
    tub = Solids().box((0.16 * height, 0.16 * height, 0.14 * height), (0, 0, 0.14 * height))
    tub.write(stage, f"{path}/Tub", look=rooms.look(stage, "Tub", (0.42, 0.14, 0.06)))
    trunk = Solids().tube((0, 0, 0.2 * height), (0, 0, 0.7 * height), 0.025 * height)
    trunk.write(stage, f"{path}/Trunk", look=rooms.look(stage, "Trunk", (0.16, 0.09, 0.04)))
    author.xform(stage, f"{path}/Top", (0, 0, 0.78 * height))
    Solids().ball(0.22 * height).write(stage, f"{path}/Top/Crown", look=crown)
