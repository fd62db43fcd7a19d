"""Search of the placement at which a policy does worst, by the cross-entropy method on a score of its episodes.

Rubinstein, R. and Kroese, D. (2004): The Cross-Entropy Method. A batch of placements is drawn from independent normal
distributions cut to the ranges, all are played at once, and the distributions move to the worst of them. A part of
every batch is drawn from the whole range, so that no region is given up for good.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from arena_newton.eval.studies.placement_axes import Axis
from arena_newton.interfaces import EpisodeResult

__all__ = ["ELITE", "EXPLORING", "CrossEntropy", "score_of", "search", "worst_of"]

ELITE = 0.2
"""The distributions move to as many of the worst placements so far as this part of a batch."""
EXPLORING = 0.25
"""Part of a batch that is drawn from the whole range."""
SMOOTHING = 0.7
"""Fraction by which the distributions move to the elite's mean and spread."""
LEAST_FAILURE = 1e-9
"""Largest score of a failure whose margin is that of a success, as of a fall behind the goal."""
NEIGHBOURS = 10
"""Most placements, itself among them, whose outcomes a placement is named the worst by."""
PER_NEIGHBOUR = 50
"""Different placements that were played for each of them: of fewer than 100 one stands for itself."""
LEAST_SPREAD = 0.03
"""Smallest standard deviation, as a part of the range: a search that has settled still looks around."""

Point = tuple[float, ...]


def score_of(results: Sequence[EpisodeResult], budget: int) -> float:
    """Score of the episodes at one placement; the search looks for the lowest.

    A failure counts its margin [m], a little below 0 at most, and success the part of the budget that was left, 0 to
    1: an order in which every failure is worse than every success, far failures are worse than near ones, and slow
    successes than fast ones. NaN where every episode ended with an error.

    Args:
        results: Of one placement.
        budget: Step budget [ticks].
    """
    judged = [
        1.0 - result.steps / budget if result.outcome == "success" else min(result.margin, -LEAST_FAILURE)
        for result in results
        if result.outcome != "error" and (result.outcome == "success" or math.isfinite(result.margin))
    ]
    return math.fsum(judged) / len(judged) if judged else math.nan


@dataclass
class CrossEntropy:
    """Distributions of the worst placements."""

    axes: tuple[Axis, ...]
    mean: np.ndarray
    """Mean of each axis, as a part of its range from 0 to 1."""
    spread: np.ndarray
    """Standard deviation of each axis, as a part of its range."""
    rng: np.random.Generator
    judged: list[tuple[float, Point]]
    """Scores and placements so far, the worst first."""

    @classmethod
    def over(cls, axes: Sequence[Axis], seed: int) -> CrossEntropy:
        """Begin with the whole range."""
        count = len(axes)
        return cls(tuple(axes), np.full(count, 0.5), np.full(count, 0.5), np.random.default_rng(seed), [])

    def uniform(self, number: int) -> list[Point]:
        """Placements drawn from the whole range."""
        return [self._point(row) for row in self.rng.random((number, len(self.axes)))]

    def draw(self, number: int) -> list[Point]:
        """A batch of placements."""
        wide = round(EXPLORING * number)
        near = np.clip(self.rng.normal(self.mean, self.spread, (number - wide, len(self.axes))), 0.0, 1.0)
        return [self._point(row) for row in near] + self.uniform(wide)

    def learn(self, points: Sequence[Point], scores: Sequence[float]) -> None:
        """Move to the worst placements so far; those without a score are left out.

        As soon as something failed, failures alone are followed: the order of successes says little about where
        failures are.
        """
        self.judged += [(score, point) for score, point in zip(scores, points, strict=True) if not math.isnan(score)]
        self.judged.sort(key=lambda one: one[0])
        elite = self.judged[: max(1, round(ELITE * len(points)))]
        elite = [one for one in elite if one[0] < 0.0] or elite
        if not elite:
            return
        unit = np.array([self._unit(point) for _, point in elite])
        self.mean += SMOOTHING * (unit.mean(axis=0) - self.mean)
        self.spread += SMOOTHING * (unit.std(axis=0) - self.spread)
        self.spread = np.maximum(self.spread, LEAST_SPREAD)

    def _point(self, unit: np.ndarray) -> Point:
        return tuple(axis.at(float(value)) for axis, value in zip(self.axes, unit, strict=True))

    def _unit(self, point: Point) -> list[float]:
        return [axis.part(value) for axis, value in zip(self.axes, point, strict=True)]


def search(
    axes: Sequence[Axis],
    play: Callable[[list[Point]], list[float]],
    *,
    batches: int,
    size: int,
    seed: int,
) -> tuple[list[Point], list[float]]:
    """Play batches of placements, the first over the whole range, the others where the worst were.

    Args:
        axes: What is moved.
        play: Scores of placements.
        batches: How many, the first among them.
        size: Placements of a batch.

    Returns:
        All placements in the order of their playing, and their scores.
    """
    found = CrossEntropy.over(axes, seed)
    points, scores = found.uniform(size), []
    batch = points
    for number in range(batches):
        scores += play(batch)
        found.learn(batch, scores[-len(batch) :])
        if number + 1 < batches:
            batch = found.draw(size)
            points = points + batch
    return points, scores


def worst_of(axes: Sequence[Axis], points: Sequence[Point], scores: Sequence[float]) -> int | None:
    """Number of the worst placement; None where none has a score.

    The lowest of thousands of scores is the outlier of a policy whose outcomes are partly chance, not its worst
    placement. So a placement counts by those that were played nearest to it, itself among them, distances in parts of
    the ranges: by the share of failures, then by the mean score, then by its own. What was played at one placement
    more than once is counted together.
    """
    judged = [k for k, score in enumerate(scores) if not math.isnan(score)]
    if not judged:
        return None
    own = np.array([scores[k] for k in judged])
    places, which, count = np.unique(
        [_place(axes, points[k]) for k in judged], axis=0, return_inverse=True, return_counts=True
    )
    failed, total = (np.bincount(which, weights=one, minlength=len(places)) for one in (own < 0.0, own))
    near = min(NEIGHBOURS, max(1, len(places) // PER_NEIGHBOUR))
    around = cKDTree(places).query(places, [*range(1, near + 1)])[1]
    played = count[around].sum(axis=1)
    share, mean = failed[around].sum(axis=1) / played, total[around].sum(axis=1) / played
    return judged[int(np.lexsort((own, mean[which], -share[which]))[0])]


def _place(axes: Sequence[Axis], point: Point) -> list[float]:
    """A placement in parts of the ranges; the ends of a full circle are one place."""
    found: list[float] = []
    for axis, value in zip(axes, point, strict=True):
        part = axis.part(value)
        angle = 2.0 * math.pi * part
        found += [math.cos(angle) / (2.0 * math.pi), math.sin(angle) / (2.0 * math.pi)] if axis.turns else [part]
    return found
