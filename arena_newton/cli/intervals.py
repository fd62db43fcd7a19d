"""Intervals of a rate."""

import math

__all__ = ["Z95", "wilson"]

Z95 = 1.959963984540054
"""97.5 % quantile of the normal distribution."""


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """95 % Wilson score interval of a rate; 0 to 1 without trials.

    Wilson, E. B. (1927): Probable inference, the law of succession, and statistical inference.
    """
    if trials == 0:
        return 0.0, 1.0
    rate, z2 = successes / trials, Z95 * Z95
    centre = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z95 * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials * trials)) / (1 + z2 / trials)
    return (0.0 if successes == 0 else centre - half), (1.0 if successes == trials else centre + half)
