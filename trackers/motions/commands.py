"""Commands of a reference generator: a set of channels, each with a neutral value, for a batch of worlds.

Channels may jump and may be combined freely; the generator limits their rates. A field of `MotionCommand` is one
channel, and the only one that names its width, neutral value, range and rate: columns, checks and limits follow.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from arena_newton.errors import InputError
from arena_newton.robot.g1 import DEFAULT_POSE
from arena_newton.trackers.motions.kinematics import Stance, neutral_stance

__all__ = [
    "CHANNELS",
    "COLUMNS",
    "COMMAND_WIDTH",
    "LIMITED_COLUMNS",
    "LIMITED_WIDTH",
    "SHORTEST_STEP",
    "Channel",
    "MotionCommand",
    "columns",
    "neutral_row",
]

SHORTEST_STEP = 0.32
"""Shortest time of a step [s]."""

Numbers = float | tuple[float, ...]
"""One number for all columns of a channel, or one for each."""


@dataclass(frozen=True)
class Channel:
    """Width, neutral value, range and rate of a channel of commands."""

    shape: tuple[int, ...] = ()
    """Shape per world."""
    neutral: Numbers | Callable[[Stance], Numbers] = 0.0
    """Value in a command to stand; some follow from the default pose."""
    low: Numbers = -1e3
    """Least value that takes effect."""
    high: Numbers = 1e3
    """Largest value that takes effect."""
    rate: Numbers | None = None
    """Largest rate [unit/s]; None takes effect at once."""
    acceleration: Numbers | None = None
    """Largest acceleration [unit/s²]; with a rate only."""
    per_arm_speed: bool = False
    """True if rate and acceleration are multiplied by the channel `arm_speed`."""

    @property
    def width(self) -> int:
        """Number of columns."""
        return math.prod(self.shape)

    def spread(self, numbers: Numbers | None) -> tuple[float, ...]:
        """One of this channel's `Numbers`, one per column."""
        found = numbers if isinstance(numbers, tuple) else (numbers or 0.0,) * self.width
        if len(found) != self.width:
            raise ValueError(f"has {self.width} columns, not {len(found)}")
        return found

    def check(self) -> None:
        """Find a row that would leave the channel without effect.

        Raises:
            ValueError: Numbers that do not fit the width, an empty range, a rate without an acceleration or of zero.
        """
        low, high = self.spread(self.low), self.spread(self.high)
        if any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"has an empty range, {self.low} to {self.high}")
        if (self.rate is None) != (self.acceleration is None):
            raise ValueError("needs both a rate and an acceleration, or neither")
        if self.rate is not None and min(*self.spread(self.rate), *self.spread(self.acceleration)) <= 0.0:
            raise ValueError(f"never moves: rate {self.rate}, acceleration {self.acceleration}")


def _channel(shape: tuple[int, ...] = (), low: Numbers = -1e3, high: Numbers = 1e3, **rest: Any) -> Any:
    """A field of `MotionCommand` with its `Channel`; commands are made with a value for every one."""
    return field(metadata={"channel": Channel(shape, low=low, high=high, **rest)})


@dataclass
class MotionCommand:
    """One command per world; rows are worlds. Values outside a channel's range count as its nearest end."""

    velocity: Tensor = _channel(
        (3,), (-0.9, -0.35, -1.2), (0.9, 0.35, 1.2), rate=(0.6, 0.6, 1.5), acceleration=(4.0, 4.0, 10.0)
    )
    """Forward and left [m/s] and yaw rate [rad/s] in the heading frame, shape [worlds, 3]; up to 0.8 m/s
    forward and 0.35 m/s sideways are followed well."""
    height: Tensor = _channel((), 0.38, 0.785, neutral=lambda stance: stance.height, rate=0.35, acceleration=1.2)
    """Pelvis above the ground [m], shape [worlds]; 0.785 nearly straightens the knees, walking lowers it to 0.75."""
    pitch: Tensor = _channel((), -0.3, 1.0, rate=0.6, acceleration=2.5)
    """Forward lean of the pelvis [rad], shape [worlds]; walking adds 0.05."""
    roll: Tensor = _channel((), -0.2, 0.2, rate=0.4, acceleration=2.0)
    """Roll of the pelvis [rad], shape [worlds]."""
    waist: Tensor = _channel((3,), -2.5, 2.5, rate=1.2, acceleration=6.0)
    """Waist yaw, roll, pitch [rad], shape [worlds, 3]."""
    shift: Tensor = _channel((2,), -0.12, 0.12, rate=0.12, acceleration=0.5)
    """Centre of mass forward and left of where it balances [m], shape [worlds, 2]; while both feet stand."""
    foot_offset: Tensor = _channel((), 0.0, 0.12, rate=0.08, acceleration=0.4)
    """Distance of walking feet behind the pelvis [m], shape [worlds]: leans the robot into a push."""
    stance_width: Tensor = _channel((), 0.16, 0.36, neutral=0.22, rate=0.2, acceleration=1.0)
    """Distance between the feet [m], shape [worlds]."""
    stagger: Tensor = _channel((), -0.3, 0.3, rate=0.2, acceleration=1.0)
    """Distance of a walking left foot ahead of the right one, beyond the gait's own steps [m], shape [worlds]. At the
    length of a step the right foot lands next to the left one, which leaves room for a sill between two pairs."""
    swing_height: Tensor = _channel((), 0.02, 0.22, neutral=0.08, rate=0.2, acceleration=1.0)
    """Height of a step [m], shape [worlds]."""
    step_time: Tensor = _channel((), SHORTEST_STEP, 0.8, neutral=0.45, rate=0.3, acceleration=2.0)
    """Time of a step [s], shape [worlds]; fast walking shortens it."""
    pelvis_back: Tensor = _channel((), 0.0, 0.45, rate=0.25, acceleration=0.8)
    """The pelvis stays at least this far behind its position above the feet [m], shape [worlds]: for real seats only,
    since the centre of mass leaves the feet. 0 = balance alone."""
    arms: Tensor = _channel((14,), neutral=tuple(DEFAULT_POSE[15:]), rate=1.0, acceleration=8.0, per_arm_speed=True)
    """Posture of the arms [rad], MuJoCo order, shape [worlds, 14]."""
    hand_point: Tensor = _channel(
        (2, 3),
        neutral=lambda stance: (*stance.hands[0], *stance.hands[1]),
        rate=0.4,
        acceleration=3.2,
        per_arm_speed=True,
    )
    """Wanted positions of the left and the right palm (`kinematics.HAND_POINT` ahead of the wrist) [m], pelvis' heading
    frame, shape [worlds, 2, 3]."""
    reach: Tensor = _channel((2,), 0.0, 1.0, rate=1.6, acceleration=8.0)
    """Weight of `hand_point` against `arms`, 0 to 1, shape [worlds, 2]."""
    arm_speed: Tensor = _channel((), 0.1, 12.0, neutral=2.0)
    """Largest speed of an arm joint [rad/s], shape [worlds]; a punch takes 10. Hand points move at 0.4 m per rad."""
    kick_speed: Tensor = _channel((), 0.5, 4.0, neutral=2.5)
    """Speed of the swinging foot [m/s], shape [worlds]."""
    ground: Tensor = _channel((), 0.0, 0.2)
    """Height of the ground ahead [m], shape [worlds]: the next foot that lands 0.2 m ahead of the other one steps onto
    it, the other one follows."""
    step_in_place: Tensor = _channel()
    """True to step without moving, bool, shape [worlds]."""
    kick: Tensor = _channel((), 0.0, 2.0)
    """0 none, 1 left foot, 2 right foot, int64, shape [worlds]; a change from 0 starts one kick."""
    hands: Tensor = _channel((2,))
    """Left and right hand: 1 closed, 0 open, shape [worlds, 2]."""

    @classmethod
    def neutral(cls, worlds: int, device: torch.device | str = "cpu") -> MotionCommand:
        """Stand still with arms at the default pose."""
        return cls.unpack(torch.tensor(neutral_row(), device=device).repeat(worlds, 1))

    @classmethod
    def unpack(cls, table: Tensor) -> MotionCommand:
        """Commands from rows laid out as `COLUMNS`; table, shape [worlds, `COMMAND_WIDTH`]."""
        parts = {name: table[:, part].reshape(-1, *CHANNELS[name].shape) for name, part in COLUMNS.items()}
        parts["step_in_place"] = parts["step_in_place"] >= 0.5
        parts["kick"] = parts["kick"].round().long()
        return cls(**parts)

    def pack(self) -> Tensor:
        """Rows laid out as `COLUMNS`, shape [worlds, `COMMAND_WIDTH`].

        Raises:
            InputError: A channel is of another shape.
        """
        worlds = len(self.height)
        packed = []
        for name, channel in CHANNELS.items():
            value = getattr(self, name)
            if value.numel() != worlds * channel.width:
                expected = [worlds, *channel.shape]
                raise InputError(f"motion command: {name} has shape {list(value.shape)}, expected {expected}")
            packed.append(value.reshape(worlds, -1).to(self.height.dtype))
        return torch.cat(packed, dim=1)


def _read_channels(command: type[MotionCommand]) -> dict[str, Channel]:
    """Channels of a command by name, checked.

    Raises:
        TypeError: A channel's row would leave it without effect.
    """
    found = {}
    for row in dataclasses.fields(command):
        try:
            found[row.name] = row.metadata["channel"]
            found[row.name].check()
        except (KeyError, ValueError) as error:
            raise TypeError(f"motion command: channel {row.name}: {error}") from error
    return found


def columns(channels: Mapping[str, Channel]) -> dict[str, slice]:
    """Columns of each channel when they are packed in order."""
    out, start = {}, 0
    for name, channel in channels.items():
        out[name] = slice(start, start + channel.width)
        start += channel.width
    return out


CHANNELS: dict[str, Channel] = _read_channels(MotionCommand)
"""The channels by name."""
COLUMNS: dict[str, slice] = columns(CHANNELS)
"""Columns of each channel in a packed command."""
COMMAND_WIDTH = sum(channel.width for channel in CHANNELS.values())
"""Columns of a packed command."""
_LIMITED = {name: channel for name, channel in CHANNELS.items() if channel.rate is not None}
LIMITED_COLUMNS: dict[str, slice] = columns(_LIMITED)
"""Columns of the rate-limited channels alone, packed in order: the state of the generator."""
LIMITED_WIDTH = sum(channel.width for channel in _LIMITED.values())
"""Columns of the rate-limited channels."""


@functools.cache
def neutral_row() -> tuple[float, ...]:
    """The packed command to stand."""
    row: list[float] = []
    for channel in CHANNELS.values():
        neutral = channel.neutral(neutral_stance()) if callable(channel.neutral) else channel.neutral
        row += channel.spread(neutral)
    return tuple(row)
