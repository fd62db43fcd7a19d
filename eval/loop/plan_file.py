"""The plan of `eval loop --plan`: a TOML file that says what is recorded, trained and played, read and checked.

Its tables hold flags of the commands that play it, by the names of their fields: [record] those of `eval record`,
[train] and [[rows]] those of `policies.train`, [evaluate] the conditions of a suite. Nothing runs here.
"""

from __future__ import annotations

import dataclasses
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.cli.flags import parse_flags, typed
from arena_newton.errors import InputError
from arena_newton.eval.loop.loop_requirements import plan_path
from arena_newton.eval.plan.config import recording_run, resolve
from arena_newton.eval.plan.options import RecordOptions
from arena_newton.eval.suites.matrix_cells import expand_cells
from arena_newton.eval.suites.suite_file import read_suite_file, read_toml
from arena_newton.files.stored_json import Json, JsonObject, check_types, shown
from arena_newton.files.text import plain_text
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.policy_options import (
    PolicyTrainOptions,
    check_numbers,
    look_fractions,
    task_weights,
)

__all__ = ["LoopPlan", "PlanRow", "PlanSettings", "policy_name", "read_plan", "suite_text"]

TABLES = ("name", "plan", "record", "attempts", "parts", "train", "rows", "evaluate", "bars", "best")
OF_ROW = ("name", "tasks", "trackers", "modes")
"""Keys of [[rows]] that are no flags of a training."""
OWN = {"record": ("out", "shard", "episodes", "task"), "train": ("dataset", "out", "seed", "resume", "minutes")}
"""Flags that the plan itself gives."""
PLAYED_SWAPPED = "base"
"""Mode in which policies are played through a tracker that they were not trained with, as in the paper."""


@dataclass(frozen=True)
class PlanSettings:
    """Table [plan]: numbers of trainings, and of commands at once."""

    seeds: tuple[int, ...] = (1,)
    """Seeds of the trainings of each row."""
    minutes: float = 10.0
    """Time of each training [min], where --minutes does not give the time of all."""
    reserve: float = 6.0
    """Minutes of --minutes that are kept for decoding, evaluation and tables."""
    gpus: int = 1
    """GPUs of a training."""
    trainings: int = 1
    """Trainings at once on the same GPUs."""
    recordings: int = 4
    """Recordings at once."""
    datasets: int = 4
    """Datasets that are built at once."""
    cells: int = 1
    """Processes that play the cells of a suite, for each GPU."""
    suites: int = 1
    """Suites that are played at once, beside trainings of other rows."""
    again: int = 0
    """Times that a command is begun again that failed, as a killed one goes on where it was."""
    failures_too: bool = False
    """Train on attempts that did not succeed, too."""


@dataclass(frozen=True)
class PlanRow:
    """Table [[rows]]: a recipe, trained once for each seed."""

    name: str
    train: PolicyTrainOptions
    """Without datasets, folder and seed."""
    tasks: tuple[str, ...]
    """Tasks of its demonstrations, which it plays."""
    trackers: tuple[str, ...]
    """Trackers of its demonstrations."""
    modes: tuple[str, ...]
    """Modes in which it is played."""


@dataclass(frozen=True)
class LoopPlan:
    """A plan, read and checked."""

    path: Path
    name: str
    text: bytes
    settings: PlanSettings
    record: RecordOptions
    """Flags of all sets; without task, tracker, episodes and folder."""
    at_once: bool
    """True if all attempts of a part are simulated at once."""
    attempts: Mapping[str, int]
    """Task → attempts through each tracker, of which the successes are trained on."""
    parts: Mapping[str, int]
    """Task → recordings into which the attempts of each of its sets are divided."""
    rows: tuple[PlanRow, ...]
    evaluate: JsonObject
    """Conditions of the suites."""
    bars: Mapping[str, tuple[float, ...]]
    """Mode → least success rate of each cell, and of all together."""
    best: Mapping[str, Mapping[str, float]]
    """Tracker → task → least success rate in mode base."""

    def row(self, name: str) -> PlanRow:
        """The row of a name.

        Raises:
            InputError: There is none.
        """
        found = next((row for row in self.rows if row.name == name), None)
        if found is None:
            known = " ".join(row.name for row in self.rows)
            raise InputError(f"--rows {plain_text(name, 60)}: {self.path} has {known}")
        return found


def policy_name(row: PlanRow, seed: int) -> str:
    """Name of a training in suites and tables."""
    return f"{row.name}#{seed}"


def read_plan(given: str) -> LoopPlan:
    """Read and check a plan: a file, or the name of one that comes with the package.

    Raises:
        InputError: There is none, or a table, key or value is unfit; the message names file and table.
    """
    path = plan_path(given)
    content, _ = read_toml(path)
    for key in content:
        if key not in TABLES:
            raise InputError(f"{path}: {plain_text(key, 60)} is unknown, known are {' '.join(TABLES)}")
    name = content.get("name", path.stem)
    settings = PlanSettings(**check_types(f"{path}: [plan]", _table(path, content, "plan"), PlanSettings))
    if not settings.seeds or not all(1 <= seed <= 9999 for seed in settings.seeds):
        raise InputError(f"{path}: [plan]: seeds are {' '.join(map(str, settings.seeds))}, expected numbers 1 to 9999")
    if len(set(settings.seeds)) < len(settings.seeds):
        raise InputError(f"{path}: [plan]: seeds are {' '.join(map(str, settings.seeds))}, expected each once")
    least = {"minutes": 0.0, "reserve": 0.0, "again": 0}
    least |= dict.fromkeys(("gpus", "trainings", "recordings", "datasets", "cells", "suites"), 1)
    for key, low in least.items():
        if not low <= getattr(settings, key):
            raise InputError(f"{path}: [plan]: {key} is {getattr(settings, key)}, expected at least {low:g}")
    if not isinstance(name, str) or not name:
        raise InputError(f"{path}: name is {shown(name)}, expected a text")
    record = _table(path, content, "record")
    options = _options(path, "record", record, RecordOptions)
    attempts = _numbers(path, content, "attempts")
    parts = {task: int(number) for task, number in _numbers(path, content, "parts").items()}
    evaluate = dict(_table(path, content, "evaluate"))
    modes = _names(evaluate.pop("modes", ["base"]))
    plan = LoopPlan(
        path=path,
        name=name,
        text=path.read_bytes(),
        settings=settings,
        record=options,
        at_once="worlds" not in record,
        attempts={task: int(number) for task, number in attempts.items()},
        parts=parts,
        rows=_rows(path, content, {"tasks": [*attempts], "trackers": options.tracker or ("twist2",), "modes": modes}),
        evaluate=evaluate,
        bars={mode: _rates(f"{path}: [bars]: {mode}", value) for mode, value in _table(path, content, "bars").items()},
        best=_best(path, _table(path, content, "best")),
    )
    _check(plan)
    return plan


def _table(path: Path, content: Mapping[str, Json], key: str) -> JsonObject:
    value = content.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{path}: {key} is {shown(value)}, expected a table [{key}]")
    return value


def _names(value: Json) -> tuple[Json, ...]:
    return tuple(value) if isinstance(value, list) else (value,)


def _rates(where: str, value: Json) -> tuple[float, ...]:
    """One or two success rates."""
    rates = _names(value)
    if not 1 <= len(rates) <= 2 or not all(type(rate) in (int, float) and 0 <= rate <= 1 for rate in rates):
        raise InputError(f"{where} is {shown(value)}, expected one or two rates from 0 to 1")
    return tuple(float(rate) for rate in rates)


def _best(path: Path, tables: JsonObject) -> dict[str, dict[str, float]]:
    """Success rates by tracker and task."""
    best: dict[str, dict[str, float]] = {}
    for tracker in tables:
        table = _table(path, tables, tracker)
        best[tracker] = {task: _rates(f"{path}: [best]: {task}", rate)[0] for task, rate in table.items()}
    return best


def _numbers(path: Path, content: Mapping[str, Json], key: str) -> dict[str, Json]:
    """A table of whole numbers from 1, by task."""
    table = _table(path, content, key)
    for task, number in table.items():
        if type(number) is not int or number < 1:
            raise InputError(f"{path}: [{key}]: {plain_text(task, 60)} is {shown(number)}, expected a number from 1")
    return table


def _options[T](path: Path, key: str, table: Mapping[str, Json], kind: type[T]) -> T:
    """Options of a command from a table of its flags; an empty list is none.

    Raises:
        InputError: A flag is unknown, unfit, or one that the plan itself gives.
    """
    where = f"{path}: [{key}]"
    for name in OWN[key]:
        if name in table:
            raise InputError(f"{where}: {name} is given by the plan, leave it out")
    words = [word for name, value in table.items() if value != [] for word in typed(name, value)]
    try:
        return parse_flags(kind, words, "the command")
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _rows(path: Path, content: Mapping[str, Json], all_: Mapping[str, Sequence[Json]]) -> tuple[PlanRow, ...]:
    tables, train = content.get("rows", []), _table(path, content, "train")
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise InputError(f"{path}: expected tables [[rows]], at least one")
    rows: list[PlanRow] = []
    for table in tables:
        name = table.get("name")
        where = f"{path}: [[rows]] {plain_text(name, 60)}"
        if not isinstance(name, str) or not re.fullmatch(r"[a-z0-9-]{1,40}", name) or name in [r.name for r in rows]:
            raise InputError(f"{where}: expected a name of its own, of small letters, digits and -")
        flags = {key: value for key, value in table.items() if key not in OF_ROW}
        options = _options(path, "train", train | flags, PolicyTrainOptions)
        mine = {key: _names(table.get(key, list(known))) for key, known in all_.items()}
        for key, known in all_.items():
            if not mine[key] or not all(value in known for value in mine[key]):
                given, names = (" ".join(map(str, values)) or "none" for values in (mine[key], known))
                raise InputError(f"{where}: {key} are {given}, known are {names}")
        rows.append(PlanRow(name, options, **mine))
    return tuple(rows)


def _check(plan: LoopPlan) -> None:
    """Hold a plan to what the commands take that play it.

    Raises:
        InputError: One of them would refuse it.
    """
    if not plan.attempts:
        raise InputError(f"{plan.path}: [attempts] is empty, name the tasks and their attempts")
    for task, parts in plan.parts.items():
        if task not in plan.attempts:
            raise InputError(f"{plan.path}: [parts]: {task} is none of [attempts], {' '.join(plan.attempts)}")
        if parts > plan.attempts[task]:
            raise InputError(f"{plan.path}: [parts]: {task} has {parts} parts of {plan.attempts[task]} attempts")
    played = {mode for row in plan.rows for mode in row.modes}
    for condition in plan.bars:
        if condition.split(",")[0] not in played:
            raise InputError(f"{plan.path}: [bars]: {condition} is no mode that is played, {' '.join(sorted(played))}")
    trackers = plan.record.tracker or ("twist2",)
    for tracker, tasks in plan.best.items():
        unknown = [tracker] if tracker not in trackers else [task for task in tasks if task not in plan.attempts]
        if unknown:
            raise InputError(f"{plan.path}: [best]: {unknown[0]} is none of the plan's trackers and tasks")
    where = f"{plan.path}: [record]"
    try:
        sets = dataclasses.replace(plan.record, task=tuple(plan.attempts), episodes=1)
        resolve(dataclasses.replace(recording_run(sets), device=None if plan.record.device is None else "cpu"))
        for row in plan.rows:
            where = f"{plan.path}: [[rows]] {row.name}"
            check_numbers(dataclasses.replace(row.train, dataset=(Path(),)))
            picture = recipe(row.train.policy, row.train.recipe).picture
            if plan.record.size != f"{picture}x{picture}":
                taken = f"recipe {row.train.policy}/{row.train.recipe} takes {picture}x{picture}"
                raise InputError(f"{taken}, and [record] has size {plan.record.size}")
            for flag, named in (
                ("task_weights", task_weights(row.train.task_weights)),
                ("looks", look_fractions(row.train.looks)[1]),
            ):
                if other := [task for task in named if task not in row.tasks]:
                    raise InputError(f"{flag} names {other[0]}, and its tasks are {' '.join(row.tasks)}")
            if bool(row.train.looks) and not plan.record.looks:
                raise InputError("changes looks, and [record] has no looks")
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    with tempfile.TemporaryDirectory() as scratch:
        for row in plan.rows:
            path = Path(scratch) / "suite.toml"
            path.write_text(suite_text(plan, row, {plan.settings.seeds[0]: Path("training")}))
            try:
                expand_cells(read_suite_file(path))
            except InputError as error:
                raise InputError(f"{plan.path}: [evaluate]: {str(error).replace(f'{path}: ', '')}") from None


def suite_text(plan: LoopPlan, row: PlanRow, trainings: Mapping[int, Path]) -> str:
    """The suite file of a row: its trainings on its tasks through all trackers.

    Args:
        trainings: Seed → folder of the training.
    """
    trackers = plan.record.tracker or ("twist2",)
    lines = [f"name = {_toml(f'{plan.name}_{row.name}')}", "", "[defaults]"]
    lines += [f"{key} = {_toml(value)}" for key, value in plan.evaluate.items()]
    axes = {"tasks": list(row.tasks), "trackers": list(trackers), "modes": list(row.modes)}
    lines += ["", "[matrix]", *(f"{key} = {_toml(value)}" for key, value in axes.items())]
    for seed, folder in trainings.items():
        entry = {"name": policy_name(row, seed), "family": row.train.policy, "spec": f"lerobot:{folder}"}
        lines += ["", "[[policies]]", *(f"{key} = {_toml(value)}" for key, value in entry.items())]
        lines += [f"trained_on = {_toml(list(row.trackers))}"]
    swapped = [mode for mode in row.modes if mode != PLAYED_SWAPPED]
    if swapped and set(trackers) - set(row.trackers):
        lines += ["", "[[cells]]", f"exclude = {{ matched = false, mode = {_toml(swapped)} }}"]
    return "\n".join(lines) + "\n"


def _toml(value: Json) -> str:
    """A value of a plan as TOML has it; its texts have no control characters."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return str(value)
