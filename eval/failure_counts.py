"""Failures of a run by stage, and its successes by what the first picture showed. Pure: records in, figures out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TypedDict

from arena_newton.eval.failure_rules import sees_at_start, stage_of
from arena_newton.eval.failure_stage import FailureStage
from arena_newton.eval.journal import EpisodeRecord
from arena_newton.eval.stats import wilson

__all__ = ["FailureCell", "SeenRate", "failure_cells"]


class SeenRate(TypedDict):
    """Successes of the episodes whose first picture showed the object, or of those whose did not."""

    successes: int
    episodes: int
    ci95: list[float] | None
    """Wilson interval of the rate; None without episodes."""


class FailureCell(TypedDict):
    """Failures of one task x tracker x policy x mode, over its episodes with signals and without an error."""

    task: str
    tracker: str
    policy: str
    mode: str
    episodes: int
    successes: int
    stages: dict[str, int]
    """Every stage, in the taxonomy's order → failures at it."""
    falls: dict[str, int]
    """The same, of these the falls."""
    seen: SeenRate
    """Episodes whose first picture shows what must be found ..."""
    unseen: SeenRate
    """... and the others, in which a policy must search or guess."""


def failure_cells(records: Iterable[EpisodeRecord]) -> list[FailureCell]:
    """Cells in the order of the plan; those without signals are left out."""
    groups: dict[tuple[str, str, str, str], list[EpisodeRecord]] = {}
    for record in sorted(records, key=lambda one: one.index):
        if record.signals is not None and record.outcome != "error":
            groups.setdefault((record.task, record.tracker, record.shown_policy, record.mode), []).append(record)
    return [_cell(names, group) for names, group in groups.items()]


def _cell(names: tuple[str, str, str, str], group: Sequence[EpisodeRecord]) -> FailureCell:
    task, tracker, policy, mode = names
    stages = Counter(stage_of(record) for record in group)
    falls = Counter(stage_of(record) for record in group if record.outcome == "fall")
    return {
        "task": task,
        "tracker": tracker,
        "policy": policy,
        "mode": mode,
        "episodes": len(group),
        "successes": sum(record.outcome == "success" for record in group),
        "stages": {str(stage): stages[stage] for stage in FailureStage},
        "falls": {str(stage): falls[stage] for stage in FailureStage},
        "seen": _rate(group, seen=True),
        "unseen": _rate(group, seen=False),
    }


def _rate(group: Sequence[EpisodeRecord], *, seen: bool) -> SeenRate:
    chosen = [one for one in group if one.signals is not None and sees_at_start(one.signals) == seen]
    successes = sum(record.outcome == "success" for record in chosen)
    return {"successes": successes, "episodes": len(chosen), "ci95": wilson(successes, len(chosen))}
