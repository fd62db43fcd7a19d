"""Author of the football scene: pitch, ball, goal with its net, backdrop walls.

Measures are those of the original's task and of its published clips (goal posts re-projected within a pixel).
"""

from pathlib import Path

from pxr import Usd

from arena_newton.tasks.football import TASK
from scene_builders import author, decor, rooms, warehouse
from scene_builders.solids import Solids

__all__ = ["build"]

BALL_RADIUS, BALL_MASS = 0.11, 0.43
"""Ball [m], [kg]."""
LEFT, RIGHT, LINE, BAR = -2.5, 2.55, 3.0, 1.67
"""Posts' x, goal line's y and crossbar's height [m]."""
BACK, BACK_HEIGHT = 5.03, 0.70
"""Rear posts' y and height [m]."""
POST = 0.05
"""Radius of posts and crossbar [m]; our choice."""
BACKDROP = [
    wall
    for sign in (-1, 1)
    for wall in (((6.84, 0.04, 1.3), (0, sign * 6.0, 1.3)), ((0.04, 6.04, 1.3), (sign * 6.8, 0, 1.3)))
]
"""Half sizes and centres of the walls around the pitch [m]."""
NET_SPACING, CORD = 0.13, 0.02
"""Mesh and cord width of the net [m]; our choice, wide enough for a 224-pixel image."""


def ball(stage: Usd.Stage, path: str, position: author.Vec, radius: float, mass: float, look: Usd.Prim) -> Usd.Prim:
    """A rolling ball: invisible collision sphere, textured visual sphere.

    A solid sphere's inertia, as PhysX gives a sphere collider (a rolling ball then keeps 5/7 of a kick's peak speed).
    Contact: condim 3 and no damping, so rolling costs no speed; priority 1, so that the ball's own friction and
    restitution count on every surface. Friction 0.7 was measured to work; restitution belongs to the rule set, which
    sets it when the scene is loaded.
    """
    body = author.rigid_body(stage, path, position, mass=mass, inertia=[0.4 * mass * radius**2] * 3)
    surface = author.physics_material(stage, f"{path}/Surface", friction=0.7, restitution=0.1)
    geom = author.sphere(stage, f"{path}/Collider", radius, visual=False, surface=surface)
    rooms.contact(geom, condim=3, priority=1)
    Solids().ball(radius).write(stage, f"{path}/Look", look=look)
    return body


def pitch(stage: Usd.Stage) -> None:
    """Grass, centre circle, goal line, four grey backdrop walls (visual only) and the `Pitch` marker inside them."""
    white = author.material(stage, "/World/Looks/white", (0.85, 0.85, 0.85))
    grey = author.material(stage, "/World/Looks/grey", (0.35, 0.35, 0.35))
    grass = author.material(stage, "/World/Looks/grass", texture="../textures/grass.png")
    author.bind(rooms.floor(stage, (7.0, 7.0), (0, 0), tile=1.0), grass)
    Solids().ring(1.45, 1.57, (0, 0, 0.003)).write(stage, "/World/CentreCircle", look=grey)
    middle = (LEFT + RIGHT) / 2
    author.quad(stage, "/World/GoalLine", (RIGHT - LEFT) / 2, 0.03, (middle, LINE, 0.003), look=white)
    walls = Solids()
    for half, centre in BACKDROP:
        walls.box(half, centre)
    walls.write(stage, "/World/Backdrop", look=grey)
    # A ball below −0.5 m has left the field too.
    author.marker(stage, "/World/Pitch", (13.52, 11.92, 3.1), (0, 0, 1.05))


def goal(stage: Usd.Stage) -> None:
    """Posts and crossbar for collision, frame and net for the eye, and the `Volume` in which a goal counts."""
    author.xform(stage, "/World/Goal")
    surface = author.physics_material(stage, "/World/Looks/GoalSurface", friction=0.5, restitution=0.1)
    half = (BAR + POST) / 2
    middle, width = (LEFT + RIGHT) / 2, RIGHT - LEFT
    for name, x in (("LeftPost", LEFT), ("RightPost", RIGHT)):
        author.cylinder(stage, f"/World/Goal/{name}", POST, 2 * half, (x, LINE, half), visual=False, surface=surface)
    author.cylinder(
        stage, "/World/Goal/Crossbar", POST, width, (middle, LINE, BAR), axis="X", visual=False, surface=surface
    )
    frame = Solids()
    for x in (LEFT, RIGHT):
        frame.tube((x, LINE, 0), (x, LINE, BAR + POST), POST, sides=14, tile=0.4)
        # The stay: a short arm back from the crossbar, then down to the rear post, as in the original's clips.
        knee = (x, LINE + 0.45, BAR - 0.06)
        frame.tube((x, LINE, BAR), knee, 0.025, tile=0.4)
        frame.tube(knee, (x, BACK, BACK_HEIGHT), 0.015, sides=8, tile=0.4)
        frame.tube((x, BACK, 0), (x, BACK, BACK_HEIGHT), 0.025, tile=0.4)
        frame.tube((x, LINE, 0.03), (x, BACK, 0.03), 0.03, tile=0.4)
    frame.tube((LEFT, LINE, BAR), (RIGHT, LINE, BAR), POST, sides=14, tile=0.4)
    frame.tube((LEFT, BACK, BACK_HEIGHT), (RIGHT, BACK, BACK_HEIGHT), 0.015, sides=8, tile=0.4)
    frame.tube((LEFT, BACK, 0.03), (RIGHT, BACK, 0.03), 0.03, tile=0.4)
    frame.write(stage, "/World/Goal/FrameLook")
    front, rear = LINE + 0.45, BAR - 0.06
    net = Solids()
    # Its top from the crossbar over the stays to the rear posts, its back, and both sides.
    nets = [
        [(LEFT, LINE, BAR), (RIGHT, LINE, BAR), (RIGHT, front, rear), (LEFT, front, rear)],
        [(LEFT, front, rear), (RIGHT, front, rear), (RIGHT, BACK, BACK_HEIGHT), (LEFT, BACK, BACK_HEIGHT)],
        [(LEFT, BACK, 0), (RIGHT, BACK, 0), (RIGHT, BACK, BACK_HEIGHT), (LEFT, BACK, BACK_HEIGHT)],
    ]
    for x in (LEFT, RIGHT):
        nets.append([(x, LINE, 0), (x, front, 0), (x, front, rear), (x, LINE, BAR)])
        nets.append([(x, front, 0), (x, BACK, 0), (x, BACK, BACK_HEIGHT), (x, front, rear)])
    for corners in nets:
        net.net(corners, spacing=NET_SPACING, width=CORD)
    net.write(stage, "/World/Goal/Net")
    # Centre of the ball, rule set `paper`: −2.5 < x < 2.6, 3.03 < y < 5.03, 0 < z < 1.85.
    author.marker(stage, "/World/Goal/Volume", (5.1, 2.0, 1.85), (0.05, 4.03, 0.925))


def _semantic_2(folder: Path) -> None:
    """A school gym: parquet with court lines, wall bars, red and white goal, blue and yellow ball, mats and benches."""
    with rooms.held_out(folder, "semantic-2") as stage:
        rooms.without(stage, "/World/Backdrop")
        warehouse.boxes(stage, "/World/WallBars", BACKDROP, look=rooms.look(stage, "bars", texture="bars"), tile=2.6)
        key = [((1.3, 0.95, 0.001), (0, -2.65, 0.002))]
        warehouse.boxes(stage, "/World/Key", key, look=rooms.look(stage, "key", (0.03, 0.22, 0.12)))
        lines: list[tuple[author.Vec, author.Vec]] = [((4.4, 0.04, 0.001), (0, y, 0.004)) for y in (2.1, -1.7)]
        lines += [((0.04, 4.6, 0.001), (x, -1.0, 0.005)) for x in (-4.4, 4.4)]
        warehouse.boxes(stage, "/World/Lines", lines, look=rooms.look(stage, "line", (0.6, 0.04, 0.04)))
        mats, seats, feet = Solids(), Solids(), Solids()
        for x, y in ((-5.4, 1.0), (-5.4, 3.6), (5.4, 2.6)):
            mats.box((0.6, 1.0, 0.15), (x, y, 0.15))
        for x, y in ((5.3, -0.6), (-5.2, -1.6)):
            seats.box((0.14, 1.2, 0.02), (x, y, 0.36))
            for end in (-0.9, 0.9):
                feet.box((0.12, 0.03, 0.17), (x, y + end, 0.17))
        mats.write(stage, "/World/Mats", look=rooms.look(stage, "mat", (0.04, 0.12, 0.42)))
        seats.write(stage, "/World/BenchSeats", look=rooms.look(stage, "bench", (0.5, 0.28, 0.1)))
        feet.write(stage, "/World/BenchFeet", look=rooms.look(stage, "feet", (0.08, 0.08, 0.09)))
        paint = {
            "/World/Floor": rooms.look(stage, "grass", texture="parquet"),
            "/World/CentreCircle": rooms.look(stage, "circle", (0.03, 0.08, 0.42)),
            "/World/Goal/FrameLook": rooms.look(stage, "handball", texture="goal"),
            "/World/Goal/Net": rooms.look(stage, "cords", (0.04, 0.1, 0.4)),
            "/World/Ball/Look": rooms.look(stage, "football", texture="ball"),
        }
        rooms.paint(stage, paint)


def _semantic_3(folder: Path) -> None:
    """A winter pitch: snow with blue lines before a forest, green goal with a red net, pink ball, firs and a bench."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.without(stage, "/World/Backdrop")
        warehouse.boxes(stage, "/World/Forest", BACKDROP, look=rooms.look(stage, "forest", texture="forest"), tile=2.6)
        snow = rooms.look(stage, "grass", texture="snow")
        author.quad(stage, "/World/Floor", 7.0, 7.0, (0, 0, 0), repeat=(4, 4), look=snow)
        for number, (x, y, height) in enumerate(((-5.0, 2.4, 2.3), (-5.8, 4.6, 2.9), (5.2, 3.0, 2.6), (5.6, 0.2, 2.0))):
            decor.conifer(stage, f"/World/Fir_{number}", (x, y, 0), height, needles=(0.02, 0.13, 0.07))
        for number, (x, y) in enumerate(((-4.8, -0.4), (4.9, -1.6), (5.9, 4.9))):
            half = (0.5, 0.8, 0.22)
            warehouse.rounded_box(stage, f"/World/Heap_{number}", half, (x, y, 0.1), radius=0.2, look=snow)
        blue = rooms.look(stage, "white", (0.03, 0.1, 0.5))
        paint = {
            "/World/CentreCircle": blue,
            "/World/Goal/FrameLook": rooms.look(stage, "pine", (0.02, 0.16, 0.09)),
            "/World/Goal/Net": rooms.look(stage, "cords", (0.5, 0.03, 0.03)),
            "/World/Ball/Look": rooms.look(stage, "football", texture="ball"),
        }
        rooms.paint(stage, paint)


def build(folder: Path) -> None:
    """Write `scene.usda` and `variants/` into `folder`."""
    variants = ("base", "semantic", "semantic_released")
    stage = rooms.scene_stage(
        folder,
        TASK.spawn_position,
        tuple(round(value, 7) for value in TASK.spawn_quat),  # as the layer has always been written
        eye=(3.00604, -1.18692, 1.99495),
        gaze=(0.70141, 0.51577, 0.29143, 0.39632),
        variants=variants,
    )
    pitch(stage)
    goal(stage)
    leather = author.material(stage, "/World/Looks/football", texture="../textures/football.png")
    ball(stage, "/World/Ball", (0, 1.0, BALL_RADIUS), BALL_RADIUS, BALL_MASS, leather)
    white = author.material(stage, "/World/Looks/goal", (0.85, 0.85, 0.85))
    striped = author.material(stage, "/World/Looks/striped", texture="../textures/hazard.png")
    orange = author.material(stage, "/World/Looks/orange", (0.8, 0.22, 0.02))
    rooms.bind_in(stage, "base", {"/World/Goal/FrameLook": white, "/World/Goal/Net": white})
    for variant in variants[1:]:
        rooms.bind_in(stage, variant, {"/World/Goal/FrameLook": striped, "/World/Goal/Net": orange})
    rubber = author.material(stage, "/World/Looks/basketball", texture="../textures/basketball.png")
    with rooms.edit(stage, "semantic_released"):
        # The original drops a 1 kg basketball next to the robot's path to the ball.
        ball(stage, "/World/Distractor", (-0.037, 0.496, 0.929), 0.12, 1.0, rubber)
    rooms.save(stage, folder)
    _semantic_2(folder)
    _semantic_3(folder)
