"""Rotations as Warp functions: wxyz quaternions in arrays, rot6d, heading, roll/pitch/yaw, rotation limits.

Arrays hold quaternions as wxyz (MuJoCo); inside a kernel they are `wp.quat` (xyzw). Formulas: specification of the
original benchmark, rot6d row layout [R00, R01, R10, R11, R20, R21] and TWIST2's roll and pitch.
"""

import warp as wp

__all__ = [
    "DEGENERATE",
    "TWO_PI",
    "heading_quat",
    "heading_yaw",
    "limit_rotation",
    "load_quat2",
    "load_quat3",
    "load_vec3",
    "pitch_of",
    "quat_from_rot6d",
    "quat_from_wxyz",
    "roll_of",
    "rot6d_from_quat",
    "rot6d_is_degenerate",
    "up_of",
    "vec6",
    "wrap_angle",
]

vec6 = wp.types.vector(length=6, dtype=wp.float32)
"""Six numbers of a rot6d in row layout."""

PI = wp.constant(3.14159265358979)
TWO_PI = wp.constant(6.28318530717959)
DEGENERATE = wp.constant(1.0e-6)
"""A rot6d whose columns span an area below this is no rotation (the original's newer validator)."""


@wp.func
def quat_from_wxyz(v: wp.vec4) -> wp.quat:
    """The quaternion stored as (w, x, y, z)."""
    return wp.quat(v[1], v[2], v[3], v[0])


@wp.func
def load_vec3(values: wp.array3d[float], world: int, item: int) -> wp.vec3:
    """Row `item` of one world as a vector; values, shape [worlds, items, 3]."""
    return wp.vec3(values[world, item, 0], values[world, item, 1], values[world, item, 2])


@wp.func
def load_quat3(values: wp.array3d[float], world: int, item: int) -> wp.quat:
    """Row `item` of one world as a unit quaternion; values wxyz, shape [worlds, items, 4]."""
    return wp.normalize(
        wp.quat(values[world, item, 1], values[world, item, 2], values[world, item, 3], values[world, item, 0])
    )


@wp.func
def load_quat2(values: wp.array2d[float], world: int, address: int) -> wp.quat:
    """Four numbers wxyz from `address` of one world's row as a unit quaternion; values, shape [worlds, n]."""
    return wp.normalize(
        wp.quat(
            values[world, address + 1], values[world, address + 2], values[world, address + 3], values[world, address]
        )
    )


@wp.func
def rot6d_from_quat(q: wp.quat) -> vec6:
    """First two columns of the rotation matrix, row by row, of a unit quaternion."""
    r = wp.quat_to_matrix(q)
    return vec6(r[0, 0], r[0, 1], r[1, 0], r[1, 1], r[2, 0], r[2, 1])


@wp.func
def rot6d_is_degenerate(v: vec6) -> bool:
    """True if the two columns of a rot6d (row layout) span no plane."""
    c0 = wp.vec3(v[0], v[2], v[4])
    c1 = wp.vec3(v[1], v[3], v[5])
    return not (wp.length(wp.cross(c0, c1)) >= DEGENERATE)


@wp.func
def quat_from_matrix_columns(c0: wp.vec3, c1: wp.vec3, c2: wp.vec3) -> wp.quat:
    """Unit quaternion of the rotation matrix with these columns (Shepperd: divides by the largest component)."""
    trace = c0[0] + c1[1] + c2[2]
    q = wp.quat(c1[2] - c2[1], c2[0] - c0[2], c0[1] - c1[0], 1.0 + trace)
    if trace < c0[0] or trace < c1[1] or trace < c2[2]:
        if c0[0] >= c1[1] and c0[0] >= c2[2]:
            q = wp.quat(1.0 + c0[0] - c1[1] - c2[2], c0[1] + c1[0], c2[0] + c0[2], c1[2] - c2[1])
        elif c1[1] >= c2[2]:
            q = wp.quat(c0[1] + c1[0], 1.0 - c0[0] + c1[1] - c2[2], c1[2] + c2[1], c2[0] - c0[2])
        else:
            q = wp.quat(c2[0] + c0[2], c1[2] + c2[1], 1.0 - c0[0] - c1[1] + c2[2], c0[1] - c1[0])
    return wp.normalize(q)


@wp.func
def quat_from_rot6d(v: vec6) -> wp.quat:
    """Rotation of a rot6d in row layout by Gram-Schmidt; a degenerate one gives the identity (callers reject it)."""
    c0 = wp.vec3(v[0], v[2], v[4])
    c1 = wp.vec3(v[1], v[3], v[5])
    if rot6d_is_degenerate(v):
        return wp.quat(0.0, 0.0, 0.0, 1.0)
    a = wp.normalize(c0)
    b = wp.normalize(c1 - a * wp.dot(a, c1))
    return quat_from_matrix_columns(a, b, wp.cross(a, b))


@wp.func
def heading_yaw(q: wp.quat) -> float:
    """Heading [rad] of a unit quaternion, atan2(2(wz+xy), 1-2(y²+z²)); also its yaw in TWIST2's roll, pitch, yaw."""
    return wp.atan2(2.0 * (q[3] * q[2] + q[0] * q[1]), 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))


@wp.func
def heading_quat(yaw: float) -> wp.quat:
    """Rotation by `yaw` [rad] about world z."""
    return wp.quat(0.0, 0.0, wp.sin(0.5 * yaw), wp.cos(0.5 * yaw))


@wp.func
def roll_of(q: wp.quat) -> float:
    """Roll [rad] of a unit quaternion, atan2(2(wx+yz), 1-2(x²+y²))."""
    return wp.atan2(2.0 * (q[3] * q[0] + q[1] * q[2]), 1.0 - 2.0 * (q[0] * q[0] + q[1] * q[1]))


@wp.func
def pitch_of(q: wp.quat) -> float:
    """Pitch [rad] of a unit quaternion, asin of 2(wy-zx) clamped to [-1, 1]."""
    return wp.asin(wp.clamp(2.0 * (q[3] * q[1] - q[2] * q[0]), -1.0, 1.0))


@wp.func
def up_of(q: wp.quat) -> float:
    """World z of the body's up-axis, 1-2(x²+y²) clamped to [-1, 1]; the cosine of the tilt."""
    return wp.clamp(1.0 - 2.0 * (q[0] * q[0] + q[1] * q[1]), -1.0, 1.0)


@wp.func
def wrap_angle(angle: float) -> float:
    """The same angle [rad] in [-pi, pi)."""
    return angle - TWO_PI * wp.floor((angle + PI) / TWO_PI)


@wp.func
def limit_rotation(start: wp.quat, target: wp.quat, max_angle: float) -> wp.quat:
    """`target`, or the point of the shortest arc from `start` to it `max_angle` [rad] away from it."""
    delta = wp.quat_inverse(start) * target
    w = delta[3]
    v = wp.vec3(delta[0], delta[1], delta[2])
    if w < 0.0:
        w = -w
        v = -v
    size = wp.length(v)
    if 2.0 * wp.atan2(size, w) <= max_angle:
        return target
    axis = v / size
    s = wp.sin(0.5 * max_angle)
    return wp.normalize(start * wp.quat(axis[0] * s, axis[1] * s, axis[2] * s, wp.cos(0.5 * max_angle)))
