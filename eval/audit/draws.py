"""Episodes that an auditor draws to play again, and how probably they show a forged line."""

from __future__ import annotations

import random
from collections.abc import Collection
from typing import TYPE_CHECKING

from arena_newton.eval.records.journal import EpisodeRecord

if TYPE_CHECKING:
    from arena_newton.eval.audit.folder_audit import Audit

__all__ = ["FORGED", "drawn", "found_probability", "odds"]

FORGED = (0.01, 0.05, 0.1, 0.25)
"""Fractions of forged lines for which an audit says how probably the drawn episodes find one."""


def drawn(audit: Audit, count: int | None, seed: int, without: Collection[int] = ()) -> list[EpisodeRecord]:
    """Episodes to play again, drawn by the head of the journal and a number of the auditor's own.

    Those whose actions are not there are drawn too: whoever leaves them out must not choose what is played again.

    Args:
        audit: Of the folder; episodes that ended as errors cannot be drawn.
        count: Number of them; None: all.
        seed: The auditor's number. Whoever forged the folder must not know it before the head is published.
        without: Numbers of episodes to leave out.
    """
    gone = set(without)
    candidates = [record for record in audit.run.records if record.index not in gone and record.outcome != "error"]
    if count is None or count >= len(candidates):
        return candidates
    chosen = random.Random(f"{audit.head} {seed}").sample(range(len(candidates)), count)
    return [candidates[number] for number in sorted(chosen)]


def found_probability(forged: float, episodes: int) -> float:
    """Probability that one of so many drawn episodes is of a fraction of forged lines."""
    return 1.0 - (1.0 - forged) ** episodes


def odds(episodes: int) -> str:
    """Probabilities that so many drawn episodes show one, in words."""
    return ", ".join(f"{found_probability(f, episodes):.0%} if {f:.0%} are forged" for f in FORGED)
