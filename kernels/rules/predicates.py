"""Conditions, and the predicates on the way to success that are made of them.

A predicate is the conjunction of conditions, each of which compares one measured quantity with a limit. Points and
boxes are fixed to bodies. Predicates are not differentiable; the margins in `success` and `success_conditions` are.
"""

# ruff: noqa: UP018 - `int(0)` declares a variable in Warp, `0` a constant that a loop may not change

import warp as wp

from arena_newton.kernels.boxes import FAR, Boxes, body_position, body_rotation, box_centre, box_rotation
from arena_newton.kernels.launching import launch

__all__ = ["ANGLE", "AWAY", "CLEAR", "MARGIN", "NEAR", "SLOW", "TERM", "TOWARD", "UNLATCHED", "UPRIGHT"]
__all__ += ["gap", "launch_predicates", "measured"]

wp.set_module_options({"enable_backward": False})

NEAR = wp.constant(0)
"""A point is at most `limit` [m] away from a box; 0 m inside it."""
CLEAR = wp.constant(1)
"""Every point is farther than `limit` [m] from every box."""
ANGLE = wp.constant(2)
"""A hinge has turned at least `limit` [rad] either way."""
TOWARD = wp.constant(3)
"""A free body moves toward a box's centre with at least `limit` [m/s]."""
AWAY = wp.constant(4)
"""A body's x-axis points away from a box's centre: the cosine of the angle is at least `limit`."""
UNLATCHED = wp.constant(5)
"""The door's latch is released."""
MARGIN = wp.constant(6)
"""The success condition holds at this instant."""
SLOW = wp.constant(7)
"""A free body moves with at most `limit` [m/s]."""
UPRIGHT = wp.constant(8)
"""A body's z-axis points up: the cosine of its tilt is at least `limit`."""
KINDS = {"near": NEAR, "clear": CLEAR, "angle": ANGLE, "toward": TOWARD, "away": AWAY, "unlatched": UNLATCHED}
KINDS |= {"margin": MARGIN, "slow": SLOW, "upright": UPRIGHT}
"""Name of a condition's kind → its number."""

TERM = ("kind", "horizontal", "address", "first_point", "end_point", "first_box", "end_box")
"""Columns of a condition: kind, whether heights are ignored, address in qpos or qvel, ranges of points and of boxes."""


@wp.func
def level(v: wp.vec3, horizontal: int) -> wp.vec3:
    """A vector, without its height where heights are ignored."""
    z = v[2]
    if horizontal != 0:
        z = 0.0
    return wp.vec3(v[0], v[1], z)


@wp.func
def distance_to_box(v: wp.vec3, half: wp.vec3, horizontal: int) -> float:
    """Distance [m] of a point to a centred box; inside, minus the distance to its nearest face."""
    d = wp.vec3(wp.abs(v[0]) - half[0], wp.abs(v[1]) - half[1], wp.abs(v[2]) - half[2])
    if horizontal != 0:
        d = wp.vec3(d[0], d[1], wp.max(d[0], d[1]))
    inside = wp.min(wp.max(d[0], wp.max(d[1], d[2])), 0.0)
    outside = wp.vec3(wp.max(d[0], 0.0), wp.max(d[1], 0.0), wp.max(d[2], 0.0))
    if horizontal != 0:
        outside = wp.vec3(outside[0], outside[1], 0.0)
    return wp.length(outside) + inside


@wp.func
def gap(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    point_body: wp.array[int],
    point_pos: wp.array[wp.vec3],
    boxes: Boxes,
    w: int,
    p: int,
    b: int,
    horizontal: int,
) -> float:
    """Distance [m] of point `p` to box `b`, as `distance_to_box`."""
    body = point_body[p]
    point = body_position(xpos, w, body) + wp.quat_rotate(body_rotation(xquat, w, body), point_pos[p])
    offset = point - box_centre(xpos, xquat, boxes, w, b)
    return distance_to_box(wp.quat_rotate_inv(box_rotation(xquat, boxes, w, b), offset), boxes.half[b], horizontal)


@wp.func
def measured(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    latched: wp.array[int],
    margin: wp.array[float],
    terms: wp.array2d[int],
    point_body: wp.array[int],
    point_pos: wp.array[wp.vec3],
    boxes: Boxes,
    w: int,
    t: int,
) -> float:
    """Quantity that condition `t` compares with its limit, in the unit of its kind."""
    kind = terms[t, 0]
    horizontal = terms[t, 1]
    address = terms[t, 2]
    p0 = terms[t, 3]
    b0 = terms[t, 5]
    if kind == NEAR or kind == CLEAR:
        nearest = float(FAR)
        for p in range(p0, terms[t, 4]):
            for b in range(b0, terms[t, 6]):
                nearest = wp.min(nearest, gap(xpos, xquat, point_body, point_pos, boxes, w, p, b, horizontal))
        return nearest
    if kind == ANGLE:
        return wp.abs(qpos[w, address])
    if kind == UNLATCHED:
        return -float(latched[w])
    if kind == MARGIN:
        return margin[w]
    if kind == SLOW:
        return wp.length(level(wp.vec3(qvel[w, address], qvel[w, address + 1], qvel[w, address + 2]), horizontal))
    body = point_body[p0]
    turn = body_rotation(xquat, w, body)
    if kind == UPRIGHT:
        return wp.quat_rotate(turn, wp.vec3(0.0, 0.0, 1.0))[2]
    point = body_position(xpos, w, body) + wp.quat_rotate(turn, point_pos[p0])
    goal = wp.normalize(level(box_centre(xpos, xquat, boxes, w, b0) - point, horizontal))
    if kind == TOWARD:
        v = wp.vec3(qvel[w, address], qvel[w, address + 1], qvel[w, address + 2])
        return wp.dot(level(v, horizontal), goal)
    ahead = level(wp.quat_rotate(turn, wp.vec3(1.0, 0.0, 0.0)), horizontal)
    return -wp.dot(wp.normalize(ahead), goal)


@wp.kernel
def predicates_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    latched: wp.array[int],
    success: wp.array[int],
    margin: wp.array[float],
    first: wp.array[int],
    terms: wp.array2d[int],
    limits: wp.array[float],
    point_body: wp.array[int],
    point_pos: wp.array[wp.vec3],
    boxes: Boxes,
    predicates: wp.array2d[int],
):
    """One thread per world and predicate; the last predicate is the success flag."""
    w, k = wp.tid()
    if k == predicates.shape[1] - 1:
        predicates[w, k] = success[w]
        return
    every = int(1)
    for t in range(first[k], first[k + 1]):
        kind = terms[t, 0]
        value = measured(xpos, xquat, qpos, qvel, latched, margin, terms, point_body, point_pos, boxes, w, t)
        ok = wp.where(value >= limits[t], 1, 0)
        if kind == NEAR or kind == SLOW:
            ok = wp.where(value <= limits[t], 1, 0)
        elif kind == CLEAR:
            ok = wp.where(value > limits[t], 1, 0)
        every = wp.min(every, ok)
    predicates[w, k] = every


def launch_predicates(
    xpos: wp.array,
    xquat: wp.array,
    qpos: wp.array,
    qvel: wp.array,
    latched: wp.array,
    success: wp.array,
    margin: wp.array,
    *,
    first: wp.array,
    terms: wp.array,
    limits: wp.array,
    point_body: wp.array,
    point_pos: wp.array,
    boxes: Boxes,
    predicates: wp.array,
) -> None:
    """Predicates that hold at this tick; launch after the task's success kernel.

    Arguments that `success` describes are not repeated.

    Args:
        latched: 1 = the latch holds the leaf, int32, shape [worlds].
        success: 1 = success, int32, shape [worlds]; becomes the last predicate.
        margin: Signed distance to success, shape [worlds].
        first: First condition of each predicate but the last, and the number of conditions, int32, shape [n].
        terms: Conditions, columns as `TERM`, int32, shape [conditions, 7].
        limits: Their limits, shape [conditions].
        point_body: Bodies that carry the points, int32, shape [points].
        point_pos: Points in those bodies' frames [m], vec3, shape [points].
        boxes: Boxes, at least one.
        predicates: Output, 1 = holds, int32, shape [worlds, n].
    """
    state = [xpos, xquat, qpos, qvel, latched, success, margin]
    conditions = [first, terms, limits, point_body, point_pos, boxes]
    launch(predicates_kernel, predicates.shape, [*state, *conditions], [predicates])
