"""Writes the scene of PushBin; from the root of a checkout: `python -m push_bin.build`."""

from pathlib import Path

from scene_builders import author, rooms, warehouse

from .task import BIN, MARK, TASK, ZONE

RADIUS, HEIGHT, MASS = 0.25, 1.1, 10.0
"""Of the bin [m, kg]."""
EDGE = 0.6
"""Of the mark [m]."""
EYE = (-5.6, -3.9, 2.1)
"""Position of the world camera [m]."""


def build(folder: Path) -> None:
    """Write `scene.usda` and `variants/semantic.usda` into `folder`."""
    gaze = author.look_at(EYE, (-3.0, -1.9, 0.5))
    stage = rooms.task_stage(folder, TASK, eye=EYE, gaze=gaze)
    rough = author.physics_material(stage, "/World/Looks/Rough")
    warehouse.room_looks(stage)
    warehouse.room(stage, rough)
    round_, upright = MASS * (RADIUS**2 / 4 + HEIGHT**2 / 12), MASS * RADIUS**2 / 2
    inertia, middle = (round_, round_, upright), (0.0, 0.0, HEIGHT / 2)
    author.rigid_body(stage, BIN, (-3.0, -2.9, 0.0), mass=MASS, inertia=inertia, com=middle)
    base = author.physics_material(stage, "/World/Looks/Sliding", friction=0.1)
    shape = author.cylinder(stage, f"{BIN}/Collider", RADIUS, HEIGHT, middle, visual=False, surface=base)
    rooms.contact(shape, priority=1)  # of two surfaces the larger friction counts, unless one has priority
    author.fixture(stage, MARK, (-3.0, -0.3, 0.0))
    author.marker(stage, ZONE, (EDGE, EDGE, 2.0), (0.0, 0.0, 1.0))
    yellow = author.material(stage, "/World/Looks/Yellow", (0.93, 0.78, 0.03))
    author.box(stage, f"{MARK}/Frame/Field", (EDGE / 2, EDGE / 2, 0.001), (0, 0, 0.002), collide=False, look=yellow)
    for variant, colour in (("base", (0.05, 0.2, 0.5)), ("semantic", (0.5, 0.08, 0.05))):
        with rooms.edit(stage, variant):
            paint = author.material(stage, f"/World/Looks/Bin_{variant}", colour)
            author.cylinder(stage, f"{BIN}/Look", RADIUS, HEIGHT, middle, collide=False, look=paint)
    rooms.save(stage, folder)


if __name__ == "__main__":
    build(Path(__file__).parent)
