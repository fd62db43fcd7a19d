"""What policies cost: minutes of training and of evaluation, per policy and tracker."""

from __future__ import annotations

from collections.abc import Sequence

from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.table_entries import SuiteTable

__all__ = ["cost_table"]


def cost_table(cells: Sequence[EvaluatedCell]) -> SuiteTable | None:
    """Minutes per policy, training and tracker of execution; None where nothing was measured.

    Training counts once per weights, in the first row that uses them.
    """
    rows: list[tuple[str, ...]] = []
    groups: dict[tuple[str, str, str, str], list[EvaluatedCell]] = {}
    for cell in cells:
        groups.setdefault((cell.policy, "+".join(cell.trained_on), cell.tracker, cell.device), []).append(cell)
    counted: set[str] = set()
    for (policy, trained_on, tracker, device), mine in groups.items():
        measured = [cell.wall_s for cell in mine if cell.wall_s]
        weights = {c.weights: c.training_minutes for c in mine if c.weights and c.training_minutes is not None}
        again = len(weights) - len(weights.keys() - counted)
        new = [minutes for name, minutes in weights.items() if name not in counted]
        counted |= set(weights)
        if not measured and not weights:
            continue
        training = f"{sum(new):.1f}" if new else "above" if again else ""
        evaluation = sum(measured) / 60
        rows.append(
            (
                policy,
                trained_on,
                tracker,
                device,
                str(len(weights)) if weights else "",
                training,
                str(len(mine)),
                str(sum(len(cell.records) for cell in mine)),
                f"{evaluation:.1f}" if measured else "",
                f"{evaluation / len(measured):.2f}" if measured else "",
            )
        )
    if not rows:
        return None
    head = ("policy", "trained on", "tracker", "device", "checkpoints", "training min", "cells", "episodes")
    caption = (
        "Minutes on the device named: of the trainings as the checkpoints say, each counted once; of the cells as the "
        "suite measured, start and compilation included."
    )
    whole = (*head, "evaluation min", "min per cell")
    return SuiteTable(whole, rows, "llllr", "Time", caption, "cost")
