"""Rounds of episodes: which of a plan are due when their number follows from outcomes. Pure.

When successes are to be kept, the first round has as many attempts as are wanted, each later one as many as are missing
still, until there are enough or the plan has no more. When an interval of some width is wanted, a round has
`LOOK_EVERY` episodes, until the interval of the success rate is as narrow, or as many were played as were fixed before.

What is due follows from the outcomes alone, so a run that was interrupted, or one with other worlds, plays the same
episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from arena_newton.cli.intervals import wilson

__all__ = ["ATTEMPTS", "LOOK_EVERY", "WidthRule", "complete", "due"]

ATTEMPTS = 2
"""Attempts planned for each success that is wanted."""
LOOK_EVERY = 20
"""Episodes of a task, tracker and mode between two looks at its interval; independent of the number of worlds."""


@dataclass(frozen=True)
class WidthRule:
    """Rule by which a task, tracker and mode has enough episodes; printed before the first one is played."""

    width: float
    """Width of the 95 % interval of the success rate, 0 to 1."""
    most: int
    """Episodes at most."""
    seeds: int
    """Group seeds, which take turns."""

    def order(self, group: Sequence[int]) -> list[int]:
        """Numbers of the planned episodes, which are seed by seed, in the order in which they are played."""
        repeats = len(group) // self.seeds
        return [group[seed * repeats + repeat] for repeat in range(repeats) for seed in range(self.seeds)][: self.most]

    def due(self, group: Sequence[int], ended: Mapping[int, str]) -> list[int]:
        """Episodes of the round that have not ended; empty where the group is complete."""
        order = self.order(group)
        for count in (*range(LOOK_EVERY, len(order), LOOK_EVERY), len(order)):
            missing = [index for index in order[:count] if index not in ended]
            if missing:
                return missing
            low, high = wilson(sum(ended[index] == "success" for index in order[:count]), count)
            if high - low <= self.width:
                return []
        return []


def due(group: Sequence[int], ended: Mapping[int, str], keep: int | None, rule: WidthRule | None = None) -> list[int]:
    """Episodes to play next.

    Args:
        group: Numbers of the planned episodes of one task, tracker and mode, in their order.
        ended: Number → outcome of those that have ended.
        keep: Successes wanted; None: all episodes are played.
        rule: When there are enough of them, without `keep`.

    Returns:
        Numbers of the round's episodes that have not ended; empty where the group is complete.
    """
    if keep is None and rule is not None:
        return rule.due(group, ended)
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


def complete(
    planned: int, groups: int, ended: Mapping[int, str], keep: int | None, rule: WidthRule | None = None
) -> bool:
    """True if a plan of equally large groups, one after the other, is played."""
    size = planned // max(groups, 1)
    return not any(due(range(g * size, (g + 1) * size), ended, keep, rule) for g in range(groups))
