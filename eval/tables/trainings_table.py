"""The table of several trainings of one recipe."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.table_entries import SuiteTable
from arena_newton.pages.tables import percent
from arena_newton.tasks.semantic_mode import task_title

__all__ = ["trainings_table"]


def trainings_table(cells: Sequence[EvaluatedCell]) -> SuiteTable | None:
    """Cells of several trainings of one recipe, and how much these differ."""
    groups: dict[tuple[str, ...], list[EvaluatedCell]] = {}
    for cell in cells:
        if cell.trained_on:
            key = (cell.recipe, "+".join(cell.trained_on), cell.tracker, cell.task, cell.mode)
            groups.setdefault(key, []).append(cell)
    rows = []
    for (recipe, trained_on, tracker, task, mode), same in groups.items():
        if len(same) > 1:
            rates = [sum(cell.held().values()) / len(cell.held()) for cell in same]
            won = " ".join(str(sum(cell.held().values())) for cell in same)
            row = (recipe, trained_on, tracker, task_title(task), mode, str(len(same)), won)
            rows.append((*row, percent(statistics.mean(rates)), percent(statistics.stdev(rates))))
    if not rows:
        return None
    head = ("recipe", "trained on", "tracker", "task", "mode", "trainings", "successes", "mean %", "sd, points")
    caption = (
        "Several trainings of one recipe: successes of each, their mean rate, and the standard deviation between "
        "trainings, chance of episodes included."
    )
    return SuiteTable(head, rows, "lllllr", "Several trainings", caption, "trainings")
