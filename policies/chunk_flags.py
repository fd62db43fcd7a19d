"""Flags by which a policy's chunks are read, of runs and of policy servers alike."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import check_least, flag_name
from arena_newton.errors import InputError

__all__ = ["LABELS", "ChunkFlags"]

LABELS = ("v3.1", "v4")
"""Label protocols, `data.readers.label_protocols.LABELS`, which loads torch."""


@dataclass(frozen=True)
class ChunkFlags:
    """Protocol of a policy's actions, and how many of a chunk are executed."""

    labels: str | None = None
    """Protocol of the policy's actions: v3.1, or v4 for one that was trained on labels of v4; what the policy says of
    itself when none is named, and v3.1 where it says nothing."""
    replan: int | None = None
    """For --policy lerobot: execute only the first so many actions of each chunk, then query it again."""
    ensemble: bool = False
    """For --policy lerobot: execute at each tick the mean of all chunks that cover it; queried every 2 ticks, or as
    --replan says."""

    def check_chunks(self, policy: str) -> None:
        """Refuse what cannot be, or belongs to another policy than this one.

        Raises:
            InputError: A flag is unfit; the message names it.
        """
        if self.labels not in (None, *LABELS):
            raise InputError(f"--labels {self.labels}: unknown, choose from {', '.join(LABELS)}")
        check_least(self, 1, "replan")
        for name in ("replan", "ensemble"):
            if getattr(self, name) and policy.partition(":")[0] != "lerobot":
                raise InputError(f"{flag_name(name)}: belongs to --policy lerobot:<checkpoint>, not {policy}")
