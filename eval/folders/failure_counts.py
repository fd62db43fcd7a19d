"""Failures of a run by stage, and its successes by what the first picture showed. Pure: records in, figures out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NotRequired, TypedDict

from arena_newton.eval.folders.failure_rules import near_bars, sees_at_start, stage_of, waits_in_view
from arena_newton.eval.folders.failure_stage import FailureStage
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.eval.statistics.stats import wilson

__all__ = ["EpisodeName", "FailureCell", "OwnTracker", "SeenRate", "episode_name", "failure_cells"]

EpisodeName = tuple[str, str, int, int]
"""Task, mode, group seed and repeat: the same episode through whichever tracker."""


class SeenRate(TypedDict):
    """Successes of the episodes whose first picture showed the object, or of those whose did not."""

    successes: int
    episodes: int
    ci95: list[float] | None
    """Wilson interval of the rate; None without episodes."""


class OwnTracker(TypedDict):
    """Failures whose actions were played through the tracker that the policy was trained with."""

    tracker: str
    replayed: int
    """Failures that were played so ..."""
    successes: int
    """... and of these the ones that succeed: the tracker-induced failures of the paper."""


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
    waits: dict[str, int]
    """The same, of these the ones that end waiting in view of the object."""
    near: int
    """Failures with a signal near the bar that decides their stage."""
    own_tracker: NotRequired[OwnTracker]
    """Absent where no failure's actions were played through another tracker."""
    seen: SeenRate
    """Episodes whose first picture shows what must be found ..."""
    unseen: SeenRate
    """... and the others, in which a policy must search or guess."""


def episode_name(record: EpisodeRecord) -> EpisodeName:
    """Name of an episode that is the same across trackers."""
    return record.task, record.mode, record.group_seed, record.repeat


def failure_cells(records: Iterable[EpisodeRecord], own: Iterable[EpisodeRecord] = ()) -> list[FailureCell]:
    """Cells in the order of the plan; those without signals are left out.

    Args:
        own: Replays of their actions through the policy's own tracker.
    """
    groups: dict[tuple[str, str, str, str], list[EpisodeRecord]] = {}
    for record in sorted(records, key=lambda one: one.index):
        if record.signals is not None and record.outcome != "error":
            groups.setdefault((record.task, record.tracker, record.shown_policy, record.mode), []).append(record)
    replays = {episode_name(record): record for record in own if record.outcome != "error"}
    return [_cell(names, group, replays) for names, group in groups.items()]


def _cell(
    names: tuple[str, str, str, str], group: Sequence[EpisodeRecord], replays: Mapping[EpisodeName, EpisodeRecord]
) -> FailureCell:
    task, tracker, policy, mode = names

    def counted(some: Iterable[EpisodeRecord]) -> dict[str, int]:
        stages = Counter(stage_of(record) for record in some)
        return {str(stage): stages[stage] for stage in FailureStage}

    cell: FailureCell = {
        "task": task,
        "tracker": tracker,
        "policy": policy,
        "mode": mode,
        "episodes": len(group),
        "successes": sum(record.outcome == "success" for record in group),
        "stages": counted(group),
        "falls": counted(record for record in group if record.outcome == "fall"),
        "waits": counted(record for record in group if waits_in_view(record)),
        "near": sum(bool(near_bars(record)) for record in group),
        "seen": _rate(group, seen=True),
        "unseen": _rate(group, seen=False),
    }
    found = [replays.get(episode_name(record)) for record in group if record.outcome != "success"]
    played = [replay for replay in found if replay is not None]
    if played:
        won = sum(replay.outcome == "success" for replay in played)
        cell["own_tracker"] = {"tracker": played[0].tracker, "replayed": len(played), "successes": won}
    return cell


def _rate(group: Sequence[EpisodeRecord], *, seen: bool) -> SeenRate:
    chosen = [one for one in group if one.signals is not None and sees_at_start(one.signals) == seen]
    successes = sum(record.outcome == "success" for record in chosen)
    return {"successes": successes, "episodes": len(chosen), "ci95": wilson(successes, len(chosen))}
