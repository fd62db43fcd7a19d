"""Flags of the command that packs a policy."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import Several

__all__ = ["ENOUGH", "PackOptions"]

ENOUGH = 0.75
"""Success rate from which on a task counts as solved."""


@dataclass(frozen=True)
class PackOptions:
    """Pack a trained checkpoint into the form that ships: float16, a card, at most 32 MB; ACT only.

    `eval run --policy learned:<out>` runs it, without LeRobot. Without --out it becomes the policy of this package,
    `--policy learned`.
    """

    out: str | None = None
    """Folder to write; that of the policy that comes with the package when none is named."""
    tasks: Several[str] = ()
    """Tasks that it is offered for, the one first that the default run shows; with results those that it solves at
    75 % in mode base through every tracker of its training, otherwise those of its training."""
    results: Several[str] = ()
    """Results folders or suites of eval whose cells of this checkpoint go into the card; a packed policy that is
    packed again keeps its other cells."""
    command: str = ""
    """Command of the training, if not as the checkpoint remembers it."""
    note: str = ""
    """A sentence for the card."""
