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
    """A gym: granulate floor, striped walls, leather and blue bags, and an upright green drum with a pale band."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.look(stage, "Floor", texture="rubber")
        rooms.look(stage, "Wall", texture="wallpaper")
        rooms.look(stage, "BagBlack", (0.36, 0.17, 0.07))
        rooms.look(stage, "BagRed", (0.04, 0.1, 0.4))
        rooms.look(stage, "Metal", (0.5, 0.5, 0.52))
        green, pale = rooms.look(stage, "TargetGreen", (0.1, 0.75, 0.02)), rooms.look(stage, "Pale", (0.8, 0.9, 0.6))
        frame, edge = "/World/Target/Frame", 2 * TARGET_RADIUS
        rooms.without(stage, f"{frame}/Ball")
        author.cylinder(stage, f"{frame}/Drum", TARGET_RADIUS, edge, collide=False, look=green)
        author.cylinder(stage, f"{frame}/Band", TARGET_RADIUS + 0.001, edge / 4, collide=False, look=pale)


def _semantic_3(folder: Path) -> None:
    """A club: mats of four hues, wooden walls, a pale and a striped bag, a green diamond, and boxes to jump on."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.look(stage, "Floor", texture="mats")
        rooms.look(stage, "Wall", texture="bars")
        rooms.look(stage, "BagBlack", (0.7, 0.66, 0.56))
        rooms.look(stage, "Metal", (0.55, 0.2, 0.03))
        low, high = BAG_Z
        skin = Solids().tube((0, 0, low), (0, 0, high), BAG_RADIUS + 0.001, sides=24, tile=0.4)
        skin.write(stage, "/World/Bag_2/Stripes", look=rooms.look(stage, "Stripes", texture="barrier"))
        frame = "/World/Target/Frame"
        rooms.without(stage, f"{frame}/Ball")
        diamond = Solids()
        for end in (-1, 1):
            diamond.tube((0, 0, 0), (0, 0, end * TARGET_RADIUS), TARGET_RADIUS, taper=0.0, sides=4)
        diamond.write(stage, f"{frame}/Diamond", look=rooms.look(stage, "TargetGreen", (0.0, 0.6, 0.08)))
        steps = [((0.35, 0.35, z), (x, -5.6, z)) for x, z in ((-5.6, 0.3), (-4.7, 0.2), (-3.9, 0.12))]
        warehouse.boxes(stage, "/World/JumpBoxes", steps, look=rooms.look(stage, "JumpBox", texture="quilt"), tile=0.7)


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
