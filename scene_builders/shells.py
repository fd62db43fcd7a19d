"""Outer shapes of the G1: what the cameras see, from lofted shells and rounded blocks.

Dimensions are our own, read off the public proportions of the robot (1.32 m tall) and of its joint offsets. Light
shells, black motors, hands and feet, and a dark head, as the robot looks from outside; its chest edge, forearms, hands
and feet are what its head camera sees. The space in front of and around the head camera is empty.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["HAND_SHAPES", "LOOKS", "SHAPES", "Block", "Loft", "Rod", "grid", "merge"]

LOOKS: dict[str, tuple[tuple[float, float, float], float]] = {
    "shell": ((0.67, 0.67, 0.69), 0.55),
    "joint": ((0.055, 0.055, 0.06), 0.6),
    "hand": ((0.035, 0.035, 0.04), 0.5),
    "visor": ((0.02, 0.02, 0.024), 0.2),
}
"""Colour and roughness by look."""


@dataclass(frozen=True)
class Loft:
    """A closed shell through superellipse sections; each row is `t, cu, cv, hu, hv` [m].

    `t` runs along `axis`, `(cu, cv)` is the section's centre and `(hu, hv)` its half widths along the two other axes in
    cyclic order (z: x, y; x: y, z; y: z, x). `roundness` 2 is an ellipse, higher is boxier.
    """

    look: str
    axis: str
    rows: tuple[tuple[float, float, float, float, float], ...]
    roundness: float = 2.6
    around: int = 16


@dataclass(frozen=True)
class Block:
    """A box with rounded edges: half sizes and centre [m]."""

    look: str
    half: tuple[float, float, float]
    center: tuple[float, float, float]
    bevel: float = 0.35
    axis: str = "x"


@dataclass(frozen=True)
class Rod:
    """A cylinder: radius, length and centre [m]."""

    look: str
    radius: float
    length: float
    center: tuple[float, float, float]
    axis: str = "Y"


def grid(shape: Loft | Block) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [n,3] m, outward normals [n,3] and triangles [m,3] of a lofted shape; the two ends are flat."""
    if isinstance(shape, Block):
        a = "xyz".index(shape.axis)
        h, hu, hv = (shape.half[(a + k) % 3] for k in range(3))
        c, cu, cv = (shape.center[(a + k) % 3] for k in range(3))
        rows = [(c + s * (h - d), cu, cv, hu - e, hv - e) for s, d, e in _profile(shape.bevel * min(shape.half))]
        return _loft(rows, a, 5.0, 16)
    return _loft(shape.rows, "xyz".index(shape.axis), shape.roundness, shape.around)


def _profile(bevel: float) -> list[tuple[int, float, float]]:
    ends = [(0.0, bevel), (0.3 * bevel, 0.3 * bevel), (bevel, 0.0)]
    return [(-1, d, e) for d, e in ends] + [(1, d, e) for d, e in reversed(ends)]


def _loft(
    rows: Sequence[Sequence[float]], axis: int, roundness: float, around: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if rows[-1][0] < rows[0][0]:
        rows = rows[::-1]
    angle = (np.arange(around) + 0.5) * (2 * np.pi / around)
    power = 2.0 / roundness
    u = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power
    v = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** power
    rings = [np.stack([np.full(around, t), cu + hu * u, cv + hv * v], 1) for t, cu, cv, hu, hv in rows]
    side = np.concatenate(rings)
    k = np.arange(around)
    n = (k + 1) % around
    quads = [(r * around, (r + 1) * around) for r in range(len(rows) - 1)]
    faces = [f for a, b in quads for f in (np.stack([a + k, a + n, b + n], 1), np.stack([a + k, b + n, b + k], 1))]
    normals = _normals(side, np.concatenate(faces))
    # The ends get vertices of their own so that their edge stays crisp; a ring is convex, so a fan fills it.
    fan = np.stack([np.zeros(around - 2, int), k[1:-1], k[2:]], 1)
    faces += [len(side) + fan[:, ::-1], len(side) + around + fan]
    points = np.concatenate([side, rings[0], rings[-1]])
    end = np.repeat([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], around, 0)
    back = np.argsort([(axis + k) % 3 for k in range(3)])
    return points[:, back], np.concatenate([normals, end])[:, back], np.concatenate(faces)


def _normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted vertex normals."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, faces[:, k], face)
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def merge(parts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One mesh out of several."""
    starts = np.cumsum([0] + [len(points) for points, _, _ in parts])
    faces = [f + start for (_, _, f), start in zip(parts, starts, strict=False)]
    return np.concatenate([p for p, _, _ in parts]), np.concatenate([n for _, n, _ in parts]), np.concatenate(faces)


def _limb(s: int) -> dict[str, tuple]:
    """Shapes of one leg and arm, `s` +1 left, -1 right."""
    # fmt: off
    return {
        "hip_pitch_link": (Rod("joint", 0.05, 0.062, (0.0, s * 0.03, 0.0)),),
        "hip_roll_link": (
            Loft("shell", "z", (
                (0.052, 0.012, s * 0.002, 0.020, 0.020), (0.045, 0.012, s * 0.002, 0.042, 0.036),
                (0.015, 0.014, s * 0.004, 0.056, 0.046), (-0.04, 0.012, s * 0.004, 0.054, 0.048),
                (-0.09, 0.006, s * 0.003, 0.050, 0.050), (-0.125, 0.000, 0.0, 0.047, 0.049),
            )),
            Rod("joint", 0.036, 0.020, (0.064, s * 0.004, -0.005), "X"),
        ),
        "hip_yaw_link": (
            Loft("shell", "z", (
                (0.000, -0.026, 0.0, 0.050, 0.052), (-0.035, -0.034, s * -0.002, 0.057, 0.054),
                (-0.085, -0.048, s * -0.003, 0.056, 0.052), (-0.13, -0.062, 0.0, 0.048, 0.045),
                (-0.155, -0.068, 0.0, 0.040, 0.036), (-0.165, -0.072, 0.0, 0.030, 0.028),
            )),
            Rod("joint", 0.042, 0.094, (-0.078, s * 0.002, -0.177)),
        ),
        "knee_link": (
            Loft("shell", "z", (
                (0.040, 0.022, 0.0, 0.018, 0.030), (0.025, 0.020, 0.0, 0.034, 0.038), (-0.03, 0.008, 0.0, 0.048, 0.042),
                (-0.10, -0.002, 0.0, 0.046, 0.042), (-0.17, -0.006, 0.0, 0.036, 0.036),
                (-0.225, -0.004, 0.0, 0.028, 0.031), (-0.245, -0.004, 0.0, 0.022, 0.026),
            )),
            Loft("joint", "z", (
                (-0.040, -0.014, 0.0, 0.028, 0.020), (-0.055, -0.014, 0.0, 0.039, 0.024),
                (-0.120, -0.014, 0.0, 0.039, 0.023), (-0.190, -0.012, 0.0, 0.032, 0.017),
                (-0.206, -0.010, 0.0, 0.022, 0.013),
            ), 5.0),
            Loft("joint", "z", (
                (-0.23, -0.004, 0.0, 0.020, 0.024), (-0.28, -0.002, 0.0, 0.018, 0.022), (-0.31, 0.0, 0.0, 0.018, 0.02),
            )),
        ),
        "ankle_roll_link": (
            Loft("joint", "x", (
                (-0.068, 0.0, -0.023, 0.022, 0.008), (-0.062, 0.0, -0.018, 0.029, 0.016),
                (-0.035, 0.0, -0.008, 0.032, 0.027), (0.015, 0.0, -0.006, 0.032, 0.029),
                (0.042, 0.0, -0.014, 0.034, 0.021), (0.085, 0.0, -0.020, 0.036, 0.015),
                (0.122, 0.0, -0.022, 0.035, 0.013), (0.134, 0.0, -0.024, 0.028, 0.010),
            ), 3.6),
        ),
        "shoulder_pitch_link": (
            Loft("shell", "y", tuple(
                (s * t, -0.008, 0.0, h, h) for t, h in ((0.0, 0.034), (0.02, 0.042), (0.055, 0.042), (0.066, 0.034))
            ), 2.0),
            Rod("joint", 0.033, 0.016, (0.0, s * 0.069, -0.008)),
        ),
        "shoulder_roll_link": (
            Loft("shell", "z", (
                (0.030, -0.002, 0.0, 0.016, 0.014), (0.020, -0.002, s * 0.001, 0.030, 0.026),
                (-0.02, -0.003, s * 0.006, 0.040, 0.036), (-0.07, -0.003, s * 0.006, 0.037, 0.035),
                (-0.100, -0.002, s * 0.006, 0.034, 0.033),
            )),
        ),
        "shoulder_yaw_link": (
            Loft("shell", "z", (
                (0.003, 0.0, 0.0, 0.034, 0.033), (-0.03, 0.003, 0.0, 0.037, 0.034), (-0.065, 0.010, 0.0, 0.036, 0.033),
                (-0.085, 0.012, 0.0, 0.026, 0.026),
            )),
            Rod("joint", 0.031, 0.076, (0.0158, 0.0, -0.0805)),
        ),
        "elbow_link": (
            Loft("shell", "x", (
                (-0.030, 0.0, -0.004, 0.022, 0.020), (-0.018, 0.0, -0.004, 0.030, 0.031),
                (0.025, s * 0.002, -0.007, 0.034, 0.036), (0.070, s * 0.002, -0.010, 0.033, 0.034),
                (0.100, s * 0.002, -0.010, 0.031, 0.032),
            )),
        ),
        "wrist_roll_link": (
            Loft("shell", "x", (
                (0.000, 0.0, 0.0, 0.030, 0.031), (0.018, 0.0, 0.0, 0.031, 0.032), (0.040, 0.0, 0.0, 0.030, 0.029),
            )),
        ),
        "wrist_pitch_link": (
            Loft("shell", "x", (
                (-0.006, 0.0, 0.0, 0.026, 0.026), (0.010, 0.0, 0.0, 0.031, 0.031), (0.038, 0.0, 0.0, 0.031, 0.031),
                (0.050, 0.0, 0.0, 0.022, 0.024),
            )),
        ),
        "wrist_yaw_link": (
            Loft("hand", "x", (
                (0.004, 0.0, 0.0, 0.024, 0.026), (0.030, 0.0, 0.0, 0.026, 0.030), (0.048, s * 0.002, 0.0, 0.020, 0.034),
                (0.075, s * 0.0035, 0.0, 0.0185, 0.040), (0.112, s * 0.0035, 0.0, 0.0185, 0.041),
                (0.121, s * 0.0035, 0.0, 0.013, 0.036),
            ), 4.0),
        ),
    }
    # fmt: on


def _fingers(s: int) -> dict[str, tuple]:
    """Shapes of the fingers, in the frames of their links; the sizes of the collision boxes, slightly slimmer."""
    thick, tip = (0.026, 0.0115, 0.0115), (0.0275, 0.0075, 0.0105)
    shapes: dict[str, tuple] = {
        "thumb_0_link": (Block("hand", (0.013, 0.014, 0.015), (-0.001, s * -0.008, 0.0), axis="y"),),
        "thumb_1_link": (Block("hand", (0.0115, 0.026, 0.0115), (0.001, s * -0.024, 0.0), axis="y"),),
        "thumb_2_link": (Block("hand", (0.0075, 0.0275, 0.0105), (0.0, s * -0.0235, 0.0), axis="y"),),
    }
    for finger in ("middle", "index"):
        shapes[f"{finger}_0_link"] = (Block("hand", thick, (0.024, s * -0.001, 0.0)),)
        shapes[f"{finger}_1_link"] = (Block("hand", tip, (0.0235, 0.0, 0.0)),)
    return shapes


SHAPES: dict[str, tuple] = {
    "pelvis": (
        Loft("shell", "z", (
            (-0.172, 0.0, 0.0, 0.022, 0.020), (-0.160, 0.0, 0.0, 0.038, 0.030), (-0.125, 0.002, 0.0, 0.054, 0.040),
            (-0.075, 0.003, 0.0, 0.062, 0.058), (-0.045, 0.002, 0.0, 0.062, 0.068), (-0.030, 0.0, 0.0, 0.050, 0.056),
        )),
        Rod("joint", 0.044, 0.050, (0.0, 0.0, -0.012), "Z"),
    ),
    "waist_yaw_link": (Rod("joint", 0.034, 0.090, (-0.004, 0.0, 0.044), "X"),),
    "torso_link": (
        Loft("joint", "z", ((0.0, 0.004, 0.0, 0.040, 0.050), (0.03, 0.004, 0.0, 0.046, 0.060),
                            (0.075, 0.004, 0.0, 0.044, 0.062))),
        Loft("shell", "z", (
            (0.040, 0.004, 0.0, 0.044, 0.060), (0.052, 0.004, 0.0, 0.056, 0.074), (0.095, 0.006, 0.0, 0.066, 0.084),
            (0.155, 0.007, 0.0, 0.076, 0.096), (0.215, 0.007, 0.0, 0.078, 0.100), (0.265, 0.005, 0.0, 0.070, 0.098),
            (0.292, 0.002, 0.0, 0.056, 0.086), (0.302, 0.0, 0.0, 0.042, 0.066),
        ), 3.0, 24),
        Loft("joint", "z", (
            (0.070, 0.004, 0.0, 0.020, 0.080), (0.080, 0.004, 0.0, 0.032, 0.0835), (0.150, 0.004, 0.0, 0.038, 0.098),
            (0.205, 0.004, 0.0, 0.034, 0.1025), (0.215, 0.004, 0.0, 0.020, 0.099),
        ), 6.0),
        Block("joint", (0.004, 0.026, 0.005), (0.0815, 0.0, 0.175), axis="y"),
        Loft("joint", "z", ((0.298, -0.006, 0.0, 0.040, 0.046), (0.315, -0.006, 0.0, 0.032, 0.036),
                            (0.365, -0.008, 0.0, 0.030, 0.034))),
        Loft("visor", "z", (
            (0.346, -0.014, 0.0, 0.028, 0.032), (0.354, -0.013, 0.0, 0.040, 0.043), (0.375, -0.013, 0.0, 0.048, 0.051),
            (0.405, -0.014, 0.0, 0.056, 0.058), (0.432, -0.014, 0.0, 0.060, 0.062), (0.448, -0.009, 0.0, 0.066, 0.062),
            (0.464, -0.008, 0.0, 0.066, 0.060), (0.478, -0.010, 0.0, 0.059, 0.053), (0.489, -0.012, 0.0, 0.044, 0.040),
            (0.494, -0.014, 0.0, 0.024, 0.022),
        ), 2.3, 20),
    ),
    **{f"left_{k}": v for k, v in _limb(1).items()},
    **{f"right_{k}": v for k, v in _limb(-1).items()},
}  # fmt: skip
"""Shapes of each body link, in the link's frame."""

HAND_SHAPES: dict[str, tuple] = {
    **{f"left_hand_{k}": v for k, v in _fingers(1).items()},
    **{f"right_hand_{k}": v for k, v in _fingers(-1).items()},
}
"""Shapes of each finger link, in the link's frame."""
