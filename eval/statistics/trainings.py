"""Sums of success rates with intervals that cover other trainings of the same recipes, not other episodes alone.

An interval over a network's episodes says how well this network is known. A claim about a family, a tracker or a label
is one about trainings: its interval needs how much they differ, from several trainings of one recipe or declared.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

from arena_newton.cli.intervals import Z95
from arena_newton.eval.statistics.stats import Outcomes, contrast, within

__all__ = [
    "DROP_SPREAD",
    "ENOUGH",
    "MATCHED_SPREAD",
    "SWAPPED_SPREAD",
    "RateTerm",
    "TrainedContrast",
    "trained_contrast",
]

MATCHED_SPREAD = 0.13
"""Standard deviation between trainings of a rate through the tracker of the training.

This and the next two are declared where fewer than `ENOUGH` trainings of a recipe say theirs. Pooled over the eight
cells of three trainings in docs/results/trainings.md, "One training is one sample", which differ in steps and in part
in demonstrations and code too, so they are rough, and rather too large than too small."""
SWAPPED_SPREAD = 0.26
"""Spread of a rate through another tracker."""
DROP_SPREAD = 0.28
"""Spread of the difference of a training's rates through both trackers, and, as none was measured, under two modes."""
ENOUGH = 3
"""Trainings of a recipe from which their own standard deviation is taken."""


@dataclass(frozen=True)
class RateTerm:
    """One rate in a sum, and the training that it is of."""

    task: str
    weight: float
    outcomes: Outcomes
    recipe: Hashable
    """Key of trainings that differ by chance alone."""
    training: Hashable
    """Key of the network."""
    swapped: bool = False
    """Another tracker than that of the training executed it."""

    @property
    def part(self) -> float:
        """Weight x rate."""
        return self.weight * sum(self.outcomes.values()) / len(self.outcomes)


@dataclass(frozen=True)
class TrainedContrast:
    """A sum of rates and its 95 % interval over episodes and trainings."""

    value: float
    low: float
    high: float
    middle: float
    error: float
    """Standard error."""
    freedom: float
    """Degrees of freedom of the error; infinite where it is declared or of episodes alone."""
    episodes: int
    trainings: int
    measured: int
    """Recipes whose trainings say how much they differ; of the others it is declared."""
    recipes: int

    def p(self, against: float = 0.0) -> float:
        """Two-sided probability of a sum at least as far from this value by chance."""
        from scipy.special import stdtr  # half a second, for tables of which most have no findings

        return float(2 * stdtr(self.freedom, -abs(self.middle - against) / self.error))


def trained_contrast(terms: Sequence[RateTerm]) -> TrainedContrast | None:
    """Sum of weight x rate, tasks as strata, and its interval.

    The variance is that of the episodes (`stats.contrast`) and that between trainings, added: what chance of episodes
    is in the latter counts twice, so that the interval is rather too wide. A recipe of `ENOUGH` trainings, which have
    the same weights, gives its own variance; degrees of freedom after Satterthwaite, F. E. (1946), An approximate
    distribution of estimates of variance components, Biometrics Bulletin 2.

    Returns:
        None without terms, or where `stats.contrast` has none.
    """
    by_task: dict[str, list[tuple[float, Outcomes]]] = {}
    by_recipe: dict[Hashable, dict[Hashable, list[RateTerm]]] = {}
    for term in terms:
        by_task.setdefault(term.task, []).append((term.weight, term.outcomes))
        by_recipe.setdefault(term.recipe, {}).setdefault(term.training, []).append(term)
    strata = [by_task[task] for task in sorted(by_task)]
    found = contrast(strata)
    if found is None:
        return None
    # Exactly rounded sums: the order of the terms changes no bit.
    variances, squared = [found.error**2], list[float]()
    for trainings in by_recipe.values():
        number = len(trainings)
        if number < ENOUGH:
            variances += [_declared(one) ** 2 for one in trainings.values()]
            continue
        parts = [number * math.fsum(term.part for term in one) for one in trainings.values()]
        mean = math.fsum(parts) / number
        own = math.fsum((part - mean) ** 2 for part in parts) / (number - 1) / number
        variances.append(own)
        squared.append(own**2 / (number - 1))
    total, squares = math.fsum(variances), math.fsum(squared)
    freedom = total**2 / squares if squares else math.inf
    from scipy.special import stdtrit

    half = (float(stdtrit(freedom, 0.975)) if squares else Z95) * math.sqrt(total)
    low, high = within(strata, found.middle - half, found.middle + half)
    return TrainedContrast(
        value=found.value,
        low=low,
        high=high,
        middle=found.middle,
        error=math.sqrt(total),
        freedom=freedom,
        episodes=found.episodes,
        trainings=sum(map(len, by_recipe.values())),
        measured=len(squared),
        recipes=len(by_recipe),
    )


def _declared(terms: Sequence[RateTerm]) -> float:
    """Standard deviation of a training's part of the sum, where it is declared.

    The rates of one network on several tasks move together, as far as is known.
    """
    up, down = (math.fsum(abs(term.weight) for term in terms if (term.weight > 0) == side) for side in (True, False))
    if up and down:
        return DROP_SPREAD * max(up, down)
    return math.fsum((SWAPPED_SPREAD if term.swapped else MATCHED_SPREAD) * abs(term.weight) for term in terms)
