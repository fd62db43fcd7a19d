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


def _beach(stage: Usd.Stage) -> None:
    """Sunshades over loungers at both sides of the field."""
    loungers = Solids()
    for number, (x, y) in enumerate(((-5.2, 0.6), (-5.4, 3.4), (5.2, 1.4), (5.5, 4.0))):
        decor.parasol(stage, f"/World/Parasol_{number}", (x, y, 0), ((0.75, 0.1, 0.06), (0.85, 0.7, 0.5))[number % 2])
        loungers.box((0.3, 0.9, 0.03), (x, y, 0.3)).box((0.25, 0.03, 0.14), (x, y - 0.7, 0.14))
        loungers.box((0.25, 0.03, 0.14), (x, y + 0.7, 0.14))
    loungers.write(stage, "/World/Loungers", look=rooms.look(stage, "Lounger", (0.1, 0.3, 0.5)))


def _semantic_2(folder: Path) -> None:
    """A beach: sand, the sea behind, blue tape, red goal with a black net, orange and teal ball, sunshades."""
    with rooms.held_out(folder, "semantic-2") as stage:
        sand = rooms.look(stage, "grass", texture="sand")
        author.quad(stage, "/World/Floor", 7.0, 7.0, (0, 0, 0), repeat=(5, 5), look=sand)
        rooms.without(stage, "/World/CentreCircle")
        tape = [((5.0, 0.05, 0.001), (0, -0.6, 0.003))] + [((0.05, 4.3, 0.001), (x, -1.3, 0.003)) for x in (-4, 4)]
        warehouse.boxes(stage, "/World/Tape", tape, look=rooms.look(stage, "white", (0.02, 0.12, 0.55)))
        paint = {
            "/World/Backdrop": rooms.look(stage, "sea", texture="sea"),
            "/World/Goal/FrameLook": rooms.look(stage, "red", (0.6, 0.03, 0.02)),
            "/World/Goal/Net": rooms.look(stage, "black", (0.015, 0.015, 0.02)),
            "/World/Ball/Look": rooms.look(stage, "football", texture="ball"),
        }
        rooms.paint(stage, paint)
        _beach(stage)


def _semantic_3(folder: Path) -> None:
    """A schoolyard: asphalt with painted games, the school's front, blue goal with a green net, orange ball, trees."""
    with rooms.held_out(folder, "semantic-3") as stage:
        rooms.without(stage, "/World/Backdrop", "/World/CentreCircle")
        warehouse.boxes(stage, "/World/School", BACKDROP, look=rooms.look(stage, "school", texture="school"), tile=2.6)
        for name, (x, y), color in (
            ("Red", (-1.6, -0.2), (0.6, 0.05, 0.04)),
            ("Yellow", (0.3, -1.2), (0.85, 0.6, 0.04)),
            ("Blue", (1.9, 0.4), (0.05, 0.3, 0.65)),
        ):
            disc = Solids().ring(0.0, 0.55, (x, y, 0.003)).ring(0.62, 0.7, (x, y, 0.003))
            disc.write(stage, f"/World/{name}Game", look=rooms.look(stage, f"{name}Paint", color))
        hopscotch = Solids()
        for number in range(7):
            for x in (0.0,) if number % 2 else (-0.25, 0.25):
                hopscotch.box((0.22, 0.22, 0.001), (x - 3.6, 0.5 * number - 2.6, 0.003))
        hopscotch.write(stage, "/World/Hopscotch", look=rooms.look(stage, "Hopscotch", (0.8, 0.75, 0.65)))
        leaves = rooms.look(stage, "Leaves", texture="boxwood")
        for number, (x, y) in enumerate(((-4.6, 3.6), (4.6, 3.6), (5.2, -0.5))):
            decor.topiary(stage, f"/World/Tree_{number}", (x, y, 0), 1.8, crown=leaves)
        paint = {
            "/World/Floor": rooms.look(stage, "grass", texture="asphalt"),
            "/World/Goal/FrameLook": rooms.look(stage, "azure", (0.03, 0.2, 0.6)),
            "/World/Goal/Net": rooms.look(stage, "green", (0.02, 0.2, 0.08)),
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
