"""Episodes of one or several runs that an auditor draws to play again, and how probably they show a forged line."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import TYPE_CHECKING

from arena_newton.eval.records.chain import joint_head
from arena_newton.eval.records.journal import EpisodeRecord

if TYPE_CHECKING:
    from arena_newton.eval.audit.folder_audit import Audit

__all__ = ["FORGED", "drawn", "found_by", "found_probability"]

FORGED = (0.01, 0.05, 0.1, 0.25)
"""Fractions of forged lines for which an audit says how probably the drawn episodes find one."""


def drawn(audits: Sequence[Audit], count: int | None, seed: int, *, at_hand: bool = False) -> list[list[EpisodeRecord]]:
    """Episodes to play again, drawn over all runs together by their joint head and a number of the auditor's own.

    Every episode is equally likely, so that a run may get none; names and order of the folders change nothing. Those
    whose actions are not there are drawn too: whoever leaves them out must not choose what is played again.

    Args:
        audits: Of the runs; episodes that ended as errors cannot be drawn.
        count: Number of them; None: all.
        seed: The auditor's number. Whoever forged a run must not know it before the head is published.
        at_hand: Draw among those whose actions are there.

    Returns:
        Those of each run, in the plan's order.
    """
    gone = [set(audit.lacking) if at_hand else set() for audit in audits]
    candidates = [
        (run, record)
        for run in sorted(range(len(audits)), key=lambda run: audits[run].head)
        for record in audits[run].run.records
        if record.index not in gone[run] and record.outcome != "error"
    ]
    if count is not None and count < len(candidates):
        head = joint_head([audit.head for audit in audits])
        chosen = random.Random(f"{head} {seed}").sample(range(len(candidates)), count)
        candidates = [candidates[number] for number in sorted(chosen)]
    return [[record for run, record in candidates if run == one] for one in range(len(audits))]


def found_probability(forged: float, episodes: int) -> float:
    """Probability that one of so many drawn episodes is of a fraction of forged lines."""
    return 1.0 - (1.0 - forged) ** episodes


def found_by(episodes: int, of: int) -> str:
    """Forged lines that so many drawn episodes show, and how probably, in words.

    Args:
        episodes: Number of them.
        of: Number of those that they are drawn from.
    """
    if episodes == of:
        return "any forged line"
    odds = (f"{found_probability(forged, episodes):.0%} if {forged:.0%} are forged" for forged in FORGED)
    return f"a forged line with {', '.join(odds)}"
