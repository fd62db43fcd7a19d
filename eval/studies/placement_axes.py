"""The ranges from which placements and dynamics are drawn, as axes: numbers that a study moves one by one."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from arena_newton.errors import InputError, check_once
from arena_newton.rules import modes
from arena_newton.rules.rule_types import CylinderRange, ObjectRule, PoseRange, TaskRules
from arena_newton.tasks.base import Sample, object_range

__all__ = ["Axis", "axes_of", "chosen", "moved"]

POSE_KEYS = ("x", "y", "z", "yaw")
CYLINDER_KEYS = ("azimuth", "z")
UNITS = {"x": "m", "y": "m", "z": "m", "yaw": "rad", "azimuth": "rad", "bag": ""}
UNITS |= {name: quantity.unit for name, quantity in modes.QUANTITIES.items()}
"""Unit of each number of a sample."""
SAME_ANGLE = 1e-6
"""Difference of angles that rounding makes [rad]."""


@dataclass(frozen=True)
class Axis:
    """One number of a placement or of the dynamics, and its range."""

    record: str
    """Object, by its name in the original's records, or `dynamics`."""
    key: str
    """`x`, `y`, `z` [m], `yaw`, `azimuth` [rad], `bag`, the number of a cylinder from 1 on, or a quantity of the
    dynamics."""
    low: float
    high: float

    @property
    def name(self) -> str:
        """Name on the command line and in files."""
        return f"{self.record}.{self.key}"

    @property
    def unit(self) -> str:
        """Unit of its values; empty for a number."""
        return UNITS[self.key]

    @property
    def counts(self) -> bool:
        """True if its values are whole numbers."""
        return self.key == "bag" or (self.record == modes.DYNAMICS and modes.QUANTITIES[self.key].whole)

    @property
    def turns(self) -> bool:
        """True if its range is a full circle."""
        return self.unit == "rad" and self.high - self.low > 2.0 * math.pi - SAME_ANGLE

    def grid(self, points: int) -> tuple[float, ...]:
        """Values from one end of the range to the other; of a number all there are, of a full circle no angle twice."""
        if self.counts:
            return tuple(float(value) for value in range(int(self.low), int(self.high) + 1))
        if points == 1:
            return (0.5 * (self.low + self.high),)
        steps = points if self.turns else points - 1
        return tuple(self.low + (self.high - self.low) * k / steps for k in range(points))

    def at(self, part: float) -> float:
        """The value at a part of the range, from 0 to 1; each number has an equal part of it."""
        if self.counts:
            numbers = int(self.high - self.low) + 1
            return self.low + min(int(part * numbers), numbers - 1)
        return self.low + part * (self.high - self.low)

    def part(self, value: float) -> float:
        """Fraction of the range at which a value lies, from 0 to 1; of a number the middle of its part."""
        if self.counts:
            return (value - self.low + 0.5) / (self.high - self.low + 1.0)
        return (value - self.low) / (self.high - self.low)


def axes_of(rules: TaskRules, mode: str) -> tuple[Axis, ...]:
    """All numbers of a task's placements that are drawn in a mode, in the order of its objects."""
    found = []
    for rule in rules.objects:
        ranges = object_range(rule, mode)
        if isinstance(ranges, CylinderRange) and len(ranges.centers) > 1:
            found.append(Axis(rule.record, "bag", 1.0, float(len(ranges.centers))))
        for key in CYLINDER_KEYS if isinstance(ranges, CylinderRange) else POSE_KEYS:
            bounds = getattr(ranges, key)
            if bounds is not None and min(bounds) < max(bounds):
                found.append(Axis(rule.record, key, min(bounds), max(bounds)))
    return (*found, *dynamics_axes(mode))


def dynamics_axes(mode: str) -> tuple[Axis, ...]:
    """All numbers of the dynamics that are drawn in a mode."""
    ranges = modes.get(mode).dynamics
    return tuple(Axis(modes.DYNAMICS, name, low, high) for name, (low, high) in ranges.items() if low < high)


def chosen(axes: Sequence[Axis], names: Sequence[str], task: str) -> tuple[Axis, ...]:
    """The axes that a user named; also of the dynamics in a mode that draws none, where all else is then as usual.

    Raises:
        InputError: One is unknown or named twice.
    """
    known = {axis.name: axis for axis in (*axes, *dynamics_axes(modes.DYNAMICS), *axes)}  # own ranges win
    for name in names:
        if name not in known:
            raise InputError(f"--axes {name}: task {task} draws {', '.join(known)}")
    check_once("--axes", names)
    return tuple(known[name] for name in names)


def moved(
    sampled: Mapping[str, Sample], axes: Sequence[Axis], values: Sequence[float], rules: TaskRules, mode: str
) -> dict[str, Sample]:
    """Samples with some of their numbers set to other values.

    Args:
        sampled: Record name → sample, as an episode's seed draws it.
        axes: What is set.
        values: To what, one per axis.
        rules: The task's rules, of whose ranges the axes are.
        mode: Mode whose ranges they are.
    """
    found = {record: copy.copy(sample) for record, sample in sampled.items()}
    for axis, value in zip(axes, values, strict=True):
        found.setdefault(axis.record, {})[axis.key] = int(value) if axis.counts else float(value)
    for rule in rules.objects:
        _on_cylinder(rule, found[rule.record], mode)
    return found


def _on_cylinder(rule: ObjectRule, sample: Sample, mode: str) -> None:
    """Set the position that bag and azimuth give on a cylinder; nothing for another range."""
    ranges = object_range(rule, mode)
    if isinstance(ranges, PoseRange):
        return
    x, y = ranges.centers[int(sample["bag"]) - 1]
    sample["x"] = x + ranges.radius * math.cos(sample["azimuth"])
    sample["y"] = y + ranges.radius * math.sin(sample["azimuth"])
