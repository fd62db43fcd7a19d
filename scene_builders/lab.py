"""Author of the lab: the open floor on which trackers are trained and measured. No task of the benchmark uses it.

Seat, sill and platform are fixtures parked under the floor; to use one, pose its `Frame`, whose origin is
the centre of the box's top face, so that a support's height is the z of its pose. Each box is taller than any support
it plays: what is too much sinks into the floor, with which fixtures do not collide.
"""

from collections.abc import Sequence
from pathlib import Path

from pxr import Usd

from arena_newton.robot.g1 import SPAWN_HEIGHT
from scene_builders import author, rooms
from scene_builders.football import BALL_MASS, BALL_RADIUS, ball

__all__ = ["BALL_PARKED", "PARKED", "SUPPORTS", "build"]

SUPPORTS: dict[str, tuple[float, float, float]] = {
    "Seat": (0.5, 0.6, 0.6),
    "Sill": (0.1, 1.4, 0.4),
    "Platform": (1.0, 1.4, 0.4),
}
"""Name to length (x), width (y) and height of the box [m]."""
PARKED: dict[str, tuple[float, float, float]] = {
    "Seat": (0.0, 0.0, -4.0),
    "Sill": (0.0, 0.0, -5.0),
    "Platform": (0.0, 0.0, -6.0),
}
"""Parking positions of the fixtures [m]: out of reach of a robot on the floor."""
BALL_PARKED = (0.0, 40.0, BALL_RADIUS)
"""Parking position of the ball of variant `ball` until it is used [m]."""


def _support(stage: Usd.Stage, name: str, size: Sequence[float], surface: Usd.Prim, look: Usd.Prim) -> None:
    frame = str(author.fixture(stage, f"/World/{name}", PARKED[name]).GetPath())
    half = [0.5 * side for side in size]
    author.box(stage, f"{frame}/Box", half, (0.0, 0.0, -half[2]), surface=surface, look=look)


def build(folder: Path) -> None:
    """Write `scene.usda` into `folder`."""
    stage = rooms.scene_stage(
        folder,
        (0.0, 0.0, SPAWN_HEIGHT),
        (1.0, 0.0, 0.0, 0.0),
        # From the robot's right, looking across its path at the height of its waist.
        eye=(1.0, -3.4, 1.3),
        gaze=(0.7644, 0.64208, 0.03764, 0.04481),
        variants=("base", "ball"),
    )
    concrete = author.material(stage, "/World/Looks/concrete", texture="../textures/concrete.png")
    author.bind(rooms.floor(stage, (20.0, 20.0), (0.0, 0.0), tile=2.0), concrete)
    surface = author.physics_material(stage, "/World/Looks/SupportSurface")
    wood = author.material(stage, "/World/Looks/wood", texture="../textures/wood.png")
    for name, size in SUPPORTS.items():
        _support(stage, name, size, surface, wood)
    leather = author.material(stage, "/World/Looks/football", texture="../textures/football.png")
    with rooms.edit(stage, "ball"):
        ball(stage, "/World/Ball", BALL_PARKED, BALL_RADIUS, BALL_MASS, leather)
    stage.Save()
