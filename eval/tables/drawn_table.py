"""Episodes by what their mode drew about the dynamics: successes and falls of each tracker per value of a quantity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.pages.tables import Table
from arena_newton.rules import modes
from arena_newton.rules.rule_types import Range

__all__ = ["drawn_table"]

TASK = "task"


def drawn_table(runs: Sequence[RunRecord], names: Sequence[str]) -> str:
    """Markdown of successes and falls per tracker, a row per combination of the quantities' values.

    A whole number has a row per value, any other the lower and the upper half of its range; `task` may be among the
    quantities. The draws follow from an episode's seed and its mode, and are drawn again; episodes of modes that draw
    none of the quantities are left out.

    Raises:
        InputError: A name is no quantity, or no episode's mode draws them all.
    """
    for name in names:
        if name not in (TASK, *modes.QUANTITIES):
            raise InputError(f"--by {name}: unknown, choose from {', '.join((TASK, *modes.QUANTITIES))}")
    cells: dict[tuple[str, ...], list[EpisodeRecord]] = {}
    trackers: dict[str, None] = {}
    for record in (record for run in runs for record in run.records):
        mode = modes.get(record.mode)
        if all(name in (TASK, *mode.dynamics) for name in names):
            drawn = mode.draw(record.episode_seed)
            key = tuple(record.task if name == TASK else _value(name, drawn, mode.dynamics[name]) for name in names)
            cells.setdefault((*key, record.tracker), []).append(record)
            trackers[record.tracker] = None
    if not cells:
        raise InputError(f"--by {' '.join(names)}: no episode is of a mode that draws it")
    rows = []
    for key in sorted({cell[:-1] for cell in cells}):
        found = [cells.get((*key, tracker), []) for tracker in trackers]
        rows.append([*key, *map(_shown, found), *([_shown(sum(found, []))] if len(found) > 1 else [])])
    head = [*names, *trackers, *(["all"] if len(trackers) > 1 else [])]
    return Table(head, rows, "l" * len(names) + "r").markdown() + "\nSuccesses of episodes, and those that fell.\n"


def _value(name: str, drawn: Mapping[str, float], bounds: Range) -> str:
    """The value of a quantity, or the half of its range."""
    if modes.QUANTITIES[name].whole:
        return f"{drawn[name]:.0f}"
    low, high = bounds
    middle = (low + high) / 2
    return f"{low:g} to {middle:g}" if drawn[name] < middle else f"{middle:g} to {high:g}"


def _shown(records: Sequence[EpisodeRecord]) -> str:
    """Text such as `58/60, 1 fell`."""
    outcomes = [record.outcome for record in records]
    fell = outcomes.count("fall")
    return f"{outcomes.count('success')}/{len(outcomes)}" + (f", {fell} fell" if fell else "") if outcomes else "–"
