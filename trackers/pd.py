"""The tracker without a network: the reference joints go straight to the drives."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot.g1 import TWIST2_DRIVE
from arena_newton.trackers.base import Tracker

if TYPE_CHECKING:
    import torch

__all__ = ["PD_DRIVE", "PdTracker", "from_checkpoint"]

_LEG_KP, _LEG_KD = (300.0, 300.0, 200.0, 300.0, 300.0, 200.0), (8.0, 8.0, 4.0, 8.0, 8.0, 6.0)
PD_DRIVE = dataclasses.replace(
    TWIST2_DRIVE,
    name="pd",
    kp=(*_LEG_KP, *_LEG_KP, *(300.0,) * 3, *TWIST2_DRIVE.kp[15:]),
    kd=(*_LEG_KD, *_LEG_KD, *(8.0,) * 3, *TWIST2_DRIVE.kd[15:]),
)
"""Stiff legs and waist within the real torque limits: nothing balances here, so the ankles' stiffness must hold the
robot up (it takes about 230 N·m/rad for both together). With these the standing command stood 20 s in plain MuJoCo;
with TWIST2's own gains (ankles 40) it tipped over after 1.6 s."""


class PdTracker(Tracker):
    """Joint targets are the reference joints; nothing balances the robot."""

    name = "pd"
    drive = PD_DRIVE
    ignores = ("root xy", "root height", "root orientation")

    def step(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> torch.Tensor:
        """The reference joints themselves [rad], shape [worlds, 29] (no copy)."""
        return command.joints

    def graded(self, worlds: int) -> PdTracker:
        """See `Tracker.graded`."""
        return PdTracker()


def from_checkpoint(checkpoint: Path | None) -> PdTracker:
    """Make the PD tracker.

    Raises:
        InputError: A checkpoint was given; this tracker has no weights.
    """
    if checkpoint is not None:
        raise InputError(f"--checkpoint {checkpoint}: --tracker pd has no weights and takes no checkpoint")
    return PdTracker()
