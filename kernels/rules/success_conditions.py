"""Success where it is a conjunction of conditions, with a margin that is differentiable as those in `success`."""

# ruff: noqa: UP018 - `int(0)` declares a variable in Warp, `0` a constant that a loop may not change

import warp as wp

from arena_newton.kernels.boxes import FAR, Boxes, count_up
from arena_newton.kernels.launching import launch
from arena_newton.kernels.rules.predicates import CLEAR, NEAR, SLOW, gap, measured

__all__ = ["launch_conditions"]


@wp.func
def slack(value: float, kind: int, limit: float) -> float:
    """Distance of a quantity to its limit, at least 0 where the condition holds."""
    s = value - limit
    if kind == NEAR or kind == SLOW:
        s = -s
    return s


@wp.func
def closest(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    terms: wp.array2d[int],
    point_body: wp.array[int],
    point_pos: wp.array[wp.vec3],
    boxes: Boxes,
    w: int,
    t: int,
) -> int:
    """The pair of a point and a box of condition `t` with the smallest gap, point times boxes plus box."""
    best = int(0)
    smallest = float(FAR)
    for p in range(terms[t, 3], terms[t, 4]):
        for b in range(terms[t, 5], terms[t, 6]):
            d = gap(xpos, xquat, point_body, point_pos, boxes, w, p, b, terms[t, 1])
            if d < smallest:
                smallest = d
                best = p * boxes.body.shape[0] + b
    return best


@wp.func
def tightest(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    latched: wp.array[int],
    margin: wp.array[float],
    terms: wp.array2d[int],
    limits: wp.array[float],
    point_body: wp.array[int],
    point_pos: wp.array[wp.vec3],
    boxes: Boxes,
    w: int,
) -> int:
    """The condition with the smallest slack."""
    best = int(0)
    least = float(FAR)
    for t in range(terms.shape[0]):
        value = measured(xpos, xquat, qpos, qvel, latched, margin, terms, point_body, point_pos, boxes, w, t)
        s = slack(value, terms[t, 0], limits[t])
        if s < least:
            least = s
            best = t
    return best


@wp.kernel
def conditions_kernel(
    xpos: wp.array3d[float],
    xquat: wp.array3d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    latched: wp.array[int],
    ticks: int,
    terms: wp.array2d[int],
    limits: wp.array[float],
    point_body: wp.array[int],
    point_pos: wp.array[wp.vec3],
    boxes: Boxes,
    counter: wp.array[int],
    success: wp.array[int],
    margin: wp.array[float],
):
    """One thread per world: all conditions hold, `ticks` in a row; the margin is the smallest slack of them."""
    w = wp.tid()
    t = tightest(xpos, xquat, qpos, qvel, latched, margin, terms, limits, point_body, point_pos, boxes, w)
    kind = terms[t, 0]
    value = float(0.0)
    if kind == NEAR or kind == CLEAR:  # a minimum within a loop has no adjoint
        k = closest(xpos, xquat, terms, point_body, point_pos, boxes, w, t)
        n = boxes.body.shape[0]
        value = gap(xpos, xquat, point_body, point_pos, boxes, w, k / n, k % n, terms[t, 1])
    else:
        value = measured(xpos, xquat, qpos, qvel, latched, margin, terms, point_body, point_pos, boxes, w, t)
    m = slack(value, kind, limits[t])
    count = count_up(m, counter[w])
    counter[w] = count
    margin[w] = m
    success[w] = wp.where(count >= ticks, 1, 0)


def launch_conditions(
    xpos: wp.array,
    xquat: wp.array,
    qpos: wp.array,
    qvel: wp.array,
    latched: wp.array,
    *,
    ticks: int,
    terms: wp.array,
    limits: wp.array,
    point_body: wp.array,
    point_pos: wp.array,
    boxes: Boxes,
    counter: wp.array,
    success: wp.array,
    margin: wp.array,
) -> None:
    """Success of a task that is one conjunction of conditions.

    Arguments that `predicates.launch_predicates` and `success` describe are not repeated.

    Args:
        ticks: Ticks in a row for which all must hold.
    """
    state = [xpos, xquat, qpos, qvel, latched, ticks]
    conditions = [terms, limits, point_body, point_pos, boxes]
    launch(conditions_kernel, success.shape, [*state, *conditions], [counter, success, margin])
