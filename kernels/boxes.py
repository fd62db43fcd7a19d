"""Oriented boxes carried by bodies, and slacks: signed distances [m] of a point to a box's faces, negative outside.

Boxes come from the stage's markers, in the frame of the body that carries them. All success conditions use the
functions here. Searches such as "the nearest of some boxes" are functions and not loops of a kernel: in the backward
pass Warp does not run a kernel's loops again, but it does call functions again.
"""

from collections.abc import Iterable
from typing import Protocol

import warp as wp

from arena_newton.kernels.rotations import load_quat2, load_quat3, load_vec3, quat_from_wxyz, up_of

__all__ = [
    "FAR",
    "Boxes",
    "body_position",
    "body_rotation",
    "box_centre",
    "box_rotation",
    "count_up",
    "holds",
    "slack_box",
    "slack_standing",
    "slack_xy",
    "upload_boxes",
    "world_half",
]

FAR = wp.constant(1.0e6)
"""Larger than any slack [m]."""


class BoxLike(Protocol):
    """Attributes that a scene's box marker has."""

    @property
    def body_id(self) -> int:
        """Carrying body, 0 = world."""

    @property
    def pos(self) -> Iterable[float]:
        """Centre [m] in the body's frame, 3 numbers."""

    @property
    def quat(self) -> Iterable[float]:
        """Orientation in the body's frame, wxyz."""

    @property
    def half(self) -> Iterable[float]:
        """Half extents [m], 3 numbers."""


@wp.struct
class Boxes:
    """Oriented boxes on the device, one entry per marker."""

    body: wp.array[int]
    """Carrying body, 0 = world, int32, shape [boxes]."""
    pos: wp.array[wp.vec3]
    """Centre [m] in the body's frame, shape [boxes]."""
    quat: wp.array[wp.vec4]
    """Orientation in the body's frame, wxyz, shape [boxes]."""
    half: wp.array[wp.vec3]
    """Half extents [m], shape [boxes]."""


def upload_boxes(markers: Iterable[BoxLike], device: wp.DeviceLike = None) -> Boxes:
    """Boxes on a Warp device."""
    rows = list(markers)

    def vectors(values: list, dtype: type) -> wp.array:
        return wp.array([dtype(*(float(v) for v in row)) for row in values], dtype=dtype, device=device)

    boxes = Boxes()
    boxes.body = wp.array([int(m.body_id) for m in rows], dtype=wp.int32, device=device)
    boxes.pos, boxes.half = vectors([m.pos for m in rows], wp.vec3), vectors([m.half for m in rows], wp.vec3)
    boxes.quat = vectors([m.quat for m in rows], wp.vec4)
    return boxes


@wp.func
def body_rotation(xquat: wp.array3d[float], world: int, body: int) -> wp.quat:
    """World orientation of a body; the world body's is the identity whatever the array holds."""
    q = wp.quat(0.0, 0.0, 0.0, 1.0)
    if body > 0:
        q = load_quat3(xquat, world, body)
    return q


@wp.func
def body_position(xpos: wp.array3d[float], world: int, body: int) -> wp.vec3:
    """World position [m] of a body; the world body's is zero whatever the array holds."""
    p = wp.vec3(0.0, 0.0, 0.0)
    if body > 0:
        p = load_vec3(xpos, world, body)
    return p


@wp.func
def box_rotation(xquat: wp.array3d[float], boxes: Boxes, world: int, box: int) -> wp.quat:
    """World orientation of a box."""
    return body_rotation(xquat, world, boxes.body[box]) * wp.normalize(quat_from_wxyz(boxes.quat[box]))


@wp.func
def box_centre(xpos: wp.array3d[float], xquat: wp.array3d[float], boxes: Boxes, world: int, box: int) -> wp.vec3:
    """World position [m] of a box's centre."""
    b = boxes.body[box]
    return body_position(xpos, world, b) + wp.quat_rotate(body_rotation(xquat, world, b), boxes.pos[box])


@wp.func
def slack_xy(p: wp.vec3, half: wp.vec3) -> float:
    """Smallest distance [m] of a point to the four upright faces of a centred box, negative outside."""
    return wp.min(half[0] - wp.abs(p[0]), half[1] - wp.abs(p[1]))


@wp.func
def slack_box(p: wp.vec3, half: wp.vec3) -> float:
    """Smallest distance [m] of a point to the six faces of a centred box, negative outside."""
    return wp.min(slack_xy(p, half), half[2] - wp.abs(p[2]))


@wp.func
def world_half(q: wp.quat, half: wp.vec3) -> wp.vec3:
    """Half extents [m] of the world-axis box around a rotated box."""
    r = wp.quat_to_matrix(q)
    return wp.vec3(
        wp.abs(r[0, 0]) * half[0] + wp.abs(r[0, 1]) * half[1] + wp.abs(r[0, 2]) * half[2],
        wp.abs(r[1, 0]) * half[0] + wp.abs(r[1, 1]) * half[1] + wp.abs(r[1, 2]) * half[2],
        wp.abs(r[2, 0]) * half[0] + wp.abs(r[2, 1]) * half[1] + wp.abs(r[2, 2]) * half[2],
    )


@wp.func
def slack_standing(qpos: wp.array2d[float], world: int, root: int, stand_height: float, stand_up: float) -> float:
    """Slack [m] of standing: root height, and the up-axis as the height of a point 1 m up the robot's axis."""
    up = up_of(load_quat2(qpos, world, root + 3))
    return wp.min(qpos[world, root + 2] - stand_height, up - stand_up)


@wp.func
def holds(margin: float) -> int:
    """1 when a margin is at least 0."""
    return wp.where(margin >= 0.0, 1, 0)


@wp.func
def count_up(margin: float, counter: int) -> int:
    """Ticks in a row with a margin of at least 0, this one included."""
    return wp.where(margin >= 0.0, counter + 1, 0)
