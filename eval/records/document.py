"""config.json of a results folder: what a run is known by, how it ended, and what its journal must agree with."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal, TypedDict

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.eval.records.journal import JOURNAL_FILE, ContradictionError, EpisodeRecord, contradiction
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES, MAX_EPISODES, Count, Positive, Seed
from arena_newton.eval.records.sharding import dealt, read_shard
from arena_newton.files.stored_json import Facts, Fit, Json, JsonObject, Name, fit, is_name, parse, read_regular, shown
from arena_newton.rules import seeding

__all__ = [
    "CONFIG_FILE",
    "Document",
    "Identity",
    "PlanKey",
    "SUITE_FILE",
    "Status",
    "check_plan",
    "plan_faults",
    "plan_numbers",
    "read_document",
    "step_budgets",
    "trackers_of",
]

CONFIG_FILE = "config.json"
SUITE_FILE = "suite.json"
"""The file by which the folder of a suite is known."""


SEED_RANGES = (seeding.EVALUATION, seeding.DEMONSTRATION)
"""Ranges of seeds that runs play."""


def _distinct(values: list[Json]) -> bool:
    return bool(values) and len(set(values)) == len(values)


def _distinct_names(value: list[Json] | str) -> bool:
    return isinstance(value, str) or _distinct(value)


ConfigHash = Annotated[str, Fit("12 hex digits", lambda value: bool(re.fullmatch("[0-9a-f]{12}", value)))]
Hash = Annotated[str | None, Fit("a hash or null", lambda value: value is None or is_name(value))]
FactsOrNone = Annotated[Facts | None, Fit("facts by name or null")]
Versions = Annotated[dict[Name, Name | None], Fit("versions by library")]


class _Identity(TypedDict):
    rules: Name
    seeds: Annotated[list[Seed], Fit("distinct numbers", _distinct)]
    repeats: Positive
    max_steps: Annotated[Positive | None, Fit("a number of ticks or null")]


class Identity(_Identity, total=False):
    """Identity of the results, by flag name; only the first four were in every version's config.json."""

    version: Name
    task: Annotated[list[Name], Fit("names of tasks", _distinct)]
    mode: Annotated[list[Name], Fit("names of modes", _distinct)]
    tracker: Annotated[list[Name] | Name, Fit("names of trackers", _distinct_names)]
    """One name in a folder of an earlier version."""
    checkpoint: Annotated[dict[Name, Hash] | Hash, Fit("hashes by tracker")]
    """The hash alone in a folder of an earlier version."""
    policy: Name
    policy_file: Hash
    labels: Name
    replan: Positive
    """Absent, as the next two, where chunks are executed as usual."""
    ensemble: bool
    latency_ticks: Positive
    until_width: Annotated[float, Fit("a number from 0 to 1", lambda value: 0 < value < 1)]
    """Width of the interval at which a task, tracker and mode has enough episodes, with `max`. Absent without rule."""
    max: Positive
    worlds: Annotated[float | None, Fit("a number or null")]
    rules_hash: Name
    engine: Name
    device: Name
    variant: Hash
    fast_physics: bool
    drive: Name
    scenes: Annotated[str, Fit("a hash")]
    code: Annotated[str, Fit("a hash")]
    mode_facts: Annotated[dict[Name, Facts], Fit("facts by mode")]
    """Hashes of the modes whose ranges are not the rule set's; absent where there is none."""
    foreign_tasks: Annotated[dict[Name, Facts], Fit("facts by task")]
    """Hashes of the tasks that another package brings; absent where there is none."""
    tracker_facts: FactsOrNone
    policy_facts: FactsOrNone
    seed_range: Annotated[str, Fit("a range of seeds", lambda value: value in SEED_RANGES)]
    """Absent in an evaluation."""
    disturbance: FactsOrNone
    """Disturbance of the execution of recorded episodes."""
    keep: Annotated[Positive | None, Fit("a number or null")]
    """Successes to record of each task, tracker and mode."""


class Status(TypedDict):
    """Ending of the last `run` or `resume` in its folder."""

    state: Literal["started", "success", "cancelled", "error", "partial"]
    """`started`: is running, or was killed; `success`: every planned episode is in the journal; `partial`: was joined
    from shards of which some were missing or unfinished."""
    started_at: str
    """ISO 8601, UTC."""
    finished_at: str | None
    error: str | None
    """Message of an `error`."""


class _Document(TypedDict):
    config_hash: ConfigHash
    config: Annotated[Identity, Fit("an object")]
    rule_set: Annotated[dict[Name, str], Fit("texts by item")]
    gym_ids: Annotated[dict[Name, Name], Fit("Gym ids by task")]
    options: Annotated[dict[str, Json], Fit("an object")]
    planned: Annotated[Count, Fit("a number of episodes")]


class Document(_Document, total=False):
    """Content of config.json."""

    versions: Versions
    environments: Annotated[dict[Name, Facts], Fit("facts by task, tracker and mode")]
    """Each environment's own description, by task, tracker and mode."""
    variant_changes: Annotated[list[str], Fit("sentences")]
    later_versions: Annotated[list[Versions], Fit("versions by library")]
    """Versions of the libraries that a later `resume --accept-versions` ran with."""
    shard: Annotated[str, Fit("a shard such as 3/16", lambda value: read_shard(value) is not None)]
    """Part of the plan that the folder is of; absent where it is of all."""
    status: Annotated[Status, Fit("state, times and error of the run")]


def read_document(folder: Path) -> Document:
    """Read a results folder's config.json.

    Raises:
        InputError: The folder holds no run, or its config.json is not the configuration of one.
    """
    path = folder / CONFIG_FILE
    where = f"{path}: cannot be read as the configuration of a run"
    try:
        document = parse(read_regular(path, MAX_CONFIG_BYTES))
    except FileNotFoundError:
        raise InputError(f"{folder}: no results folder (it has no {CONFIG_FILE})") from None
    except ValueError:
        raise InputError(where) from None
    if not isinstance(document, dict):
        raise InputError(where)
    if isinstance(config := document.get("config"), dict):
        fit(f"{where}: config", config, Identity)
        for key, value in config.items():
            if not is_name(key) or (isinstance(value, str) and not is_name(value)):
                raise InputError(f"{where}: config: {shown(key)} is {shown(value)}, expected plain text")
    fit(where, document, Document)
    for task in document["gym_ids"]:
        if task not in tasks.names():
            known = f"this package and those installed beside it have {' '.join(tasks.names())}"
            raise InputError(f"{path}: gym_ids: task {shown(task)} is unknown, {known}")
    return document  # type: ignore[return-value]  # what `fit` has tested


PlanKey = tuple[str, str, str, int, int]
"""Task, tracker, mode, group seed, repeat."""
_PARTS: tuple[Literal["policy", "rules", "engine"], ...] = ("policy", "rules", "engine")


def trackers_of(config: Identity) -> list[str] | None:
    """Names of a run's trackers; None where its configuration names none."""
    named = config.get("tracker")
    return [named] if isinstance(named, str) else named


def check_plan(folder: Path, records: Iterable[EpisodeRecord], document: Document) -> None:
    """Hold a journal to its configuration, as `plan_faults` does.

    Raises:
        InputError: A record belongs to another plan or another run, or contradicts itself.
    """
    for fault in plan_faults(folder, records, document):
        raise fault


def plan_faults(folder: Path, records: Iterable[EpisodeRecord], document: Document) -> Iterator[InputError]:
    """Faults of a journal, held to its configuration.

    No episode that the plan lacks or that another run played, none twice under two numbers, and none again that had
    ended as something else than an error; seeds and step budgets are the plan's, and no line contradicts itself.

    Raises:
        InputError: The plan is too large, or its shard is not one of it.
    """
    config = document["config"]
    by_hand = "the journal was changed by hand"
    numbers: dict[PlanKey, int] = {}
    ended: dict[int, EpisodeRecord] = {}
    budgets, plan = step_budgets(config), plan_numbers(folder / CONFIG_FILE, config)
    if plan and document["planned"] != len(plan):
        count = f"planned is {document['planned']}, the plan has {len(plan)}"
        yield InputError(f"{folder / CONFIG_FILE}: {count}; it was changed by hand")
    ours = _dealt_numbers(folder / CONFIG_FILE, document, plan)
    run: JsonObject = {key: config[key] for key in _PARTS if key in config}
    named = trackers_of(config)
    kind = config.get("seed_range") or seeding.EVALUATION
    privileged = bool((config.get("policy_facts") or {}).get("privileged"))
    for record in records:
        key = (record.task, record.tracker, record.mode, record.group_seed, record.repeat)
        words = f"{record.task} {record.mode} seed {record.group_seed} repeat {record.repeat}"
        name = f"{folder / JOURNAL_FILE}: episode {record.index} ({words})"
        if (
            record.index >= document["planned"]
            or record.task not in document["gym_ids"]
            or record.group_seed not in config["seeds"]
            or record.repeat >= config["repeats"]
            or ("mode" in config and record.mode not in config["mode"])
        ):
            yield InputError(f"{name}: is not in the plan of {CONFIG_FILE}; {by_hand}")
            continue
        if ours is not None and record.index not in ours:
            yield InputError(f"{name}: is not in shard {document['shard']}; {by_hand}")
        if numbers.setdefault(key, record.index) != record.index:
            yield InputError(f"{name}: is in the journal as episode {numbers[key]} too")
        seed = seeding.planned_seed(document["gym_ids"][record.task], kind, record.group_seed, record.repeat)
        planned = run | {"episode_seed": seed, "object_seed": seeding.object_seed(seed), "privileged": privileged}
        if named is not None and record.tracker not in named:
            planned["tracker"] = " or ".join(named)
        if record.task in budgets:
            planned["max_steps"] = budgets[record.task]
        if key in plan:
            planned["index"] = plan[key]
        recorded = {field: getattr(record, field) for field in planned} | {"config hash": record.hashes.get("config")}
        for field, wanted in (planned | {"config hash": document["config_hash"]}).items():
            if recorded[field] != wanted:
                yield InputError(
                    f"{name}: {field} is {shown(recorded[field])}, this run's is {shown(wanted)}; {by_hand}"
                )
        if record.steps > record.max_steps:
            yield InputError(f"{name}: {record.steps} steps of at most {record.max_steps}; {by_hand}")
        before = ended.get(record.index)
        if before is not None and before.outcome != "error" and not _recorded_again(before, record):
            yield InputError(f"{name}: is in the journal again after it had ended ({before.outcome}); {by_hand}")
        if (text := contradiction(record)) is not None:
            yield ContradictionError(f"{name}: {text}; {by_hand}, or wrong when it was written")
        ended[record.index] = record


def _recorded_again(before: EpisodeRecord, record: EpisodeRecord) -> bool:
    """True if an episode was played again because its recording was missing: it ended as before."""
    same = all(getattr(before, key) == getattr(record, key) for key in ("outcome", "reason", "steps"))
    return same and "episode" in (record.media or {})


def step_budgets(config: Identity) -> dict[str, int]:
    """Step budgets by task; empty where the run's rule set is not known here."""
    names = config.get("task", [])
    if config["rules"] not in rule_sets.names() or not set(names) <= set(tasks.names()):
        return {}
    rule_set = rule_sets.get(config["rules"])
    if config.get("rules_hash") != rule_set.hash_for(tuple(names)):
        return {}
    cap = config["max_steps"]
    budgets = {name: tasks.get(name).max_steps(rule_set) for name in names}
    return {name: budget if cap is None else min(budget, cap) for name, budget in budgets.items()}


def _dealt_numbers(path: Path, document: Document, plan: Mapping[PlanKey, int]) -> frozenset[int] | None:
    """Numbers of the episodes of a folder's shard; None where it is of the whole plan."""
    shard = read_shard(document.get("shard", ""))
    if shard is None:
        return None
    if shard.count > len(plan):
        raise InputError(f"{path}: shard {shard} of a plan of {len(plan):,} episodes; it was changed by hand")
    return frozenset(dealt(list(plan), shard))


def plan_numbers(path: Path, config: Identity) -> dict[PlanKey, int]:
    """Numbers of the plan's episodes by task, tracker, mode, group seed and repeat; empty where they are not known.

    Raises:
        InputError: There are more than a run may have; the message begins with `path`.
    """
    named = trackers_of(config)
    if "task" not in config or "mode" not in config or named is None:
        return {}
    parts = (config["task"], named, config["mode"], config["seeds"], range(config["repeats"]))
    if math.prod(len(part) for part in parts) > MAX_EPISODES:
        raise InputError(f"{path}: plans more than {MAX_EPISODES:,} episodes")
    return {key: number for number, key in enumerate(itertools.product(*parts))}
