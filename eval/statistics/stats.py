"""Statistics of a run, pure: records in, cells and suite averages out."""

from __future__ import annotations

import itertools
import math
import statistics
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NotRequired, TypedDict

from arena_newton import tasks
from arena_newton.cli import intervals
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.files.text import plain_text

__all__ = [
    "Aggregate",
    "Contrast",
    "ResultCell",
    "ErrorReason",
    "Figures",
    "MetricFigures",
    "PairedRates",
    "PooledFigures",
    "Suite",
    "aggregate",
    "cell",
    "contrast",
    "error_reasons",
    "holm",
    "mcnemar",
    "outside_suites",
    "paired_rates",
    "pooled",
    "population_std",
    "seed_rates",
    "suites",
    "wilson",
    "within",
]

type Outcomes = Mapping[Hashable, bool]
"""Event (a success, a fall) in each episode: True if it happened, by the episode's name in both of two conditions."""


class MetricFigures(TypedDict):
    """Figures of a recorder's metric, over the episodes that have it."""

    episodes: int
    mean: float
    std: float | None
    """Population standard deviation."""
    least: float
    most: float


class Figures(TypedDict):
    """Figures of some episodes, as in results.json."""

    episodes: int
    successes: int
    falls: int
    startup_falls: int
    timeouts: int
    errors: int
    overflows: int
    sr: float | None
    """Success rate."""
    sr_seed_mean: float | None
    sr_seed_std: float | None
    sr_per_seed: dict[str, float]
    ci95: list[float] | None
    """Wilson interval of the success rate."""
    afr: float | None
    """Average fall rate."""
    mean_steps: float | None
    """Over the episodes without error [ticks]."""
    extra: NotRequired[dict[str, MetricFigures]]
    """Metrics of recorders by name; absent where no episode has one."""


class ResultCell(Figures):
    """Figures of one task x tracker x policy x mode."""

    task: str
    tracker: str
    policy: str
    mode: str


class PooledFigures(TypedDict):
    """Figures of a suite's episodes."""

    episodes: int
    falls: int
    errors: int
    sr: float
    sr_std: float | None
    afr: float


class Suite(PooledFigures):
    """Average of one suite x tracker x policy x mode."""

    suite: str
    tracker: str
    policy: str
    mode: str


class Aggregate(TypedDict):
    """Figures of a run."""

    cells: list[ResultCell]
    suites: list[Suite]


class ErrorReason(TypedDict):
    """One cause of errors."""

    reason: str
    message: str
    """One line without terminal escapes."""
    count: int


def suites() -> dict[str, tuple[str, ...]]:
    """Task groups of the paper's tables by name, from the tasks: human-object and human-scene interaction, both.

    `outside_suites` names other tasks.
    """
    named = {suite: tuple(t for t in tasks.PAPER if tasks.get(t).suite == suite) for suite in ("HOI", "HSI")}
    return {f"{suite}_AVG": names for suite, names in named.items()} | {"ALL_AVG": named["HOI"] + named["HSI"]}


def population_std(values: Sequence[float]) -> float | None:
    """Standard deviation with divisor n, as the paper's tables; None without values."""
    if not values:
        return None
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((v - mean) ** 2 for v in values) / len(values))


def wilson(successes: int, episodes: int) -> list[float] | None:
    """95 % Wilson score interval of a success rate; None without episodes.

    Wilson, E. B. (1927): Probable inference, the law of succession, and statistical inference.
    """
    return list(intervals.wilson(successes, episodes)) if episodes else None


def outside_suites(names: Iterable[str]) -> list[str]:
    """Tasks that no average of the paper's tables counts, such as one that was added to its seven."""
    return [task for task in dict.fromkeys(names) if task not in suites()["ALL_AVG"]]


def error_reasons(records: Iterable[EpisodeRecord]) -> list[ErrorReason]:
    """Causes of episodes that ended as errors, the most frequent first."""
    counts: Counter[tuple[str, str]] = Counter(
        (plain_text(record.reason or "error", 80), plain_text(record.error or "no message", 400))
        for record in records
        if record.outcome == "error"
    )
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return [{"reason": reason, "message": message, "count": count} for (reason, message), count in ordered]


def seed_rates(records: Iterable[EpisodeRecord]) -> dict[int, float]:
    """Success rate per group seed, in order of the seeds."""
    counts: dict[int, list[int]] = {}
    for record in records:
        entry = counts.setdefault(record.group_seed, [0, 0])
        entry[0] += record.outcome == "success"
        entry[1] += 1
    return {seed: counts[seed][0] / counts[seed][1] for seed in sorted(counts)}


def cell(records: Sequence[EpisodeRecord]) -> Figures:
    """Figures of one task x tracker x policy x mode.

    An episode that ended with an error counts as an episode without success, and is shown as an error: a policy cannot
    raise its rate by breaking off. `mean_steps` is taken over the episodes without error [ticks].
    """
    outcomes = [record.outcome for record in records]
    episodes, successes, falls = len(outcomes), outcomes.count("success"), outcomes.count("fall")
    rates = seed_rates(records)
    steps = [record.steps for record in records if record.outcome != "error"]
    figures: Figures = {
        "episodes": episodes,
        "successes": successes,
        "falls": falls,
        "startup_falls": sum(r.outcome == "fall" and r.startup_fall for r in records),
        "timeouts": outcomes.count("timeout"),
        "errors": outcomes.count("error"),
        "overflows": sum(record.overflow for record in records),
        "sr": successes / episodes if episodes else None,
        "sr_seed_mean": math.fsum(rates.values()) / len(rates) if rates else None,
        "sr_seed_std": population_std(list(rates.values())),
        "sr_per_seed": {str(seed): rate for seed, rate in rates.items()},
        "ci95": wilson(successes, episodes),
        "afr": falls / episodes if episodes else None,
        "mean_steps": math.fsum(steps) / len(steps) if steps else None,
    }
    metrics = {name: _metric(records, name) for name in sorted({name for record in records for name in record.extra})}
    return figures | {"extra": metrics} if metrics else figures


def _metric(records: Iterable[EpisodeRecord], name: str) -> MetricFigures:
    """Figures of a metric over the episodes that have it, one at least."""
    values = [float(record.extra[name]) for record in records if name in record.extra]
    mean, std = statistics.mean(values), statistics.pstdev(values)  # no sum on the way to them is too large for a float
    return {"episodes": len(values), "mean": mean, "std": std, "least": min(values), "most": max(values)}


def pooled(records_by_task: Mapping[str, Sequence[EpisodeRecord]], names: Sequence[str]) -> PooledFigures | None:
    """Average over a suite: mean and population std over all task x seed rates pooled, falls over all its episodes.

    For instance 3 tasks x 3 seeds for HOI. Returns None unless every task of the suite has episodes.
    """
    if any(not records_by_task.get(task) for task in names):
        return None
    rates = [rate for task in names for rate in seed_rates(records_by_task[task]).values()]
    records = [record for task in names for record in records_by_task[task]]
    falls = sum(record.outcome == "fall" for record in records)
    return {
        "episodes": len(records),
        "falls": falls,
        "errors": sum(record.outcome == "error" for record in records),
        "sr": math.fsum(rates) / len(rates),
        "sr_std": population_std(rates),
        "afr": falls / len(records),
    }


def aggregate(records: Iterable[EpisodeRecord]) -> Aggregate:
    """Cells and suite averages of a run, in the order of the plan (`index`), whatever order the episodes ended in."""
    groups: dict[tuple[str, str, str, str], list[EpisodeRecord]] = {}
    for record in sorted(records, key=lambda r: r.index):
        groups.setdefault((record.task, record.tracker, record.shown_policy, record.mode), []).append(record)
    cells: list[ResultCell] = [
        {"task": task, "tracker": tracker, "policy": policy, "mode": mode, **cell(group)}
        for (task, tracker, policy, mode), group in groups.items()
    ]
    averages: list[Suite] = []
    for tracker, policy, mode in dict.fromkeys(key[1:] for key in groups):
        by_task = {key[0]: group for key, group in groups.items() if key[1:] == (tracker, policy, mode)}
        for name, names in suites().items():
            figures = pooled(by_task, names)
            if figures is not None:
                averages.append({"suite": name, "tracker": tracker, "policy": policy, "mode": mode, **figures})
    return {"cells": cells, "suites": averages}


@dataclass(frozen=True)
class PairedRates:
    """Two conditions over the episodes that both played."""

    pairs: int
    """Episodes of both; others do not count."""
    unpaired: int
    """Episodes of one condition only."""
    first: float | None
    """Rate of the first condition over the pairs."""
    second: float | None
    """Rate of the second condition over the pairs."""
    only_first: int
    """Pairs in which it held under the first condition alone."""
    only_second: int
    """Pairs in which it held under the second condition alone."""
    p: float | None
    """Exact McNemar test, two-sided; None without pairs."""


def mcnemar(only_first: int, only_second: int) -> float:
    """Exact two-sided McNemar test: the probability of discordant pairs at least as uneven as these by chance.

    McNemar, Q. (1947), Psychometrika 12; the exact form is a binomial test of the discordant pairs against 1/2.
    """
    discordant, fewer = only_first + only_second, min(only_first, only_second)
    if 2 * fewer == discordant:
        return 1.0
    term = tail = math.comb(discordant, fewer)
    for k in range(fewer, 0, -1):
        term = term * k // (discordant - k + 1)
        tail += term
        if term * k << 64 < tail:
            break  # all that is left is below the precision of what is returned
    return min(1.0, tail / (1 << discordant) * 2)


def holm(probabilities: Sequence[float]) -> list[float]:
    """p-values adjusted for their number, in the order given.

    Holm, S. (1979): A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6.
    """
    adjusted, highest = [0.0] * len(probabilities), 0.0
    for rank, number in enumerate(sorted(range(len(probabilities)), key=lambda i: probabilities[i])):
        highest = max(highest, min(1.0, (len(probabilities) - rank) * probabilities[number]))
        adjusted[number] = highest
    return adjusted


def paired_rates(first: Outcomes, second: Outcomes) -> PairedRates:
    """Compare two conditions over the episodes that both have; the others are counted and left out."""
    common = [key for key in first if key in second]
    only_first = sum(first[key] and not second[key] for key in common)
    only_second = sum(second[key] and not first[key] for key in common)
    n = len(common)
    return PairedRates(
        pairs=n,
        unpaired=len(first) + len(second) - 2 * n,
        first=sum(first[key] for key in common) / n if n else None,
        second=sum(second[key] for key in common) / n if n else None,
        only_first=only_first,
        only_second=only_second,
        p=mcnemar(only_first, only_second) if n else None,
    )


@dataclass(frozen=True)
class Contrast:
    """A weighted sum of rates, such as a mean difference, and its 95 % interval."""

    value: float
    low: float
    high: float
    middle: float
    """Middle of the interval: the sum with pseudo-episodes."""
    error: float
    """Standard error."""
    strata: int
    """Groups of episodes, usually tasks."""
    episodes: int
    """Over all groups; those that several conditions share count once."""
    unpaired: int
    """Episodes that some condition lacks which shares others with theirs; they are left out."""


def contrast(strata: Sequence[Sequence[tuple[float, Outcomes]]]) -> Contrast | None:
    """Sum of weight x rate over conditions in strata, and its interval; the one of every difference of rates.

    Conditions of a stratum that share episodes are paired: those that all of them have count. Those that share none are
    independent. The interval is normal, from the spread of the episodes' own sums. Two pseudo-episodes, whose outcomes
    are as those of fair coins, keep it from closing where nothing varies. Of one difference it is that of Agresti, A.
    and Min, Y. (2005), Simple improved confidence intervals for comparing matched proportions, Statistics in Medicine
    24, where paired, and of Agresti, A. and Caffo, B. (2000), Simple and effective confidence intervals for
    proportions, The American Statistician 54, where not. Of several strata each has the two in its variance, while the
    two that move the middle are shared out, as by Price, R. M. and Bonett, D. G. (2004), An improved confidence
    interval for a linear function of binomial proportions, Computational Statistics & Data Analysis 45; two in each
    stratum would draw the middle of many small ones to 0. It covers other episodes of the same networks, no other
    trainings: those `trainings.trained_contrast` adds.

    Args:
        strata: Of each its conditions: weight and outcomes.

    Returns:
        None where a stratum has a condition without an episode, or no episode that all which share some have.
    """
    exact = Fraction()
    middles, variances = list[float](), list[float]()
    episodes = unpaired = 0
    for conditions in strata:
        blocks = _sharing(conditions)
        for block in blocks:
            common = set(block[0][1]).intersection(*(outcomes for _, outcomes in block[1:]))
            if not common:
                return None
            n, made = len(common), 2 / len(strata)
            ends = Counter(zip(*(map(outcomes.__getitem__, common) for _, outcomes in block), strict=True))
            weights = [weight for weight, _ in block]
            sums = [(math.fsum(itertools.compress(weights, end)), times) for end, times in ends.items()]
            both = math.fsum(weights)
            total = math.fsum(times * one for one, times in sums)
            shrunk = (total + both) / (n + 2)
            coin = math.fsum(weight * weight for weight in weights) / 4
            squares = math.fsum(times * (one - shrunk) ** 2 for one, times in sums)
            variances.append((squares + 2 * (coin + (both / 2 - shrunk) ** 2)) / (n + 2) ** 2)
            middles.append((total + both * made / 2) / (n + made))
            for weight, outcomes in block:
                exact += Fraction(weight) * Fraction(sum(map(outcomes.__getitem__, common)), n)
            episodes += n
            unpaired += len(set().union(*(outcomes for _, outcomes in block))) - n
        if not blocks:
            return None
    if not strata:
        return None
    # Exactly rounded sums: the strata's order changes no bit.
    middle, error = math.fsum(middles), math.sqrt(math.fsum(variances))
    low, high = within(strata, middle - intervals.Z95 * error, middle + intervals.Z95 * error)
    return Contrast(float(exact), low, high, middle, error, len(strata), episodes, unpaired)


def within(strata: Sequence[Sequence[tuple[float, Outcomes]]], low: float, high: float) -> tuple[float, float]:
    """An interval without what no rates can give."""
    weights = [weight for conditions in strata for weight, _ in conditions]
    return max(low, math.fsum(min(0.0, w) for w in weights)), min(high, math.fsum(max(0.0, w) for w in weights))


def _sharing(conditions: Sequence[tuple[float, Outcomes]]) -> list[list[tuple[float, Outcomes]]]:
    """Conditions in groups that share episodes, one with another or through a third."""
    groups: list[list[tuple[float, Outcomes]]] = []
    for condition in conditions:
        joined, others = [condition], list[list[tuple[float, Outcomes]]]()
        for group in groups:
            if all(condition[1].keys().isdisjoint(outcomes) for _, outcomes in group):
                others.append(group)
            else:
                joined += group
        groups = [*others, joined]
    return groups
