"""Can the tasks be solved? The experts' success for every task, tracker and rule set."""

from __future__ import annotations

from arena_newton.eval.certification.context import CertifyCell, Context
from arena_newton.eval.certification.finding import Check, CheckFinding, Sheet, percent, pooled_score, score
from arena_newton.rule_sets import names as rule_sets

__all__ = ["CHECKS", "recorded"]

SOLVED = 0.9
"""Success rate that an expert must not be significantly below: the Wilson interval reaches it. Of 60 episodes 50 do,
of 4 three."""


def recorded(context: Context, task: str, tracker: str) -> CertifyCell:
    """The expert's episodes in base mode under `paper`, with their actions: what several checks compare with."""
    return CertifyCell(task, tracker, actions=True)


def solvable(context: Context) -> CheckFinding:
    """Play every task with its expert."""
    rows, low, scores = [], [], []
    for tracker in context.trackers:
        for rules in rule_sets() if tracker in context.sample else ("paper",):
            for task in context.tasks:
                paper = rules == "paper"
                cell = recorded(context, task, tracker) if paper else CertifyCell(task, tracker, rules)
                records = context.evaluate(cell)
                one = score(records)
                scores.append(one)
                falls = sum(record.outcome == "fall" for record in records)
                steps = [record.steps for record in records if record.outcome == "success"]
                mean = f"{sum(steps) / len(steps):.0f}" if steps else "-"
                rows.append((task, tracker, rules, *one.cells(), str(falls), mean))
                if one.interval[1] < SOLVED:
                    low.append(f"{task} through {tracker} under {rules}: {one.successes} of {one.episodes}")
    total = pooled_score(scores)
    summary = f"experts solve {total.successes} of {total.episodes} episodes"
    head = ("task", "tracker", "rules", "successes", "95 % interval", "falls", "mean steps of a success")
    notes = [f"An expert is to reach {percent(SOLVED)} within its interval; below that are {', '.join(low)}."] * bool(
        low
    )
    return CheckFinding(
        "fail" if low else "pass", summary, (Sheet("Success of the experts", head, tuple(rows)),), tuple(notes)
    )


CHECKS = (Check("solvable", "Does an expert solve every task, through each tracker, under both rule sets?", solvable),)
"""This module's checks."""
