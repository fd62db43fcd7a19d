"""Statistics of a run, pure: records in, cells and suite averages out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from arena_newton import intervals
from arena_newton.eval.records import plain_text

__all__ = [
    "SUITES",
    "aggregate",
    "cell",
    "error_reasons",
    "outside_suites",
    "pooled",
    "population_std",
    "seed_rates",
    "wilson",
]

SUITES: dict[str, tuple[str, ...]] = {
    "HOI_AVG": ("football", "double_desk", "pp_box"),
    "HSI_AVG": ("open_door", "sit_sofa", "boxing", "vis_navi"),
    "ALL_AVG": ("football", "double_desk", "pp_box", "open_door", "sit_sofa", "boxing", "vis_navi"),
}
"""Task groups of the paper's tables: human-object and human-scene interaction; `outside_suites` names other tasks."""


def population_std(values: Sequence[float]) -> float | None:
    """Standard deviation with divisor n, as the paper's tables; None without values."""
    if not values:
        return None
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((v - mean) ** 2 for v in values) / len(values))


def wilson(successes: int, episodes: int) -> list[float] | None:
    """95 % Wilson score interval of a success rate; None without episodes.

    Wilson, E. B. (1927): Probable inference, the law of succession, and statistical inference.
    """
    return list(intervals.wilson(successes, episodes)) if episodes else None


def outside_suites(tasks: Iterable[str]) -> list[str]:
    """Tasks that no average of the paper's tables counts, such as one that was added to its seven."""
    return [task for task in dict.fromkeys(tasks) if task not in SUITES["ALL_AVG"]]


def error_reasons(records: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Why episodes ended as errors, the most frequent cause first.

    Returns:
        One object per cause: ``reason``, ``message`` (one line without terminal escapes) and ``count``.
    """
    counts: Counter[tuple[str, str]] = Counter(
        (plain_text(record.get("reason") or "error", 80), plain_text(record.get("error") or "no message", 400))
        for record in records
        if record["outcome"] == "error"
    )
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return [{"reason": reason, "message": message, "count": count} for (reason, message), count in ordered]


def seed_rates(records: Iterable[dict[str, Any]]) -> dict[int, float]:
    """Success rate per group seed, in order of the seeds."""
    counts: dict[int, list[int]] = {}
    for record in records:
        entry = counts.setdefault(record["group_seed"], [0, 0])
        entry[0] += record["outcome"] == "success"
        entry[1] += 1
    return {seed: counts[seed][0] / counts[seed][1] for seed in sorted(counts)}


def cell(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures of one task x tracker x policy x mode.

    An episode that ended with an error counts as an episode without success, and is shown as an error: a policy cannot
    raise its rate by breaking off. ``mean_steps`` is taken over the episodes without error [ticks].
    """
    outcomes = [record["outcome"] for record in records]
    episodes, successes, falls = len(outcomes), outcomes.count("success"), outcomes.count("fall")
    rates = seed_rates(records)
    steps = [record["steps"] for record in records if record["outcome"] != "error"]
    return {
        "episodes": episodes,
        "successes": successes,
        "falls": falls,
        "startup_falls": sum(r["outcome"] == "fall" and bool(r.get("startup_fall")) for r in records),
        "timeouts": outcomes.count("timeout"),
        "errors": outcomes.count("error"),
        "overflows": sum(bool(record.get("overflow")) for record in records),
        "sr": successes / episodes if episodes else None,
        "sr_seed_mean": math.fsum(rates.values()) / len(rates) if rates else None,
        "sr_seed_std": population_std(list(rates.values())),
        "sr_per_seed": {str(seed): rate for seed, rate in rates.items()},
        "ci95": wilson(successes, episodes),
        "afr": falls / episodes if episodes else None,
        "mean_steps": math.fsum(steps) / len(steps) if steps else None,
    }


def pooled(records_by_task: Mapping[str, Sequence[dict[str, Any]]], tasks: Sequence[str]) -> dict[str, Any] | None:
    """Average over a suite: mean and population std over all task x seed rates pooled, falls over all its episodes.

    For instance 3 tasks x 3 seeds for HOI. Returns None unless every task of the suite has episodes.
    """
    if any(not records_by_task.get(task) for task in tasks):
        return None
    rates = [rate for task in tasks for rate in seed_rates(records_by_task[task]).values()]
    records = [record for task in tasks for record in records_by_task[task]]
    falls = sum(record["outcome"] == "fall" for record in records)
    return {
        "episodes": len(records),
        "falls": falls,
        "errors": sum(record["outcome"] == "error" for record in records),
        "sr": math.fsum(rates) / len(rates),
        "sr_std": population_std(rates),
        "afr": falls / len(records),
    }


def aggregate(records: Iterable[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Cells and suite averages of a run, in the order of the plan (``index``), whatever order the episodes ended in."""
    groups: dict[tuple[str, str, str, str], list[dict[str, Any]]] = {}
    for record in sorted(records, key=lambda r: r["index"]):
        key = (record["task"], record["tracker"], record["policy"], record["mode"])
        groups.setdefault(key, []).append(record)
    cells = [
        {"task": key[0], "tracker": key[1], "policy": key[2], "mode": key[3], **cell(group)}
        for key, group in groups.items()
    ]
    suites: list[dict[str, Any]] = []
    for tracker, policy, mode in dict.fromkeys(key[1:] for key in groups):
        by_task = {key[0]: group for key, group in groups.items() if key[1:] == (tracker, policy, mode)}
        for name, tasks in SUITES.items():
            figures = pooled(by_task, tasks)
            if figures is not None:
                suites.append({"suite": name, "tracker": tracker, "policy": policy, "mode": mode, **figures})
    return {"cells": cells, "suites": suites}
