"""Power of a plan: the smallest difference of two success rates that a paired comparison finds."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from fractions import Fraction

from arena_newton.files.text import counted

__all__ = ["MOST_PAIRS", "POWER", "detectable_difference", "detectable_text", "paired_power"]

LEVEL = 0.05
"""Level of the two-sided test."""
POWER = 0.8
"""Probability with which a difference of the printed size is found."""
STEP = 0.005
"""Precision of the difference, which is rounded up."""
MOST_PAIRS = 2000
"""Episodes up to which a plan's difference is computed: a quarter of a second."""
NEGLIGIBLE = 1e-12
"""Terms of a distribution below this are left out."""


def detectable_text(cells: Sequence[int]) -> str:
    """Line on the difference that a plan can detect, from the numbers of episodes of its cells; empty without episodes.

    The cell with the fewest episodes is named, and all of them together.
    """
    if not cells:
        return ""
    ranges = [f"{counted(min(cells), 'episode')} per cell: {_range(min(cells))}"] if min(cells) <= MOST_PAIRS else []
    if len(cells) > 1 and sum(cells) <= MOST_PAIRS:
        ranges.append(f"all {sum(cells):,}: {_range(sum(cells))}")
    if not ranges:
        return ""
    text = (
        "smallest difference from a success rate of 50 % that two such runs detect (McNemar's test, 5 %, power "
        f"{100 * POWER:.0f} %): {', '.join(ranges)}"
    )
    if " to " not in text:
        return text
    return (
        f"{text}; the first if the better one also solves all that the other does, the last if outcomes are independent"
    )


def _range(pairs: int) -> str:
    """The differences for nested and for independent outcomes in points, such as `13 to 26.5 points`."""
    nested, independent = (detectable_difference(pairs, nested=how) for how in (True, False))
    if nested is None:
        return "none"
    return (
        f"{100 * nested:g} points or more"
        if independent is None
        else f"{100 * nested:g} to {100 * independent:g} points"
    )


@functools.cache
def detectable_difference(pairs: int, base: float = 0.5, *, nested: bool = False, level: float = LEVEL) -> float | None:
    """Smallest difference from a rate `base` that McNemar's exact test finds with a probability of `POWER`.

    Args:
        pairs: Episodes that both policies play.
        base: Success rate of the weaker one.
        nested: Whether the better one solves all that the weaker one solves; otherwise their outcomes are independent.
        level: Of the two-sided test.

    Returns:
        A fraction; None where not even the largest difference that `base` admits is found.
    """
    for step in range(1, round((1.0 - base) / STEP) + 1):
        gain = step * STEP
        better = base + gain
        only_better, only_weaker = (gain, 0.0) if nested else (better * (1 - base), base * (1 - better))
        if paired_power(pairs, only_better, only_weaker, level) >= POWER:
            return gain
    return None


def paired_power(pairs: int, only_first: float, only_second: float, level: float = LEVEL) -> float:
    """Probability that McNemar's exact test at `level` rejects, in either direction.

    Args:
        pairs: Paired episodes.
        only_first: Probability that a pair is a success of the first alone.
        only_second: Probability that it is one of the second alone.
        level: Of the two-sided test.
    """
    differing = only_first + only_second
    if differing <= 0.0:
        return 0.0
    towards = only_first / differing
    found = 0.0
    for discordant in _likely(pairs, differing):
        fewest = _critical(discordant, level)
        if fewest >= 0:
            tail = _below(discordant, fewest, towards) + _below(discordant, fewest, 1.0 - towards)
            found += _binomial(pairs, discordant, differing) * tail
    return found


def _likely(trials: int, p: float) -> list[int]:
    spread = 8.0 * math.sqrt(trials * p * (1.0 - p)) + 8.0
    near = range(max(0, math.floor(trials * p - spread)), min(trials, math.ceil(trials * p + spread)) + 1)
    return [k for k in near if _binomial(trials, k, p) > NEGLIGIBLE]


def _binomial(trials: int, k: int, p: float) -> float:
    if p <= 0.0 or p >= 1.0:
        return float(k == (0 if p <= 0.0 else trials))
    logarithm = math.lgamma(trials + 1) - math.lgamma(k + 1) - math.lgamma(trials - k + 1)
    return math.exp(logarithm + k * math.log(p) + (trials - k) * math.log1p(-p))


def _below(trials: int, most: int, p: float) -> float:
    """Probability of at most `most` successes."""
    found = 0.0
    for k in range(most, -1, -1):
        term = _binomial(trials, k, p)
        found += term
        if term < NEGLIGIBLE and k < trials * p:
            break
    return found


@functools.cache
def _critical(discordant: int, level: float) -> int:
    """Most successes of the rarer side with which the test of so many discordant pairs rejects; -1: it never does."""
    # Whole numbers: a float ends at 2 to the power of 1024.
    limit = math.floor(Fraction(str(level)) / 2 * (1 << discordant))
    weight, tail, k = 1, 0, 0
    while tail + weight <= limit:
        tail += weight
        weight = weight * (discordant - k) // (k + 1)
        k += 1
    return k - 1
