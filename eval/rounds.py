"""Rounds of attempts: which episodes of a plan are due when a number of successes is to be kept. Pure.

The first round has as many attempts as successes are wanted, each later one as many as are missing still, until there
are enough or the plan has no more. What is due follows from the outcomes alone, so a run that was interrupted, or one
with other worlds, keeps the same episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

__all__ = ["ATTEMPTS", "complete", "due"]

ATTEMPTS = 2
"""Attempts planned for each success that is wanted."""


def due(group: Sequence[int], ended: Mapping[int, str], keep: int | None) -> list[int]:
    """Episodes to play next.

    Args:
        group: Numbers of the planned episodes of one task, tracker and mode, in their order.
        ended: Number → outcome of those that have ended.
        keep: Successes wanted; None: all episodes are played.

    Returns:
        Numbers of the round's episodes that have not ended; empty where the group is complete.
    """
    if keep is None:
        return [index for index in group if index not in ended]
    first, count = 0, keep
    while count > 0 and first < len(group):
        attempts = group[first : first + count]
        missing = [index for index in attempts if index not in ended]
        if missing:
            return missing
        first += len(attempts)
        count = keep - sum(ended[index] == "success" for index in group[:first])
    return []


def complete(planned: int, groups: int, ended: Mapping[int, str], keep: int | None) -> bool:
    """Whether a plan of equally large groups, one after the other, is played."""
    size = planned // max(groups, 1)
    return not any(due(range(g * size, (g + 1) * size), ended, keep) for g in range(groups))
