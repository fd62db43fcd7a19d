"""The page of a plan: seconds of its stages, successes of every training with their bars, failures by stage."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.folders.failure_counts import failure_cells
from arena_newton.eval.loop.plan_commands import PlanFolders
from arena_newton.eval.loop.plan_file import LoopPlan, PlanRow
from arena_newton.eval.loop.plan_run import CommandTime, stage_seconds
from arena_newton.eval.records.journal import write_atomic
from arena_newton.eval.reports.progress import duration
from arena_newton.eval.tables.episode_table import PlayedCell, read_folder
from arena_newton.pages.tables import Table, escaped

__all__ = ["PAGE", "middle_training", "write"]

PAGE = "plan.md"
"""File of the page."""


@dataclass(frozen=True)
class _Scores:
    """Successes of some cells of every training of a row."""

    won: dict[int, int]
    """Seed → successes."""
    episodes: int

    @property
    def middle(self) -> int:
        """Successes of the training in the middle, of an even number the lower one."""
        return statistics.median_low(self.won.values())

    @property
    def rate(self) -> float:
        """Its success rate."""
        return self.middle / self.episodes


def _seed(cell: PlayedCell) -> int:
    """Seed of a cell's training, which its suite has as number."""
    return int(cell.planned.policy.partition("#")[2]) if cell.planned is not None else 0


def _scores(cells: Sequence[PlayedCell]) -> _Scores:
    won: Counter[int] = Counter()
    played: Counter[int] = Counter()
    for cell in cells:
        won[_seed(cell)] += sum(cell.held().values())
        played[_seed(cell)] += len(cell.records)
    whole = max(played.values())
    return _Scores({seed: won[seed] for seed in sorted(played) if played[seed] == whole}, whole)


def _cells(suites: Sequence[Path]) -> list[PlayedCell]:
    return [cell for suite in suites for cell in read_folder(suite, [])[1]]


def middle_training(suites: Sequence[Path]) -> tuple[int, list[Path]]:
    """Seed of the training whose sum of successes over all cells is the middle one, and suites that hold others.

    Raises:
        InputError: No cell was played.
    """
    cells = _cells(suites)
    if not cells:
        raise InputError(f"{' '.join(map(str, suites)) or 'evaluation'}: no cell is whole")
    scores = _scores(cells)
    middle = next(seed for seed, won in scores.won.items() if won == scores.middle)
    return middle, [suite for suite in suites if any(_seed(cell) != middle for cell in _cells([suite]))]


def _condition(cell: PlayedCell) -> str:
    """Mode of a cell, with a word where the tracker is none of its training's."""
    return cell.mode + ("" if cell.tracker in cell.trained_on else ", swapped")


def write(plan: LoopPlan, folders: PlanFolders, times: Sequence[CommandTime], command: str) -> list[str]:
    """Write `plan.md` of what is there.

    Returns:
        Lines for the terminal: seconds of the stages, sums of the rows by mode, bars that are missed.
    """
    seconds = stage_seconds(times)
    lines = ["time: " + ", ".join(f"{name} {duration(some)}" for name, some in seconds.items())] if seconds else []
    stages = [
        [stage, f"{some:.1f}", str(sum(t.stage == stage for t in times) or "")] for stage, some in seconds.items()
    ]
    text = [f"# The plan {escaped(plan.name)}", "", f"`{command.replace('`', '')}`", ""]
    text += ["## Time", "", *Table(["stage", "seconds", "commands"], stages, "lr").compact()]
    for row in plan.rows:
        if cells := _cells(folders.suites(row)):
            more, said = _row(plan, row, cells)
            text, lines = text + more, lines + said
    path = folders.out / PAGE
    write_atomic(path, "\n".join(text).rstrip() + "\n")
    return [*lines, f"report: {path}"]


def _row(plan: LoopPlan, row: PlanRow, cells: Sequence[PlayedCell]) -> tuple[list[str], list[str]]:
    """Section of a row, and its lines for the terminal."""
    conditions = dict.fromkeys(map(_condition, cells))
    sums, missed, lines = [], [], []
    for condition in conditions:
        mine = [cell for cell in cells if _condition(cell) == condition]
        scores, (least, all_) = _scores(mine), (*plan.bars.get(condition, ()), 0.0, 0.0)[:2]
        each = " ".join(map(str, scores.won.values()))
        verdict = "" if not all_ else "held" if scores.rate >= all_ else "missed"
        bar = f"{all_ * scores.episodes:.0f}" if all_ else ""
        sums.append([condition, each, f"{scores.middle} of {scores.episodes}", bar, verdict])
        lines.append(f"{row.name}: {condition}: {scores.middle} of {scores.episodes} ({each}) {verdict}".rstrip())
        missed += _missed(plan, mine, condition, least)
    text = ["", f"## Row {escaped(row.name)}", "", f"Seeds of its trainings: {' '.join(map(str, _scores(cells).won))}."]
    text += ["", *Table(["mode", "successes of each training", "middle", "bar", ""], sums, "llr").compact()]
    pairs = dict.fromkeys((cell.task, cell.tracker) for cell in cells)
    table = []
    for task, tracker in pairs:
        row_of = [task, tracker]
        for condition in conditions:
            mine = [c for c in cells if (c.task, c.tracker, _condition(c)) == (task, tracker, condition)]
            row_of.append(" ".join(map(str, _scores(mine).won.values())) if mine else "")
        table.append(row_of)
    text += ["", *Table(["task", "tracker", *conditions], table, "llr").compact()]
    if missed:
        text += ["", "Cells under their bars, by the training in the middle:", "", *(f"- {one}" for one in missed)]
        lines += [f"{row.name}: under its bar: {one}" for one in missed]
    return text + _failures(cells), lines


def _missed(plan: LoopPlan, cells: Sequence[PlayedCell], condition: str, least: float) -> list[str]:
    """Cells of a condition under their bars."""
    found = []
    for task, tracker in dict.fromkeys((cell.task, cell.tracker) for cell in cells):
        scores = _scores([cell for cell in cells if (cell.task, cell.tracker) == (task, tracker)])
        best = plan.best.get(tracker, {}).get(task, 0.0) if condition == "base" else 0.0
        bar = max(least, best)
        if scores.rate < bar:
            counts = f"{scores.middle} of {scores.episodes}, bar {bar * scores.episodes:.0f}"
            found.append(f"{task} {tracker} {condition}: {counts}")
    return found


def _failures(cells: Sequence[PlayedCell]) -> list[str]:
    """Failures of all trainings of a row by stage, where the plan keeps their signals."""
    counts: dict[tuple[str, str, str], Counter[str]] = {}
    for cell in cells:
        for one in failure_cells(cell.records):
            key = (one["task"], one["tracker"], _condition(cell))
            counts.setdefault(key, Counter()).update(one["stages"])
    rows = [
        [*key, str(sum(stages.values())), ", ".join(f"{name} {n}" for name, n in stages.most_common() if n)]
        for key, stages in counts.items()
        if sum(stages.values())
    ]
    if not rows:
        return []
    head = ["task", "tracker", "mode", "failures", "at which stage"]
    return ["", "Failures of all trainings by stage:", "", *Table(head, rows, "lllrl").compact()]
