"""Interaction of a robot with the things that a task has it find, approach and touch, by which failures are measured.

Nothing heavy is imported here: a plan reads it, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from arena_newton.errors import InputError
from arena_newton.robot.g1 import ANKLES, FEET, PALMS, TOE
from arena_newton.tasks.base import TOUCH
from arena_newton.tasks.boxing import BOUNDS, TARGET
from arena_newton.tasks.double_desk import HAMMER
from arena_newton.tasks.football import BALL, KICK
from arena_newton.tasks.open_door import HANDLE, LEAF_BODY
from arena_newton.tasks.pp_box import BOX
from arena_newton.tasks.sit_sofa import SEAT
from arena_newton.tasks.vis_navi import SIGN, ZONE

__all__ = ["INTERACTIONS", "Interaction", "check_interactions"]


@dataclass(frozen=True)
class Interaction:
    """One task's first contact."""

    sight: str
    """Prim that the robot must find, with all below it; its pixels are counted in the head camera's picture."""
    box: str
    """Marker whose box is to be touched, or rigid body with the box around its collision geometry."""
    effectors: tuple[str, ...]
    """Links or frames of the robot that touch it."""
    touch: float
    """Distance of an effector to the box from which on it touches [m]: the one of the task's own `predicate`; where it
    has none, wider than the success condition, so that a contact that misses it is a contact."""
    stance: float
    """Distance of the root to the box, seen from above, at which the touch needs no further step [m]."""
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


INTERACTIONS: Mapping[str, Interaction] = {
    # A fist that lands beside the target is still on the bag, whose radius is 0.15 m. The expert strikes from 0.45 m
    # off the bag's axis with the target 0.1 to 0.3 rad to its side; a hand reaches 45 degrees aside without a step.
    "boxing": Interaction(TARGET, BOUNDS, PALMS, touch=0.20, stance=0.60, bearing=0.8),
    # The area is entered by walking on: half a step (0.3 m) before its border the next one leads into it.
    "vis_navi": Interaction(
        SIGN, ZONE, ANKLES, touch=0.0, stance=0.30, predicate="enter", level=True, reached_only=True
    ),
    # The toe's distance is the one of the task's own `contact`. It is 0.12 m before the ankle and swings another 0.3 m
    # ahead while the other foot stands. The expert walks through the ball, and turns and steps back below 0.35 m/s.
    "football": Interaction(
        BALL, BALL, FEET, touch=KICK, stance=0.40, predicate="contact", bearing=0.8, loose=True, slow=0.35, tip=TOE
    ),
    # The origin of a pelvis that sits is 0.17 m above the box; a robot that comes down without weight stays some
    # centimetres higher. The expert goes down from 0.12 m in front of the edge. Cartons stand
    # before the sofa: who comes for it and stops at them is up to 1.9 m from the seat.
    "sit_sofa": Interaction(
        "/World/Sofa", SEAT, ("pelvis",), touch=0.25, stance=0.25, bearing=0.8, near=1.9, behind=True
    ),
    # The leaf is what a robot can find, the lever what it must touch: 6 cm off the leaf. The expert presses it from
    # 0.38 m with the lever 0.4 rad to its right, and a fist of 5 cm meets the leaf around it within 0.15 m.
    "open_door": Interaction(LEAF_BODY, HANDLE, PALMS, touch=TOUCH, stance=0.60, predicate="contact", bearing=0.8),
    # A palm is 6 cm from the box when its fist squeezes it, and 0.16 m when it begins to close. The expert stands 0.22
    # to 0.30 m before the box. Episodes begin 0.9 m and more before it, which is not near yet.
    "pp_box": Interaction(
        BOX, BOX, PALMS, touch=TOUCH, stance=0.45, predicate="contact", bearing=0.8, near=0.85, carried=True, loose=True
    ),
    # The palm is 5 cm from the handle that it grasps and hovers 0.17 m above it. The expert stands 0.23 to 0.40 m from
    # the hammer. Episodes begin 0.82 m and more from it, which is not near yet.
    "double_desk": Interaction(
        HAMMER,
        HAMMER,
        PALMS,
        touch=TOUCH,
        stance=0.40,
        predicate="contact",
        bearing=1.0,
        near=0.80,
        carried=True,
        loose=True,
    ),
}
"""Task name → its first contact; tasks that are not here have no failure signals."""


def check_interactions(tasks: Sequence[str]) -> None:
    """Refuse tasks without an entry.

    Raises:
        InputError: Names those that have none, and those that have one.
    """
    without = [task for task in tasks if task not in INTERACTIONS]
    if without:
        raise InputError(f"--failures: no signals are defined for {' '.join(without)}; for {' '.join(INTERACTIONS)}")
