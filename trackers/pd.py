"""The tracker without a network: the reference joints go straight to the drives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError
from arena_newton.robot import TWIST2_DRIVE
from arena_newton.trackers.base import RobotState, Tracker, TrackerCommand

if TYPE_CHECKING:
    import torch

__all__ = ["PdTracker", "from_checkpoint"]


class PdTracker(Tracker):
    """Joint targets are the reference joints; nothing balances the robot."""

    name = "pd"
    drive = TWIST2_DRIVE
    ignores = ("root xy", "root height", "root orientation")

    def step(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        """The reference joints themselves [rad], shape [worlds, 29] (no copy)."""
        return command.joints


def from_checkpoint(checkpoint: Path | None) -> PdTracker:
    """Make the PD tracker.

    Raises:
        InputError: A checkpoint was given; this tracker has no weights.
    """
    if checkpoint is not None:
        raise InputError(f"--checkpoint {checkpoint}: --tracker pd has no weights and takes no checkpoint")
    return PdTracker()
