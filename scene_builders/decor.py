"""Furniture of held-out looks: drawn things that stand aside of every task, touched by nothing."""

from pxr import Usd

from scene_builders import author, rooms
from scene_builders.author import Vec
from scene_builders.solids import Solids

__all__ = ["conifer", "topiary"]


def conifer(stage: Usd.Stage, path: str, position: Vec, height: float, *, needles: Vec) -> None:
    """A fir of three tiers, `height` [m] tall; colour of its needles, linear RGB."""
    author.xform(stage, path, position)
    trunk = Solids().tube((0, 0, 0), (0, 0, 0.3 * height), 0.04 * height)
    trunk.write(stage, f"{path}/Trunk", look=rooms.look(stage, "Trunk", (0.14, 0.07, 0.03)))
    crown = Solids()
    for low, top, radius in ((0.14, 0.55, 0.3), (0.38, 0.78, 0.23), (0.62, 1.0, 0.16)):
        crown.tube((0, 0, low * height), (0, 0, top * height), radius * height, taper=0.02, sides=12)
    crown.write(stage, f"{path}/Crown", look=rooms.look(stage, "Needles", needles))


def topiary(stage: Usd.Stage, path: str, position: Vec, height: float, *, crown: Usd.Prim) -> None:
    """A bush in a square tub, `height` [m] tall."""
    author.xform(stage, path, position)
    tub = Solids().box((0.16 * height, 0.16 * height, 0.14 * height), (0, 0, 0.14 * height))
    tub.write(stage, f"{path}/Tub", look=rooms.look(stage, "Tub", (0.42, 0.14, 0.06)))
    trunk = Solids().tube((0, 0, 0.2 * height), (0, 0, 0.7 * height), 0.025 * height)
    trunk.write(stage, f"{path}/Trunk", look=rooms.look(stage, "Trunk", (0.16, 0.09, 0.04)))
    author.xform(stage, f"{path}/Top", (0, 0, 0.78 * height))
    Solids().ball(0.22 * height).write(stage, f"{path}/Top/Crown", look=crown)
