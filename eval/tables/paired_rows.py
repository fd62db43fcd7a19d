"""Rows of tables that compare two conditions over the episodes that both played."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from arena_newton.eval.statistics.stats import contrast, holm, paired_rates
from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.table_entries import UNDEFINED, TableEntry, interval_text, ours, probability
from arena_newton.pages.tables import percent, points

__all__ = ["PAIRED", "RowPair", "paired_rows"]


@dataclasses.dataclass(frozen=True)
class RowPair:
    """Two conditions on the same episodes: cells, the columns that name them, and what the paper says."""

    first: EvaluatedCell
    second: EvaluatedCell
    named: tuple[str, ...]
    paper: tuple[str, ...] = ()


def paired_rows(table: str, pairs: Sequence[RowPair]) -> tuple[list[tuple[str, ...]], list[TableEntry]]:
    """Rows and entries of pairs: rates over common episodes, difference, retention, test and adjusted test."""
    results = [paired_rates(pair.first.held(), pair.second.held()) for pair in pairs]
    tested = [r.p for r in results if r.p is not None]
    adjusted = iter(holm(tested))
    rows: list[tuple[str, ...]] = []
    entries: list[TableEntry] = []
    for pair, r in zip(pairs, results, strict=True):
        found = contrast([[(1.0, pair.first.held()), (-1.0, pair.second.held())]])
        if found is None or r.first is None or r.second is None:
            rows.append((*pair.named, "0", *[""] * 8, *pair.paper))
            continue
        p_holm = next(adjusted)
        retention = r.second / r.first if r.first > 0 else None
        entry = dataclasses.replace(
            ours(table, pair.second),
            matched_sr=r.first,
            drop=found.value,
            drop_low=found.low,
            drop_high=found.high,
            retention=retention,
            pairs=r.pairs,
            unpaired=r.unpaired,
            only_first=r.only_first,
            only_second=r.only_second,
            p=r.p,
            p_holm=p_holm,
        )
        entries.append(entry)
        rows.append(
            (
                *pair.named,
                str(r.pairs),
                percent(r.first),
                percent(r.second),
                f"{points(found.value)} {interval_text(found.low, found.high)}",
                percent(retention) if retention is not None else UNDEFINED,
                f"{r.only_first}/{r.only_second}",
                probability(r.p),
                probability(p_holm),
                percent(entry.afr or 0.0, 2),
                *pair.paper,
            )
        )
    return rows, entries


PAIRED = (
    "Over the n episodes that both played: rates in %, their difference Δ in points with 95 % interval, successes of "
    "the first / of the second alone, p of the exact McNemar test, and adjusted for the tests of this table (Holm). "
)
