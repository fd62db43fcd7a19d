"""Controls that a person holds on the page, and the canonical actions that a reference generator makes of them.

The page sends all that is held 25 times a second; the generator limits every rate, so that nothing that is typed,
dragged or lost makes the action jump.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import torch

from arena_newton.errors import InputError
from arena_newton.policies.experts.base import REALIGN
from arena_newton.policies.teleop.source import Control
from arena_newton.robot.g1 import TICK
from arena_newton.robot.rotations import heading_np
from arena_newton.trackers.motions.commands import CHANNELS, COLUMNS, neutral_row
from arena_newton.trackers.motions.generator import ReferenceGenerator
from arena_newton.trackers.motions.kinematics import neutral_stance
from arena_newton.trackers.motions.primitives import CARRY_ARMS, Program, rise, sit

if TYPE_CHECKING:
    from arena_newton.policies.teleop.source import Telemetry

__all__ = ["CAMERAS", "EVENTS", "HEIGHTS", "KICKS", "RANGES", "Driver", "Held", "read_held"]

FULL = {"forward": 0.6, "back": 0.4, "aside": 0.3, "turn": 0.9}
"""Speeds at full deflection of the stick [m/s, m/s, m/s, rad/s]: both trackers follow them well."""
HEIGHTS = (0.45, 0.785)
"""Range of the pelvis above the ground [m]."""
LOW_LEAN = 0.3
"""Forward lean of the pelvis at the lowest height [rad], as in `primitives.squat`: the weight stays over the feet."""
RANGES: dict[str, tuple[float, float]] = {
    "forward": (-1.0, 1.0),
    "left": (-1.0, 1.0),
    "turn": (-1.0, 1.0),
    "height": HEIGHTS,
    "look": (-0.8, 0.8),
    "hand_forward": (0.10, 0.50),
    "hand_aside": (-0.05, 0.35),
    "hand_up": (-0.15, 0.45),
    "frames": (1.0, 240.0),
}
"""Numbers of a message and their ranges: deflections of the stick, height of the pelvis [m], turn of the waist [rad],
where a reaching palm is ahead of, outward of and above the pelvis [m], and frames of the page per second."""
CAMERAS = ("follow", "room", "free")
"""Views of the page: behind the robot, the scene's own camera, wherever a mouse takes it."""
SWITCHES = ("reach_left", "reach_right", "close_left", "close_right", "high_steps", "sit")
"""Switches of a message."""
HIGH_STEPS = {"swing_height": 0.18, "step_time": 0.52, "height": 0.74}
"""Channels of a walk over a sill, as in `primitives.step_over`."""
KICK_SPEED = 2.5
"""Speed of a kicking foot [m/s]."""
KICK_WITHIN = 400
"""Ticks after which a kick that could not begin is given up."""
KICKS = {"kick_left": 1, "kick_right": 2}
"""Event → value of the channel `kick`."""
DOWN = 3.2
"""Time of sitting down [s], as in `primitives.sit`; a robot rises after it."""
EVENTS = (*KICKS, *(control for control in get_args(Control) if control != "none"))
"""Events that a message may request."""
MOST_EVENTS = 8
"""Events in one message."""


@dataclass(frozen=True)
class Held:
    """Everything that a person holds at one moment."""

    forward: float = 0.0
    """Deflection of the stick, -1 to 1."""
    left: float = 0.0
    turn: float = 0.0
    height: float = neutral_stance().height
    """Pelvis above the ground [m]."""
    look: float = 0.0
    """Turn of the waist to the left [rad]."""
    hand_forward: float = 0.30
    """Reaching palms ahead of the pelvis [m]."""
    hand_aside: float = 0.14
    """Outward of it, to each hand's own side [m]."""
    hand_up: float = 0.15
    """Above it [m]."""
    reach_left: bool = False
    reach_right: bool = False
    close_left: bool = False
    close_right: bool = False
    high_steps: bool = False
    sit: bool = False
    camera: str = CAMERAS[0]
    """One of `CAMERAS`."""
    frames: float = 30.0
    """Frames per second that the page draws."""
    events: tuple[str, ...] = ()
    """Names of `EVENTS`, in their order."""


def read_held(text: str | bytes) -> Held:
    """A message of the page.

    Args:
        text: JSON object with any of the fields of `Held`; numbers outside their range count as its nearest end.

    Raises:
        InputError: It is none, or a field is unknown, no finite number, no switch or no known event.
    """
    try:
        given = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("page: a message that is no JSON") from None
    if not isinstance(given, dict):
        raise InputError("page: a message that is no JSON object")
    events = given.pop("events", [])
    if not isinstance(events, list) or len(events) > MOST_EVENTS or any(event not in EVENTS for event in events):
        raise InputError(f"page: events: expected at most {MOST_EVENTS} of {', '.join(EVENTS)}")
    fields: dict[str, Any] = {}
    for name, value in given.items():
        if name in RANGES:
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise InputError(f"page: {name}: expected a finite number")
            low, high = RANGES[name]
            fields[name] = min(max(float(value), low), high)
        elif name in SWITCHES:
            if not isinstance(value, bool):
                raise InputError(f"page: {name}: expected true or false")
            fields[name] = value
        elif name == "camera":
            if value not in CAMERAS:
                raise InputError(f"page: camera: expected one of {', '.join(CAMERAS)}")
            fields[name] = value
        else:
            raise InputError(f"page: {name[:40]}: unknown field")
    return Held(**fields, events=tuple(events))


class Driver:
    """Makes one action per tick of what is held."""

    def __init__(self) -> None:
        """Stand; nothing is held."""
        self.generator = ReferenceGenerator(1)
        self._held = Held()
        self._kick = 0
        self._kick_ticks = 0
        self._kicking = False
        self._seat: Program | None = None
        """Program that a robot follows while it sits or rises."""
        self._seat_ticks = 0
        self._sits = False

    def begin(self, view: Telemetry) -> None:
        """An episode begins: stand where the robot is, with nothing held.

        Args:
            view: The robot at step 0.
        """
        pose = torch.tensor([[*view.root_position[:2], heading_np(view.root_quat)]], dtype=torch.float32)
        self.generator.reset(root_xy=pose[:, :2], yaw=pose[:, 2])
        self._held = Held()
        self._kick = self._kick_ticks = 0
        self._kicking = self._sits = False
        self._seat = None

    def ask(self, event: str) -> None:
        """Begin a kick, unless one is under way; other events are not a driver's.

        Args:
            event: A name of `EVENTS`.
        """
        if event in KICKS and not self._kick and self._seat is None:
            self._kick, self._kick_ticks, self._kicking = KICKS[event], 0, False

    def action(self, held: Held | None, view: Telemetry) -> np.ndarray:
        """The canonical action of this tick, float32, shape [40].

        Args:
            held: What is held; None: nobody is there, and the robot comes to a stand in the posture that it has.
            view: The robot before the tick.
        """
        self._held = held or _let_go(self._held)
        row = self._row(self._held)
        walking = bool(row[COLUMNS["velocity"]].any())
        yaw = torch.tensor([heading_np(view.root_quat)], dtype=torch.float32)
        self.generator.realign(yaw, REALIGN if walking else 0.0)
        self.generator.step(torch.from_numpy(row)[None])
        return self.generator.action()[0].numpy()

    def _row(self, held: Held) -> np.ndarray:
        """The packed command."""
        row = np.array(neutral_row(), dtype=np.float32)
        self._sit_or_rise(held.sit)
        if self._seat is not None:
            row[:] = self._seat(self._seat_ticks * TICK).pack()[0].numpy()
        else:
            _posture(row, held)
            self._advance_kick(row)
        row[COLUMNS["hands"]] = held.close_left, held.close_right
        return row

    def _sit_or_rise(self, wanted: bool) -> None:
        """Change between standing, sitting and rising; the robot must stand still to sit down."""
        self._seat_ticks += 1
        if wanted and not self._sits and self._seat is None and not self._kick and bool(self.generator.settled[0]):
            self._seat, self._seat_ticks, self._sits = Program([sit()]), 0, True
        elif self._sits and not wanted and self._seat is not None and self._seat_ticks * TICK > DOWN:
            self._seat, self._seat_ticks, self._sits = Program([rise()]), 0, False
        elif not self._sits and self._seat is not None and self._seat_ticks * TICK > self._seat.seconds:
            self._seat = None

    def _advance_kick(self, row: np.ndarray) -> None:
        """Hold a kick's command until it is over; the feet stand for it."""
        if not self._kick:
            return
        self._kick_ticks += 1
        progress = float(self.generator.kick_progress[0])
        self._kicking |= progress > 0.0
        if (self._kicking and progress == 0.0) or self._kick_ticks > KICK_WITHIN:
            self._kick = 0
            return
        row[COLUMNS["velocity"]] = 0.0
        row[COLUMNS["kick"]], row[COLUMNS["kick_speed"]] = self._kick, KICK_SPEED


def _let_go(held: Held) -> Held:
    """The same posture without a walk."""
    return replace(held, forward=0.0, left=0.0, turn=0.0, events=())


def _posture(row: np.ndarray, held: Held) -> None:
    """Fill in walk, height, waist and arms of a robot that stands or walks."""
    forward = held.forward * FULL["forward" if held.forward > 0.0 else "back"]
    row[COLUMNS["velocity"]] = forward, held.left * FULL["aside"], held.turn * FULL["turn"]
    low, stand = HEIGHTS[0], neutral_stance().height
    row[COLUMNS["height"]] = held.height
    row[COLUMNS["pitch"]] = LOW_LEAN * min(max((stand - held.height) / (stand - low), 0.0), 1.0)
    row[COLUMNS["waist"]] = held.look, 0.0, 0.0
    if held.high_steps:
        for name, value in HIGH_STEPS.items():
            row[COLUMNS[name]] = min(value, held.height) if name == "height" else value
    if held.reach_left or held.reach_right:
        out = held.hand_forward, held.hand_aside, held.hand_up
        points = row[COLUMNS["hand_point"]].reshape(CHANNELS["hand_point"].shape)
        points[0], points[1] = out, (out[0], -out[1], out[2])
        row[COLUMNS["reach"]] = held.reach_left, held.reach_right
        arms = row[COLUMNS["arms"]].reshape(2, 7)
        carry = np.array(CARRY_ARMS, dtype=np.float32).reshape(2, 7)
        for side, reaches in enumerate((held.reach_left, held.reach_right)):
            if reaches:
                arms[side] = carry[side]
