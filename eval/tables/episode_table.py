"""Episodes of results folders and suites with their conditions, read once for `report`, `tables` and `compare`.

A row is a cell: all episodes of one policy, tracker, task and mode that were played under one set of conditions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, check_whole_plan, is_complete, load_run
from arena_newton.eval.records.chain import head, joint_head
from arena_newton.eval.records.document import CONFIG_FILE, SUITE_FILE
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.eval.suites.suite_records import SuiteCell, SuitePlan, load_cell, read_suite
from arena_newton.files.stored_json import Json
from arena_newton.files.text import counted, plain, plain_text
from arena_newton.rules import seeding

__all__ = [
    "NAMED",
    "EvaluatedCell",
    "PlayedCell",
    "cells_of",
    "check_alike",
    "code_notes",
    "error_note",
    "head_notes",
    "incomplete_note",
    "read_folder",
    "runs_of",
]

ALIKE = ("rules", "max_steps", "variant")
"""Conditions under which runs must agree: one table must not mix judges, budgets or scenes."""
NAMED = ("engine", "device", "drive", "fast_physics")
"""Conditions that may differ; every value is named."""
UNTRAINED = ("expert", "stand", "replay")
"""Policies without training: no tracker is the one of theirs."""


@dataclass(frozen=True, kw_only=True)
class EvaluatedCell:
    """Episodes of one policy through one tracker on one task under one set of conditions."""

    policy: str
    """Name of its row in tables; `act#2` is the second training of recipe `act`, whose first is `act` or `act#1`."""
    family: str
    """`act`, `diffusion`, `flow`, `pi05`, or another; empty where nothing is known."""
    trained_on: tuple[str, ...]
    """Trackers through which the demonstrations of its training were recorded; none for a policy without training."""
    trained_tasks: tuple[str, ...]
    """Tasks of its training."""
    tracker: str
    """The tracker that executed its actions."""
    task: str
    mode: str
    labels: str
    latency: int
    """Ticks by which each chunk started late."""
    replan: int | None
    """Actions of a chunk that were executed before the next query; None: all."""
    ensemble: bool
    records: tuple[EpisodeRecord, ...]
    """Its episodes in plan order."""
    folder: Path
    wall_s: float | None = None
    """Time that its evaluation took [s], where a suite measured it."""
    device: str = ""
    """Device on which it was played, such as `NVIDIA H200`."""
    weights: str = ""
    """Hash of the policy's weights, where it says one."""
    training_minutes: float | None = None
    """Time that the training of these weights took [min], where the policy says it."""
    tallied: Mapping[str, Mapping[Hashable, bool]] | None = None
    """Outcomes made of counts, where a file has these alone: outcome -> whether each episode ended so."""

    @property
    def recipe(self) -> str:
        """The policy without the number of the training: trainings of one recipe differ by chance alone."""
        return self.policy.partition("#")[0]

    @property
    def training(self) -> tuple[Hashable, ...]:
        """Key of the network, shared by all of its cells and no others; its first part is the policy."""
        return (self.policy, self.trained_on, "" if self.merged else self.task)

    @property
    def merged(self) -> bool:
        """True if the policy was trained on several tasks or through several trackers at once."""
        return len(self.trained_tasks) > 1 or len(self.trained_on) > 1

    @property
    def matched(self) -> bool:
        """True if the tracker of its training executed it, or it needs none."""
        return self.trained_on in ((), (self.tracker,))

    def held(self, outcome: str = "success") -> dict[Hashable, bool]:
        """True for each episode that ended so, by group seed and repeat; a task and these two decide its start."""
        if self.tallied is not None:
            return dict(self.tallied[outcome])
        return {(record.group_seed, record.repeat): record.outcome == outcome for record in self.records}


@dataclass(frozen=True, kw_only=True)
class PlayedCell(EvaluatedCell):
    """A cell with the results folder that its episodes are of."""

    run: RunRecord
    planned: SuiteCell | None = None
    """The cell of its suite, where it is of one."""


def read_folder(folder: Path, notes: list[str]) -> tuple[SuitePlan | None, list[PlayedCell]]:
    """Finished cells of a suite, or the cells of a results folder; `notes` get what is missing in them.

    Raises:
        InputError: The folder holds neither or is damaged, recordings for training, or a shard.
    """
    if not (folder / SUITE_FILE).is_file():
        whole = load_run(folder)
        _check_evaluation(whole)
        check_whole_plan(whole)
        notes += incomplete_note(whole)
        return None, cells_of(whole)
    suite, found, waiting, begin = read_suite(folder), [], 0, len(notes)
    for cell in suite.cells:
        if cell.status == "failed":
            notes.append(f"{folder / cell.folder}: failed ({plain_text(cell.error or 'no reason', 200)}).")
        # A cell that is beginning has a folder before it has a configuration.
        run = load_cell(suite, cell) if (folder / cell.folder / CONFIG_FILE).exists() else None
        if run is None or not run.records:
            waiting += cell.status != "failed"
        elif is_complete(run):
            _check_evaluation(run)
            found.append(_suite_cell(cell, run))
        else:
            # Successes end before timeouts do: the first episodes of a cell are no fair sample of it.
            played, planned = len(run.records), run.document["planned"]
            notes.append(f"{run.folder} is incomplete, and left out: {played} of {planned} episodes.")
    if waiting:
        notes.insert(begin, f"{folder}: {counted(waiting, 'cell')} of {len(suite.cells)} not played yet.")
    return suite, found


def _check_evaluation(run: RunRecord) -> None:
    if run.config.get("seed_range", seeding.EVALUATION) != seeding.EVALUATION:
        raise InputError(f"{run.folder}: holds recordings for training; results are of evaluations")


def incomplete_note(run: RunRecord) -> list[str]:
    """A sentence of a run that has not all of its episodes."""
    played, planned = len(run.records), run.document["planned"]
    return [] if is_complete(run) else [f"{run.folder} is incomplete: {played} of {planned} episodes."]


def cells_of(run: RunRecord) -> list[PlayedCell]:
    """Cells of a results folder that is of no suite, with what the policy declares."""
    config: Mapping[str, Json] = run.config
    facts = _facts(config.get("policy_facts"))
    family, replan = _text(facts.get("family")), config.get("replan")
    groups: dict[tuple[str, str, str, str], list[EpisodeRecord]] = {}
    for record in run.records:
        groups.setdefault((record.task, record.tracker, record.shown_policy, record.mode), []).append(record)
    return [
        PlayedCell(
            policy=" ".join(filter(None, (family, _text(facts.get("recipe"))))) or policy,
            family=family or (scheme if scheme in UNTRAINED else ""),
            trained_on=tuple(sorted(_texts(facts.get("trackers")), key=_tracker_order)),
            trained_tasks=_texts(facts.get("tasks")),
            tracker=tracker,
            task=task,
            mode=mode,
            labels=_text(facts.get("labels")) or _text(config.get("labels")) or "v3.1",
            latency=_number(config.get("latency_ticks")),
            replan=replan if type(replan) is int else None,
            ensemble=config.get("ensemble") is True,
            records=tuple(records),
            folder=run.folder,
            weights=_text(facts.get("weights")),
            training_minutes=_minutes(facts.get("minutes")),
            run=run,
        )
        for (task, tracker, policy, mode), records in groups.items()
        for scheme in (records[0].policy.partition(":")[0],)
    ]


def _suite_cell(cell: SuiteCell, run: RunRecord) -> PlayedCell:
    """Cell of a suite: its name there, and of its training what the run itself does not say."""
    own = cells_of(run)[0]
    known = bool(own.trained_on) or own.family in UNTRAINED
    return dataclasses.replace(
        own,
        policy=dataclasses.replace(run.records[0], policy=cell.policy).shown_policy,
        family=own.family or cell.family,
        trained_on=own.trained_on if known else tuple(sorted(cell.trained_on, key=_tracker_order)),
        trained_tasks=own.trained_tasks if known else cell.trained_tasks,
        records=tuple(run.records),
        wall_s=cell.wall_s,
        device=cell.device,
        planned=cell,
    )


def _tracker_order(name: str) -> tuple[bool, str]:
    """The paper's trackers in its order: TWIST2 comes first."""
    return name != "twist2", name


def _facts(given: Json) -> Mapping[str, Json]:
    """Facts of a checkpoint in those of its policy: on top of them, or as its `facts`."""
    if not isinstance(given, dict):
        return {}
    inner = given.get("facts")
    return given | inner if isinstance(inner, dict) else given


def _text(value: Json) -> str:
    return plain_text(value, 80) if isinstance(value, str) else ""


def _texts(value: Json) -> tuple[str, ...]:
    return tuple(_text(one) for one in value if isinstance(one, str)) if isinstance(value, list) else ()


def _number(value: Json) -> int:
    return value if type(value) is int and value >= 0 else 0


def _minutes(value: Json) -> float | None:
    usable = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < 1e7
    return float(value) if usable else None


def runs_of(cells: Iterable[PlayedCell]) -> list[RunRecord]:
    """Results folders of cells, each once."""
    return list({id(cell.run): cell.run for cell in cells}.values())


def check_alike(runs: Sequence[RunRecord]) -> dict[str, str]:
    """Refuse runs that one table must not mix, and return the hash of the weights of each tracker that has some.

    Raises:
        InputError: Runs differ in a condition of `ALIKE`, or in the weights of a tracker; the message names both.
    """
    weights: dict[str, tuple[str, Path]] = {}
    for run in runs:
        for name in ALIKE:
            was, now = runs[0].config.get(name), run.config.get(name)
            if was != now:
                raise InputError(f"{run.folder}: {name} is {plain(now)}, in {runs[0].folder} {plain(was)}")
        for record in run.records:
            now = record.hashes.get("checkpoint")
            if now is not None and (first := weights.setdefault(record.tracker, (now, run.folder)))[0] != now:
                name = f"weights of {plain(record.tracker)}"
                raise InputError(f"{run.folder}: {name} are {plain(now)}, in {first[1]} {plain(first[0])}")
    return {tracker: now for tracker, (now, _) in weights.items()}


def head_notes(runs: Sequence[RunRecord]) -> list[str]:
    """A sentence with the head of the journals, which binds the table to their episodes; none where one has no head."""
    found = joint_head([head(run.records) for run in runs])
    return [] if found is None else [f"Head of {counted(len(runs), 'journal')}: {found}."]


def code_notes(runs: Iterable[RunRecord]) -> list[str]:
    """A sentence where the runs were made with several versions of the code."""
    codes = {run.config.get("code") for run in runs}
    return [f"The runs were made with {len(codes)} versions of the code."] if len(codes) > 1 else []


def error_note(cells: Iterable[EvaluatedCell]) -> str:
    """Number of episodes that ended with an error, in a sentence; empty without one."""
    outcomes = [record.outcome for cell in cells for record in cell.records]
    errors = outcomes.count("error")
    text = f"{counted(errors, 'episode')} of {len(outcomes)} ended with an error; they count as no success."
    return text if errors else ""
