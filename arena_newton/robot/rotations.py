"""Quaternions and planar rotations in torch, and a few in NumPy; `kernels.rotations` has those of the kernels.

Quaternions are wxyz. A function takes the rotation first, then what it rotates.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

__all__ = [
    "atan2",
    "gravity_in_body",
    "heading",
    "heading_np",
    "heading_quat",
    "matrix_from_quat",
    "matrix_from_quat_np",
    "quat_apply",
    "quat_conjugate",
    "quat_from_euler",
    "quat_from_matrix",
    "quat_from_rot6d",
    "quat_from_yaw",
    "quat_from_yaw_np",
    "quat_multiply",
    "roll_pitch",
    "rotate_xy",
    "rotation_vector",
    "turn",
    "turned_by",
    "wrap_angle",
]


def atan2(y: Tensor, x: Tensor) -> Tensor:
    """Angle of (x, y) [rad], elementwise; the same bits whatever the number of elements.

    On the CPU torch computes contiguous elements in blocks of 8 or more, with other last bits than those that are left
    over, so that an episode would depend on how many worlds run with it; elements with a stride it computes one by one.
    """
    one_by_one = y.numel() < 8 or (y.dim() == 1 and y.stride(0) > 1 and x.stride(0) > 1)
    if y.is_cuda or (y.shape == x.shape and one_by_one):
        return torch.atan2(y, x)
    pair = torch.stack(torch.broadcast_tensors(y, x), dim=-1)
    return torch.atan2(pair[..., 0], pair[..., 1])


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle within -pi..pi [rad]."""
    return atan2(torch.sin(angle), torch.cos(angle))


def rotate_xy(yaw: Tensor, vector: Tensor) -> Tensor:
    """Planar vectors of a heading frame in the world, for `-yaw` the inverse; shapes [...] [rad] and [..., 2]."""
    c, s = torch.cos(yaw), torch.sin(yaw)
    x, y = vector.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y], dim=-1)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Product of quaternions wxyz, shapes [..., 4]."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def quat_conjugate(quat: Tensor) -> Tensor:
    """The inverse of unit quaternions wxyz, shape [..., 4]."""
    return torch.cat([quat[..., :1], -quat[..., 1:]], dim=-1)


def quat_apply(quat: Tensor, vector: Tensor) -> Tensor:
    """Vectors [..., 3] turned by unit quaternions wxyz [..., 4]."""
    w, u = quat[..., :1], quat[..., 1:]
    u, vector = torch.broadcast_tensors(u, vector)
    t = 2.0 * torch.cross(u, vector, dim=-1)
    return vector + w * t + torch.cross(u, t, dim=-1)


def quat_from_yaw(yaw: Tensor) -> Tensor:
    """Rotation by `yaw` [rad] about world z, wxyz, shape [..., 4]."""
    zero = torch.zeros_like(yaw)
    return torch.stack([torch.cos(0.5 * yaw), zero, zero, torch.sin(0.5 * yaw)], dim=-1)


def quat_from_euler(angles: Tensor) -> Tensor:
    """Rotations by yaw, pitch, roll [rad] in this order (ZYX), shape [..., 3], wxyz, shape [..., 4]."""
    half = 0.5 * angles
    cz, cy, cx = torch.cos(half).unbind(-1)
    sz, sy, sx = torch.sin(half).unbind(-1)
    return torch.stack(
        [
            cz * cy * cx + sz * sy * sx,
            cz * cy * sx - sz * sy * cx,
            cz * sy * cx + sz * cy * sx,
            sz * cy * cx - cz * sy * sx,
        ],
        dim=-1,
    )


def heading(quat: Tensor) -> Tensor:
    """Heading of unit quaternions [rad], atan2(2(wz + xy), 1 - 2(y² + z²))."""
    w, x, y, z = quat.unbind(-1)
    return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def heading_quat(quat: Tensor) -> Tensor:
    """Rotations about the vertical by the heading of unit quaternions, wxyz, shapes [..., 4].

    Sums, products, quotients and roots alone, which are exactly rounded: a row's bits do not depend on the other rows.
    """
    w, x, y, z = quat.unbind(-1)
    ahead, left = 1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y)
    length = torch.sqrt(ahead * ahead + left * left).clamp_min(torch.finfo(quat.dtype).tiny)
    cosine, sine = ahead / length, left / length
    larger = torch.sqrt(0.5 + 0.5 * cosine.abs())
    smaller = 0.5 * sine / larger
    front, zero = cosine >= 0.0, torch.zeros_like(w)
    half = torch.where(front, larger, smaller.abs())
    return torch.stack([half, zero, zero, torch.where(front, smaller, torch.copysign(larger, sine))], dim=-1)


def roll_pitch(quat: Tensor) -> Tensor:
    """Roll and pitch of unit quaternions (ZYX angles) [rad], shape [..., 2]."""
    w, x, y, z = quat.unbind(-1)
    roll = atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    return torch.stack([roll, pitch], dim=-1)


def rotation_vector(quat: Tensor) -> Tensor:
    """Axis times angle [rad] of unit quaternions along the shorter arc, shape [..., 3]."""
    quat = torch.where(quat[..., :1] < 0.0, -quat, quat)
    sine = torch.linalg.vector_norm(quat[..., 1:], dim=-1, keepdim=True)
    angle = 2.0 * atan2(sine, quat[..., :1])
    # angle / sine tends to 2 for small angles.
    tiny = torch.finfo(quat.dtype).tiny
    return quat[..., 1:] * torch.where(sine > 1e-9, angle / sine.clamp_min(tiny), torch.full_like(sine, 2.0))


def matrix_from_quat(quat: Tensor) -> Tensor:
    """Rotation matrices of unit quaternions wxyz, shape [..., 3, 3]."""
    w, x, y, z = quat.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def quat_from_matrix(matrix: Tensor) -> Tensor:
    """Unit quaternions wxyz of rotation matrices [..., 3, 3], by the best conditioned of Shepperd's four formulas."""
    m00, m11, m22 = matrix[..., 0, 0], matrix[..., 1, 1], matrix[..., 2, 2]
    pairs = ((2, 1), (0, 2), (1, 0))
    a, b, c = (matrix[..., i, j] - matrix[..., j, i] for i, j in pairs)
    f, e, d = (matrix[..., i, j] + matrix[..., j, i] for i, j in pairs)
    # Row i is 4 q_i q: the one with the largest diagonal has the least cancellation.
    rows = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, a, b, c], dim=-1),
            torch.stack([a, 1 + m00 - m11 - m22, d, e], dim=-1),
            torch.stack([b, d, 1 - m00 + m11 - m22, f], dim=-1),
            torch.stack([c, e, f, 1 - m00 - m11 + m22], dim=-1),
        ],
        dim=-2,
    )
    best = torch.diagonal(rows, dim1=-2, dim2=-1).argmax(dim=-1)[..., None, None].expand(*rows.shape[:-2], 1, 4)
    return torch.nn.functional.normalize(rows.gather(-2, best).squeeze(-2), dim=-1)


def quat_from_rot6d(rot6d: Tensor) -> Tensor:
    """Rotation next to each rot6d in row layout [..., 6] (Gram-Schmidt), wxyz, shape [..., 4]."""
    columns = rot6d.unflatten(-1, (3, 2))
    x = torch.nn.functional.normalize(columns[..., 0], dim=-1)
    y = columns[..., 1] - x * (x * columns[..., 1]).sum(-1, keepdim=True)
    y = torch.nn.functional.normalize(y, dim=-1)
    return quat_from_matrix(torch.stack([x, y, torch.cross(x, y, dim=-1)], dim=-1))


def gravity_in_body(quat: Tensor) -> Tensor:
    """Direction of gravity in the body's frame, shape [..., 4] to [..., 3]."""
    w, x, y, z = quat.unbind(-1)
    return torch.stack((2.0 * (w * y - x * z), -2.0 * (w * x + y * z), 2.0 * (x * x + y * y) - 1.0), -1)


def turn(yaw: Tensor, vector: Tensor) -> Tensor:
    """Vectors [..., 3] rotated about the vertical by `yaw` [rad], broadcast against their leading dimensions."""
    c, s = torch.cos(yaw), torch.sin(yaw)
    x, y, z = vector.unbind(-1)
    return torch.stack((c * x - s * y, s * x + c * y, z), -1)


def turned_by(quat: Tensor, vector: Tensor) -> Tensor:
    """Orientations rotated in the body's frame by small rotation vectors [rad], shapes [..., 4] and [..., 3]."""
    w, x, y, z = quat.unbind(-1)
    a, b, c = (0.5 * vector).unbind(-1)
    out = torch.stack(
        (w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a),
        -1,
    )
    unit: Tensor = out / out.norm(dim=-1, keepdim=True)
    return unit


def heading_np(quat: np.ndarray) -> float:
    """Heading of one unit quaternion wxyz [rad]."""
    w, x, y, z = quat
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def quat_from_yaw_np(yaw: float) -> np.ndarray:
    """Rotation by `yaw` [rad] about world z, wxyz, shape [4]."""
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def matrix_from_quat_np(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of one unit quaternion wxyz, shape [3, 3]."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
