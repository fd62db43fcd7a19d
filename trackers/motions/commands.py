"""What a reference generator is told: a set of channels, each with a neutral value, for a batch of worlds.

Channels may jump and may be combined freely; the generator limits their rates.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from arena_newton.errors import InputError
from arena_newton.robot import DEFAULT_POSE
from arena_newton.trackers.motions.kinematics import neutral_stance

if TYPE_CHECKING:
    import torch

__all__ = ["CHANNELS", "COMMAND_WIDTH", "MotionCommand", "neutral_row"]

_SHAPES: dict[str, tuple[int, ...]] = {
    "velocity": (3,),
    "height": (),
    "pitch": (),
    "roll": (),
    "waist": (3,),
    "shift": (2,),
    "foot_offset": (),
    "stance_width": (),
    "stagger": (),
    "swing_height": (),
    "step_time": (),
    "pelvis_back": (),
    "arms": (14,),
    "hand_point": (2, 3),
    "reach": (2,),
    "arm_speed": (),
    "kick_speed": (),
    "ground": (),
    "step_in_place": (),
    "kick": (),
    "hands": (2,),
}


def _slices() -> dict[str, slice]:
    out, at = {}, 0
    for name, shape in _SHAPES.items():
        size = 1
        for n in shape:
            size *= n
        out[name] = slice(at, at + size)
        at += size
    return out


CHANNELS: dict[str, slice] = _slices()
"""Columns of each channel in a packed command."""
COMMAND_WIDTH = sum(part.stop - part.start for part in CHANNELS.values())
"""Numbers of a packed command."""


@functools.cache
def neutral_row() -> tuple[float, ...]:
    """A packed command that says: stand."""
    stance = neutral_stance()
    values: dict[str, tuple[float, ...]] = {
        "height": (stance.height,),
        "stance_width": (0.22,),
        "swing_height": (0.08,),
        "step_time": (0.45,),
        "arms": tuple(DEFAULT_POSE[15:]),
        "hand_point": (*stance.hands[0], *stance.hands[1]),
        "arm_speed": (2.0,),
        "kick_speed": (2.5,),
    }
    row = [0.0] * COMMAND_WIDTH
    for name, numbers in values.items():
        row[CHANNELS[name]] = list(numbers)
    return tuple(row)


@dataclass
class MotionCommand:
    """One command a world; rows are worlds."""

    velocity: torch.Tensor
    """Forward and left [m/s] and yaw rate [rad/s] in the heading frame, shape [worlds, 3]; up to 0.8 m/s
    forward and 0.35 m/s sideways."""
    height: torch.Tensor
    """Pelvis above the ground [m], 0.40 to 0.785, shape [worlds]; walking lowers it to 0.75."""
    pitch: torch.Tensor
    """Forward lean of the pelvis [rad], shape [worlds]; walking adds 0.05."""
    roll: torch.Tensor
    """Roll of the pelvis [rad], shape [worlds]."""
    waist: torch.Tensor
    """Waist yaw, roll, pitch [rad], shape [worlds, 3]."""
    shift: torch.Tensor
    """Centre of mass forward and left of where it balances [m], shape [worlds, 2]; while both feet stand."""
    foot_offset: torch.Tensor
    """How far walking feet are set behind the pelvis [m], 0 to 0.10, shape [worlds]: leans the robot into a push."""
    stance_width: torch.Tensor
    """Distance between the feet [m], shape [worlds]."""
    stagger: torch.Tensor
    """How far a walking left foot is set before the right one, beyond the gait's own steps [m], shape [worlds]: by the
    length of a step, the right foot lands beside the left one, which leaves room for a sill between two pairs."""
    swing_height: torch.Tensor
    """Height of a step [m], shape [worlds]."""
    step_time: torch.Tensor
    """Time of a step [s], shape [worlds]; fast walking shortens it."""
    pelvis_back: torch.Tensor
    """The pelvis stays at least so far behind its place above the feet [m], shape [worlds]: for real seats only, since
    the centre of mass leaves the feet. 0 = balance alone."""
    arms: torch.Tensor
    """Posture of the arms [rad], MuJoCo order, shape [worlds, 14]."""
    hand_point: torch.Tensor
    """Where left and right palm (`kinematics.HAND_POINT` before the wrist) shall be [m], pelvis' heading frame, shape
    [worlds, 2, 3]."""
    reach: torch.Tensor
    """Share of `hand_point` against `arms`, 0 to 1, shape [worlds, 2]."""
    arm_speed: torch.Tensor
    """Largest speed of an arm joint [rad/s], shape [worlds]; a punch takes 10. Hand points move at 0.4 m a rad."""
    kick_speed: torch.Tensor
    """Speed of the swinging foot [m/s], shape [worlds]."""
    ground: torch.Tensor
    """Height of the ground ahead [m], 0 to 0.2, shape [worlds]: the next foot that lands 0.2 m before the other one
    steps onto it, the other one follows."""
    step_in_place: torch.Tensor
    """Whether to step without moving, bool, shape [worlds]."""
    kick: torch.Tensor
    """0 none, 1 left foot, 2 right foot, int64, shape [worlds]; a change from 0 starts one kick."""
    hands: torch.Tensor
    """Left and right hand: 1 closed, 0 open, shape [worlds, 2]."""

    @classmethod
    def neutral(cls, worlds: int, device: Any = "cpu") -> MotionCommand:
        """Stand still with arms at the default pose."""
        import torch

        return cls.unpack(torch.tensor(neutral_row(), device=device).repeat(worlds, 1))

    @classmethod
    def unpack(cls, table: torch.Tensor) -> MotionCommand:
        """Commands from rows laid out as `CHANNELS`; table, shape [worlds, `COMMAND_WIDTH`]."""
        parts = {name: table[:, part].reshape(-1, *_SHAPES[name]) for name, part in CHANNELS.items()}
        parts["step_in_place"] = parts["step_in_place"] >= 0.5
        parts["kick"] = parts["kick"].round().long()
        return cls(**parts)

    def pack(self) -> torch.Tensor:
        """Rows laid out as `CHANNELS`, shape [worlds, `COMMAND_WIDTH`]."""
        import torch

        worlds = len(self.height)
        columns = []
        for name, part in CHANNELS.items():
            value = getattr(self, name)
            if value.numel() != worlds * (part.stop - part.start):
                expected = [worlds, *_SHAPES[name]]
                raise InputError(f"motion command: {name} has shape {list(value.shape)}, expected {expected}")
            columns.append(value.reshape(worlds, -1).to(self.height.dtype))
        return torch.cat(columns, dim=1)

    def replace(self, **channels: Any) -> MotionCommand:
        """The same command with other channels."""
        return dataclasses.replace(self, **channels)
