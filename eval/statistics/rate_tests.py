"""Exact tests of two success rates, paired by episode or not, over one task or several.

Pure: counts in, probabilities out. Needs SciPy, for one test.
"""

from __future__ import annotations

import functools
import string
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from arena_newton.eval.statistics.stats import mcnemar

__all__ = [
    "LARGEST_BOSCHLOO",
    "PairedCounts",
    "TestOfRates",
    "UnpairedCounts",
    "excess",
    "letters",
    "rate_test",
    "stratified_test",
]

LARGEST_BOSCHLOO = 60_000
"""Product of both numbers of episodes up to which Boschloo's test is computed (half a second); above it Fisher's."""
TIE = 1e-9
"""Relative difference up to which two probabilities count as equal: they are rounded."""


@dataclass(frozen=True)
class PairedCounts:
    """Episodes that both of two conditions played."""

    both: int
    """Episodes in which both succeeded."""
    only_first: int
    only_second: int
    neither: int

    @property
    def first(self) -> int:
        """Successes of the first."""
        return self.both + self.only_first

    @property
    def second(self) -> int:
        """Successes of the second."""
        return self.both + self.only_second

    @property
    def first_episodes(self) -> int:
        """Episodes of the first, as many as of the second."""
        return self.both + self.only_first + self.only_second + self.neither

    @property
    def second_episodes(self) -> int:
        """Episodes of the second."""
        return self.first_episodes


@dataclass(frozen=True)
class UnpairedCounts:
    """Episodes of two conditions that share none."""

    first: int
    """Successes of the first."""
    first_episodes: int
    second: int
    """Successes of the second."""
    second_episodes: int


type Counts = PairedCounts | UnpairedCounts


@dataclass(frozen=True)
class TestOfRates:
    """A test's name and its two-sided probability."""

    __test__ = False  # pytest collects classes by their name

    name: str
    p: float


def rate_test(counts: Counts) -> TestOfRates:
    """Exact two-sided test of two rates on one task: McNemar's where episodes are paired, else Boschloo's.

    Boschloo, R. D. (1970): Raised conditional level of significance for the 2x2-table when testing the equality of two
    probabilities, Statistica Neerlandica 24; uniformly more powerful than Fisher's, which is used for large numbers.
    """
    if isinstance(counts, PairedCounts):
        return TestOfRates("McNemar", mcnemar(counts.only_first, counts.only_second))
    if counts.first_episodes * counts.second_episodes > LARGEST_BOSCHLOO:
        return TestOfRates("Fisher", stratified_test([counts]))
    return TestOfRates(
        "Boschloo", _boschloo(counts.first, counts.first_episodes, counts.second, counts.second_episodes)
    )


@functools.lru_cache(maxsize=1 << 14)
def _boschloo(first: int, first_episodes: int, second: int, second_episodes: int) -> float:
    successes = first + second
    if successes in (0, first_episodes + second_episodes):
        return 1.0  # nothing varies, and SciPy says NaN
    from scipy.stats import boschloo_exact  # its import takes seconds, and most tests are of paired episodes

    table = [[first, second], [first_episodes - first, second_episodes - second]]
    return min(1.0, float(boschloo_exact(table).pvalue))


def stratified_test(strata: Sequence[Counts]) -> float:
    """Exact two-sided test that the rates are equal in every stratum; p from 0 to 1, 1 without episodes.

    The statistic is the first's number of successes, given in each stratum what does not depend on who succeeded: of
    paired episodes how many had one success (each is a fair coin then), of others all successes (hypergeometric then).
    Strata are independent, so the sum's distribution is the convolution of theirs; all its terms are sums of products
    of positive numbers, so that the smallest are as precise as the largest. Outcomes at most as probable as the
    observed one count, as in Fisher's test. This is the exact conditional form of the test of Cochran (1954),
    Biometrics 10, and Mantel and Haenszel (1959), J. Nat. Cancer Inst. 22; of paired episodes, each a stratum of its
    own, it is McNemar's test of all of them, of one unpaired stratum Fisher's.
    """
    paired = [counts for counts in strata if isinstance(counts, PairedCounts)]
    observed = sum(counts.only_first for counts in paired)
    discordant = observed + sum(counts.only_second for counts in paired)
    if len(paired) == len(strata):
        return mcnemar(observed, discordant - observed)  # the same, without all the terms
    k = np.arange(discordant)
    law = _distribution((discordant - k) / (k + 1))
    for counts in strata:
        if isinstance(counts, UnpairedCounts):
            successes = counts.first + counts.second
            fewest = max(0, successes - counts.second_episodes)
            k = np.arange(fewest, min(counts.first_episodes, successes))
            others = counts.second_episodes - successes + k + 1
            here = (counts.first_episodes - k) * (successes - k) / ((k + 1) * others)
            law = np.asarray(np.convolve(law, _distribution(here)), dtype=np.float64)
            observed += counts.first - fewest
    return min(1.0, float(law[law <= law[observed] * (1.0 + TIE)].sum() / law.sum()))


def _distribution(ratios: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Probabilities of the values of a variable, given how much likelier each is than the one before.

    The ratios fall. From the likeliest value outwards nothing overflows, and what is too small for a number is 0.
    """
    likeliest = int(np.count_nonzero(ratios >= 1.0))
    below = np.cumprod(1.0 / ratios[:likeliest][::-1])[::-1]
    weights = np.concatenate((below, [1.0], np.cumprod(ratios[likeliest:])))
    weights[weights < np.finfo(float).tiny] = 0.0  # arithmetic with what is between is slow
    return np.asarray(weights / weights.sum())


def excess(strata: Sequence[Counts]) -> float:
    """Successes of the first beyond what `stratified_test` expects of equal rates: its sign is the test's direction.

    0 without episodes.
    """
    found = Fraction()
    for counts in strata:
        if isinstance(counts, PairedCounts):
            found += Fraction(counts.only_first - counts.only_second, 2)
        elif episodes := counts.first_episodes + counts.second_episodes:
            found += counts.first - Fraction((counts.first + counts.second) * counts.first_episodes, episodes)
    return float(found)


def letters(number: int, differing: Collection[tuple[int, int]]) -> list[str]:
    """Compact letter display: two of `number` things share a letter exactly if they are no pair that differs.

    Things are numbered from 0, best first, so that the best has an `a`. By insertion and absorption: Piepho, H.-P.
    (2004), An algorithm for a letter-based representation of all-pairwise comparisons, Journal of Computational and
    Graphical Statistics 13.
    """
    columns = [frozenset(range(number))]
    for first, second in differing:
        split = [column for column in columns if first in column and second in column]
        columns = [column for column in columns if column not in split]
        for column in [part for whole in split for part in (whole - {second}, whole - {first})]:
            if not any(column <= other for other in columns):
                columns = [other for other in columns if not other < column] + [column]
    columns.sort(key=sorted)
    return ["".join(_letter(n) for n, column in enumerate(columns) if thing in column) for thing in range(number)]


def _letter(number: int) -> str:
    rounds, letter = divmod(number, len(string.ascii_lowercase))
    return string.ascii_lowercase[letter] + (str(rounds) if rounds else "")
