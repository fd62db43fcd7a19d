"""One table of several runs: successes per task and tracker, a column per mode, as the README shows them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, changed_conditions, due_episodes
from arena_newton.eval.reports.report import metrics
from arena_newton.eval.statistics.stats import aggregate, wilson
from arena_newton.eval.tables.episode_table import (
    NAMED,
    EvaluatedCell,
    cells_of,
    check_alike,
    code_notes,
    error_note,
    head_notes,
    incomplete_note,
)
from arena_newton.eval.tables.table_entries import ordered
from arena_newton.files.text import counted, plain
from arena_newton.pages.tables import Table, between
from arena_newton.rules.modes import names as mode_names
from arena_newton.tasks.semantic_mode import semantic_notes

__all__ = ["joint_table"]

ALL = "all"
"""Name of the rows over all tasks."""


def joint_table(runs: Sequence[RunRecord]) -> str:
    """Markdown of successes with 95 % Wilson intervals per task, tracker and mode, and what the runs have in common.

    Episodes with errors count as episodes without success, as in every table.

    Raises:
        InputError: Two runs hold the same episode, or differ in rules, step budgets, scene or a tracker's weights.
    """
    weights = check_alike(runs)
    found = [(_policy(cell), cell) for run in runs for cell in cells_of(run)]
    _check_unique(found)
    policies = list(dict.fromkeys(policy for policy, _ in found))
    used = dict.fromkeys(cell.tracker for _, cell in found)
    modes = ordered({cell.mode for _, cell in found}, mode_names())
    cells: dict[tuple[str, ...], list[bool]] = {}
    for policy, cell in found:
        for task in (cell.task, ALL):
            cells.setdefault((task, cell.tracker, policy, cell.mode), []).extend(cell.held().values())
    shown = ordered({cell.task for _, cell in found}, tasks.names())
    shown += [ALL] if len(shown) > 1 else []
    rows = []
    for task, tracker, policy in itertools.product(shown, used, policies):
        figures = [_cell(cells.get((task, tracker, policy, mode), ())) for mode in modes]
        if any(figures):
            rows.append([task, tracker, *([policy] if len(policies) > 1 else []), *(text or "–" for text in figures)])
    head = ["task", "tracker", *(["policy"] if len(policies) > 1 else []), *modes]
    table = Table(head, rows, "l" * (len(head) - len(modes)) + "r").markdown()
    notes = "".join(f"{note}\n" for note in _notes(runs, [cell for _, cell in found]))
    measured = metrics([found for run in runs for found in aggregate(run.records)["cells"]])
    return f"{table}\n{_conditions(runs, policies, weights)}\n{notes}{measured}"


def _policy(cell: EvaluatedCell) -> str:
    """A cell's policy; how it executed chunks, where that is not the usual, belongs to its name."""
    text = [f"queried every {counted(cell.replan, 'tick')}"] if cell.replan else []
    text += ["ensembled"] if cell.ensemble else []
    text += [f"{counted(cell.latency, 'tick')} late"] if cell.latency else []
    return ", ".join([cell.records[0].shown_policy, *text])


def _check_unique(found: Sequence[tuple[str, EvaluatedCell]]) -> None:
    """Refuse an episode that is in two runs."""
    known: dict[tuple[object, ...], EvaluatedCell] = {}
    for policy, cell in found:
        for r in cell.records:
            other = known.setdefault((cell.task, cell.tracker, policy, cell.mode, r.group_seed, r.repeat), cell)
            if other is not cell:
                name = " ".join(map(plain, (cell.task, cell.tracker, policy, cell.mode)))
                name += f" seed {r.group_seed} repeat {r.repeat}"
                raise InputError(f"{cell.folder}: episode {name} is in {other.folder} too; leave one of them out")


def _cell(held: Sequence[bool]) -> str:
    """Text such as `58/60 (89 to 99)`; empty without episodes."""
    interval = wilson(sum(held), len(held))
    return "" if interval is None else f"{sum(held)}/{len(held)} ({between(interval)})"


def _conditions(runs: Sequence[RunRecord], policies: Sequence[str], weights: Mapping[str, str]) -> str:
    """Conditions that the episodes of the table have in common, in a sentence."""
    parts = [f"policy {plain(policies[0])}"] if len(policies) == 1 else []
    parts.append(f"rules {plain(runs[0].config['rules'])}")
    configs: list[Mapping[str, object]] = [run.config for run in runs]
    for name in NAMED:
        values = dict.fromkeys(plain(config[name]) for config in configs if name in config)
        if values and list(values) not in (["auto"], ["False"]):
            parts.append(f"{name.replace('_', ' ')} {' or '.join(values)}")
    parts += [f"weights of {plain(tracker)} {plain(weight)}" for tracker, weight in weights.items()]
    return f"Successes of episodes (95 % Wilson interval of the rate, %); {', '.join(parts)}."


def _notes(runs: Sequence[RunRecord], cells: Sequence[EvaluatedCell]) -> list[str]:
    """Sentences that a reader of the table must know besides it."""
    found = changed_conditions(runs[0])
    for run in runs:
        shard = run.document.get("shard")
        if shard is None:
            found += incomplete_note(run)
        else:
            due = f"{len(run.records)} of {counted(due_episodes(run.document), 'episode')}"
            found.append(f"{run.folder} is shard {shard} of a plan of {run.document['planned']:,} episodes: {due}.")
    found += semantic_notes(cell.mode for cell in cells)
    falls = [held for cell in cells for held in cell.held("fall").values()]
    found += [f"{counted(sum(falls), 'episode')} of {len(falls)} ended in a fall."] if any(falls) else []
    return [*found, *filter(None, [error_note(cells)]), *code_notes(runs), *head_notes(runs)]
