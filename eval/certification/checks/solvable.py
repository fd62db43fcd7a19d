"""Can the tasks be solved? The experts' success for every task, tracker and rule set, by their actions alone."""

from __future__ import annotations

from arena_newton.eval.certification.checks.replays import SOLVED, own_replay, recorded
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding, pooled_score, score
from arena_newton.pages.tables import Table, percent
from arena_newton.rule_sets import names as rule_sets

__all__ = ["CHECKS"]


def solvable(context: Context) -> CheckFinding:
    """Play every task with its expert, and replay its actions without it."""
    rows, low, scores, replays, gaps = [], [], [], 0, []
    for tracker in context.trackers:
        for rules in rule_sets() if tracker in context.sample and not context.options.quick else ("paper",):
            for task in context.tasks:
                records = context.evaluate(recorded(context, task, tracker, rules))
                replayed, apart = own_replay(context, task, tracker, rules)
                replays, gaps = replays + len(replayed), gaps + apart
                one = score(records)
                scores.append(one)
                falls = sum(record.outcome == "fall" for record in records)
                steps = [record.steps for record in records if record.outcome == "success"]
                mean = f"{sum(steps) / len(steps):.0f}" if steps else "-"
                rows.append((task, tracker, rules, *one.cells(), str(falls), mean))
                if one.interval[1] < SOLVED:
                    low.append(f"{task} through {tracker} under {rules}: {one.successes} of {one.episodes}")
    total = pooled_score(scores)
    summary = f"experts solve {total.successes} of {total.episodes} episodes; "
    summary += f"not by their actions alone: {gaps[0]}" if gaps else f"{replays} replays of their actions end the same"
    head = ("task", "tracker", "rules", "successes", "95 % interval", "falls", "mean steps of a success")
    notes = [f"Not by their actions alone, {gap}." for gap in gaps]
    notes += [
        f"An expert is to reach {percent(SOLVED, 0)} % within its interval; below that are {', '.join(low)}."
    ] * bool(low)
    return CheckFinding(
        "fail" if low or gaps else "pass", summary, (Table(head, rows, title="Success of the experts"),), tuple(notes)
    )


CHECKS = (Check("solvable", "Does an expert solve every task, through each tracker, under both rule sets?", solvable),)
"""This module's checks."""
