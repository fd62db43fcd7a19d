"""Furniture of held-out looks: drawn things that stand aside of every task, touched by nothing."""

import numpy as np
from pxr import Usd

from scene_builders import author, rooms
from scene_builders.author import Vec
from scene_builders.solids import Solids

__all__ = ["cones", "lamp", "plant"]


def plant(stage: Usd.Stage, path: str, position: Vec, height: float = 1.0) -> None:
    """A pot with arched leaves, `height` [m] tall, on the floor or table at `position`."""
    author.xform(stage, path, position)
    pot = Solids().tube((0, 0, 0), (0, 0, 0.3 * height), 0.12 * height, taper=1.4)
    pot.write(stage, f"{path}/Pot", look=rooms.look(stage, "Pot", (0.5, 0.2, 0.12)))
    leaves = Solids()
    for number, angle in enumerate(np.arange(12) * 2.4):
        out, top = np.array([np.cos(angle), np.sin(angle), 0.0]), (0.6 + 0.4 * (number % 3) / 2) * height
        knee = 0.12 * height * out + (0, 0, 0.8 * top)
        side = np.array([-out[1], out[0], 0.0])
        leaves.cord((0, 0, 0.28 * height), knee, 0.05 * height, np.cross(side, knee))
        leaves.cord(knee, 0.35 * height * out + (0, 0, top), 0.08 * height, (0, 0, 1))
    leaves.write(stage, f"{path}/Leaves", look=rooms.look(stage, "Leaves", (0.05, 0.24, 0.07)))


def lamp(stage: Usd.Stage, path: str, position: Vec) -> None:
    """A standing lamp with a wide shade."""
    author.xform(stage, path, position)
    stand = Solids().box((0.14, 0.14, 0.015), (0, 0, 0.015)).tube((0, 0, 0), (0, 0, 1.4), 0.015)
    stand.write(stage, f"{path}/Stand", look=rooms.look(stage, "LampStand", (0.04, 0.04, 0.04)))
    shade = Solids().tube((0, 0, 1.3), (0, 0, 1.65), 0.24, taper=0.6, sides=16)
    shade.write(stage, f"{path}/Shade", look=rooms.look(stage, "LampShade", (0.85, 0.62, 0.3)))


def cones(stage: Usd.Stage, path: str, positions: list[Vec], height: float = 0.6) -> None:
    """Orange traffic cones with a white collar, `height` [m] tall."""
    orange, white = Solids(), Solids()
    for position in positions:
        foot = np.asarray(position, dtype=float)

        def cone(
            low: float, high: float, swell: float, foot: np.ndarray = foot
        ) -> tuple[np.ndarray, np.ndarray, float, float]:
            wide, narrow = (0.24 * (1 - z) * height + 0.02 + swell for z in (low, high))
            return foot + (0, 0, low * height), foot + (0, 0, high * height), wide, narrow / wide

        orange.box((0.15, 0.15, 0.01), foot + (0, 0, 0.012))
        for solids, span, swell in ((orange, (0.0, 1.0), 0.0), (white, (0.4, 0.65), 0.003)):
            start, end, radius, taper = cone(*span, swell)
            solids.tube(start, end, radius, taper=taper, sides=16)
    orange.write(stage, f"{path}Body", look=rooms.look(stage, "Cone", (0.85, 0.18, 0.02)))
    white.write(stage, f"{path}Collar", look=rooms.look(stage, "ConeCollar", (0.9, 0.9, 0.9)))
