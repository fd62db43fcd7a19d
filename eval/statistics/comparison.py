"""Several policies against each other: all pairs tested within each task and across all, adjusted for their number.

Pure: outcomes in, figures out; where outcomes come from is `contenders`' matter.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

from arena_newton.cli.intervals import wilson
from arena_newton.errors import InputError
from arena_newton.eval.statistics.rate_tests import (
    PairedCounts,
    UnpairedCounts,
    excess,
    letters,
    rate_test,
    stratified_test,
)
from arena_newton.eval.statistics.stats import Contrast, contrast, holm

__all__ = ["LEVEL", "Comparison", "Contender", "PairComparison", "Standing", "StratumPair", "compare", "counts_of"]

LEVEL = 0.05
"""Probability, after adjustment, below which two rates count as different."""

type Stratum = tuple[str, ...]
"""Name of episodes that are compared with each other: a task, and what of tracker and mode varies."""
type StratumOutcomes = Mapping[Hashable, bool]
"""Success of each episode of a stratum, by the name that the episode has in every contender."""


@dataclass(frozen=True)
class Contender:
    """Side of a comparison: usually a policy, as one results folder has it."""

    name: str
    outcomes: Mapping[Stratum, StratumOutcomes]


@dataclass(frozen=True)
class StratumPair:
    """Two contenders in one stratum."""

    stratum: Stratum
    counts: PairedCounts | UnpairedCounts
    unpaired: int
    """Episodes left out, because the other contender has others."""
    test: str
    p: float
    p_holm: float
    """Adjusted for the number of all pairs in all strata."""
    difference: Contrast


@dataclass(frozen=True)
class PairComparison:
    """Two contenders over all strata; `first` and `second` are their numbers from 0."""

    first: int
    second: int
    strata: tuple[StratumPair, ...]
    p: float
    """Probability of the stratified exact test."""
    p_holm: float
    """Adjusted for the number of pairs."""
    excess: float
    """Successes of the first beyond what the test expects of equal rates: where it differs, whether it is better."""
    difference: Contrast

    @property
    def differs(self) -> bool:
        """True if the contenders differ significantly over all strata."""
        return self.p_holm <= LEVEL


@dataclass(frozen=True)
class Standing:
    """One contender in one stratum, or over all."""

    successes: int
    episodes: int
    low: float
    """95 % Wilson interval of the rate, as `high`."""
    high: float
    letters: str
    """Contenders that share a letter do not differ significantly."""

    @property
    def rate(self) -> float:
        """Success rate."""
        return self.successes / self.episodes


@dataclass(frozen=True)
class Comparison:
    """Contenders, how each stands, and every pair."""

    names: tuple[str, ...]
    strata: tuple[Stratum, ...]
    """Those that all contenders have, in the order of the first."""
    left_out: tuple[Stratum, ...]
    """Those that some contender lacks."""
    overall: tuple[Standing, ...]
    """Standing of each contender over all strata."""
    within: Mapping[Stratum, tuple[Standing, ...]]
    """Standing of each contender in each stratum."""
    pairs: tuple[PairComparison, ...]


def counts_of(first: StratumOutcomes, second: StratumOutcomes) -> tuple[PairedCounts | UnpairedCounts, int]:
    """Counts of two conditions in a stratum, and how many episodes they leave out.

    Where they share an episode, those that they share count, paired; where they share none, all of them.
    """
    common = [key for key in first if key in second]
    if not common:
        return UnpairedCounts(sum(first.values()), len(first), sum(second.values()), len(second)), 0
    cells = [[0, 0], [0, 0]]
    for key in common:
        cells[first[key]][second[key]] += 1
    return PairedCounts(cells[1][1], cells[1][0], cells[0][1], cells[0][0]), len(first) + len(second) - 2 * len(common)


def compare(contenders: Sequence[Contender]) -> Comparison:
    """Compare all pairs of contenders over the strata that all of them have.

    Raises:
        InputError: There are fewer than two, or they have no stratum in common.
    """
    if len(contenders) < 2:
        raise InputError(f"compare: needs two policies or more, found {len(contenders)}")
    strata = tuple(s for s in contenders[0].outcomes if all(one.outcomes.get(s) for one in contenders))
    if not strata:
        raise InputError(_nothing_common(contenders))
    numbers = list(itertools.combinations(range(len(contenders)), 2))
    table = {
        (pair, stratum): counts_of(contenders[pair[0]].outcomes[stratum], contenders[pair[1]].outcomes[stratum])
        for pair in numbers
        for stratum in strata
    }
    tests = {key: rate_test(counts) for key, (counts, _) in table.items()}
    adjusted = dict(zip(tests, holm([test.p for test in tests.values()]), strict=True))
    over_all = [stratified_test([table[pair, stratum][0] for stratum in strata]) for pair in numbers]
    pairs = []
    for pair, p, p_holm in zip(numbers, over_all, holm(over_all), strict=True):
        parts = tuple(
            StratumPair(
                stratum,
                *table[pair, stratum],
                tests[pair, stratum].name,
                tests[pair, stratum].p,
                adjusted[pair, stratum],
                _difference(contenders, pair, [stratum]),
            )
            for stratum in strata
        )
        counts = [part.counts for part in parts]
        difference = _difference(contenders, pair, strata)
        pairs.append(PairComparison(*pair, parts, p, p_holm, excess(counts), difference))
    within = {}
    for position, stratum in enumerate(strata):
        differing = [(pair.first, pair.second) for pair in pairs if pair.strata[position].p_holm <= LEVEL]
        within[stratum] = _standings([list(one.outcomes[stratum].values()) for one in contenders], differing)
    differing = [(pair.first, pair.second) for pair in pairs if pair.differs]
    everything = [[won for stratum in strata for won in one.outcomes[stratum].values()] for one in contenders]
    return Comparison(
        names=tuple(one.name for one in contenders),
        strata=strata,
        left_out=tuple(dict.fromkeys(s for one in contenders for s in one.outcomes if s not in strata)),
        overall=_standings(everything, differing),
        within=within,
        pairs=tuple(pairs),
    )


def _difference(contenders: Sequence[Contender], pair: tuple[int, int], strata: Sequence[Stratum]) -> Contrast:
    """First rate minus second, averaged over strata that both have."""
    first, second = (contenders[number].outcomes for number in pair)
    weight = 1 / len(strata)
    found = contrast([[(weight, first[stratum]), (-weight, second[stratum])] for stratum in strata])
    assert found is not None, "a stratum that all contenders have holds episodes"
    return found


def _standings(outcomes: Sequence[Sequence[bool]], differing: Sequence[tuple[int, int]]) -> tuple[Standing, ...]:
    """Rate, interval and letters of each contender; letters begin with the best."""
    rates = [sum(won) / len(won) for won in outcomes]
    ranked = sorted(range(len(outcomes)), key=lambda number: -rates[number])
    rank = {number: position for position, number in enumerate(ranked)}
    signs = letters(len(outcomes), [(rank[first], rank[second]) for first, second in differing])
    return tuple(
        Standing(sum(won), len(won), *wilson(sum(won), len(won)), signs[rank[number]])
        for number, won in enumerate(outcomes)
    )


def _nothing_common(contenders: Sequence[Contender]) -> str:
    """Error that lists each contender's strata, and the pairs that share one."""
    message = "; ".join(
        f"{one.name} has {', '.join(' '.join(stratum) for stratum in one.outcomes) or 'no episode'}"
        for one in contenders
    )
    text = f"compare: nothing in common: {message}"
    sharing = [
        f"{first.name} with {second.name}"
        for first, second in itertools.combinations(contenders, 2)
        if set(first.outcomes) & set(second.outcomes)
    ]
    return text + (f". To be compared: {'; '.join(sharing)}" if sharing and len(contenders) > 2 else "")
