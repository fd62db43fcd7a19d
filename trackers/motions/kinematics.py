"""Forward kinematics of the G1 in torch: poses of all links and the centre of mass, batched, from the link table.

The link table (`usd_scenes.g1.links`) is the one copy of the robot's numbers. Fingers are open (angle zero).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch

from arena_newton.robot.g1 import DEFAULT_POSE, FEET, MUJOCO_JOINTS
from arena_newton.robot.rotations import matrix_from_quat_np, quat_apply, quat_multiply
from arena_newton.usd_scenes.g1.links import LINKS

__all__ = ["HAND_POINT", "LINK_NAMES", "SOLE_CENTRE", "SOLE_HEIGHT", "Chain", "Poses", "Stance", "chain", "forward"]
__all__ += ["link_index", "neutral_stance"]

SOLE_HEIGHT = 0.035
"""Height of the ankle roll frame above the ground with a flat foot [m]: contact spheres at -0.03, radius 0.005."""
SOLE_CENTRE = 0.035
"""Middle of the four contact spheres ahead of the ankle roll frame [m]."""
HAND_POINT = 0.10
"""Distance of the point of a hand that reaches ahead of the wrist yaw frame [m]: the middle of the palm."""
LINK_NAMES: tuple[str, ...] = tuple(link.name for link in LINKS)
"""Links in the order of `Poses`."""

_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


def link_index(name: str) -> int:
    """Row of a link in `Poses`."""
    return LINK_NAMES.index(name)


@dataclass(frozen=True)
class Poses:
    """Links of a batch of robots in the world."""

    position: torch.Tensor
    """Origins [m], shape [..., links, 3]."""
    quat: torch.Tensor
    """Orientations, wxyz, shape [..., links, 4]."""
    com: torch.Tensor
    """Centre of mass of the whole robot [m], shape [..., 3]."""


def forward(root_pos: torch.Tensor, root_quat: torch.Tensor, joint_pos: torch.Tensor) -> Poses:
    """Poses of all links.

    Args:
        root_pos: Pelvis position [m], shape [..., 3].
        root_quat: Pelvis orientation, wxyz, shape [..., 4].
        joint_pos: Joint angles [rad], MuJoCo order, shape [..., 29].
    """

    def constant(values: tuple[float, ...]) -> torch.Tensor:
        return root_pos.new_tensor(values)

    half = 0.5 * joint_pos
    cos, sin = torch.cos(half), torch.sin(half)
    positions: list[torch.Tensor] = []
    quats: list[torch.Tensor] = []
    moment = torch.zeros_like(root_pos)
    for link in LINKS:
        if link.parent is None:
            position, quat = root_pos, root_quat
        else:
            parent = link_index(link.parent)
            position = positions[parent] + quat_apply(quats[parent], constant(link.offset).expand(root_pos.shape))
            quat = quat_multiply(quats[parent], constant(link.quat).expand(root_quat.shape))
            if link.hinge is not None and link.hinge.name in MUJOCO_JOINTS:
                j = MUJOCO_JOINTS.index(link.hinge.name)
                turn = torch.cat([cos[..., j : j + 1], sin[..., j : j + 1] * constant(_AXES[link.hinge.axis])], -1)
                quat = quat_multiply(quat, turn)
        positions.append(position)
        quats.append(quat)
        moment = moment + link.mass * (position + quat_apply(quat, constant(link.com).expand(root_pos.shape)))
    total = sum(link.mass for link in LINKS)
    return Poses(torch.stack(positions, -2), torch.stack(quats, -2), moment / total)


@dataclass(frozen=True)
class Chain:
    """Pelvis and the 29 links that body joints carry, fingers lumped into the wrists; row 1 + j is moved by joint j."""

    offset: np.ndarray
    """Origin in the parent's frame [m], shape [30, 3]."""
    quat: np.ndarray
    """Orientation in the parent's frame at angle zero, wxyz, shape [30, 4]."""
    axis: np.ndarray
    """Joint axis in the link's frame, shape [30, 3]."""
    limits: np.ndarray
    """Lower and upper angle [rad], shape [30, 2]."""
    mass: np.ndarray
    """Mass [kg], shape [30]."""
    com: np.ndarray
    """Centre of mass in the link's frame [m], shape [30, 3]."""
    hand_point: float
    """`HAND_POINT` [m]."""


@functools.cache
def chain() -> Chain:
    """The table in the form that the IK kernel reads."""
    table = {link.name: link for link in LINKS}
    rows = [LINKS[0]] + [next(k for k in LINKS if k.hinge and k.hinge.name == name) for name in MUJOCO_JOINTS]
    kept = {link.name for link in rows}
    mass, moment = dict.fromkeys(kept, 0.0), {name: np.zeros(3) for name in kept}
    for link in LINKS:
        point, at = np.asarray(link.com, dtype=float), link
        while at.name not in kept:
            quat = np.asarray(at.quat) / np.linalg.norm(at.quat)
            point = np.asarray(at.offset) + matrix_from_quat_np(quat) @ point
            at = table[at.parent or ""]
        mass[at.name] += link.mass
        moment[at.name] += link.mass * point
    return Chain(
        offset=np.array([k.offset for k in rows], dtype=np.float32),
        quat=np.array([k.quat for k in rows], dtype=np.float32),
        axis=np.array([_AXES[k.hinge.axis] if k.hinge else (0.0, 0.0, 1.0) for k in rows], dtype=np.float32),
        limits=np.array([k.hinge.limits if k.hinge else (0.0, 0.0) for k in rows], dtype=np.float32),
        mass=np.array([mass[k.name] for k in rows], dtype=np.float32),
        com=np.array([moment[k.name] / mass[k.name] for k in rows], dtype=np.float32),
        hand_point=HAND_POINT,
    )


@dataclass(frozen=True)
class Stance:
    """The default pose on flat feet; lengths in the pelvis' heading frame."""

    height: float
    """Pelvis above the ground [m]."""
    ankle: float
    """Ankles ahead of the pelvis [m]."""
    width: float
    """Distance between the ankles [m]."""
    com: float
    """Centre of mass ahead of the pelvis [m]."""
    hands: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Hand points [m], left and right."""


@functools.cache
def neutral_stance() -> Stance:
    """Numbers of `g1.DEFAULT_POSE`, whose feet are flat when the pelvis is upright."""
    poses = forward(
        torch.zeros(3, dtype=torch.float64),
        torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64),
        torch.tensor(DEFAULT_POSE, dtype=torch.float64),
    )
    feet = poses.position[[link_index(name) for name in FEET]]
    wrist = [link_index(f"{side}_wrist_yaw_link") for side in ("left", "right")]
    palm = torch.tensor([HAND_POINT, 0.0, 0.0], dtype=torch.float64).expand(2, 3)
    hands = poses.position[wrist] + quat_apply(poses.quat[wrist], palm)
    left, right = ((float(h[0]), float(h[1]), float(h[2])) for h in hands)
    return Stance(
        height=SOLE_HEIGHT - float(feet[:, 2].mean()),
        ankle=float(feet[:, 0].mean()),
        width=float(feet[0, 1] - feet[1, 1]),
        com=float(poses.com[0]),
        hands=(left, right),
    )
