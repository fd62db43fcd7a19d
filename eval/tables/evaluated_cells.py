"""Cells of the paper's tables: episodes of suites and results folders, and counts of files `cells.csv`."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import changed_conditions
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES, MAX_COUNT
from arena_newton.eval.tables.episode_table import (
    NAMED,
    EvaluatedCell,
    PlayedCell,
    check_alike,
    code_notes,
    error_note,
    head_notes,
    read_folder,
    runs_of,
)
from arena_newton.files.stored_json import read_regular, shown
from arena_newton.files.text import counted, plain_text
from arena_newton.rules import modes

__all__ = ["CellSet", "read_cells"]


@dataclass(frozen=True)
class CellSet:
    """Everything that tables are made of."""

    cells: tuple[EvaluatedCell, ...]
    rules: str
    notes: tuple[str, ...]
    """Sentences for a reader of the tables."""
    changed: tuple[str, ...] = ()
    """Reasons for which these episodes are no results of the benchmark: cut step budgets, a variant of the scene."""


def read_cells(folders: Sequence[Path], rules: str = "paper") -> CellSet:
    """Read suites (folders with `suite.json`), results folders, and files `cells.csv` that `eval tables` wrote.

    Args:
        rules: Rule set whose episodes count; others are left out and counted in a note. A `cells.csv` does not say
            its own, and is taken to be of these.

    Raises:
        InputError: A folder holds neither or is damaged, two hold the same cell, none holds an episode under the
            rules, one holds recordings for training or a shard, or they differ in step budgets, scene variant or a
            tracker's weights.
    """
    found: list[PlayedCell] = []
    tallied: list[EvaluatedCell] = []
    notes: list[str] = []
    for folder in folders:
        if folder.suffix == ".csv":
            tallied += _of_csv(folder)
            notes.append(
                f"{folder} has counts alone: episodes of a training that its own and another tracker executed are "
                "paired, all others are not, which makes intervals wider."
            )
        else:
            found += read_folder(folder, notes)[1]
    others = [cell for cell in found if cell.run.config["rules"] != rules]
    kept = [cell for cell in found if cell.run.config["rules"] == rules]
    names = " ".join(sorted({plain_text(cell.run.config["rules"], 60) for cell in others}))
    if others:
        number = sum(len(cell.records) for cell in others)
        notes.append(f"{counted(number, 'episode')} under the rules {names} left out.")
    if not kept and not tallied:
        where = " ".join(str(folder) for folder in folders)
        raise InputError(f"{where}: no episode under the rules {rules}" + (f", only {names}" * bool(others)))
    changed: tuple[str, ...] = ()
    if kept:
        check_alike(runs_of(kept))
        notes += _conditions(kept)
        changed = tuple(changed_conditions(runs_of(kept)[0]))
    named = _named_rows([*tallied, *kept])
    return CellSet(named, rules, tuple(dict.fromkeys([*changed, *notes])), changed)


def _of_csv(path: Path) -> list[EvaluatedCell]:
    """Our single cells without latency in a `cells.csv`, with the pairing that its table of swapped trackers has.

    Raises:
        InputError: It is missing, or no such file; the message names file and line.
    """
    try:
        text = read_regular(path, MAX_CONFIG_BYTES).decode("utf-8")
        rows = list(csv.DictReader(io.StringIO(text, newline=""), strict=True))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: is no table of CSV ({error})") from None
    found: dict[tuple[Hashable, ...], EvaluatedCell] = {}
    for number, row in enumerate(rows, 2):
        table, where = row.get("table") or "", f"{path}: line {number}"
        if row.get("source") != "ours" or not table.startswith(("in_gmt", "cross_gmt", "merge_all")):
            continue
        if row.get("task") not in tasks.names() or not row.get("trained_on") or row.get("latency") != "0":
            continue
        cell = _of_row(where, path, row, found)
        found[cell.training, cell.task, cell.tracker, cell.mode] = cell
    if not found:
        raise InputError(f"{path}: has no cell of ours that is a result, in the tables in_gmt, cross_gmt or merge_all")
    return list(found.values())


def _of_row(
    where: str, path: Path, row: Mapping[str, str], others: Mapping[tuple[Hashable, ...], EvaluatedCell]
) -> EvaluatedCell:
    """A cell from its line; a swapped one is paired with the matched one of its training among those before."""

    def count(column: str) -> int:
        text = row.get(column) or ""
        if not text.isdecimal() or not text.isascii() or int(text[:9]) > MAX_COUNT:
            raise InputError(f"{where}: {column} is {plain_text(text, 60)!r}, expected a number")
        return int(text[:9])

    episodes, won, mode = count("episodes"), count("successes"), row.get("mode") or ""
    try:
        falls = round(float(row.get("afr") or 0) * episodes)
    except (ValueError, OverflowError):
        falls = -1
    if not 0 < episodes or not 0 <= won <= won + falls <= episodes or falls < 0 or mode not in modes.names():
        raise InputError(f"{where}: episodes, successes, afr or mode are none of a cell")
    trained_on = tuple(plain_text(name, 80) for name in row["trained_on"].split("+"))
    merged = row["table"] == "merge_all"
    cell = EvaluatedCell(
        policy=plain_text(row.get("policy") or "", 80),
        family=plain_text(row.get("family") or "", 80),
        trained_on=trained_on,
        trained_tasks=tasks.PAPER if merged else (row["task"],),
        tracker=plain_text(row.get("tracker") or "", 80),
        task=row["task"],
        mode=mode,
        labels=plain_text(row.get("labels") or "", 80),
        latency=0,
        replan=None,
        ensemble=False,
        records=(),
        folder=path,
    )
    names: list[Hashable] = [(str(path), *cell.training, cell.tracker, mode, n) for n in range(episodes)]
    wins = set(names[:won])
    matched = others.get((cell.training, cell.task, trained_on[0], "base"))
    if row["table"] == "cross_gmt" and matched is not None and matched.tallied is not None:
        before = matched.tallied["success"]
        lost, gained = count("only_first"), count("only_second")
        first, rest = ([name for name, held in before.items() if held is side] for side in (True, False))
        if count("pairs") == len(before) == episodes and len(first) - lost + gained == won and gained <= len(rest):
            names, wins = [*first, *rest], {*first[: len(first) - lost], *rest[:gained]}
    fell = [name for name in names if name not in wins][:falls]
    ends = {"success": wins, "fall": set(fell)}
    tallied = {outcome: {name: name in ended for name in names} for outcome, ended in ends.items()}
    return dataclasses.replace(cell, tallied=tallied)


def _conditions(cells: Sequence[PlayedCell]) -> list[str]:
    """Conditions of the runs, and errors, in sentences."""
    runs, found = runs_of(cells), []
    for name in NAMED:
        values = sorted({shown(run.config.get(name)) for run in runs if name in run.config})
        if len(values) > 1:
            found.append(f"{name.replace('_', ' ').capitalize()}: {' and '.join(values)}.")
    found += [*code_notes(runs), *filter(None, [error_note(cells)]), *head_notes(runs)]
    episodes = sum(len(cell.records) for cell in cells)
    return [*found, f"{counted(episodes, 'episode')} in {counted(len(cells), 'cell')}."]


def _named_rows(cells: Sequence[EvaluatedCell]) -> tuple[EvaluatedCell, ...]:
    """Cells whose `policy` names one row: it names label protocols and chunk executions that differ."""
    parts: dict[str, tuple[set[str], set[object], set[bool]]] = {}
    for cell in cells:
        labels, replans, ensembles = parts.setdefault(cell.recipe, (set(), set(), set()))
        labels.add(cell.labels)
        replans.add(cell.replan)
        ensembles.add(cell.ensemble)
    named = []
    for cell in cells:
        recipe, sign, number = cell.policy.partition("#")
        labels, replans, ensembles = parts[recipe]
        words = [cell.labels] if len(labels) > 1 else []
        words += [f"replan {cell.replan}"] if len(replans) > 1 and cell.replan is not None else []
        words += ["ensemble"] if len(ensembles) > 1 and cell.ensemble else []
        named.append(dataclasses.replace(cell, policy=" ".join([recipe, *words]) + sign + number))
    seen: dict[tuple[object, ...], EvaluatedCell] = {}
    for cell in named:
        key = (cell.policy, cell.trained_on, cell.merged, cell.tracker, cell.task, cell.mode, cell.latency)
        other = seen.setdefault(key, cell)
        if other is not cell:
            name = " ".join(plain_text(word, 60) for word in (cell.policy, cell.tracker, cell.task, cell.mode))
            raise InputError(f"{cell.folder}: cell {name} is in {other.folder} too; leave one of them out")
    return tuple(named)
