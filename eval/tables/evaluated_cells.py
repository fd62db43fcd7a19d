"""Episodes of suites, results folders and cells.csv as cells of tables: a policy, tracker, task and its conditions."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, changed_conditions, check_whole_plan, is_complete, load_run
from arena_newton.eval.records.document import SUITE_FILE
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES, MAX_COUNT, Json, read_regular, shown
from arena_newton.eval.suites.suite_records import SuiteCell, load_cell, read_suite
from arena_newton.files.text import counted, plain_text
from arena_newton.rules import seeding
from arena_newton.rules.rule_types import MODES

__all__ = ["CellSet", "EvaluatedCell", "read_cells"]

ALIKE = ("max_steps", "variant")
"""Conditions under which all runs must agree: one table must not mix budgets or scenes."""
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
    """Actions of a chunk that were executed before the next look; None: all."""
    ensemble: bool
    records: tuple[EpisodeRecord, ...]
    """Its episodes in plan order."""
    folder: Path
    wall_s: float | None = None
    """Time that its evaluation took [s], where a suite measured it."""
    device: str = ""
    """Where it was played, such as `NVIDIA H200`."""
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
        """Whether the policy was trained on several tasks or through several trackers at once."""
        return len(self.trained_tasks) > 1 or len(self.trained_on) > 1

    @property
    def matched(self) -> bool:
        """Whether it was executed by the tracker of its training, or needs none."""
        return self.trained_on in ((), (self.tracker,))

    def held(self, outcome: str = "success") -> dict[Hashable, bool]:
        """Whether each episode ended so, by group seed and repeat; a task and these two decide an episode's start."""
        if self.tallied is not None:
            return dict(self.tallied[outcome])
        return {(record.group_seed, record.repeat): record.outcome == outcome for record in self.records}


@dataclass(frozen=True)
class CellSet:
    """Everything that tables are made of."""

    cells: tuple[EvaluatedCell, ...]
    rules: str
    notes: tuple[str, ...]
    """What a reader of the tables must know besides them."""
    changed: tuple[str, ...] = ()
    """Reasons for which these episodes are no results of the benchmark: cut step budgets, a variant of the scene."""


def read_cells(folders: Sequence[Path], rules: str = "paper") -> CellSet:
    """Read suites (folders with `suite.json`), results folders, and files `cells.csv` that `eval tables` wrote.

    Args:
        folders: Each of them.
        rules: Rule set whose episodes count; others are left out and counted in a note. A `cells.csv` does not say
            its own, and is taken to be of these.

    Raises:
        InputError: A folder holds neither or is damaged, two hold the same cell, none holds an episode under the
            rules, one holds recordings for training or a shard, or they differ in step budgets, scene variant or a
            tracker's weights.
    """
    found: list[tuple[str, EvaluatedCell, RunRecord]] = []
    tallied: list[EvaluatedCell] = []
    notes: list[str] = []
    for folder in folders:
        if folder.suffix == ".csv":
            tallied += _of_csv(folder)
            notes.append(
                f"{folder} has counts alone: episodes of a training that its own and another tracker executed are "
                "paired, all others are not, which makes intervals wider."
            )
        elif (folder / SUITE_FILE).is_file():
            found += _of_suite(folder, notes)
        else:
            run = load_run(folder)
            if run.config.get("seed_range", seeding.EVALUATION) != seeding.EVALUATION:
                raise InputError(f"{folder}: holds recordings for training; tables are of evaluations")
            check_whole_plan(run)
            found += [(run.config["rules"], cell, run) for cell in _of_run(run)]
            if run.config.get("keep") is None and len(run.records) < run.document["planned"] and not is_complete(run):
                notes.append(f"{folder} is incomplete: {len(run.records)} of {run.document['planned']} episodes.")
    others = sorted({plain_text(other, 60) for other, _, _ in found if other != rules})
    if others:
        number = sum(len(cell.records) for other, cell, _ in found if other != rules)
        notes.append(f"{counted(number, 'episode')} under the rules {' '.join(others)} left out.")
    kept = [(cell, run) for other, cell, run in found if other == rules]
    if not kept and not tallied:
        where = " ".join(str(folder) for folder in folders)
        raise InputError(f"{where}: no episode under the rules {rules}" + (f", only {' '.join(others)}" * bool(others)))
    changed: tuple[str, ...] = ()
    if kept:
        _check_alike([run for _, run in kept])
        notes += _conditions(kept)
        changed = tuple(changed_conditions(kept[0][1]))
    named = _named_rows([*tallied, *(cell for cell, _ in kept)])
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
        raise InputError(f"{path}: has no cell of ours in the tables in_gmt, cross_gmt or merge_all")
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
    if not 0 < episodes or not 0 <= won <= won + falls <= episodes or falls < 0 or mode not in MODES:
        raise InputError(f"{where}: episodes, successes, afr or mode are none of a cell")
    trained_on = tuple(plain_text(name, 80) for name in row["trained_on"].split("+"))
    merged = row["table"] == "merge_all"
    cell = EvaluatedCell(
        policy=plain_text(row.get("policy") or "", 80),
        family=plain_text(row.get("family") or "", 80),
        trained_on=trained_on,
        trained_tasks=tuple(tasks.names()) if merged else (row["task"],),
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


def _of_suite(folder: Path, notes: list[str]) -> list[tuple[str, EvaluatedCell, RunRecord]]:
    suite = read_suite(folder)
    found = []
    waiting = [cell for cell in suite.cells if not (folder / cell.folder).is_dir()]
    if waiting:
        notes.append(f"{folder}: {counted(len(waiting), 'cell')} of {len(suite.cells)} not played yet.")
    for cell in suite.cells:
        if cell in waiting:
            continue
        run = load_cell(suite, cell)
        if cell.status == "failed":
            notes.append(f"{run.folder}: failed ({plain_text(cell.error or 'no reason', 200)}).")
        played, planned = len(run.records), run.document["planned"]
        if played < planned:
            # Successes end before timeouts do: the first episodes of a cell are no fair sample of it.
            notes.append(f"{run.folder} is incomplete, and left out: {played} of {planned} episodes.")
        elif run.records:
            found.append((cell.rules, _suite_cell(cell, run), run))
    return found


def _suite_cell(cell: SuiteCell, run: RunRecord) -> EvaluatedCell:
    facts = _facts(run.config.get("policy_facts"))
    return EvaluatedCell(
        policy=dataclasses.replace(run.records[0], policy=cell.policy).shown_policy,
        family=cell.family,
        trained_on=tuple(sorted(cell.trained_on, key=_tracker_order)),
        trained_tasks=cell.trained_tasks,
        tracker=cell.tracker,
        task=cell.task,
        mode=cell.mode,
        labels=cell.labels,
        latency=cell.latency,
        replan=cell.replan,
        ensemble=cell.ensemble,
        records=tuple(run.records),
        folder=run.folder,
        wall_s=cell.wall_s,
        device=cell.device,
        weights=_text(facts.get("weights")),
        training_minutes=_minutes(facts.get("minutes")),
    )


def _tracker_order(name: str) -> tuple[bool, str]:
    """The paper's trackers in its order: TWIST2 comes first."""
    return name != "twist2", name


def _of_run(run: RunRecord) -> list[EvaluatedCell]:
    """Cells of a plain results folder, with what the policy said of itself."""
    config: Mapping[str, Json] = run.config
    facts = _facts(config.get("policy_facts"))
    groups: dict[tuple[str, str, str, str], list[EpisodeRecord]] = {}
    for record in run.records:
        groups.setdefault((record.task, record.tracker, record.shown_policy, record.mode), []).append(record)
    found = []
    for (task, tracker, policy, mode), records in groups.items():
        family = _text(facts.get("family"))
        scheme = records[0].policy.partition(":")[0]
        recipe = _text(facts.get("recipe"))
        replan = config.get("replan")
        found.append(
            EvaluatedCell(
                policy=" ".join(filter(None, (family, recipe))) or policy,
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
            )
        )
    return found


def _facts(given: Json) -> Mapping[str, Json]:
    """What a checkpoint says of itself, in what its policy said: on top of it, or as its `facts`."""
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


def _check_alike(runs: Sequence[RunRecord]) -> None:
    """Refuse runs that one table must not mix."""
    first, weights = runs[0], dict[str, tuple[str, Path]]()
    for run in runs:
        for name in ALIKE:
            was, now = first.config.get(name), run.config.get(name)
            if was != now:
                raise InputError(f"{run.folder}: {name} is {shown(now)}, in {first.folder} {shown(was)}")
        for record in run.records:
            now = record.hashes.get("checkpoint")
            if now is None:
                continue
            was, where = weights.setdefault(record.tracker, (now, run.folder))
            if was != now:
                name = f"weights of {plain_text(record.tracker, 60)}"
                raise InputError(f"{run.folder}: {name} are {plain_text(now, 60)}, in {where} {plain_text(was, 60)}")


def _conditions(kept: Iterable[tuple[EvaluatedCell, RunRecord]]) -> list[str]:
    """What ran, and what went wrong, in sentences."""
    pairs = list(kept)
    runs = list({id(run): run for _, run in pairs}.values())
    found = []
    for name in NAMED:
        values = sorted({shown(run.config.get(name)) for run in runs if name in run.config})
        if len(values) > 1:
            found.append(f"{name.replace('_', ' ').capitalize()}: {' and '.join(values)}.")
    codes = {run.config.get("code") for run in runs}
    found += [f"The runs were made with {len(codes)} versions of the code."] if len(codes) > 1 else []
    errors = sum(record.outcome == "error" for cell, _ in pairs for record in cell.records)
    episodes = sum(len(cell.records) for cell, _ in pairs)
    if errors:
        found.append(f"{counted(errors, 'episode')} of {episodes} ended with an error; they count as no success.")
    return [*found, f"{counted(episodes, 'episode')} in {counted(len(pairs), 'cell')}."]


def _named_rows(cells: Sequence[EvaluatedCell]) -> tuple[EvaluatedCell, ...]:
    """Cells whose `policy` names one row: label protocols and chunk executions that differ are told apart."""
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
