"""Author Boxing: two bags on posts and the small green target at one of them.

Bag size, heights and positions, post offset and hook height: spec of the original (measured on its clips). Bags are
static, as the rule needs no contact and no force.
"""

from pathlib import Path

import numpy as np
from pxr import Usd

from arena_newton.tasks.boxing import TASK
from scene_builders import author, rooms, warehouse
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
    """A fitness studio: speckled rubber, peach over plum, an orange and a navy bag on white posts, a green diamond."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.look(stage, "Floor", texture="rubber")
        rooms.look(stage, "Wall", texture="studio")
        rooms.look(stage, "Skirting", (0.06, 0.06, 0.08))
        rooms.look(stage, "BagBlack", (0.75, 0.24, 0.03))
        rooms.look(stage, "BagRed", (0.02, 0.05, 0.24))
        rooms.look(stage, "Metal", (0.7, 0.7, 0.72))
        frame, r = "/World/Target/Frame", TARGET_RADIUS
        rooms.without(stage, f"{frame}/Ball")
        gem = Solids()
        for tip in (-r, r):
            gem.tube((0, 0, 0), (0, 0, tip), r, taper=0.01, sides=8)
        gem.write(stage, f"{frame}/Gem", look=rooms.look(stage, "TargetGreen", (0.03, 0.8, 0.08)))
        rack, weights = Solids(), Solids()
        for z in (0.3, 0.75):
            rack.box((0.75, 0.16, 0.02), (-5.0, -6.2, z))
            for x in np.linspace(-5.6, -4.4, 5):
                weights.tube((x, -6.34, z + 0.1), (x, -6.06, z + 0.1), 0.08, sides=12)
        for x in (-5.72, -4.28):
            rack.box((0.03, 0.2, 0.45), (x, -6.2, 0.45))
        rack.write(stage, "/World/Rack", look=rooms.look(stage, "Rack", (0.5, 0.52, 0.55)))
        weights.write(stage, "/World/Weights", look=rooms.look(stage, "Weights", (0.03, 0.25, 0.35)))


def _semantic_3(folder: Path) -> None:
    """A circus tent: sawdust, striped canvas, a leather and a blue bag on gilt posts, a green drum, podiums."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "Floor", texture="sawdust")
        rooms.look(stage, "Wall", texture="tent")
        rooms.look(stage, "Skirting", (0.1, 0.05, 0.2))
        rooms.look(stage, "BagBlack", (0.22, 0.08, 0.03))
        rooms.look(stage, "BagRed", (0.03, 0.14, 0.5))
        rooms.look(stage, "Metal", (0.62, 0.42, 0.06))
        frame, width = "/World/Target/Frame", 2 * TARGET_RADIUS
        rooms.without(stage, f"{frame}/Ball")
        green = rooms.look(stage, "TargetGreen", (0.14, 0.72, 0.03))
        author.cylinder(stage, f"{frame}/Drum", TARGET_RADIUS, width, collide=False, look=green)
        podiums, tops = Solids(), Solids()
        for x, y, radius in ((-5.2, -5.7, 0.6), (-4.1, -6.0, 0.4), (-0.1, -5.6, 0.4), (-5.6, -3.6, 0.4)):
            podiums.tube((x, y, 0), (x, y, 0.5), radius, taper=0.8, sides=24, tile=0.5)
            tops.ring(0.0, 0.8 * radius, (x, y, 0.5))
        podiums.write(stage, "/World/Podiums", look=rooms.look(stage, "Podium", texture="podium"))
        tops.write(stage, "/World/PodiumTops", look=rooms.look(stage, "PodiumTop", (0.6, 0.05, 0.05)))


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
