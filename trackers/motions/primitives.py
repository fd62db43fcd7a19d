"""Named motions as short command programs, such as `walk`, `squat` or `kick`.

A primitive is a `Script`, a row of timed segments; `+` joins scripts, `over` sets channels in all segments. A
`Program` holds one script per world and turns a time into a `MotionCommand`. Nothing here limits a rate: the generator
does, so a segment may jump, and one with `ramp` moves its channels evenly over its time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from arena_newton.errors import InputError
from arena_newton.kernels.footwork import kick_seconds
from arena_newton.robot.g1 import DEFAULT_POSE
from arena_newton.trackers.motions.commands import CHANNELS, COLUMNS, COMMAND_WIDTH, MotionCommand, neutral_row

__all__ = [
    "CARRY_ARMS",
    "GUARD_ARMS",
    "PUSH_HANDS",
    "Program",
    "Script",
    "Segment",
    "carry",
    "crouch_reach",
    "kick",
    "mirrored_arms",
    "punch",
    "push",
    "reach",
    "rise",
    "script",
    "shift",
    "sit",
    "squat",
    "stand",
    "step",
    "step_over",
    "step_up",
    "walk",
]

SIDES = {"left": 0, "right": 1}
SEAT_APPROACH, SEAT_DEPTH = (0.24, 0.14), (0.25, 0.12)
"""Pelvis behind its standing position and above the seat [m], first until it touches, then pressed into it."""
SEAT_CLEAR = 0.17
"""Pelvis above a seat that it is about to leave [m]."""


def mirrored_arms(left: Sequence[float]) -> tuple[float, ...]:
    """Posture of both arms [rad] from the left one's seven joints: roll and yaw joints change their sign."""
    signs = (1, -1, -1, 1, -1, 1, -1)
    return (*left, *(s * v for s, v in zip(signs, left, strict=True)))


DEFAULT_ARMS: tuple[float, ...] = tuple(DEFAULT_POSE[15:])
GUARD_ARMS = mirrored_arms((-0.35, 0.25, 0.1, -0.45, 0.0, 0.0, 0.0))
"""Fists in front of the chest [rad]."""
CARRY_ARMS = mirrored_arms((-0.15, 0.12, 0.0, 0.05, 0.0, 0.0, 0.0))
"""Forearms level, palms facing each other [rad]."""
FORWARD_ARMS = mirrored_arms((-1.0, 0.2, 0.0, 0.9, 0.0, 0.0, 0.0))
"""Arms stretched forward as a counterweight [rad]."""
PUNCH_ARM = (-1.45, 0.12, 0.0, 1.25, 0.0, 0.0, 0.0)
"""A stretched left arm [rad]."""
PUSH_HANDS = ((0.36, 0.14, 0.20), (0.36, -0.14, 0.20))
"""Palms in front of the chest [m]."""


@dataclass(frozen=True)
class Segment:
    """Commands for some time."""

    seconds: float
    """Duration [s]."""
    channels: Mapping[str, Any] = field(default_factory=dict)
    """Channels that are not neutral."""
    ramp: bool = False
    """True if channels move evenly from the last segment's values instead of jumping."""

    def row(self) -> np.ndarray:
        """The packed command; shape [`COMMAND_WIDTH`].

        Raises:
            InputError: No such channel, or numbers that do not fit it.
        """
        row = np.array(neutral_row(), dtype=np.float32)
        for name, value in self.channels.items():
            if name not in CHANNELS:
                raise InputError(f"motion command: no channel {name!r}, expected one of {', '.join(CHANNELS)}")
            numbers, width = np.asarray(value, dtype=np.float32).ravel(), CHANNELS[name].width
            if numbers.size not in (1, width):
                raise InputError(f"motion command: {name} takes {width} numbers, got {numbers.size}")
            row[COLUMNS[name]] = numbers
        return row


@dataclass(frozen=True)
class Script:
    """Segments one after the other."""

    segments: tuple[Segment, ...]

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return sum(s.seconds for s in self.segments)

    def __add__(self, other: Script) -> Script:
        """One after the other."""
        return Script(self.segments + other.segments)

    def over(self, **channels: Any) -> Script:
        """The same with these channels wherever a segment does not set them itself."""
        return Script(tuple(Segment(s.seconds, {**channels, **s.channels}, s.ramp) for s in self.segments))


class Program:
    """One script per world; past its end a script holds its last segment."""

    def __init__(self, scripts: Sequence[Script], device: torch.device | str = "cpu"):
        """Packs the scripts.

        Args:
            scripts: One per world.
        """
        longest = max(len(s.segments) for s in scripts)
        ends = np.full((len(scripts), longest), np.inf, dtype=np.float32)
        rows = np.empty((len(scripts), longest + 1, COMMAND_WIDTH), dtype=np.float32)
        lengths, ramps = np.ones_like(ends), np.zeros_like(ends)
        for w, script in enumerate(scripts):
            rows[w] = neutral_row()
            total = 0.0
            for k, segment in enumerate(script.segments):
                total += segment.seconds
                ends[w, k], lengths[w, k], ramps[w, k] = total, max(segment.seconds, 1e-3), segment.ramp
                rows[w, k + 1 :] = segment.row()
            ends[w, len(script.segments) - 1 :] = np.inf
            lengths[w, len(script.segments) :] = 1.0
        starts = np.concatenate([np.zeros((len(scripts), 1), np.float32), ends[:, :-1]], axis=1)
        self._ends, self._starts = torch.tensor(ends, device=device), torch.tensor(starts, device=device)
        self._lengths, self._ramps = torch.tensor(lengths, device=device), torch.tensor(ramps, device=device)
        self._rows = torch.tensor(rows, device=device)
        self._worlds = torch.arange(len(scripts), device=device)
        self.worlds = len(scripts)
        self.seconds = max(s.seconds for s in scripts)

    def __call__(self, time: float | torch.Tensor) -> MotionCommand:
        """Commands at a time [s] since the start, one number or one per world."""
        if not isinstance(time, torch.Tensor):
            time = torch.full((self.worlds,), float(time), device=self._ends.device)
        w = self._worlds
        k = (time[:, None] >= self._ends).sum(1)
        fraction = ((time - self._starts[w, k]) / self._lengths[w, k]).clamp(0.0, 1.0)
        fraction = torch.where(self._ramps[w, k] > 0.5, fraction, 1.0)[:, None]
        previous, row = self._rows[w, k], self._rows[w, k + 1]
        return MotionCommand.unpack(previous + fraction * (row - previous))


def script(*segments: tuple[float, dict[str, Any]] | Segment) -> Script:
    """A script of segments, each given whole or as its time [s] and channels."""
    return Script(tuple(s if isinstance(s, Segment) else Segment(*s) for s in segments))


def _sided(side: str) -> int:
    if side not in SIDES:
        raise InputError(f"motion primitive: no side {side!r}, expected left or right")
    return SIDES[side]


def stand(seconds: float = 2.0, **channels: Any) -> Script:
    """Stand for a while, with any other channels."""
    return script((seconds, channels))


def shift(forward: float = 0.0, left: float = 0.05, hold: float = 1.5) -> Script:
    """Move the centre of mass over fixed feet [m], hold, and come back."""
    return script((hold + 0.8, {"shift": (forward, left)}), (1.0, {}))


def step(seconds: float = 3.0, *, pause: float = 1.0) -> Script:
    """Step in place."""
    return script((seconds, {"step_in_place": 1.0}), (pause, {}))


def walk(
    forward: float = 0.3, left: float = 0.0, turn: float = 0.0, seconds: float = 4.0, *, pause: float = 1.5
) -> Script:
    """Walk at a velocity [m/s, m/s, rad/s] of the heading frame and stop."""
    return script((seconds, {"velocity": (forward, left, turn)}), *([(pause, {})] if pause > 0.0 else []))


def step_over(
    stride: float = 0.40, seconds: float = 6.0, *, swing_height: float = 0.18, step_time: float = 0.52
) -> Script:
    """Walk with high steps, the right foot next to the left one, as over a sill.

    Args:
        stride: Stride length [m] (two steps).
        seconds: Time of walking [s].
        swing_height: Height of a step [m].
        step_time: Time of a step [s].
    """
    high = {"swing_height": swing_height, "step_time": step_time, "height": 0.74}
    speed = 0.5 * stride / step_time
    stepping = {"velocity": (speed, 0.0, 0.0), "stagger": 0.5 * stride, **high}
    return script((0.5, high), (seconds, stepping), (1.5, high), (0.5, {}))


def step_up(
    height: float = 0.10,
    stride: float = 0.40,
    pairs: int = 2,
    *,
    ahead: float = 1.3,
    down: bool = False,
    swing_height: float = 0.16,
    step_time: float = 0.56,
) -> Script:
    """Walk with high steps, the right foot next to the left one, onto ground of another height, and stand there.

    Args:
        height: Height of a platform [m], up to 0.2.
        stride: Stride length [m] (two steps).
        pairs: Pairs of steps once the ground ahead is higher.
        ahead: Time of walking before them [s].
        down: Go on and step down at the other end.
        swing_height: Height of a step above the ground that it leaves and meets [m].
        step_time: Time of a step [s].
    """
    high = {"swing_height": swing_height, "step_time": step_time, "height": 0.73}
    stepping = {"velocity": (0.5 * stride / step_time, 0.0, 0.0), "stagger": 0.5 * stride, **high}
    seconds = 2.0 * step_time * pairs
    parts = script((0.5, high), (ahead, stepping), (seconds, {**stepping, "ground": height}))
    if down:
        return parts + script((4.0 * step_time, stepping), (1.5, high), (0.5, {}))
    return parts + script((1.5, {**high, "ground": height}), (0.5, {"ground": height}))


def squat(height: float = 0.45, *, pitch: float = 0.3, down: float = 1.5, hold: float = 1.0) -> Script:
    """Lower the pelvis [m] over fixed feet, hold, and rise; `down` is the time of going down, and of going up [s]."""
    low = {"height": height, "pitch": pitch}
    return script(Segment(down, low, ramp=True), (hold + 0.3, low), Segment(down, {}, ramp=True), (0.5, {}))


def reach(side: str, point: Sequence[float], *, hold: float = 1.5, arms: Sequence[float] = DEFAULT_ARMS) -> Script:
    """Reach with one palm to a point of the pelvis' heading frame [m], hold, and return."""
    k = _sided(side)
    points, weights = np.array(neutral_row()[COLUMNS["hand_point"]]).reshape(2, 3), [0.0, 0.0]
    points[k], weights[k] = point, 1.0
    out = {"hand_point": points, "reach": weights, "arms": arms}
    return script((hold + 1.2, out), (1.2, {"arms": arms}))


def crouch_reach(
    side: str,
    point: Sequence[float],
    height: float = 0.55,
    *,
    pitch: float = 0.35,
    down: float = 1.5,
    hold: float = 1.5,
) -> Script:
    """Squat, reach to a point of the pelvis' heading frame [m], return, and rise."""
    low = {"height": height, "pitch": pitch}
    lower, up = script(Segment(down, low, ramp=True)), script(Segment(down, {}, ramp=True), (0.5, {}))
    return lower + reach(side, point, hold=hold).over(**low) + up


def kick(side: str = "right", speed: float = 2.5, *, pause: float = 0.5) -> Script:
    """Shift to the other foot, wind up, swing at a foot speed [m/s], and recover."""
    foot = _sided(side) + 1
    return script((kick_seconds(float(speed)), {"kick": foot, "kick_speed": speed}), (0.1 + pause, {}))


def punch(side: str = "right", *, height: float | None = None, speed: float = 10.0, times: int = 1) -> Script:
    """Guard, stretch an arm in about 0.25 s at a joint speed [rad/s], and come back."""
    k = _sided(side)
    out = np.array(GUARD_ARMS).reshape(2, 7)
    out[k] = np.array(mirrored_arms(PUNCH_ARM)).reshape(2, 7)[k]
    both = {"hands": (1.0, 1.0), **({} if height is None else {"height": height, "pitch": 0.15})}
    guard = {"arms": GUARD_ARMS, "arm_speed": 3.0, **both}
    hit = ((0.35, {**guard, "arms": out.ravel(), "arm_speed": speed}), (0.7, {**guard, "arm_speed": 6.0}))
    return script((1.2, guard), *(hit * times), (1.2, {"arms": DEFAULT_ARMS}))


def sit(seat: float = 0.42, *, hold: float = 3.0, depth: float = SEAT_DEPTH[0], press: float = SEAT_DEPTH[1]) -> Script:
    """Sit down on a real seat of a height [m] whose edge is about 5 cm behind the standing pelvis, and stay.

    Args:
        seat: Height of the seat [m].
        hold: Time on the seat [s].
        depth: How far behind its standing position the pelvis ends [m].
        press: Height of the pelvis above the seat at the end [m]; the robot's own touches it higher.
    """
    arms = {"arms": FORWARD_ARMS}
    back, above = min(SEAT_APPROACH[0], depth), SEAT_APPROACH[1]
    lean = {"pitch": 0.21, "waist": (0.0, 0.0, 0.14), **arms}
    middle = 0.5 * (0.78 + seat + above)
    return script(
        Segment(1.1, {"height": middle, "pelvis_back": 0.5 * back, **lean}, ramp=True),
        Segment(1.1, {"height": seat + above, "pelvis_back": back, "pitch": 0.12, **arms}, ramp=True),
        Segment(1.0, {"height": seat + press, "pelvis_back": depth, "pitch": 0.05, **arms}, ramp=True),
        (hold, {"height": seat + press, "pelvis_back": depth, "pitch": 0.0, **arms}),
    )


def rise(seat: float = 0.42, *, depth: float = SEAT_DEPTH[0], press: float = SEAT_DEPTH[1]) -> Script:
    """Stand up from a seat on which `sit` with the same numbers ended: lean forward, slide over the feet, rise."""
    arms = {"arms": FORWARD_ARMS}
    lean = {"pitch": 0.45, "waist": (0.0, 0.0, 0.35), **arms}
    # The weight comes over the feet while the seat still bears it; leaving it earlier, the robot falls back.
    return script(
        Segment(0.8, {"height": seat + press, "pelvis_back": depth, **lean}, ramp=True),
        Segment(0.4 + 4.0 * depth, {"height": seat + SEAT_CLEAR, "pelvis_back": 0.0, **lean}, ramp=True),
        (0.2, {"height": seat + SEAT_CLEAR, **lean}),
        Segment(1.2, {**arms}, ramp=True),
        (0.8, {}),
    )


def carry(
    forward: float = 0.25, left: float = 0.0, turn: float = 0.0, seconds: float = 4.0, *, width: float = 0.24
) -> Script:
    """Walk with both palms at the sides of a box of a width [m] in front of the belly."""
    points = ((0.30, 0.5 * width, 0.10), (0.30, -0.5 * width, 0.10))
    held = {"hand_point": points, "reach": (1.0, 1.0), "arms": CARRY_ARMS}
    return script((1.5, held), (seconds, {**held, "velocity": (forward, left, turn)}), (1.0, held), (1.5, {}))


def push(
    forward: float = 0.35,
    seconds: float = 5.0,
    *,
    foot_offset: float = 0.08,
    hands: Sequence[Sequence[float]] = PUSH_HANDS,
) -> Script:
    """Walk against a resistance: palms forward, feet set behind the pelvis [m]."""
    held = {"hand_point": hands, "reach": (1.0, 1.0), "arms": CARRY_ARMS, "foot_offset": foot_offset}
    return script((1.2, held), (seconds, {**held, "velocity": (forward, 0.0, 0.0)}), (1.0, held), (1.5, {}))
