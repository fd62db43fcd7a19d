"""Success predicates of the tasks between robot and scene: OpenDoor, SitSofa, Boxing, VisNavi.

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
    slack_standing,
    slack_xy,
    world_half,
)
from arena_newton.kernels.launching import launcher
from arena_newton.kernels.rotations import load_quat3, load_vec3

__all__ = [
    "launch_boxing",
    "launch_open_door_paper",
    "launch_open_door_released",
    "launch_sit_sofa_paper",
    "launch_sit_sofa_released",
    "launch_vis_navi",
]


@wp.kernel
def open_door_paper_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    qpos: wp.array2d[float],
    root_qpos_adr: int,
    doorway: Boxes,
    half_width: float,
    min_y: float,
    stand_height: float,
    stand_up: float,
    success: wp.array[int],
    margin: wp.array[float],
):
    """OpenDoor, `paper`: the root has passed the frame's plane y = 0 within the doorway, and the robot stands.

    Args:
        doorway: One box; its frame's y = 0 is the plane, x = 0 the middle of the leaf.
        half_width: Largest |x| [m], 0.55.
        min_y: Smallest y [m], 0.02.
    """
    w = wp.tid()
    p = wp.vec3(qpos[w, root_qpos_adr], qpos[w, root_qpos_adr + 1], qpos[w, root_qpos_adr + 2])
    q = box_rotation(xquat, doorway, w, 0)
    v = wp.quat_rotate_inv(q, p - box_centre(xpos, xquat, doorway, w, 0))
    m = wp.min(half_width - wp.abs(v[0]), v[1] - min_y)
    m = wp.min(m, slack_standing(qpos, w, root_qpos_adr, stand_height, stand_up))
    margin[w] = m
    success[w] = holds(m)


launch_open_door_paper = launcher(open_door_paper_kernel)


@wp.kernel
def open_door_released_kernel(
    qpos: wp.array2d[float],
    root_qpos_adr: int,
    leaf_qpos_adr: int,
    latched: wp.array[int],
    min_angle: float,
    stand_height: float,
    stand_up: float,
    success: wp.array[int],
    margin: wp.array[float],
):
    """OpenDoor, `released`: the latch is released, the leaf has opened far enough, and the robot stands.

    Angles enter the margin as the arc [m] at 1 m from the hinge; a latched leaf counts as closed.

    Args:
        leaf_qpos_adr: Address of the leaf's hinge in `qpos`, 0 rad = closed.
        latched: 1 = the latch still holds the leaf, int32, shape [worlds].
        min_angle: Smallest |angle| of the leaf [rad], 60 deg, positive.
    """
    w = wp.tid()
    m = -min_angle
    if latched[w] == 0:
        m = wp.abs(qpos[w, leaf_qpos_adr]) - min_angle
    m = wp.min(m, slack_standing(qpos, w, root_qpos_adr, stand_height, stand_up))
    margin[w] = m
    success[w] = holds(m)


launch_open_door_released = launcher(open_door_released_kernel)


@wp.kernel
def sit_sofa_paper_kernel(
    qpos: wp.array2d[float],
    seat_force: wp.array[float],
    root_qpos_adr: int,
    min_force: float,
    max_root_z: float,
    stiffness: float,
    confirm_ticks: int,
    counter: wp.array[int],
    success: wp.array[int],
    margin: wp.array[float],
):
    """SitSofa, `paper`: pelvis, hips and thighs press the seat hard enough and the root is low, several ticks in a row.

    Args:
        seat_force: Normal force of those links on the seat [N], shape [worlds].
        min_force: Smallest force [N], 50.
        max_root_z: Root height below which the robot sits [m], 0.62.
        confirm_ticks: Ticks in a row, 25.
        stiffness: Turns force into length for the margin alone [N/m]; 500 puts no force 0.1 m away from 50 N.
    """
    w = wp.tid()
    m = wp.min(max_root_z - qpos[w, root_qpos_adr + 2], (seat_force[w] - min_force) / stiffness)
    count = count_up(m, counter[w])
    counter[w] = count
    margin[w] = m
    success[w] = wp.where(count >= confirm_ticks, 1, 0)


launch_sit_sofa_paper = launcher(sit_sofa_paper_kernel, stiffness=500.0)


@wp.func
def slack_in_seat(p: wp.vec3, centre: wp.vec3, half: wp.vec3, below: float, above: float) -> float:
    """Slack [m] of a point in the seat volume: xy in the seat, z from `below` its bottom to `above` its top."""
    v = p - centre
    return wp.min(slack_xy(v, half), wp.min(v[2] + half[2] + below, half[2] + above - v[2]))


@wp.func
def slack_pressing(
    xpos: wp.array3d[float],
    contact_force: wp.array2d[float],
    centre: wp.vec3,
    half: wp.vec3,
    world: int,
    body: int,
    below: float,
    above: float,
    min_force: float,
    stiffness: float,
) -> float:
    """Slack [m] of one body in the seat volume with contact."""
    s = slack_in_seat(load_vec3(xpos, world, body), centre, half, below, above)
    return wp.min(s, (contact_force[world, body] - min_force) / stiffness)


@wp.func
def most_pressing(
    xpos: wp.array3d[float],
    contact_force: wp.array2d[float],
    bodies: wp.array[int],
    centre: wp.vec3,
    half: wp.vec3,
    world: int,
    below: float,
    above: float,
    min_force: float,
    stiffness: float,
) -> int:
    """The body with the largest pressing slack."""
    best = bodies[0]
    best_slack = float(-FAR)
    for k in range(bodies.shape[0]):
        b = bodies[k]
        s = slack_pressing(xpos, contact_force, centre, half, world, b, below, above, min_force, stiffness)
        if s > best_slack:
            best_slack = s
            best = b
    return best


@wp.func
def second_deepest(
    xpos: wp.array3d[float],
    bodies: wp.array[int],
    centre: wp.vec3,
    half: wp.vec3,
    world: int,
    below: float,
    above: float,
) -> int:
    """The body with the second largest slack in the seat volume, -1 where only one is listed."""
    first = bodies[0]
    second = int(-1)
    first_slack = float(-FAR)
    second_slack = float(-FAR)
    for k in range(bodies.shape[0]):
        b = bodies[k]
        s = slack_in_seat(load_vec3(xpos, world, b), centre, half, below, above)
        if s > first_slack:
            second_slack = first_slack
            if k > 0:
                second = first
            first_slack = s
            first = b
        elif s > second_slack:
            second_slack = s
            second = b
    return second


@wp.kernel
def sit_sofa_released_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    contact_force: wp.array2d[float],
    bodies: wp.array[int],
    seat: Boxes,
    below: float,
    above: float,
    min_force: float,
    stiffness: float,
    success: wp.array[int],
    margin: wp.array[float],
):
    """SitSofa, `released`: one listed body in the seat volume with contact, or two in it without; one tick.

    Args:
        contact_force: Norm of the net contact force on each body [N], shape [worlds, nbody].
        bodies: Bodies that count, at least one, int32, shape [k]; one that is listed twice counts as two.
        seat: One box; its world-axis box is the seat.
        below: How far below the seat's bottom a body still counts [m], 0.10.
        above: How far above the seat's top a body still counts [m], 0.35.
        min_force: Smallest contact force [N], 5.
        stiffness: Turns force into length for the margin alone [N/m].
    """
    w = wp.tid()
    c = box_centre(xpos, xquat, seat, w, 0)
    h = world_half(box_rotation(xquat, seat, w, 0), seat.half[0])
    pressing = most_pressing(xpos, contact_force, bodies, c, h, w, below, above, min_force, stiffness)
    m = slack_pressing(xpos, contact_force, c, h, w, pressing, below, above, min_force, stiffness)
    second = second_deepest(xpos, bodies, c, h, w, below, above)
    if second >= 0:
        m = wp.max(m, slack_in_seat(load_vec3(xpos, w, second), c, h, below, above))
    margin[w] = m
    success[w] = holds(m)


launch_sit_sofa_released = launcher(sit_sofa_released_kernel, stiffness=500.0)


@wp.func
def fist_distance(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    target: wp.vec3,
    palm_body: wp.array[int],
    palm_offset: wp.array[wp.vec3],
    world: int,
    palm: int,
) -> float:
    """Distance [m] of one palm's frame to a point."""
    b = palm_body[palm]
    p = load_vec3(xpos, world, b) + wp.quat_rotate(load_quat3(xquat, world, b), palm_offset[palm])
    d = p - target
    return wp.sqrt(wp.dot(d, d) + 1.0e-12)


@wp.func
def nearest_fist(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    target: wp.vec3,
    palm_body: wp.array[int],
    palm_offset: wp.array[wp.vec3],
    world: int,
) -> int:
    """The palm nearest to a point."""
    best = int(0)
    best_distance = float(FAR)
    for k in range(palm_body.shape[0]):
        d = fist_distance(xpos, xquat, target, palm_body, palm_offset, world, k)
        if d < best_distance:
            best_distance = d
            best = k
    return best


@wp.kernel
def boxing_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    palm_body: wp.array[int],
    palm_offset: wp.array[wp.vec3],
    target: Boxes,
    min_radius: float,
    pad: float,
    success: wp.array[int],
    margin: wp.array[float],
):
    """Boxing: a palm within max(bounding radius, min_radius) + pad of the target's centre.

    Args:
        palm_body: Bodies that carry the palms, int32, shape [k].
        palm_offset: Palms in those bodies' frames [m], vec3, shape [k].
        target: One box; half of its largest extent is the bounding radius.
        min_radius: 0 in `paper`, 0.10 in `released` [m].
        pad: Reach beyond the radius [m], 0.08.
    """
    w = wp.tid()
    centre = box_centre(xpos, xquat, target, w, 0)
    h = target.half[0]
    reach = wp.max(wp.max(wp.max(h[0], h[1]), h[2]), min_radius) + pad
    best = nearest_fist(xpos, xquat, centre, palm_body, palm_offset, w)
    m = reach - fist_distance(xpos, xquat, centre, palm_body, palm_offset, w, best)
    margin[w] = m
    success[w] = holds(m)


launch_boxing = launcher(boxing_kernel)


@wp.func
def foot_slack(
    xpos: wp.array3d[float],
    feet: wp.array[int],
    centre: wp.vec3,
    q: wp.quat,
    half: wp.vec3,
    round_zone: int,
    world: int,
    foot: int,
) -> float:
    """Slack [m] of one foot link's origin in the zone, seen from above: the box, or the disc inscribed in it."""
    v = wp.quat_rotate_inv(q, load_vec3(xpos, world, feet[foot]) - centre)
    s = slack_xy(v, half)
    if round_zone != 0:
        s = wp.min(half[0], half[1]) - wp.sqrt(v[0] * v[0] + v[1] * v[1] + 1.0e-12)
    return s


@wp.func
def worst_foot(
    xpos: wp.array3d[float],
    feet: wp.array[int],
    centre: wp.vec3,
    q: wp.quat,
    half: wp.vec3,
    round_zone: int,
    world: int,
) -> int:
    """The foot with the smallest slack."""
    worst = int(0)
    worst_slack = float(FAR)
    for k in range(feet.shape[0]):
        s = foot_slack(xpos, feet, centre, q, half, round_zone, world, k)
        if s < worst_slack:
            worst_slack = s
            worst = k
    return worst


@wp.kernel
def vis_navi_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    qpos: wp.array2d[float],
    root_qpos_adr: int,
    feet: wp.array[int],
    zone: Boxes,
    round_zone: int,
    stand_height: float,
    stand_up: float,
    success: wp.array[int],
    margin: wp.array[float],
):
    """VisNavi: the origins of all foot links inside the zone, seen from above, and the robot stands.

    Args:
        feet: Ankle links, int32, shape [k].
        zone: One box.
        round_zone: Whether the zone is the upright cylinder inscribed in the box, its diameter the smaller extent.
    """
    w = wp.tid()
    q = box_rotation(xquat, zone, w, 0)
    c = box_centre(xpos, xquat, zone, w, 0)
    worst = worst_foot(xpos, feet, c, q, zone.half[0], round_zone, w)
    m = foot_slack(xpos, feet, c, q, zone.half[0], round_zone, w, worst)
    m = wp.min(m, slack_standing(qpos, w, root_qpos_adr, stand_height, stand_up))
    margin[w] = m
    success[w] = holds(m)


launch_vis_navi = launcher(vis_navi_kernel, round_zone=False)
