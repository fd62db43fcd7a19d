"""Properties of a library's clips: speed, height, joint limits, jumps, sliding feet, height of the soles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from arena_newton.robot.g1 import FEET, MUJOCO_JOINTS, TICK
from arena_newton.robot.rotations import quat_apply
from arena_newton.trackers.motions import kinematics
from arena_newton.trackers.motions.library import SUPPORTS, MotionLibrary
from arena_newton.usd_scenes.g1.links import LINKS

__all__ = ["ClipMeasures", "grounded", "measure_clips", "measures_summary", "measures_table"]

JUMP_SPEED = 4.0
"""Root speed [m/s] that no motion of the robot reaches within a tick."""
JUMP_JOINT_SPEED = 35.0
"""Joint speed [rad/s] that the fastest of its motors does not reach."""
LIMIT_SLACK = 1e-3
"""A joint this far outside its range counts as within it [rad]: rounding of clips that were clipped to the range."""
CONTACT_HEIGHT = 0.015
"""A sole carries the robot while its middle is less than this above the clip's floor [m]..."""
CONTACT_SPEED = 0.1
"""...and moves up or down slower than this [m/s]."""
FLOOR_QUANTILE = 0.02
"""Fraction of frames whose lower sole may be below a clip's floor: single frames do not decide."""


@dataclass(frozen=True)
class ClipMeasures:
    """Numbers of one clip."""

    name: str
    """Its name."""
    family: str
    """Its kind of motion."""
    seconds: float
    """Length [s]."""
    speed: float
    """Mean horizontal root speed [m/s]."""
    top_speed: float
    """95th percentile of it [m/s]."""
    lowest: float
    """Least root height [m]."""
    beyond_limits: float
    """Largest angle of a joint outside its range [rad]."""
    beyond_limits_joint: str
    """Name of the joint; empty without one."""
    jumps: int
    """Ticks in which root or joints move faster than the robot can."""
    slip: float
    """Mean horizontal speed of the soles on the ground [m/s]."""
    floor: float
    """Height of its soles on the ground [m]; 0 is right."""
    support: str
    """Support of the robot in addition to the floor."""
    licence: str
    """Its licence."""
    source: str
    """Its origin."""


def _soles(library: MotionLibrary) -> np.ndarray:
    """Middles of both soles [m], shape [frames, 2, 3]."""
    feet = [kinematics.link_index(name) for name in FEET]
    out = np.empty((library.frames, 2, 3), dtype=np.float32)
    for first in range(0, library.frames, 20000):
        part = slice(first, first + 20000)
        motion = (torch.from_numpy(x[part]) for x in (library.root_pos, library.root_quat, library.joint_pos))
        poses = kinematics.forward(*motion)
        sole = poses.position.new_tensor([kinematics.SOLE_CENTRE, 0.0, -kinematics.SOLE_HEIGHT])
        at = poses.position[:, feet] + quat_apply(poses.quat[:, feet], sole.expand(len(out[part]), 2, 3))
        out[part] = at.numpy()
    return out


def _floor(soles: np.ndarray) -> float:
    """Height of a clip's soles on the ground [m]."""
    return float(np.quantile(soles[..., 2].min(axis=1), FLOOR_QUANTILE))


def measure_clips(library: MotionLibrary) -> list[ClipMeasures]:
    """Measure every clip."""
    ranges = {link.hinge.name: link.hinge.limits for link in LINKS if link.hinge is not None}
    low, high = np.array([ranges[name] for name in MUJOCO_JOINTS]).T
    soles = _soles(library)
    measures = []
    for clip in range(library.clips):
        rows = library.rows(clip)
        moved = np.diff(library.root_pos[rows], axis=0) / TICK
        speed = np.linalg.norm(moved[:, :2], axis=1)
        joints = library.joint_pos[rows]
        fastest = np.abs(np.diff(joints, axis=0)).max(axis=1) / TICK
        outside = np.maximum(low - joints, joints - high).max(axis=0)
        worst = int(outside.argmax())
        beyond = float(outside[worst]) if outside[worst] > LIMIT_SLACK else 0.0
        floor = _floor(soles[rows])
        measures.append(
            ClipMeasures(
                name=str(library.clip_names[clip]),
                family=str(library.family_names[library.family[clip]]),
                seconds=float(library.seconds[clip]),
                speed=float(speed.mean()),
                top_speed=float(np.quantile(speed, 0.95)),
                lowest=float(library.root_pos[rows, 2].min()),
                beyond_limits=beyond,
                beyond_limits_joint=MUJOCO_JOINTS[worst] if beyond else "",
                jumps=int(((np.linalg.norm(moved, axis=1) > JUMP_SPEED) | (fastest > JUMP_JOINT_SPEED)).sum()),
                slip=_slip(soles[rows], floor),
                floor=floor,
                support=SUPPORTS[library.support_kind[clip]],
                licence=str(library.licence[clip]),
                source=str(library.source[clip]),
            )
        )
    return measures


def _slip(soles: np.ndarray, floor: float) -> float:
    velocity = np.diff(soles, axis=0) / TICK
    height = np.maximum(soles[1:, :, 2], soles[:-1, :, 2])
    standing = (height < floor + CONTACT_HEIGHT) & (np.abs(velocity[..., 2]) < CONTACT_SPEED)
    return float(np.linalg.norm(velocity[..., :2], axis=-1)[standing].mean()) if standing.any() else 0.0


def grounded(library: MotionLibrary) -> tuple[MotionLibrary, np.ndarray]:
    """The library with every clip on a floor of its own shifted up or down until its soles are at height 0.

    Clips with a support keep their height, which is known.

    Returns:
        The library and the shift of each clip [m], shape [clips].
    """
    soles = _soles(library)
    shift = np.zeros(library.clips)
    for clip in np.flatnonzero(library.support_kind == SUPPORTS.index("none")):
        shift[clip] = -_floor(soles[library.rows(int(clip))])
    root = library.root_pos.copy()
    root[:, 2] += np.repeat(shift, library.clip_length)
    return replace(library, root_pos=root), shift


def measures_summary(measures: list[ClipMeasures]) -> dict[str, Any]:
    """Totals: clips and seconds of all, by family and by licence; the clips as dictionaries."""

    def by(key: str) -> dict[str, dict[str, float]]:
        groups: dict[str, dict[str, float]] = {}
        for m in measures:
            group = groups.setdefault(getattr(m, key), {"clips": 0, "seconds": 0.0})
            group["clips"] += 1
            group["seconds"] += m.seconds
        return groups

    return {
        "clips": len(measures),
        "seconds": sum(m.seconds for m in measures),
        "families": by("family"),
        "licences": by("licence"),
        "measures": [asdict(m) for m in measures],
    }


def _limits(m: ClipMeasures) -> str:
    return (
        f"{np.degrees(m.beyond_limits):.1f}° {m.beyond_limits_joint.removesuffix('_joint')}" if m.beyond_limits else "-"
    )


# Title, alignment, and the text for one clip.
_COLUMNS: tuple[tuple[str, Callable[[str, int], str], Callable[[ClipMeasures], str]], ...] = (
    ("clip", str.ljust, lambda m: m.name),
    ("family", str.ljust, lambda m: m.family),
    ("s", str.rjust, lambda m: f"{m.seconds:.1f}"),
    ("m/s", str.rjust, lambda m: f"{m.speed:.2f}"),
    ("p95", str.rjust, lambda m: f"{m.top_speed:.2f}"),
    ("low m", str.rjust, lambda m: f"{m.lowest:.2f}"),
    ("limits", str.ljust, _limits),
    ("jumps", str.rjust, lambda m: str(m.jumps or "-")),
    ("slip mm/s", str.rjust, lambda m: f"{1e3 * m.slip:.0f}"),
    ("floor cm", str.rjust, lambda m: f"{round(100 * m.floor, 1) + 0.0:+.1f}"),
    ("support", str.ljust, lambda m: m.support if m.support != "none" else "-"),
    ("licence", str.ljust, lambda m: m.licence),
)


def measures_table(measures: list[ClipMeasures], rows: int | None = None) -> str:
    """A table of the first `rows` clips (all by default), with totals by family below."""
    columns = []
    for title, align, cell in _COLUMNS:
        cells = [title, *map(cell, measures[:rows])]
        columns.append([align(text, max(map(len, cells))) for text in cells])
    text = ["  ".join(line).rstrip() for line in zip(*columns, strict=True)]
    if rows is not None and len(measures) > rows:
        text.append(f"... and {len(measures) - rows} more (--all shows them)")
    total = measures_summary(measures)
    text.append("")
    for name, group in total["families"].items():
        text.append(f"{name}: {group['clips']} clips, {group['seconds']:.1f} s")
    licences = ", ".join(f"{name} ({group['clips']})" for name, group in total["licences"].items())
    text.append(f"total: {total['clips']} clips, {total['seconds']:.1f} s; licences: {licences}")
    return "\n".join(text)
