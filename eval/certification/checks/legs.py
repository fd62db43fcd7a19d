"""Are legs needed? The experts with their legs frozen, and with a base that glides in place of legs."""

from __future__ import annotations

import itertools

from arena_newton import tasks
from arena_newton.eval.certification.checks.replays import recorded
from arena_newton.eval.certification.context import CertifyCell, Context
from arena_newton.eval.certification.finding import Check, CheckFinding, Picture, Verdict, pooled_score, score
from arena_newton.files.text import counted
from arena_newton.pages.tables import Table

__all__ = ["CHECKS"]

SHOWN = 2
"""Film strips of each task that the page shows."""


def _cell(context: Context, task: str, tracker: str, body: str) -> CertifyCell:
    """Episodes of a body, which last as long as their budgets: one under --quick, unless more are asked for."""
    options = context.options
    episodes = 1 if options.quick and options.episodes is None else context.episodes
    return CertifyCell(task, tracker, body=body, strip=True, episodes=episodes)


def _without_legs(context: Context, body: str) -> tuple[dict[str, int], Table, tuple[Picture, ...]]:
    """Successes of the experts with a body by task, the table of them, and pictures of those successes."""
    rows, pictures, found = [], [], {}
    for tracker in context.sample:
        for task in context.tasks:
            cell = _cell(context, task, tracker, body)
            whole, records = score(context.evaluate(recorded(context, task, tracker))), context.evaluate(cell)
            one = score(records)
            found[task] = found.get(task, 0) + one.successes
            falls = sum(record.outcome == "fall" for record in records)
            reached = sum(record.progress or 0.0 for record in records) / max(len(records), 1)
            rows.append((task, tracker, *one.cells(), str(falls), f"{reached:.2f}", whole.cells()[0]))
            for record, path in context.strips(cell, "success")[:SHOWN]:
                which = f"{task} through {tracker}, seed {record.group_seed} repeat {record.repeat}"
                pictures.append(Picture(f"{which}, {context.bodies[body].title}: success at step {record.steps}", path))
    head = ("task", "tracker", "successes", "95 % interval", "falls", "mean progress", "with legs")
    return found, Table(head, rows, title=f"Experts with {context.bodies[body].title}"), tuple(pictures)


def _broken(context: Context, body: str) -> tuple[str, ...]:
    """Reasons for which zero successes show nothing: errors, or nobody solves the task with legs either."""
    lines = []
    for tracker, task in itertools.product(context.sample, context.tasks):
        records = context.evaluate(_cell(context, task, tracker, body))
        errors = sum(record.outcome == "error" for record in records)
        lines += [f"{task} through {tracker}: {errors} episodes ended as errors"] * bool(errors)
        if not score(context.evaluate(recorded(context, task, tracker))).successes:
            lines.append(f"{task} through {tracker}: the expert does not solve it with legs either")
    return tuple(lines)


def frozen(context: Context) -> CheckFinding:
    """Play every task with legs that only stand."""
    found, sheet, pictures = _without_legs(context, "frozen")
    solved = {task: count for task, count in found.items() if count}
    broken = _broken(context, "frozen")
    cells = [_cell(context, task, tracker, "frozen") for task in context.tasks for tracker in context.sample]
    total = counted(sum(cell.episodes or 0 for cell in cells), "episode")
    summary = f"{sum(found.values())} successes in {total} with the legs frozen in the standing posture"
    notes = tuple(f"{task}: {count} successes with frozen legs, see the pictures" for task, count in solved.items())
    return CheckFinding("fail" if solved or broken else "pass", summary, (sheet,), (*broken, *notes), pictures)


def gliding(context: Context) -> CheckFinding:
    """Play every task with a base that glides.

    A base on wheels is not what the rules forbid: they read where hands, feet and things are, not how the robot came
    there. So a task may say why one solves it (`TaskSpec.without_legs`).
    """
    found, sheet, pictures = _without_legs(context, "gliding")
    whole = pooled_score(
        [score(context.evaluate(recorded(context, task, tracker))) for tracker in context.sample for task in found]
    )
    solved = {task: count for task, count in found.items() if count}
    reasons = {task: tasks.get(task).without_legs for task in solved}
    unknown = [task for task, reason in reasons.items() if not reason]
    needed = [task for task in found if task not in solved]
    summary = f"{sum(found.values())} successes with a gliding base, {whole.successes} with legs; 0 in: "
    summary += " ".join(needed) or "none"
    notes = [f"{task}, {solved[task]} successes: {reason}." for task, reason in reasons.items() if reason]
    notes += [f"{task}, {solved[task]} successes: no reason is known, see the pictures." for task in unknown]
    broken = _broken(context, "gliding")
    notes += broken
    verdict: Verdict = "fail" if unknown or broken else "note" if solved else "pass"
    claim = f"a gliding base solves {len(solved)} of {counted(len(found), 'task')}"
    return CheckFinding(verdict, summary, (sheet,), tuple(notes), pictures, claim)


CHECKS = (
    Check("frozen-legs", "Do the experts score 0 when their legs only stand?", frozen),
    Check("gliding-base", "Do they score 0 with a base that glides in place of legs, or is it known why not?", gliding),
)
"""This module's checks."""
