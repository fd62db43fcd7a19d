"""Are failures labelled right? Scripted failures of each stage, and real ones that two readers judged by eye."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from arena_newton import tasks as task_registry
from arena_newton.cli.intervals import wilson
from arena_newton.eval.certification.checks.labelled_failures import agreements, labelled_failures, labelled_sheets
from arena_newton.eval.certification.context import CertifyCell, Context
from arena_newton.eval.certification.finding import Check, CheckFinding, Verdict, skipped
from arena_newton.eval.certification.stand_ins.bodies import Body
from arena_newton.eval.certification.stand_ins.sabotage import SABOTAGES
from arena_newton.eval.folders.failure_rules import stage_of
from arena_newton.eval.folders.failure_stage import FailureStage
from arena_newton.pages.tables import Table

__all__ = ["CHECKS", "HELD_OUT", "LEAST", "TUNED", "Confusion", "confusion"]

LEAST = 0.8
"""Least precision and recall of each stage."""
QUICK_FAILURES = 2
"""Episodes of each kind of failure and tracker under --quick, all in one task."""
ENOUGH = 20
"""Episodes from which on a part itself is held to the bar; of fewer, its 95 % interval must reach it."""


TUNED: Mapping[str, tuple[int, ...]] = {
    "boxing": (0, 10, 700),
    "vis_navi": (0, 10, 500, 501, 502, 503, 504, 505, 700, 800, 900),
    "football": (500, 501, 502, 503, 700, 701, 800, 801, 900),
    "sit_sofa": (500, 501, 502, 700, 1100, 1150),
    "open_door": (500, 700, 701, 800, 900),
    "pp_box": (0, 500, 700, 701, 900),
    "double_desk": (500, 700, 701, 900, 1100, 1150),
}
"""Task → group seeds whose episodes were looked at when thresholds and saboteurs were set."""
HELD_OUT = 1200
"""First group seed that the check plays: above all that were looked at. Whoever changes a rule after episodes from here
on were seen chooses another."""


@dataclass(frozen=True)
class Confusion:
    """Scripted failures by the stage that was scripted and the stage that was found."""

    counts: Mapping[tuple[FailureStage, FailureStage], int]
    """(scripted, found) → episodes."""

    def scripted(self, stage: FailureStage) -> int:
        """Number of scripted failures of a stage."""
        return sum(self.counts.get((stage, text), 0) for text in FailureStage)

    def found(self, stage: FailureStage) -> int:
        """Number of failures that the rules assign to a stage."""
        return sum(self.counts.get((scripted, stage), 0) for scripted in FailureStage)

    def recall(self, stage: FailureStage) -> float | None:
        """Part of the scripted failures of a stage that are found to be of it; None without any."""
        return self._part(stage, self.scripted(stage))

    def precision(self, stage: FailureStage) -> float | None:
        """Part of those found at a stage that were scripted so; None where none is."""
        return self._part(stage, self.found(stage))

    def _part(self, stage: FailureStage, total: int) -> float | None:
        return self.counts.get((stage, stage), 0) / total if total else None


def confusion(pairs: Sequence[tuple[FailureStage, FailureStage | None]]) -> Confusion:
    """Counts of pairs (scripted, found); pairs without a failure are left out."""
    return Confusion(Counter((scripted, text) for scripted, text in pairs if text is not None))


def failures(context: Context) -> CheckFinding:
    """Let saboteurs fail, and compare scripted stages with found ones; count how often rules and readers agree."""
    tasks = [task for task in context.tasks if task_registry.get(task).interaction]
    if not tasks:
        return skipped(f"no signals are defined for {' '.join(context.tasks)}")
    real = labelled_failures()
    pairs: dict[str, list[tuple[FailureStage, FailureStage | None]]] = {}
    notes, total = [], 0
    for task in tasks:
        for tracker in context.sample:
            for name, sabotage in SABOTAGES.items():
                if not sabotage.fits(task) or context.options.quick and task != _quick_task(name):
                    continue
                episodes = min(QUICK_FAILURES, context.episodes) if context.options.quick else None
                cell = CertifyCell(task, tracker, body=name, failures=True, first_seed=HELD_OUT, episodes=episodes)
                records = context.evaluate(cell)
                found = [(sabotage.stage, stage_of(record)) for record in records]
                pairs.setdefault(task, []).extend(found)
                solved = sum(record.outcome == "success" for record in records)
                total += len(records)
                if solved:
                    notes.append(f"{task} {tracker}, {name}: {solved} of {len(records)} episodes succeed all the same")
    for task in tasks:
        looked_at = " ".join(str(seed) for seed in TUNED.get(task, ())) or "none of its episodes"
        notes.append(f"{task}: played from group seed {HELD_OUT} on; thresholds and saboteurs were set on {looked_at}")
    left_out = [task for task in context.tasks if task not in tasks]
    notes += [f"no signals are defined for {' '.join(left_out)}"] if left_out else []
    matrices = {task: confusion(found) for task, found in pairs.items()}
    every = confusion([pair for found in pairs.values() for pair in found])
    matrices |= {"all": every} if len(tasks) > 1 else {}
    below = [(f"{task}: {text}", shown) for task, matrix in matrices.items() for text, shown in _below(matrix)]
    below += [
        (f"real failures: {' and '.join(one.judges)} agree on {one.same} of {one.failures} ({one.part} numbers)", True)
        for one in agreements(real)
        if one.part != "even" and one.rate < LEAST  # on the even ones thresholds were set
    ]
    verdict: Verdict = "fail" if any(shown for _, shown in below) else "note" if below else "pass"
    failed = sum(every.counts.values())
    right = sum(every.counts.get((stage, stage), 0) for stage in FailureStage)
    rates = ", ".join(f"{one.rate:.2f} {' with '.join(one.judges)}" for one in agreements(real) if one.part == "all")
    summary = (
        f"{right} of {failed} scripted failures get their stage ({total} episodes); of {len(real)} real ones judged by "
        f"eye: {rates}"
    )
    sheets = (*(_sheet(task, matrix) for task, matrix in matrices.items()), *labelled_sheets(real))
    for sheet in sheets:
        print(f"{sheet.title}\n\n{dataclasses.replace(sheet, align='lr').markdown()}")
    return CheckFinding(verdict, summary, sheets, (*(text for text, _ in below), *notes))


def _quick_task(name: str) -> str | None:
    """The task in which a kind of failure is played under --quick: the kinds go round the tasks."""
    fit = [task for task in TUNED if SABOTAGES[name].fits(task)]
    return fit[list(SABOTAGES).index(name) % len(fit)] if fit else None


def _below(matrix: Confusion) -> list[tuple[str, bool]]:
    """Stages whose precision or recall is below the bar, and whether the episodes are enough to show it.

    One that was not scripted has no bar: what is found to be of it counts against the recall of the others.
    """
    found = []
    for stage in FailureStage:
        if not matrix.scripted(stage):
            continue
        right = matrix.counts.get((stage, stage), 0)
        for name, total in (("recall", matrix.scripted(stage)), ("precision", matrix.found(stage))):
            if total and right < LEAST * total:
                text = f"{name} of {stage} is {right} of {total}, expected at least {LEAST:g}"
                shown = total >= ENOUGH or wilson(right, total)[1] < LEAST
                found.append((text if shown else f"{text}; too few episodes to say", shown))
    return found


def _sheet(task: str, matrix: Confusion) -> Table:
    """The matrix: a row for each stage that was scripted."""

    def part(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    rows = [
        (
            str(scripted),
            *(str(matrix.counts.get((scripted, text), 0)) for text in FailureStage),
            part(matrix.recall(scripted)),
            part(matrix.precision(scripted)),
        )
        for scripted in FailureStage
    ]
    head = ("scripted", *(f"found {stage}" for stage in FailureStage), "recall", "precision")
    return Table(head, rows, title=f"{task}: scripted failures (rows) and what the rules say (columns)")


BODIES: dict[str, Body] = {name: sabotage.body for name, sabotage in SABOTAGES.items()}
"""Bodies of the scripted failures by name, for `Context.bodies`."""
QUESTION = "Do failures get the stage at which they were scripted to happen, and that two readers say?"
CHECKS = (Check("failures", QUESTION, failures),)
"""This module's checks."""
