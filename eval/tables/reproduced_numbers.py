"""Numbers of the paper next to ours, each with the mark that the interval of their difference allows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from arena_newton.eval.statistics.stats import contrast, suites
from arena_newton.eval.tables.condition_rates import ConditionRate, rate_of_cell, rates_of_paper
from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.paper_numbers import FAMILIES
from arena_newton.eval.tables.table_entries import PAPER_NAMES
from arena_newton.files.text import counted
from arena_newton.pages.tables import Table, escaped, percent
from arena_newton.tasks.semantic_mode import semantic_notes, task_title

__all__ = ["reproductions_page"]

MARKS = {"≈": "agree", "▲": "ours is higher", "▼": "ours is lower", "·": "not measured here"}
"""Sign between our rate and the paper's → its meaning."""
METHOD = (
    "Success rates in per cent: ours, mark, the paper's. ≈: the 95 % interval of the difference (Agresti and Caffo, "
    "2000) contains 0, which does not show that both are equal; ▲ and ▼: it does not, and ours is higher or lower; ·: "
    "not measured here. One in twenty of equal pairs is marked ▲ or ▼ by chance. The paper prints no episodes: its are "
    "derived from rate and 60 episodes of a cell; through a swapped tracker from the matched rate and the drop. "
    "Simulator and demonstrations differ: a mark compares numbers, and says nothing of why they differ."
)


def reproductions_page(cells: Sequence[EvaluatedCell]) -> str:
    """Page of every success rate in the paper's tables next to ours, as Markdown.

    Args:
        cells: Ours; those of other families, or of late chunks, are left out.
    """
    names, marks, rows = suites()["ALL_AVG"], Counter[str](), []
    ours: dict[tuple[str, tuple[str, ...]], dict[str, dict[str, ConditionRate]]] = {}
    for cell in cells:
        rate = rate_of_cell(cell)
        if cell.latency == 0:
            ours.setdefault((cell.family, rate.row), {}).setdefault(cell.policy, {})[cell.task] = rate
    for family in FAMILIES.values():
        theirs: dict[tuple[str, ...], dict[str, ConditionRate]] = {}
        for rate in rates_of_paper(family):
            theirs.setdefault(rate.row, {})[rate.task] = rate
        for row, printed in theirs.items():
            for policy, mine in ours.get((family, row), {"": {}}).items():
                found = [_marked(mine.get(task), printed[task]) for task in names]
                marks.update(mark for mark, _ in found)
                setting, mode, trained_on, tracker = row
                conditions = (setting, mode, PAPER_NAMES[family], f"{trained_on} → {tracker}", policy or "–")
                rows.append((*conditions, *(text for _, text in found)))
    order = list(dict.fromkeys(row[:2] for row in rows))
    rows.sort(key=lambda row: order.index(row[:2]))
    head = ("setting", "mode", "family", "trained on → executed by", "ours", *map(task_title, names))
    said = ", ".join(f"{number} {mark} ({MARKS[mark]})" for mark in MARKS if (number := marks[mark]))
    notes = semantic_notes({row[1] for row in rows})
    parts = [f"{counted(marks.total(), 'number')}: {said}.", METHOD, *notes]
    table = "\n".join(Table(head, rows, "lllllr").compact(escaped))
    return "\n\n".join(["# Reproductions", *map(escaped, parts), table]) + "\n"


def _marked(ours: ConditionRate | None, theirs: ConditionRate) -> tuple[str, str]:
    """Mark, and both rates with it."""
    printed = percent(theirs.rate)
    if ours is None or ours.held is None or theirs.held is None:
        return "·", f"· {printed}"
    found = contrast([[(1.0, ours.held), (-1.0, theirs.held)]])
    mark = "≈" if found is None or found.low <= 0 <= found.high else "▲" if found.low > 0 else "▼"
    return mark, f"{percent(ours.rate)} {mark} {printed}"
