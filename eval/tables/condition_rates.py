"""Success rates by relation between training and execution: of our cells, of the paper and of others."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Mapping
from dataclasses import dataclass

from arena_newton.eval.statistics.stats import suites
from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.paper_numbers import TRAINING_SETS, PaperRate, PublishedRow, paper_numbers
from arena_newton.eval.tables.suite_tables import tracker_order

__all__ = ["IN_GMT", "SETTINGS", "ConditionRate", "rate_of_cell", "rates_of_paper", "rates_of_published"]

IN_GMT, CROSS_GMT, MERGED = "in-GMT", "cross-GMT", "merged"
SETTINGS = {
    IN_GMT: "Executed by the tracker of its training, or not trained at all",
    CROSS_GMT: "Executed by a tracker that it was not trained with",
    MERGED: "Trained on the demonstrations of several tasks or trackers, executed by a tracker of these",
}
"""Relation between training and execution → its meaning."""


@dataclass(frozen=True)
class ConditionRate:
    """Success rate of a policy in a task under one set of conditions."""

    setting: str
    """A key of `SETTINGS`."""
    mode: str
    trained_on: str
    """Trackers of its training, joined by `+`; empty where there was none, or it is not known."""
    tracker: str
    """Trackers of its execution, likewise."""
    task: str
    rate: float
    held: Mapping[Hashable, bool] | None
    """Success of each episode; None where even their number is not known."""
    unusual: str = ""
    """Conditions that are not the protocol's, such as `fast physics`; empty where there are none, or none is known."""

    @property
    def row(self) -> tuple[str, str, str, str]:
        """Conditions, by which tables make a row of the rates of all tasks."""
        return self.setting, self.mode, self.trained_on, self.tracker


def _joined(trackers: Collection[str]) -> str:
    return "+".join(tracker_order(set(trackers)))


def rate_of_cell(cell: EvaluatedCell) -> ConditionRate:
    """Success rate of a cell; one of several trackers that were pooled names them all."""
    held, trackers = cell.held(), cell.tracker.split("+")
    merged = MERGED if cell.merged else IN_GMT
    setting = CROSS_GMT if cell.trained_on and not set(trackers) <= set(cell.trained_on) else merged
    rate = sum(held.values()) / len(held)
    return ConditionRate(setting, cell.mode, _joined(cell.trained_on), _joined(trackers), cell.task, rate, held)


def rates_of_paper(family: str) -> Iterator[ConditionRate]:
    """Rates of a family in the paper's tables, with derived episodes.

    Those through swapped trackers are the matched rate without the printed drop.
    """
    paper, names = paper_numbers(), suites()["ALL_AVG"]

    def one(setting: str, trained_on: str, tracker: str, rate: PaperRate, drop: float = 0.0) -> ConditionRate:
        number, left = rate.episodes, rate.sr - drop
        held: dict[Hashable, bool] = {("paper", n): n < round(left * number) for n in range(number)}
        return ConditionRate(setting, rate.mode, trained_on, tracker, rate.task, left, held)

    for (tracker, _, row, task), rate in paper.in_gmt.items():
        if row == family and task in names:
            yield one(IN_GMT, tracker, tracker, rate)
    for (trained_on, tracker, row, task), cell in paper.cross_gmt.items():
        if row == family:
            yield one(CROSS_GMT, trained_on, tracker, paper.in_gmt[trained_on, "base", family, task], cell.drop)
    for (name, row, task), rate in paper.merged.items():
        if row == family and task in names:
            yield one(MERGED, _joined(TRAINING_SETS[name]), _joined(TRAINING_SETS[name]), rate)


def rates_of_published(row: PublishedRow) -> Iterator[ConditionRate]:
    """Rates of base mode that others published; trained through the tracker of the execution, as their board says."""
    for task, rate in row.rates.items():
        yield ConditionRate(IN_GMT, "base", row.tracker, row.tracker, task, rate, None)
