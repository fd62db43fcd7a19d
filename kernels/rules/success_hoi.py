"""Success predicates of the tasks that move an object: Football, DoubleDesk, P&PBox.

Arguments that `success` describes are not repeated.
"""

# ruff: noqa: UP018 - `int(0)` declares a variable in Warp, `0` a constant that a loop may not change

import warp as wp

from arena_newton.kernels.boxes import (
    FAR,
    Boxes,
    box_centre,
    box_rotation,
    count_up,
    holds,
    slack_box,
    slack_xy,
    world_half,
)
from arena_newton.kernels.launching import launch, launcher
from arena_newton.kernels.rotations import load_vec3

__all__ = [
    "launch_double_desk",
    "launch_football",
    "launch_pp_box_paper",
    "launch_pp_box_released",
]


@wp.kernel
def football_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    ball_body: int,
    goal: Boxes,
    pitch: Boxes,
    rear_bound: int,
    judge_out: int,
    min_z: float,
    success: wp.array[int],
    margin: wp.array[float],
    event: wp.array[int],
):
    """Football: the ball's centre inside the goal's volume, with (`paper`) or without (`released`) its rear face.

    Args:
        goal: One box whose +y face is the rear of the net.
        pitch: One box; xy beyond its upright faces is out.
        rear_bound: Whether the +y face bounds the goal.
        judge_out: Whether leaving the field is an event.
        min_z: A ball below this height [m] has left the field.
        event: Output, 1 = the ball left the field without a goal, int32, shape [worlds].
    """
    w = wp.tid()
    p = load_vec3(xpos, w, ball_body)
    q = box_rotation(xquat, goal, w, 0)
    c = box_centre(xpos, xquat, goal, w, 0)
    v = wp.quat_rotate_inv(q, p - c)
    h = goal.half[0]
    m = wp.min(wp.min(h[0] - wp.abs(v[0]), h[2] - wp.abs(v[2])), h[1] + v[1])
    if rear_bound != 0:
        m = wp.min(m, h[1] - v[1])
    margin[w] = m
    success[w] = holds(m)
    out = int(0)
    if judge_out != 0:
        pq = box_rotation(xquat, pitch, w, 0)
        pc = box_centre(xpos, xquat, pitch, w, 0)
        pv = wp.quat_rotate_inv(pq, p - pc)
        if slack_xy(pv, pitch.half[0]) < 0.0 or p[2] < min_z:
            out = 1
    event[w] = wp.where(m >= 0.0, 0, out)


launch_football = launcher(football_kernel)


@wp.kernel
def double_desk_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    xipos: wp.array3d[float],
    hammer: int,
    box: Boxes,
    world_aligned: int,
    min_z: float,
    success: wp.array[int],
    margin: wp.array[float],
):
    """One thread per world."""
    w = wp.tid()
    p = load_vec3(xipos, w, hammer)
    q = box_rotation(xquat, box, w, 0)
    offset = p - box_centre(xpos, xquat, box, w, 0)
    m = float(0.0)
    if world_aligned != 0:
        m = wp.min(slack_box(offset, world_half(q, box.half[0])), p[2] - min_z)
    else:
        m = slack_box(wp.quat_rotate_inv(q, offset), box.half[0])
    margin[w] = m
    success[w] = holds(m)


def launch_double_desk(
    xpos: wp.array,
    xquat: wp.array,
    xipos: wp.array,
    *,
    hammer_body: int,
    inside: Boxes,
    min_z: float | None = None,
    success: wp.array,
    margin: wp.array,
) -> None:
    """DoubleDesk: the hammer's centre of mass inside the crate's box.

    Args:
        inside: One box, the crate's.
        min_z: None: the box is in the crate's own frame (`paper`). Otherwise it is the world-axis box around the
            crate's, cut at this height [m] (`released`).
    """
    floor = (0, 0.0) if min_z is None else (1, min_z)
    launch(double_desk_kernel, success.shape[0], [xpos, xquat, xipos, hammer_body, inside, *floor], [success, margin])


@wp.func
def slack_on_deck(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    centre: wp.vec3,
    bottom: float,
    decks: Boxes,
    world: int,
    deck: int,
    height_tolerance: float,
) -> float:
    """Slack [m] of a box on one deck: its centre within the span, its bottom near the deck's top face."""
    q = box_rotation(xquat, decks, world, deck)
    c = box_centre(xpos, xquat, decks, world, deck)
    top = c + wp.quat_rotate(q, wp.vec3(0.0, 0.0, decks.half[deck][2]))
    span = slack_xy(wp.quat_rotate_inv(q, centre - c), decks.half[deck])
    return wp.min(span, height_tolerance - wp.abs(bottom - top[2]))


@wp.func
def best_deck(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    centre: wp.vec3,
    bottom: float,
    decks: Boxes,
    world: int,
    height_tolerance: float,
) -> int:
    """The deck with the largest slack."""
    best = int(0)
    best_slack = float(-FAR)
    for d in range(decks.body.shape[0]):
        s = slack_on_deck(xpos, xquat, centre, bottom, decks, world, d, height_tolerance)
        if s > best_slack:
            best_slack = s
            best = d
    return best


@wp.kernel
def pp_box_paper_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    qvel: wp.array2d[float],
    robot_force: wp.array[float],
    box_qvel_adr: int,
    box: Boxes,
    decks: Boxes,
    height_tolerance: float,
    max_speed: float,
    confirm_ticks: int,
    window: float,
    stiffness: float,
    counter: wp.array[int],
    success: wp.array[int],
    margin: wp.array[float],
):
    """One thread per world."""
    w = wp.tid()
    p = box_centre(xpos, xquat, box, w, 0)
    bottom = p[2] - world_half(box_rotation(xquat, box, w, 0), box.half[0])[2]
    best = best_deck(xpos, xquat, p, bottom, decks, w, height_tolerance)
    m = slack_on_deck(xpos, xquat, p, bottom, decks, w, best, height_tolerance)
    v = wp.vec3(qvel[w, box_qvel_adr], qvel[w, box_qvel_adr + 1], qvel[w, box_qvel_adr + 2])
    speed = wp.sqrt(wp.dot(v, v) + 1.0e-12)
    m = wp.min(m, (max_speed - speed) * window)
    if robot_force[w] > 0.0:
        m = wp.min(m, -robot_force[w] / stiffness)
    count = count_up(m, counter[w])
    counter[w] = count
    margin[w] = m
    success[w] = wp.where(count >= confirm_ticks, 1, 0)


def launch_pp_box_paper(
    xpos: wp.array,
    xquat: wp.array,
    qvel: wp.array,
    robot_force: wp.array,
    *,
    box: Boxes,
    box_qvel_adr: int,
    decks: Boxes,
    height_tolerance: float,
    max_speed: float,
    confirm_ticks: int,
    tick: float,
    stiffness: float = 500.0,
    counter: wp.array,
    success: wp.array,
    margin: wp.array,
) -> None:
    """P&PBox, `paper`: box centre above any deck within its span, bottom near the deck, slow, let go, ticks in a row.

    The bottom is the box's lowest corner. Speed enters the margin as the length (max_speed - speed) x confirmation
    time, a touch as the length -force / stiffness.

    Args:
        robot_force: Normal force between robot and box [N], any of which restarts the count, shape [worlds].
        box: One box, the one to move.
        box_qvel_adr: Address of its free joint in `qvel`.
        decks: Boxes whose top faces are the decks' surfaces, at least one.
        height_tolerance: Largest distance of bottom and deck [m], 0.06.
        max_speed: Largest speed [m/s], 0.05.
        confirm_ticks: Ticks in a row, 10.
        tick: Control period [s].
        stiffness: Turns force into length for the margin alone [N/m]; 500 puts a held box (10 N) 2 cm away.
    """
    limits = [height_tolerance, max_speed, confirm_ticks, confirm_ticks * tick, stiffness]
    inputs = [xpos, xquat, qvel, robot_force, box_qvel_adr, box, decks, *limits]
    launch(pp_box_paper_kernel, success.shape[0], inputs, [counter, success, margin])


@wp.kernel
def pp_box_released_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    box: Boxes,
    decks: Boxes,
    deck: int,
    plane_below: float,
    height_tolerance: float,
    success: wp.array[int],
    margin: wp.array[float],
):
    """P&PBox, `released`: box centre in the target deck's world-axis span less the box's half, bottom near a plane.

    Args:
        box: One box, the one to move; half its xy extents shrink the span, half its z is taken off its centre's height.
        decks: The shelf's decks.
        deck: Which of them is the target.
        plane_below: How far the target plane is below that deck's upper face [m].
        height_tolerance: Largest distance to the plane [m], 0.06.
    """
    w = wp.tid()
    p = box_centre(xpos, xquat, box, w, 0)
    half = box.half[0]
    h = world_half(box_rotation(xquat, decks, w, deck), decks.half[deck])
    offset = p - box_centre(xpos, xquat, decks, w, deck)
    m = slack_xy(offset, wp.vec3(h[0] - half[0], h[1] - half[1], h[2]))
    m = wp.min(m, height_tolerance - wp.abs(offset[2] - half[2] - (h[2] - plane_below)))
    margin[w] = m
    success[w] = holds(m)


launch_pp_box_released = launcher(pp_box_released_kernel)
