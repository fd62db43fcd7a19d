"""Author Boxing: two bags on posts and the small green target at one of them.

Bag size, heights and positions, post offset and hook height: spec of the original (measured on its clips). Bags are
static, as the rule needs no contact and no force.
"""

from pathlib import Path

import numpy as np
from pxr import Usd

from arena_newton.tasks.base import ROOM
from arena_newton.tasks.boxing import TASK
from scene_builders import author, decor, rooms, warehouse
from scene_builders.solids import Solids

BAG_RADIUS = 0.155
BAG_Z = (0.40, 1.34)
HOOK_Z = 1.53
POST_BEHIND = 0.5
BAGS = {"Bag_1": (-0.97, -3.7), "Bag_2": (-3.0, -3.7)}
TARGET_POSITION = (-0.97, -3.55, 0.8)
"""Position before the first draw: on the robot's side of bag 1."""
TARGET_RADIUS = 0.05
SEMANTIC_EDGE = 2 * TARGET_RADIUS
"""Edge of the cube that stands in for the sphere [m]: the paper's "green cube of equal bounding extent"."""


def _bag(stage: Usd.Stage, name: str, centre: author.Vec, skin: Usd.Prim, metal: Usd.Prim, rough: Usd.Prim) -> None:
    path, (x, y) = f"/World/{name}", centre
    author.xform(stage, path, (x, y, 0.0))
    low, high = BAG_Z
    middle, length = (low + high) / 2, high - low
    # A capsule of the same height: exact over the target's heights (0.65-0.95 m), and cheap against every robot shape.
    author.capsule(
        stage, f"{path}/Collider", BAG_RADIUS, length - 2 * BAG_RADIUS, (0, 0, middle), visual=False, surface=rough
    )
    author.cylinder(stage, f"{path}/Skin", BAG_RADIUS, length, (0, 0, middle), collide=False, look=skin)
    for i, z in enumerate((low + 0.06, high - 0.12)):
        author.cylinder(stage, f"{path}/Band_{i}", BAG_RADIUS + 0.003, 0.03, (0, 0, z), collide=False, look=metal)
    author.box(stage, f"{path}/Post", (0.03, 0.03, 0.87), (0, -POST_BEHIND, 0.87), look=metal, surface=rough)
    beam = HOOK_Z + 0.14
    warehouse.boxes(
        stage,
        f"{path}/Gallows",
        [
            ((0.03, POST_BEHIND / 2 + 0.05, 0.03), (0, -POST_BEHIND / 2 + 0.02, beam)),
            ((0.012, 0.012, (beam - HOOK_Z) / 2), (0, 0, (beam + HOOK_Z) / 2)),
            ((0.16, 0.16, 0.012), (0, -POST_BEHIND, 0.012)),
        ],
        look=metal,
    )
    # Brace between post and beam, then the four straps from the hook to the rim.
    lean = np.pi / 4
    author.box(
        stage, f"{path}/Brace", (0.015, 0.17, 0.015), (0, -POST_BEHIND + 0.13, beam - 0.13),
        (float(np.cos(lean / 2)), float(np.sin(lean / 2)), 0, 0), collide=False, look=metal,
    )  # fmt: skip
    straps = Solids()
    for angle in np.pi / 4 + np.arange(4) * np.pi / 2:
        straps.tube((0.12 * np.cos(angle), 0.12 * np.sin(angle), high), (0, 0, HOOK_Z), 0.006, sides=6)
    straps.write(stage, f"{path}/Straps", look=metal)


def _semantic_2(folder: Path) -> None:
    """A dojo: straw mats, paper walls, a plum and a white bag on wooden posts, a pale green disc with a hub."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.look(stage, "Floor", texture="tatami")
        rooms.look(stage, "Wall", texture="shoji")
        rooms.look(stage, "Skirting", (0.1, 0.045, 0.02))
        rooms.look(stage, "BagBlack", (0.26, 0.02, 0.1))
        rooms.look(stage, "BagRed", (0.75, 0.72, 0.64))
        rooms.look(stage, "Metal", (0.3, 0.15, 0.06))
        green, hub = rooms.look(stage, "TargetGreen", (0.12, 0.8, 0.2)), rooms.look(stage, "Hub", (0.9, 0.9, 0.85))
        frame, width = "/World/Target/Frame", 2 * TARGET_RADIUS
        rooms.without(stage, f"{frame}/Ball")
        author.cylinder(stage, f"{frame}/Disc", TARGET_RADIUS, width - 0.002, axis="Y", collide=False, look=green)
        author.cylinder(stage, f"{frame}/Hub", 0.25 * TARGET_RADIUS, width, axis="Y", collide=False, look=hub)


def _semantic_3(folder: Path) -> None:
    """An indoor track: red lanes, block walls over blue mats, a lilac and a banded bag, a dark green cross, hurdles."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "Floor", texture="track")
        rooms.look(stage, "Wall", texture="blocks")
        rooms.look(stage, "Skirting", (0.3, 0.3, 0.32))
        rooms.look(stage, "BagBlack", (0.52, 0.44, 0.66))
        rooms.look(stage, "BagRed", (0.85, 0.6, 0.08))
        rooms.look(stage, "Metal", (0.1, 0.22, 0.4))
        decor.dado(stage, "/World/Mats", *ROOM, 0.8, look=rooms.look(stage, "WallMat", (0.04, 0.16, 0.42)))
        lanes = [((3.85, 0.025, 0.001), (-3.3, y, 0.003)) for y in (-5.6, -4.6, -3.6, -2.6, -1.6)]
        warehouse.boxes(stage, "/World/Lanes", lanes, look=rooms.look(stage, "Lane", (0.85, 0.83, 0.78)))
        bands = Solids()
        for z in (0.62, 0.94):
            bands.tube((0, 0, z), (0, 0, z + 0.14), BAG_RADIUS + 0.002, sides=24)
        bands.write(stage, "/World/Bag_2/Bands", look=rooms.look(stage, "BagBand", (0.05, 0.05, 0.07)))
        frame, thin = "/World/Target/Frame", 0.42 * TARGET_RADIUS
        rooms.without(stage, f"{frame}/Ball")
        cross = Solids()
        for axis in range(3):
            cross.box(tuple(TARGET_RADIUS if k == axis else thin for k in range(3)))
        cross.write(stage, f"{frame}/Cross", look=rooms.look(stage, "TargetGreen", (0.0, 0.34, 0.06)))
        hurdles = Solids()
        for x in (-5.9, -4.7):
            hurdles.box((0.5, 0.02, 0.06), (x, -5.9, 0.8))
            for side in (-0.45, 0.45):
                hurdles.box((0.02, 0.02, 0.4), (x + side, -5.9, 0.4)).box((0.02, 0.25, 0.02), (x + side, -5.7, 0.02))
        hurdles.write(stage, "/World/Hurdles", look=rooms.look(stage, "Hurdle", (0.85, 0.85, 0.82)))


def build(folder: Path) -> None:
    """Write `scene.usda` and `variants/semantic.usda` into `folder`."""
    stage = rooms.task_stage(
        folder, TASK, eye=(-4.39689, -2.7965, 2.15956), gaze=(0.62349, 0.41055, -0.34404, -0.56951)
    )
    rough = author.physics_material(stage, "/World/Looks/Rough")
    warehouse.room_looks(stage)
    warehouse.room(stage, rough)
    metal = author.material(stage, "/World/Looks/Metal", (0.05, 0.05, 0.055), roughness=0.4, metallic=0.6)
    black = author.material(stage, "/World/Looks/BagBlack", (0.035, 0.035, 0.04), roughness=0.45)
    red = author.material(stage, "/World/Looks/BagRed", (0.80, 0.04, 0.04), roughness=0.45)
    for (name, centre), skin in zip(BAGS.items(), (black, red), strict=True):
        _bag(stage, name, centre, skin, metal, rough)
    green = author.material(stage, "/World/Looks/TargetGreen", (0.05, 0.85, 0.10))
    author.fixture(stage, "/World/Target", TARGET_POSITION)
    frame = "/World/Target/Frame"
    with rooms.edit(stage, "base"):
        author.sphere(stage, f"{frame}/Ball", TARGET_RADIUS, collide=False, look=green)
        author.marker(stage, f"{frame}/Bounds", (2 * TARGET_RADIUS,) * 3)
    with rooms.edit(stage, "semantic"):
        author.box(stage, f"{frame}/Cube", (SEMANTIC_EDGE / 2,) * 3, collide=False, look=green)
        author.marker(stage, f"{frame}/Bounds", (SEMANTIC_EDGE,) * 3)
    rooms.save(stage, folder)
    _semantic_2(folder)
    _semantic_3(folder)
