"""Rates at which comparisons err and at which they find a difference, on synthetic episodes whose truth is known.

Also how often intervals over trainings hold the truth, on synthetic recipes whose trainings differ by known amounts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import binom

from arena_newton.cli.intervals import wilson
from arena_newton.eval.certification.finding import Check, CheckFinding
from arena_newton.eval.statistics.comparison import LEVEL, Contender, compare
from arena_newton.eval.statistics.detectable import paired_power
from arena_newton.eval.statistics.trainings import MATCHED_SPREAD, RateTerm, trained_contrast
from arena_newton.pages.tables import Table, between, percent

if TYPE_CHECKING:
    from arena_newton.eval.certification.context import Context

__all__ = ["CHECKS", "EventTally", "mcnemar_power", "tallies"]

COMPARISONS = 10_000
"""Synthetic comparisons of each case."""
MOST_TRAINED = 2_000
"""Comparisons of a case of several trainings, which take longer."""
QUICK_COMPARISONS = 100
"""Under --quick."""
RATES = (0.2, 0.4, 0.6)
"""Success rate of the weaker policies in each synthetic task."""
SPREAD = 0.15
"""Half of a task's episodes are easier by so much, half harder: outcomes of one episode correlate."""
EPISODES = 60
"""Episodes of each task: the protocol's."""
DIFFERENCES = (0.0, 0.1, 0.2)
"""Advantages of the last of the policies, in every episode."""
SPREADS = (0.0, 0.05, 0.1, 0.2)
"""Standard deviations between trainings of one recipe."""
TRAININGS = 3
"""Trainings of a recipe, where they show how much they differ."""
SLACK = 1e-4
"""Probability with which a test that keeps its level exactly is found to exceed it."""
LEAST_COVERAGE = 0.93
"""Least coverage of the intervals of nominally 95 %, which are approximations."""
SEED = 20260611


@dataclass
class EventTally:
    """Frequency of an event."""

    case: str
    what: str
    kind: str
    """`error`: at most the level; `power`: as high as it gets; `coverage`: about 95 % or more; `shown`: as it is."""
    expected: float | None = None
    """Expected frequency in closed form, where there is one."""
    happened: int = 0
    times: int = 0

    def count(self, event: bool) -> None:
        """Count one comparison."""
        self.happened += bool(event)
        self.times += 1

    @property
    def rate(self) -> float:
        """Fraction of the comparisons."""
        return self.happened / self.times

    @property
    def holds(self) -> bool:
        """True if the count agrees with the expected one, up to chance."""
        if self.kind == "error":
            return bool(self.happened <= binom.isf(SLACK, self.times, LEVEL))
        if self.kind == "coverage":
            return bool(self.happened >= binom.ppf(SLACK, self.times, LEAST_COVERAGE))
        if self.expected is None:  # power, or shown as it is
            return True
        low, high = binom.ppf(SLACK / 2, self.times, self.expected), binom.isf(SLACK / 2, self.times, self.expected)
        return bool(low <= self.happened <= high)


def mcnemar_power(difference: float, rate: float, episodes: int = EPISODES) -> float:
    """Probability that McNemar's test tells the last synthetic policy from another in one task, in closed form."""
    each = (rate - SPREAD, rate + SPREAD)
    only_last = sum((p + difference) * (1 - p) for p in each) / 2
    only_other = sum(p * (1 - p - difference) for p in each) / 2
    return paired_power(episodes, only_last, only_other)


def tallies(comparisons: int, episodes: int = EPISODES, seed: int = SEED) -> list[EventTally]:
    """Make synthetic comparisons of each case and count.

    Three policies of which the last is better by each of `DIFFERENCES` play the same episodes; two of which the second
    is better play different ones. Two equal recipes have trainings that differ by each of `SPREADS`.

    Args:
        comparisons: Of each case.
        episodes: Of each policy and task.
    """
    found = []
    rng = np.random.default_rng(seed)
    for difference in DIFFERENCES:
        found += list(_paired(rng, comparisons, episodes, difference).values())
        found += list(_unpaired(rng, comparisons, episodes, difference).values())
    for spread in SPREADS:
        found += list(_trained(rng, min(comparisons, MOST_TRAINED), episodes, spread).values())
    return found


@dataclass
class _Case:
    """Tallies of one case by their names, in the order of their first use."""

    name: str
    found: dict[str, EventTally] = field(default_factory=dict)

    def count(self, what: str, kind: str, event: bool, expected: float | None = None) -> None:
        self.found.setdefault(what, EventTally(self.name, what, kind, expected)).count(event)


def _paired(rng: np.random.Generator, comparisons: int, episodes: int, difference: float) -> dict[str, EventTally]:
    case = _Case(f"3 policies, same episodes, the last +{100 * difference:.0f} points")
    kind = "power" if difference else "error"
    expected = mcnemar_power(difference, RATES[0], episodes)
    for contenders in _contenders(rng, comparisons, episodes, (0.0, 0.0, difference), shared=True):
        result = compare(contenders)
        equal, _, unequal = result.pairs  # of numbers 0 and 1, 0 and 2, 1 and 2
        case.count("McNemar, one task", kind, unequal.strata[0].p <= LEVEL, expected)
        case.count("Cochran-Mantel-Haenszel, all tasks", kind, unequal.p <= LEVEL)
        case.count("Holm: the last is found to differ from the second", kind, unequal.p_holm <= LEVEL)
        nulls = [equal] if difference else list(result.pairs)
        case.count("Holm: any two equal ones found to differ", "error", any(pair.differs for pair in nulls))
        shared = all(set(result.overall[p.first].letters) & set(result.overall[p.second].letters) for p in nulls)
        case.count("letters: two equal ones share none", "error", not shared)
        within = [part for pair in nulls for part in pair.strata]
        differing = any(part.p_holm <= LEVEL for part in within)
        case.count("Holm, within tasks: any two equal ones found to differ", "error", differing)
        interval = unequal.difference
        case.count("interval of the mean difference covers", "coverage", interval.low <= -difference <= interval.high)
        interval = unequal.strata[0].difference
        case.count("interval of a task's difference covers", "coverage", interval.low <= -difference <= interval.high)
    return case.found


def _unpaired(rng: np.random.Generator, comparisons: int, episodes: int, difference: float) -> dict[str, EventTally]:
    case = _Case(f"2 policies, different episodes, the last +{100 * difference:.0f} points")
    kind = "power" if difference else "error"
    for contenders in _contenders(rng, comparisons, episodes, (0.0, difference), shared=False):
        (pair,) = compare(contenders).pairs
        case.count("Boschloo, one task", kind, pair.strata[0].p <= LEVEL)
        case.count("Cochran-Mantel-Haenszel, all tasks", kind, pair.p <= LEVEL)
        interval = pair.difference
        case.count("interval of the mean difference covers", "coverage", interval.low <= -difference <= interval.high)
        interval = pair.strata[0].difference
        case.count("interval of a task's difference covers", "coverage", interval.low <= -difference <= interval.high)
    return case.found


def _trained(rng: np.random.Generator, comparisons: int, episodes: int, spread: float) -> dict[str, EventTally]:
    """Two equal recipes, of which several trainings or one play the same episodes of all tasks."""
    case = _Case(f"2 recipes, trainings differ by {100 * spread:.0f} points")
    for _ in range(comparisons):
        for number in (TRAININGS, 1):
            terms = _recipes(rng, episodes, spread, number)
            text = f"interval over {number} trainings" if number > 1 else "interval over a training, declared"
            # What is declared covers trainings that differ by no more.
            kind = "shown" if number == 1 and spread > MATCHED_SPREAD else "coverage"
            for what, chosen, weight in (
                (f"{text}, one task, covers", [term for term in terms if term.task == "0"], 1.0),
                (f"{text}, all tasks, covers", terms, 1.0 / len(RATES)),
            ):
                found = trained_contrast([dataclasses.replace(one, weight=one.weight * weight) for one in chosen])
                assert found is not None
                case.count(what, kind, found.low <= 0.0 <= found.high)
    return case.found


def _recipes(rng: np.random.Generator, episodes: int, spread: float, number: int) -> list[RateTerm]:
    """Terms of the first recipe's rate minus the second's in every task, each task for itself.

    Rates of trainings are beta distributed around those of the tasks, so that they stay rates.
    """
    terms = []
    for task, rate in enumerate(RATES):
        harder = rng.integers(0, 2, size=episodes) * 2 - 1
        total = rate * (1 - rate) / spread**2 - 1 if spread else 0.0
        for recipe, sign in enumerate((1.0, -1.0)):
            for training in range(number):
                own = rng.beta(rate * total, (1 - rate) * total) if spread else rate
                won = rng.random(episodes) < own + min(SPREAD, own, 1 - own) * harder
                outcomes: dict[Hashable, bool] = dict(enumerate(won.tolist()))
                key = (recipe, task)
                terms.append(RateTerm(str(task), sign / number, outcomes, key, (*key, training)))
    return terms


def _contenders(
    rng: np.random.Generator, comparisons: int, episodes: int, gains: tuple[float, ...], shared: bool
) -> Iterator[list[Contender]]:
    """Contenders of each comparison; with `shared` they play the same episodes."""
    tasks = len(RATES)
    for _ in range(comparisons):
        harder = rng.integers(0, 2, size=(1 if shared else len(gains), tasks, episodes)) * 2 - 1
        chance = np.array(RATES)[None, :, None] + SPREAD * harder + np.array(gains)[:, None, None]
        won = (rng.random((len(gains), tasks, episodes)) < chance).tolist()
        yield [
            Contender(
                f"policy {number}",
                {
                    (f"task {task}",): dict(enumerate(won[number][task], start=0 if shared else number * episodes))
                    for task in range(tasks)
                },
            )
            for number in range(len(gains))
        ]


def _statistics(context: Context) -> CheckFinding:
    number = QUICK_COMPARISONS if context.options.quick else COMPARISONS
    found = tallies(number)
    rows = []
    for tally in found:
        expected = "" if tally.expected is None else percent(tally.expected)
        figures = (percent(tally.rate), between(wilson(tally.happened, tally.times), 1), expected)
        rows.append((tally.case, tally.what, tally.kind, *figures, "" if tally.holds else "fails"))
    errors = [tally.rate for tally in found if tally.kind == "error"]
    failed = [f"{tally.what} ({tally.case})" for tally in found if not tally.holds]
    least = min(tally.rate for tally in found if tally.kind == "coverage")
    declared = max(spread for spread in SPREADS if spread <= MATCHED_SPREAD)
    summary = (
        f"Up to {number:,} synthetic comparisons of each case: at most {100 * max(errors):.1f} % err at a level of "
        f"5 %, intervals hold the truth in at least {100 * least:.1f} %, also over trainings that differ by up to "
        f"{100 * max(SPREADS):.0f} points where that is measured, {100 * declared:.0f} where it is declared"
    )
    head = ("case", "what", "kind", "%", "95 % interval", "computed", "")
    return CheckFinding(
        "fail" if failed else "pass",
        summary + (f"; {', '.join(failed)}" if failed else ""),
        (Table(head, rows, title=f"{EPISODES} episodes of each policy in {len(RATES)} tasks, level 5 %"),),
    )


CHECKS = (Check("statistics", "Do comparisons err as rarely as they say, and find what they should?", _statistics),)
"""The check of this module."""
