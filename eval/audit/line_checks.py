"""Contradictions within a journal and its configuration, without the simulator.

What `document.plan_faults` finds stops every command that reads a folder. What is found here besides stops none: it is
of a line's details, of hashes and of files next to the journal.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from arena_newton import __version__, rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, is_complete
from arena_newton.eval.folders.run_folder import actions_folder, comparable
from arena_newton.eval.records.document import CONFIG_FILE, Document, step_budgets, trackers_of
from arena_newton.eval.records.identity import config_hash, moving_versions
from arena_newton.eval.records.journal import BY_CONTENT, CHAINED, EVIDENCE, JOURNAL_FILE, EpisodeRecord
from arena_newton.files.stored_json import JsonObject, read_regular, shown
from arena_newton.files.untrusted_files import array_digest, read_arrays
from arena_newton.robot.g1 import TICK

__all__ = ["action_faults", "configuration_faults", "is_current", "line_faults"]

MAX_ACTIONS_BYTES = 64 << 20
"""Largest file of one episode's actions; one of 2,000 ticks has 0.1 MB."""
FLAGS = "task mode tracker rules seeds repeats max_steps engine fast_physics drive".split()
FLAGS += "replan ensemble latency_ticks until_width max".split()
"""Flags of a run that its identity names too: the latter is in tables, by the former it is played again."""
ROUNDING = 1e-6
"""Durations are written with so many seconds' precision."""


def is_current(run: RunRecord) -> bool:
    """True if this version wrote all lines, so that its texts are those that it would write."""
    return run.config.get("version") == __version__ and all(record.schema >= CHAINED for record in run.records)


def configuration_faults(run: RunRecord) -> Iterator[str]:
    """Contradictions of config.json with itself, with the rule set of its name, and with the number of lines."""
    document, config, path = run.document, run.config, run.folder / CONFIG_FILE
    if config_hash(config) != document["config_hash"]:
        yield f"{path}: config_hash is {document['config_hash']}, its config gives {config_hash(config)}"
    for task, gym_id in document["gym_ids"].items():
        if gym_id != tasks.get(task).gym_id:
            yield f"{path}: gym_ids: {task} is {shown(gym_id)}, expected {tasks.get(task).gym_id}"
    if (
        is_current(run)
        and step_budgets(config)
        and document["rule_set"] != dict(rule_sets.table(rule_sets.get(config["rules"], config["task"])))
    ):
        yield f"{path}: rule_set is not what the rule set {config['rules']} of this hash says"
    options: Mapping[str, object] = document["options"] if is_current(run) else {}
    for name in FLAGS:
        if name in options and (options[name] or None) != ((named := config.get(name)) or None):
            yield f"{path}: config: {name} is {shown(named)}, its options have {shown(options[name])}"
    if "policy" in options and _scheme(options["policy"]) != _scheme(config["policy"]):
        yield f"{path}: config: policy is {shown(config['policy'])}, its options have {shown(options['policy'])}"
    if "variant" in options and (options["variant"] is None) != (config.get("variant") is None):
        yield f"{path}: config: variant is {shown(config.get('variant'))}, its options have {shown(options['variant'])}"
    if run.status is not None and run.status["state"] == "success" and not is_complete(run):
        yield f"{path}: status is success, but {len(run.records)} episodes do not complete the plan"


def _scheme(policy: object) -> str:
    """Kind of a policy, such as `lerobot`; the path after it is shortened in an identity."""
    return str(policy).partition(":")[0]


def line_faults(run: RunRecord, records: Sequence[EpisodeRecord]) -> Iterator[str]:
    """Contradictions of single lines with themselves, with the task's predicates and with the configuration's hashes.

    Args:
        run: The run.
        records: All lines of its journal.
    """
    known, hashes = step_budgets(run.config), _hashes(run.document)
    watched = is_current(run) and run.document["options"].get("failures") is True
    for record in records:
        where = f"{run.folder / JOURNAL_FILE}: episode {record.index}"
        named = hashes | {"checkpoint": [_checkpoint(run.document, record.tracker)]}
        group = f"{record.task} {record.tracker} {record.mode}"
        facts = run.document.get("environments", {}).get(group)
        if facts is not None or is_current(run):  # the oldest name environments otherwise
            named["environment"] = [None if facts is None else config_hash(comparable(facts))]
        for name, wanted in named.items():
            if name in record.hashes and record.hashes[name] not in wanted:
                expected = " or ".join(map(shown, wanted))
                yield f"{where}: hash of {name} is {shown(record.hashes[name])}, {CONFIG_FILE} gives {expected}"
        details = [*_ending(record, facts), *_ticks(record)]
        if record.schema > 1 and record.task in known and record.outcome != "error":
            details += _predicates(record)
        if record.extra and not (run.document["options"].get("recorder") or (facts or {}).get("recorders")):
            details.append(f"has metrics ({' '.join(record.extra)}), and the run no recorder")
        if watched and record.signals is None and record.steps:
            details.append("has no signals of its failure, which the run kept")
        for text in details:
            yield f"{where}: {text}"


def _hashes(document: Document) -> dict[str, list[str | None]]:
    """Hashes that a line may have, by name, except those of its tracker and environment."""
    config = document["config"]
    sets = [document.get("versions", {}), *document.get("later_versions", ())]
    found: dict[str, list[str | None]] = {"versions": [config_hash(moving_versions(one)) for one in sets]}
    found |= {"rules": [config["rules_hash"]]} if "rules_hash" in config else {}
    found |= {"policy": [config["policy_file"]]} if "policy_file" in config else {}
    return found | ({"variant": [config["variant"]]} if "variant" in config else {})


def _checkpoint(document: Document, tracker: str) -> str | None:
    stored = document["config"].get("checkpoint")
    return stored.get(tracker) if isinstance(stored, dict) else stored


def _ending(record: EpisodeRecord, facts: JsonObject | None) -> Iterator[str]:
    """Contradictions between outcome, reason and duration."""
    outcome, reason = record.outcome, record.reason
    if (outcome == "error") != (record.error is not None):
        yield f"outcome {outcome} {'without' if outcome == 'error' else 'with'} an error's message"
    reasons = {"success": ("success",), "fall": ("fall", "startup_fall")}
    reasons["timeout"] = ("timeout", *tasks.get(record.task).events.values())
    if outcome in reasons and reason not in reasons[outcome]:
        yield f"outcome {outcome} with the reason {shown(reason)}"
    if record.startup_fall != (reason == "startup_fall") or (record.startup_fall and record.steps):
        yield f"startup_fall is {shown(record.startup_fall)} with reason {shown(reason)} after {record.steps} steps"
    objects = [event.detail for event in record.events if event.kind == "object_out"]
    out = [*objects, *(f"{name}_out" for name in objects)]
    if record.schema > 1 and outcome == "timeout" and reason not in ("timeout", *out):
        yield f"reason {shown(reason)} without its event"
    startup, played = (facts or {}).get("startup_ticks"), (record.durations or {}).get("sim_s")
    if outcome != "error" and record.steps and isinstance(startup, int) and played is not None:
        expected = (record.steps + startup) * TICK
        if abs(played - expected) > ROUNDING:
            yield f"sim_s is {played:g}, {record.steps} steps and {startup} ticks of start-up last {expected:g}"


def _ticks(record: EpisodeRecord) -> Iterator[str]:
    """Ticks after the episode's end, or out of order."""
    for name, ticks in (
        ("phases", [tick for _, tick in record.phases]),
        ("events", [event.tick for event in record.events]),
        ("predicates", sorted(tick for tick in record.predicates.values() if tick is not None)),
    ):
        if ticks != sorted(ticks) or (ticks and ticks[-1] > record.steps):
            yield f"{name} are at {' '.join(map(str, ticks))}, out of order or after the end at step {record.steps}"
    signals = record.signals
    if signals is None:
        return
    if signals.looks_seen > signals.looks or signals.engaged_ticks > record.steps + 1:
        yield f"signals of {signals.looks_seen} of {signals.looks} looks and {signals.engaged_ticks} engaged ticks"


def _predicates(record: EpisodeRecord) -> Iterator[str]:
    """Contradictions of predicates with the task's, and of progress with predicates."""
    names = [predicate.name for predicate in tasks.get(record.task).predicates]
    if list(record.predicates) != names:
        yield f"predicates are {' '.join(record.predicates) or 'absent'}, the task's are {' '.join(names)}"
        return
    ticks = list(record.predicates.values())
    whole = record.outcome == "success" or ticks[-1] is not None
    expected = 1.0 if whole else sum(tick is not None for tick in ticks) / len(ticks)
    if record.progress != expected:
        yield f"progress is {shown(record.progress)}, its predicates give {expected:g}"


def action_faults(run: RunRecord, records: Sequence[EpisodeRecord], lacking: list[int]) -> Iterator[str]:
    """Contradictions between lines and the files of their actions.

    Args:
        run: The run.
        records: Its episodes.
        lacking: Gets the numbers of the episodes whose actions are not there.
    """
    several = trackers_of(run.config) or []
    kept = run.document["options"].get("actions") is True
    for record in records:
        where = f"{run.folder / JOURNAL_FILE}: episode {record.index}"
        if record.actions is None:
            if kept and record.schema >= CHAINED and record.steps:
                yield f"{where}: has no hash of its actions, which the run kept"
            lacking += [record.index] * bool(record.steps)  # of an error or fall before step 0 there are none
            continue
        name = f"{record.task}_{record.mode}_s{record.group_seed}_r{record.repeat}.npz"
        path = f"{actions_folder(several, record.tracker)}/{name}"
        if (named := (record.media or {}).get("actions")) != path:
            yield f"{where}: its actions are {shown(named)}, expected {path}"
            lacking.append(record.index)
            continue
        try:
            data = read_regular(run.folder / path, MAX_ACTIONS_BYTES)
        except FileNotFoundError:
            lacking.append(record.index)
            continue
        try:
            arrays = read_arrays(run.folder / path, content=data)
        except InputError as error:
            yield str(error)
            continue
        digest = array_digest(arrays) if record.schema >= BY_CONTENT else hashlib.sha256(data).hexdigest()
        if digest != record.actions:
            yield f"{run.folder / path}: are not the actions whose hash episode {record.index} names"
        if (seed := _seed_of(arrays)) != record.episode_seed:
            yield f"{run.folder / path}: is of seed {seed}, episode {record.index} has {record.episode_seed}"
        if record.schema >= BY_CONTENT and (gone := [name for name in EVIDENCE if getattr(record, name) is None]):
            yield f"{where}: {' and '.join(gone)} are absent, which the run kept"


def _seed_of(arrays: Mapping[str, np.ndarray]) -> int | None:
    """Episode seed that a file of actions names, by which a replay knows it; None where it names none."""
    try:
        return int(arrays["episode_seed"])
    except (KeyError, TypeError, ValueError):
        return None
