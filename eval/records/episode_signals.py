"""Signals of an episode that tell why it failed: a few running numbers, no trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from arena_newton.eval.records.schema import Count
from arena_newton.files.stored_json import Fit

__all__ = ["EpisodeSignals"]

MaybeTick = Annotated[int | None, Fit("a number of ticks or null", lambda value: value is None or 0 <= value <= 10**7)]
Length = Annotated[float, Fit("a number of at least 0", lambda value: 0 <= value <= 10**6)]
Figure = Annotated[float, Fit("a number", lambda value: abs(value) <= 10**6)]
MaybeLength = Annotated[
    float | None, Fit("a number of at least 0 or null", lambda value: value is None or 0 <= value <= 10**6)
]


@dataclass(frozen=True, kw_only=True)
class EpisodeSignals:
    """Signals of one episode from its step 0 on; a line of the journal holds them as an object.

    The *object* is what the task's `interaction.Interaction` names, distances to it are to its box. Numbers marked with
    a star leave the last second out, so that a fall itself is not among its causes.
    """

    looks: Count
    """Looks at the head camera's picture, one each `signal_recorder.EVERY` ticks until the first touch."""
    looks_seen: Count
    """Number of these that showed the object."""
    first_pixels: Count
    """Pixels of the object in the first picture."""
    first_seen: MaybeTick
    """First look that showed it; None: none did."""
    start_distance: Length
    """Root to object at step 0, seen from above [m], as all distances of the root."""
    nearest_distance: Length
    """Smallest distance of the root."""
    engaged_ticks: Count
    """Longest spell in which the robot stood or stepped slowly near the object."""
    stop_distance: MaybeLength
    """Smallest distance of the root while it did so; None: it never did."""
    stop_bearing: MaybeLength
    """Angle between heading and object there [rad]."""
    aligned_ticks: Count
    """Longest spell in which it did so where the object can be touched without a step."""
    reach_distance: Length
    """Smallest distance between an effector and the object [m]."""
    touches: Count
    """Number of times that an effector came to touch the object."""
    first_touch: MaybeTick
    touch_distance: MaybeLength
    """Root to object at the first touch [m]."""
    touch_bearing: MaybeLength
    """Angle between heading and object there [rad]."""
    moved: Length
    """Distance of the object at the end from where it was at the first touch [m]; 0 without one."""
    touches_moved: Count
    """Touches of an object that had moved since the first one."""
    posture_margin: Figure
    """Lowest angle between the root's tilt and the fall rule's first angle, until the first touch [rad]*."""
    height_min: Figure
    """Lowest root [m]*."""
    reference_tilt: Length
    """Largest tilt of the reference's root from the vertical, until the first touch [rad]*."""
    reference_height: Figure
    """Lowest root of the reference, until the first touch [m]*."""
    tracking_error: Length
    """Mean over time of the RMS difference between the leg joints and their reference [rad]*."""
    tracking_worst: Length
    """Largest mean of that over half a second [rad]*."""
    tilt_error: Length
    """Largest mean over half a second of the angle between the root's upright and its reference's [rad]*."""
    drift: Length
    """Largest difference between what the root and its reference moved within a second [m]*."""
