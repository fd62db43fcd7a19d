"""Flags of the command that plays one checkpoint through every protocol."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import Device, Engine

__all__ = ["PROTOCOLS", "ProtocolOptions"]

PROTOCOLS = ("lerobot", "learned", "lerobot-eval", "openpi", "roboarena", "vla-eval", "arena")
"""Names of the programs that are compared: two of our runner, LeRobot's own command line, the protocols of
`policies.serve`."""


@dataclass(frozen=True)
class ProtocolOptions:
    """Play the same episodes with one checkpoint through each protocol, and compare outcomes, steps and actions.

    The others are compared with the first protocol. On engine mujoco and the CPU every protocol but `learned`, whose
    forward pass is another program, promises the same bits. Exit code 0: the promise holds; 1: it does not.
    """

    checkpoint: str | None = None
    """A checkpoint of LeRobot, or the folder of a training; the policy that comes with the package by default."""
    task: str = "vis_navi"
    """Task."""
    tracker: str = "twist2"
    """Tracker that executes actions."""
    episodes: int = 3
    """Episodes of group seed 0, repeats 0, 1, 2 ..., 20 at most."""
    protocols: tuple[str, ...] = PROTOCOLS
    """Protocols, in order."""
    first: int = 40
    """Actions of each episode that are compared bit for bit."""
    max_steps: int | None = None
    """Cap on the step budget of the rule set [ticks of 0.02 s]."""
    engine: Engine = "mujoco"
    device: Device[str] = "cpu"
    out: str = "protocols"
    """Folder of the episodes, the programs' output and the table; must be empty or new."""
