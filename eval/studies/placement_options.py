"""Flags of the commands that choose placements themselves."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import Several
from arena_newton.eval.plan.options import Batch, Chunks, Stepping

__all__ = ["PlacementOptions"]


@dataclass(frozen=True)
class _Placements:
    """Episodes that are played at every placement."""

    task: str = ""
    """Task whose placements are moved."""
    policy: str = "expert"
    """Policy: expert, stand, learned, lerobot:<checkpoint or training>, remote:<url> ..."""
    tracker: str = "twist2"
    """Tracker that executes the 40D action."""
    checkpoint: str | None = None
    """Its weights; those that come with the package when none are named."""
    mode: str = "base"
    """Mode whose ranges are searched: base, execution (wider), semantic, visual, dynamics."""
    rules: str = "paper"
    """Rule set: paper or released."""
    axes: Several[str] = ()
    """Numbers that are moved, such as football.x football.y, or dynamics.friction, also in a mode that leaves friction
    alone; the seeds draw the others. An unknown name lists all."""
    seed: int = 0
    """Group seed of what is drawn; the same seeds are played at every placement."""
    repeats: int = 1
    """Episodes, with one seed each, at every placement."""


@dataclass(frozen=True)
class PlacementOptions(Chunks, Stepping, Batch, _Placements):
    """Run behind a study of placements."""
