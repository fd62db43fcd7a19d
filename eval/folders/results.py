"""Contents of a results folder, read and checked, and the figures that results.json gives of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NotRequired

from arena_newton.errors import InputError
from arena_newton.eval.folders.failure_counts import FailureCell, failure_cells
from arena_newton.eval.plan import rounds
from arena_newton.eval.records.chain import head
from arena_newton.eval.records.document import CONFIG_FILE, Document, Identity, Status, check_plan, read_document
from arena_newton.eval.records.journal import JOURNAL_FILE, EpisodeRecord, read_journal
from arena_newton.eval.records.sharding import read_shard
from arena_newton.eval.statistics.stats import Aggregate, aggregate
from arena_newton.files.text import plain_text
from arena_newton.robot.g1 import TICK

__all__ = [
    "OWN_FOLDER",
    "Results",
    "RunRecord",
    "changed_conditions",
    "check_whole_plan",
    "due_episodes",
    "in_plan_order",
    "is_complete",
    "load_run",
    "own_records",
    "results_json",
    "width_rule",
]

OWN_FOLDER = "own"
"""Folder inside a swapped run's: its actions through its policy's own tracker."""


@dataclass(frozen=True)
class RunRecord:
    """Contents of a results folder."""

    folder: Path
    document: Document
    """Content of config.json."""
    records: list[EpisodeRecord]
    """Finished episodes in plan order; of an episode that was run twice the last."""

    @property
    def config(self) -> Identity:
        """The run's identity."""
        return self.document["config"]

    @property
    def status(self) -> Status | None:
        """Ending of the last run or resume; None in a folder of a version without status."""
        return self.document.get("status")


class Results(Aggregate):
    """Content of results.json."""

    config_hash: str
    config: Identity
    planned: int
    """Episodes of the plan, or of its part that the folder is of."""
    finished: int
    complete: bool
    head: NotRequired[str]
    """Head of the journal's chain (`records.chain`); absent where a line is of a version without chain."""
    shard: NotRequired[str]
    """Part of the plan, such as `3/16`; absent where the folder is of all."""
    failures: NotRequired[list[FailureCell]]
    """Failures by stage; absent where no episode has signals (`eval run --failures`)."""
    status: NotRequired[str]
    """State of `document.Status`; absent in a folder of a version without status."""


def in_plan_order(records: Sequence[EpisodeRecord]) -> list[EpisodeRecord]:
    """Records by plan order; of two with the same index the later one in the journal counts."""
    latest = {record.index: record for record in records}
    return [latest[index] for index in sorted(latest)]


def load_run(folder: Path) -> RunRecord:
    """Read a results folder.

    Raises:
        InputError: It holds no run, or one that was changed by hand.
    """
    document = read_document(folder)
    records, _ = read_journal(folder / JOURNAL_FILE)
    check_plan(folder, records, document)
    return RunRecord(folder, document, in_plan_order(records))


def own_records(folder: Path) -> list[EpisodeRecord]:
    """Replays of a run's actions through its policy's own tracker (`own_tracker`); none where none were played.

    Raises:
        InputError: Their folder is damaged.
    """
    inside = folder / OWN_FOLDER
    if inside.is_symlink() or not (inside / CONFIG_FILE).is_file():
        return []
    return load_run(inside).records


def due_episodes(document: Document) -> int:
    """Episodes that a folder is to have: those of its plan, or of its shard."""
    shard = read_shard(document.get("shard", ""))
    return document["planned"] if shard is None else shard.size(document["planned"])


def check_whole_plan(run: RunRecord) -> None:
    """Refuse a shard, whose episodes are a part of a result.

    Raises:
        InputError: The folder is one.
    """
    shard = run.document.get("shard")
    if shard is not None:
        raise InputError(f"{run.folder}: is shard {shard} of a run; name the folder into which eval merge joins all")


def changed_conditions(run: RunRecord) -> list[str]:
    """Reasons for which a run is no result of the benchmark, in sentences: cut step budgets, a variant of the scene."""
    found, cap = [], run.config.get("max_steps")
    if cap is not None:
        found.append(f"--max-steps cut the step budgets to {cap} ticks ({cap * TICK:g} s): no benchmark result.")
    if run.config.get("variant") is not None:
        name = plain_text(run.document["options"].get("variant") or run.config["variant"], 200)
        found.append(f"The scene is the variant {name}: no benchmark result.")
    return found


def is_complete(run: RunRecord) -> bool:
    """True if every planned episode is finished, or as many successes are recorded as were wanted."""
    planned, keep = run.document["planned"], run.config.get("keep")
    rule = width_rule(run.config)
    if keep is None and rule is None:
        return len(run.records) == due_episodes(run.document)
    groups = planned // (run.config["repeats"] * len(run.config["seeds"]))
    return rounds.complete(planned, groups, {record.index: record.outcome for record in run.records}, keep, rule)


def width_rule(config: Identity) -> rounds.WidthRule | None:
    """The rule by which a task, tracker and mode of a stored run had enough episodes; None where it had all."""
    if "until_width" not in config:
        return None
    return rounds.WidthRule(config["until_width"], config["max"], len(config["seeds"]))


def results_json(run: RunRecord) -> Results:
    """Content of results.json."""
    figures = aggregate(run.records)
    results: Results = {
        "config_hash": run.document["config_hash"],
        "config": run.config,
        "planned": due_episodes(run.document),
        "finished": len(run.records),
        "complete": is_complete(run),
        "cells": figures["cells"],
        "suites": figures["suites"],
    }
    failures = failure_cells(run.records, own_records(run.folder))
    if failures:
        results["failures"] = failures
    chained = head(run.records)
    if chained is not None:
        results["head"] = chained
    if "shard" in run.document:
        results["shard"] = run.document["shard"]
    if run.status is not None:
        results["status"] = run.status["state"]
    return results
