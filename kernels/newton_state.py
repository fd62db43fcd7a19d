"""Between the solver's batch and the rest: body poses for rendering, latch and overflow flags, idle worlds."""

from typing import Any

import warp as wp

from arena_newton.kernels.launching import launch

__all__ = ["launch_body_q", "launch_latch", "launch_overflow", "launch_put_back"]


@wp.kernel
def _body_q(
    xpos: wp.array3d[wp.float32],
    xquat: wp.array3d[wp.float32],
    newton_body: wp.array2d[wp.int32],
    body_q: wp.array[wp.transform],
):
    world, body = wp.tid()
    target = newton_body[world, body]
    if target >= 0:
        position = wp.vec3(xpos[world, body, 0], xpos[world, body, 1], xpos[world, body, 2])
        rotation = wp.quat(xquat[world, body, 1], xquat[world, body, 2], xquat[world, body, 3], xquat[world, body, 0])
        body_q[target] = wp.transform(position, rotation)


def launch_body_q(xpos: wp.array, xquat: wp.array, newton_body: wp.array, body_q: wp.array) -> None:
    """Write body poses [worlds, nbody] (position [m], quaternion wxyz) into Newton's `State.body_q`."""
    launch(_body_q, newton_body.shape, [xpos, xquat, newton_body], [body_q])


@wp.kernel
def _latch(locked: wp.array[wp.int32], equality: wp.int32, eq_active: wp.array2d[wp.bool]):
    world = wp.tid()
    eq_active[world, equality] = locked[world] != 0


def launch_latch(locked: wp.array, equality: int, eq_active: wp.array) -> None:
    """Set an equality constraint active where `locked` [worlds] is 1."""
    launch(_latch, locked.shape[0], [locked, equality], [eq_active])


@wp.kernel
def _overflow(mask: wp.array[wp.int32], lost: wp.int32, seen: wp.array[wp.int32]):
    world = wp.tid()
    if (mask[world] & lost) != 0:
        seen[world] = 1


LOST_CONTACTS = 0b10111111
"""Bits of mujoco_warp's overflow mask that mean lost contacts or constraint rows (not iteration limits)."""


def launch_overflow(mask: wp.array, seen: wp.array) -> None:
    """Remember in `seen` [worlds] that a contact or constraint buffer overflowed since the last reset."""
    launch(_overflow, seen.shape[0], [mask, LOST_CONTACTS], [seen])


@wp.kernel
def _put_back(mask: wp.array[wp.int32], saved: wp.array2d[Any], rows: wp.array2d[Any]):
    world, column = wp.tid()
    if mask[world] != 0:
        rows[world, column] = saved[world, column]


for _words in (wp.int32, wp.uint8):  # all of them now: one that a launch adds compiles the whole module again
    wp.overload(_put_back, [wp.array[wp.int32], wp.array2d[_words], wp.array2d[_words]])


def launch_put_back(mask: wp.array, saved: wp.array, rows: wp.array) -> None:
    """Copy the rows of the masked worlds (int32, 1 = copy) from `saved` into `rows`, both [worlds, n]."""
    launch(_put_back, rows.shape, [mask, saved], [rows])
