"""Interface between a teleoperation session and the source of a person's actions: records and a Protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

__all__ = ["Control", "Recording", "Source", "Telemetry", "Wish"]

Recording = Literal["idle", "recording", "saved", "discarded"]
"""State of the running episode's recording: not recorded, recorded, just saved, just discarded."""

Control = Literal["none", "start", "save", "cancel", "save_and_reset", "discard_and_reset", "quit"]
"""Control of the recording by a person: `start` begins one, in an episode that begins with it; `save` and `cancel` end
it; the `_and_reset` forms also begin the next episode; `quit` ends the session. A control is an event: a source gives
each once."""


@dataclass(frozen=True)
class Telemetry:
    """The robot as it is at one tick."""

    tick: int
    """Ticks since step 0 of the episode; the robot stands in the start-up before it."""
    state: np.ndarray
    """Canonical state, float32, shape [64]."""
    root_position: np.ndarray
    """Position of the pelvis in the world [m], float32, shape [3]."""
    root_quat: np.ndarray
    """Orientation of the pelvis wxyz, float32, shape [4]."""
    ang_vel_body: np.ndarray
    """Angular velocity of the pelvis in its own frame [rad/s], float32, shape [3]."""
    joint_pos: np.ndarray
    """Joint positions [rad], MuJoCo order, float32, shape [29]."""
    joint_vel: np.ndarray
    """Joint velocities [rad/s], MuJoCo order, float32, shape [29]."""
    image: np.ndarray | None
    """The newest picture of the head camera, uint8, shape [H, W, 3]; None before the first. The same array is given
    until a newer picture is there."""
    recording: Recording
    """State of the recording."""
    outcome: str | None = None
    """Ending of the episode: `success`, `fall`, or the task's own event, such as `ball_out`; None while it goes on."""
    note: str = ""
    """One line for the person, such as the file that was saved."""
    factor: float = 1.0
    """Simulated time over time that passed, of the last seconds; below 1 the machine is too slow."""


@dataclass(frozen=True)
class Wish:
    """Wanted action and control of a source at one tick."""

    action: np.ndarray | None
    """Canonical action of this tick, float32, shape [40]; None: the source has nothing of now, and the robot comes to a
    stand."""
    control: Control = "none"
    """Control of the recording."""


class Source(Protocol):
    """Gives the session a person's action at every tick; nothing here may block."""

    name: str

    def begin(self, view: Telemetry) -> None:
        """An episode begins: the robot stands, and the reference is aligned with it at this tick.

        Args:
            view: The robot at step 0.
        """

    def wish(self, view: Telemetry) -> Wish:
        """The action of this tick; called once per 50 Hz tick.

        Args:
            view: The robot before the tick.
        """

    def show(self, view: Telemetry) -> None:
        """Give state and pictures back to the person.

        Args:
            view: The robot after the tick.
        """

    def close(self) -> None:
        """End threads, sockets and connections."""
