"""Directions and turns that rewards and observations need beside those of `motions.frames`, in torch, wxyz."""

from __future__ import annotations

import torch

__all__ = ["gravity_in_body", "turn", "turned_by"]


def gravity_in_body(quat: torch.Tensor) -> torch.Tensor:
    """Direction of gravity in the body's frame, shape [..., 4] to [..., 3]."""
    w, x, y, z = quat.unbind(-1)
    return torch.stack((2.0 * (w * y - x * z), -2.0 * (w * x + y * z), 2.0 * (x * x + y * y) - 1.0), -1)


def turn(angle: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Vectors [..., 3] turned about the vertical by `angle` [rad], broadcast against v's leading dimensions."""
    c, s = torch.cos(angle), torch.sin(angle)
    return torch.stack((c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1], v[..., 2]), -1)


def turned_by(quat: torch.Tensor, rotation_vector: torch.Tensor) -> torch.Tensor:
    """Orientations turned in the body's frame by small rotation vectors [rad], shapes [..., 4] and [..., 3]."""
    w, x, y, z = quat.unbind(-1)
    a, b, c = (0.5 * rotation_vector).unbind(-1)
    out = torch.stack(
        (w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a),
        -1,
    )
    return out / out.norm(dim=-1, keepdim=True)
