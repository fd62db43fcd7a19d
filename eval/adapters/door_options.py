"""Flags of the command that plays one checkpoint through every door."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["DOOR_NAMES", "DoorOptions"]

DOOR_NAMES = ("lerobot", "learned", "lerobot-eval", "openpi", "roboarena", "vla-eval", "arena")
"""Doors: two of our runner, LeRobot's own command line, and the protocols of `policies.serve`."""


@dataclass(frozen=True)
class DoorOptions:
    """Play the same episodes with one checkpoint through each door, and compare outcomes, steps and actions.

    The first door is what the others are compared with. On engine mujoco and the CPU every door but `learned`, whose
    forward pass is another program, promises the same bits. Exit code 0: what is promised holds; 1: it does not.
    """

    checkpoint: str | None = None
    """A checkpoint of LeRobot, or the folder of a training; the policy that comes with the package by default."""
    task: str = "vis_navi"
    """Task."""
    tracker: str = "twist2"
    """Tracker that executes actions."""
    episodes: int = 3
    """Episodes of group seed 0, repeats 0, 1, 2 ..., 20 at most."""
    doors: tuple[str, ...] = DOOR_NAMES
    """Doors, in order."""
    first: int = 40
    """Actions of each episode that are compared bit for bit."""
    max_steps: int | None = None
    """Cap on the step budget of the rule set [ticks of 0.02 s]."""
    engine: str = "mujoco"
    """Physics engine: mujoco or warp."""
    device: str = "cpu"
    """Device of worlds and networks: cpu, cuda."""
    out: str = "doors"
    """Folder of the episodes, the programs' output and the table; must be empty or new."""
