"""Interaction of a robot with the thing that a task has it approach and touch, by which failures are measured."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Interaction"]


@dataclass(frozen=True)
class Interaction:
    """One task's first contact."""

    box: str
    """Marker whose box is to be touched, or rigid body with the box around its collision geometry."""
    effectors: tuple[str, ...]
    """Links or frames of the robot that touch it."""
    touch: float
    """Distance of an effector to the box from which on it touches [m]: the one of the task's own `predicate`; where it
    has none, wider than the success condition, so that a contact that misses it is a contact."""
    stance: float
    """Distance of the root to the box, seen from above, at which the touch needs no further step [m]."""
    sight: str = ""
    """Prim whose pixels are counted in the head camera's picture, with all below it; empty: the task's `target`."""
    predicate: str = ""
    """Predicate of the task that says the same touch: without it in an episode's line nothing was touched. Empty where
    the task's only such predicate is its success condition."""
    level: bool = False
    """The effectors' heights do not count."""
    bearing: float = 3.2
    """Largest angle between heading and box at which it can be touched [rad]; above pi: any."""
    near: float = 1.4
    """Distance of the root to the object [m] within which it is near: `tasks.base.REACH`, 0.8 m, and a long step."""
    carried: bool = False
    """It moves with the effectors: how far it has moved is seen from above, from where they touched it last."""
    loose: bool = False
    """It lies or stands free: a touch that has an effect moves it."""
    reached_only: bool = False
    """True if a touch is all that is wanted: it has no effect that could fail to come."""
    slow: float = 0.20
    """Speed of the root, averaged over half a second, below which the robot stands or steps slowly [m/s]: the experts
    strike and turn below it, and walk at 0.3 m/s and more."""
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point of each effector that touches, in its frame [m]."""
    behind: bool = False
    """It is touched with the back: bearings are between the back and the nearest point of the box."""
