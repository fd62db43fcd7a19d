"""TWIST2 with state estimation and a look ahead, as a package: what its network cannot see, a loop around it can.

Shows: `needs`, `lookahead`, an argument and an entry point. More: docs/howto/bring/trackers.md.

    uv pip install -e examples/new_tracker
    python -m arena_newton doctor --tracker homing:0.5 --stand
"""

import dataclasses
from pathlib import Path

import torch

from arena_newton import trackers
from arena_newton.errors import InputError
from arena_newton.robot.rotations import quat_apply, quat_conjugate
from arena_newton.trackers import RobotState, TrackerCommand

ARMS = slice(15, 29)


class HomingTracker(trackers.Tracker):
    """Corrects the commanded velocity by the position error, and lets the arms lead by the drives' delay."""

    name = "homing"
    needs = ("position",)
    lookahead = 2

    def __init__(self, checkpoint: Path | None, gain: str = "0.5"):
        """Take TWIST2's weights and a gain [1/s]: `--tracker homing` or `homing:<gain>`."""
        try:
            self.inner, self.gain = trackers.get("twist2", checkpoint), float(gain)
        except ValueError:
            raise InputError(f"--tracker homing:{gain}: expected a gain in 1/s, such as 0.5") from None
        self.checkpoint, self.checkpoint_hash = self.inner.checkpoint, self.inner.checkpoint_hash
        self.drive, self.physics_rate = self.inner.drive, self.inner.physics_rate

    def bind(self, worlds: int, device: torch.device | str = "cpu") -> None:
        """Allocate."""
        self.inner.bind(worlds, device)

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Forget the past of some worlds, or of all."""
        self.inner.reset(mask)

    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Begin as if the first frame had been there for ever."""
        self.inner.prefill(command, state, mask)

    def step(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Joint targets [rad] of the corrected command."""
        away = quat_apply(quat_conjugate(command.quat), command.position - state.position)
        mimic = command.mimic.clone()
        mimic[:, :2] += (self.gain * away[:, :2]).clamp(-0.2, 0.2)  # m/s
        targets = self.inner.step(dataclasses.replace(command, mimic=mimic), state, mask).clone()
        targets[:, ARMS] += command.ahead.joints[:, -1, ARMS] - command.joints[:, ARMS]
        return targets

    def describe(self) -> dict[str, object]:
        """Facts to record with every result."""
        return super().describe() | {"gain": self.gain}
