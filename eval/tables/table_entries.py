"""Entries of a table of several evaluations: rows as they are shown, and one record per number for a file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from arena_newton.eval.statistics.stats import Contrast, contrast, population_std, seed_rates, wilson
from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.paper_numbers import PaperRate, PublishedRow
from arena_newton.pages.tables import Table, percent

__all__ = [
    "NO_RESULT",
    "PAPER_NAMES",
    "UNDEFINED",
    "SuiteTable",
    "TableEntry",
    "interval_text",
    "ordered",
    "ours",
    "ours_average",
    "paper_entry",
    "published_entry",
    "probability",
    "rate_text",
]

PAPER_NAMES = {"act": "ACT", "diffusion": "DP", "flow": "FM", "pi05": "π0.5"}
"""Family → how the paper's tables name it."""
NO_RESULT = "no result"
"""Source of numbers of cut step budgets or another scene in a `cells.csv`, of which no finding is made."""
UNDEFINED = "—"
"""Shown where a number is undefined, such as a retention of nothing."""


@dataclass(frozen=True, kw_only=True)
class TableEntry:
    """One number of a table with all that belongs to it: a line of cells.csv. Fractions are in [0, 1]."""

    table: str
    source: str
    """`ours`, `paper` or `self-reported`; in a file `NO_RESULT` for ours of a changed run."""
    policy: str
    family: str
    trained_on: str = ""
    """Trackers of its training, joined by `+`."""
    tracker: str = ""
    task: str = ""
    """A task, or the average of a suite."""
    mode: str = "base"
    labels: str = ""
    latency: int = 0
    """[ticks]"""
    episodes: int | None = None
    successes: int | None = None
    sr: float | None = None
    """Success rate: mean of the seeds' rates, of an average mean of all task x seed rates."""
    sr_std: float | None = None
    """Population standard deviation of these rates."""
    low: float | None = None
    """95 % interval: Wilson's of a cell, `stats.contrast`'s of an average."""
    high: float | None = None
    derived: bool = False
    """True if successes and interval are derived from a printed rate."""
    afr: float | None = None
    """Falls of all episodes; in the paper's rows of its whole table row."""
    matched_sr: float | None = None
    """Rate that a drop is from, over the same pairs."""
    drop: float | None = None
    drop_low: float | None = None
    drop_high: float | None = None
    retention: float | None = None
    pairs: int | None = None
    """Episodes of both conditions; only these count in a drop."""
    unpaired: int | None = None
    only_first: int | None = None
    """Pairs with a success under the first condition alone."""
    only_second: int | None = None
    p: float | None = None
    """Exact McNemar test, two-sided."""
    p_holm: float | None = None
    """Adjusted for the number of tests in the table."""


@dataclass(frozen=True)
class SuiteTable(Table):
    """A table as it is shown, and its numbers."""

    entries: Sequence[TableEntry] = ()


def ordered(names: set[str], known: Sequence[str]) -> list[str]:
    """Names in the order of those that are known, others after them."""
    return [name for name in known if name in names] + sorted(names - set(known))


def interval_text(low: float, high: float) -> str:
    """An interval of fractions in whole percent, such as `(33 to 58)`."""
    return f"({_whole(low)} to {_whole(high)})"


def _whole(value: float) -> str:
    return str(round(100 * value)).replace("-", "−")


def probability(value: float | None) -> str:
    """A p-value, such as `0.031` or `<0.001`."""
    if value is None:
        return ""
    return "<0.001" if value < 0.0005 else f"{value:.3f}"


def rate_text(entry: TableEntry, digits: int = 1) -> str:
    """`45.0 ± 4.1 (33 to 58)`, or as much of it as is known."""
    if entry.sr is None:
        return ""
    text = percent(entry.sr, digits)
    text += f" ± {percent(entry.sr_std, digits)}" if entry.sr_std is not None else ""
    return text + (
        f" {interval_text(entry.low, entry.high)}" if entry.low is not None and entry.high is not None else ""
    )


def _known(cell: EvaluatedCell) -> dict[str, object]:
    return {
        "policy": cell.policy,
        "family": cell.family,
        "trained_on": "+".join(cell.trained_on),
        "tracker": cell.tracker,
        "task": cell.task,
        "mode": cell.mode,
        "labels": cell.labels,
        "latency": cell.latency,
    }


def ours(table: str, cell: EvaluatedCell) -> TableEntry:
    """The numbers of a cell, by the conventions of `stats.cell`."""
    rates = list(seed_rates(cell.records).values())
    episodes = len(cell.records)
    won = sum(record.outcome == "success" for record in cell.records)
    interval = wilson(won, episodes)
    entry = TableEntry(
        table=table,
        source="ours",
        policy="",
        family="",
        episodes=episodes,
        successes=won,
        sr=math.fsum(rates) / len(rates),
        sr_std=population_std(rates),
        low=interval[0] if interval else None,
        high=interval[1] if interval else None,
        afr=sum(record.outcome == "fall" for record in cell.records) / episodes,
    )
    return dataclasses.replace(entry, **_known(cell))  # type: ignore[arg-type]  # fields of the record, by name


def ours_average(table: str, name: str, cells: Sequence[EvaluatedCell], tasks: Iterable[str]) -> TableEntry | None:
    """Average over tasks: mean and population std over all task x seed rates, as the paper's suites.

    A policy that was played through several trackers has several cells of a task; their seeds' rates are pooled.

    Returns:
        None unless every task has a cell.
    """
    wanted = tuple(tasks)
    groups = [[cell for cell in cells if cell.task == task] for task in wanted]
    if not wanted or not all(groups):
        return None
    chosen = [cell for group in groups for cell in group]
    rates = [rate for cell in chosen for rate in seed_rates(cell.records).values()]
    records = [record for cell in chosen for record in cell.records]
    found: Contrast | None = contrast(
        [[(1 / len(wanted) / len(group), cell.held()) for cell in group] for group in groups]
    )
    entry = TableEntry(
        table=table,
        source="ours",
        policy="",
        family="",
        episodes=len(records),
        successes=sum(record.outcome == "success" for record in records),
        sr=math.fsum(rates) / len(rates),
        sr_std=population_std(rates),
        low=found.low if found else None,
        high=found.high if found else None,
        afr=sum(record.outcome == "fall" for record in records) / len(records),
    )
    known = _known(chosen[0]) | {"task": name, "tracker": "+".join(dict.fromkeys(cell.tracker for cell in chosen))}
    return dataclasses.replace(entry, **known)  # type: ignore[arg-type]  # fields of the record, by name


def paper_entry(table: str, rate: PaperRate, trained_on: str = "") -> TableEntry:
    """A rate of the paper; the interval of one task is derived."""
    single = not rate.task.endswith("_AVG")
    low, high = rate.interval if single else (None, None)
    return TableEntry(
        table=table,
        source="paper",
        policy=rate.family,
        family=rate.family,
        trained_on=trained_on or rate.tracker,
        tracker=rate.tracker,
        task=rate.task,
        mode=rate.mode,
        episodes=rate.episodes,
        successes=rate.successes if single else None,
        sr=rate.sr,
        sr_std=rate.sr_std,
        low=low,
        high=high,
        derived=True,
        afr=rate.afr,
    )


def published_entry(table: str, row: PublishedRow, task: str) -> TableEntry:
    """A rate that others published of a policy of theirs; its number of episodes is not known."""
    return TableEntry(
        table=table,
        source="self-reported",
        policy=row.policy,
        family="",
        tracker=row.tracker,
        task=task,
        sr=row.rates[task],
    )
