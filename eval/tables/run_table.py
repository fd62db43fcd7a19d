"""One table of several runs: successes per task and tracker, a column per mode, as the README shows them."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, changed_conditions, due_episodes, is_complete
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.eval.statistics.stats import wilson
from arena_newton.eval.tables.table_entries import SEMANTIC_STRENGTH, semantic_text
from arena_newton.files.text import counted, plain
from arena_newton.files.text_tables import Table, between
from arena_newton.rules.rule_types import MODES

__all__ = ["joint_table"]

ALL = "all"
"""Name of the rows over all tasks."""
ALIKE = ("rules", "max_steps", "variant")
"""Conditions under which runs must agree: one table must not mix judges, budgets or scenes."""
NAMED = ("engine", "device", "drive", "fast_physics")
"""Conditions that may differ; every value is named under the table."""


def joint_table(runs: Sequence[RunRecord]) -> str:
    """Markdown of successes with 95 % Wilson intervals per task, tracker and mode, and what the runs have in common.

    Episodes with errors count as episodes without success, as in every table.

    Raises:
        InputError: Two runs hold the same episode, or differ in rules, step budgets, scene or a tracker's weights.
    """
    records = _records(runs)
    weights = _weights(runs)
    policies = list(dict.fromkeys(record.policy for record in records))
    modes = _ordered({record.mode for record in records}, MODES)
    cells: dict[tuple[str, ...], list[EpisodeRecord]] = {}
    for record in records:
        for task in (record.task, ALL):
            cells.setdefault((task, record.tracker, record.policy, record.mode), []).append(record)
    shown = _ordered({record.task for record in records}, tasks.names())
    shown += [ALL] if len(shown) > 1 else []
    used = dict.fromkeys(record.tracker for record in records)
    rows = []
    for task, tracker, policy in itertools.product(shown, used, policies):
        figures = [_cell(cells.get((task, tracker, policy, mode), ())) for mode in modes]
        if any(figures):
            rows.append([task, tracker, *([policy] if len(policies) > 1 else []), *(text or "–" for text in figures)])
    head = ["task", "tracker", *(["policy"] if len(policies) > 1 else []), *modes]
    table = Table(head, rows, "l" * (len(head) - len(modes)) + "r").markdown()
    return f"{table}\n{_conditions(runs, policies, weights)}\n" + "".join(f"{note}\n" for note in _notes(runs, records))


def _played(run: RunRecord) -> list[EpisodeRecord]:
    """A run's episodes; how it executed chunks, where that is not the usual, belongs to the policy's name."""
    late, replan = run.config.get("latency_ticks"), run.config.get("replan")
    said = [f"looks every {counted(replan, 'tick')}"] if replan else []
    said += ["ensembled"] if run.config.get("ensemble") else []
    said += [f"{counted(late, 'tick')} late"] if late else []
    return [dataclasses.replace(r, policy=", ".join([r.shown_policy, *said]), privileged=False) for r in run.records]


def _records(runs: Sequence[RunRecord]) -> list[EpisodeRecord]:
    """All episodes; none may be in two runs."""
    found: dict[tuple[object, ...], RunRecord] = {}
    episodes = []
    for run in runs:
        for r in _played(run):
            key = (r.task, r.tracker, r.policy, r.mode, r.group_seed, r.repeat)
            other = found.setdefault(key, run)
            if other is not run:
                name = " ".join(map(plain, key[:4])) + f" seed {r.group_seed} repeat {r.repeat}"
                raise InputError(f"{run.folder}: episode {name} is in {other.folder} too; leave one of them out")
            episodes.append(r)
    return episodes


def _weights(runs: Sequence[RunRecord]) -> dict[str, str]:
    """Hash of the weights by tracker; runs that differ in what a table must not mix are refused."""
    first = runs[0].config
    for run in runs[1:]:
        for name in ALIKE:
            was, now = first.get(name), run.config.get(name)
            if was != now:
                raise InputError(f"{run.folder}: {name} is {plain(now)}, in {runs[0].folder} {plain(was)}")
    weights: dict[str, str] = {}
    for run in runs:
        for record in run.records:
            now = record.hashes.get("checkpoint")
            if now is not None and weights.setdefault(record.tracker, now) != now:
                name = f"weights of {plain(record.tracker)}"
                raise InputError(f"{run.folder}: {name} are {plain(now)}, elsewhere {plain(weights[record.tracker])}")
    return weights


def _ordered(names: set[str], known: Sequence[str]) -> list[str]:
    """Names in the order of those that are known, others after them."""
    return [name for name in known if name in names] + sorted(names - set(known))


def _cell(records: Sequence[EpisodeRecord]) -> str:
    """Such as `58/60 (89 to 99)`; empty without episodes."""
    won = sum(record.outcome == "success" for record in records)
    interval = wilson(won, len(records))
    return "" if interval is None else f"{won}/{len(records)} ({between(interval)})"


def _conditions(runs: Sequence[RunRecord], policies: Sequence[str], weights: Mapping[str, str]) -> str:
    """What the episodes of the table have in common, in a sentence."""
    parts = [f"policy {plain(policies[0])}"] if len(policies) == 1 else []
    parts.append(f"rules {plain(runs[0].config['rules'])}")
    configs: list[Mapping[str, object]] = [run.config for run in runs]
    for name in NAMED:
        values = dict.fromkeys(plain(config[name]) for config in configs if name in config)
        if values and list(values) not in (["auto"], ["False"]):
            parts.append(f"{name.replace('_', ' ')} {' or '.join(values)}")
    parts += [f"weights of {plain(tracker)} {plain(weight)}" for tracker, weight in weights.items()]
    return f"Successes of episodes (95 % Wilson interval of the rate, %); {', '.join(parts)}."


def _notes(runs: Sequence[RunRecord], records: Sequence[EpisodeRecord]) -> list[str]:
    """What a reader of the table must know besides it."""
    found = changed_conditions(runs[0])
    for run in runs:
        played, shard, planned = len(run.records), run.document.get("shard"), run.document["planned"]
        if shard is not None:
            due = f"{played} of {counted(due_episodes(run.document), 'episode')}"
            found.append(f"{run.folder} is shard {shard} of a plan of {planned:,} episodes: {due}.")
        elif not is_complete(run):
            found.append(f"{run.folder} is incomplete: {played} of {planned} episodes.")
    if any(record.mode == "semantic" for record in records):
        found.append(f"{semantic_text()} {SEMANTIC_STRENGTH}")
    falls, errors = (sum(record.outcome == outcome for record in records) for outcome in ("fall", "error"))
    found += [f"{counted(falls, 'episode')} of {len(records)} ended in a fall."] if falls else []
    found += [f"{counted(errors, 'episode')} of {len(records)} ended with an error."] if errors else []
    codes = {run.config.get("code") for run in runs}
    found += [f"The runs were made with {len(codes)} versions of the code."] if len(codes) > 1 else []
    return found
