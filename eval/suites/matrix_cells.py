"""The cells of a suite file: expanded, chosen, dealt to shards, shown. Nothing is built and nothing runs.

Cells of one task, tracker and rule set follow each other, mode by mode, so that they can use one environment.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from collections.abc import Sequence
from pathlib import Path

from arena_newton import policies, tasks
from arena_newton.errors import InputError
from arena_newton.eval.plan import episode_plan
from arena_newton.eval.plan.options import Remote, RunOptions, flags_of
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES
from arena_newton.eval.reports.progress import simulated
from arena_newton.eval.suites.suite_file import SELECTORS, PolicyEntry, Selector, SuiteFile
from arena_newton.eval.suites.suite_records import SuiteCell
from arena_newton.files.stored_json import MAX_NAME, JsonObject, parse, read_regular
from arena_newton.files.text import counted, plain_text
from arena_newton.pages.tables import Table
from arena_newton.policies.learned import learned_card
from arena_newton.policies.lerobot.checkpoint_facts import CONFIG_FILE, CheckpointFacts, checkpoint_folder

__all__ = [
    "MAX_CELLS",
    "check_policies",
    "dealt",
    "expand_cells",
    "matrix_table",
    "parse_only",
    "run_options",
    "selected",
]

MAX_CELLS = 20_000
"""Cells of one suite; the paper's largest table has a few hundred."""
LATER_FLAGS = {"latency": "latency_ticks", "replan": "replan", "ensemble": "ensemble"}
"""Field of a cell → flag of `eval run`."""
CHECKPOINTS, PACKED = "lerobot", "learned"
"""Policies whose spec names a checkpoint, or a packed one; without a name the one that comes with the package."""


def expand_cells(suite: SuiteFile) -> list[SuiteCell]:
    """Every cell of a suite file, in the order in which they are played.

    Raises:
        InputError: A condition is out of range, a rule fits no cell, two cells are alike, or none is left.
    """
    axes = suite.axes
    size = len(axes.tasks) * len(axes.trackers) * len(axes.modes) * len(axes.rules) * len(axes.latency)
    size *= sum(max(len(entry.trained_on), 1) for entry in suite.policies)
    if size > MAX_CELLS:
        raise InputError(f"{suite.path}: makes {size:,} cells, at most {MAX_CELLS:,} are planned at once")
    cells: list[SuiteCell] = []
    for task, tracker, mode, rules in itertools.product(axes.tasks, axes.trackers, axes.modes, axes.rules):
        size_of = _size(suite, task, tracker, mode, rules)
        for entry in suite.policies:
            chosen = {"tasks": task, "trackers": tracker, "modes": mode, "rules": rules}
            if any(getattr(entry, key) and value not in getattr(entry, key) for key, value in chosen.items()):
                continue
            for latency in entry.latency or axes.latency:
                for trained_on in _trainings(entry):
                    cells.append(_cell(suite, entry, trained_on, size_of, (task, tracker, mode, rules, latency)))
    return _ruled(suite, cells)


def _trainings(entry: PolicyEntry) -> list[tuple[str, ...]]:
    """The trackers of each checkpoint that an entry names."""
    return [(tracker,) for tracker in entry.trained_on] if "{tracker}" in entry.spec else [entry.trained_on]


def _size(suite: SuiteFile, task: str, tracker: str, mode: str, rules: str) -> tuple[int, int]:
    """Episodes of a cell and the sum of their budgets [ticks]."""
    given = {key: suite.defaults[key] for key in ("seeds", "repeats", "max_steps") if key in suite.defaults}
    try:
        episodes = episode_plan.expand([task], trackers=[tracker], policy="", modes=[mode], rules=rules, **given)
    except InputError as error:
        raise InputError(f"{suite.path}: [defaults]: {error}") from None
    return len(episodes), sum(episode.max_steps for episode in episodes)


def _cell(
    suite: SuiteFile,
    entry: PolicyEntry,
    trained_on: tuple[str, ...],
    size: tuple[int, int],
    conditions: tuple[str, str, str, str, int],
) -> SuiteCell:
    """The cell of a checkpoint under task, tracker, mode, rules and latency."""
    task, tracker, mode, rules, latency = conditions
    spec = entry.spec.replace("{task}", task).replace("{tracker}", "".join(trained_on[:1]))
    if len(spec) > MAX_NAME:
        raise InputError(f"{suite.path}: [[policies]] {entry.name}: spec has more than {MAX_NAME} characters")
    scheme = spec.partition(":")[0]
    if "{task}" in entry.spec:
        learned: tuple[str, ...] = (task,)
    else:
        learned = (entry.trained_tasks or entry.tasks or suite.axes.tasks) if trained_on else ()
    if trained_on and task not in learned:
        raise InputError(
            f"{suite.path}: [[policies]] {entry.name}: is played on {task}, which is not in trained_tasks "
            f"({' '.join(learned)})"
        )
    trained = f".{'+'.join(trained_on)}" if trained_on else ""
    ending = ("" if rules == "paper" else f".{rules}") + (f".latency{latency}" if latency else "")
    name = f"{entry.name}{trained}/{tracker}/{task}/{mode}{ending}"
    return SuiteCell(
        id=name,
        policy=entry.name,
        family=entry.family or ("" if scheme in (CHECKPOINTS, PACKED, "process", "remote") else scheme),
        spec=spec,
        trained_on=trained_on,
        trained_tasks=learned,
        tracker=tracker,
        task=task,
        mode=mode,
        rules=rules,
        labels=entry.labels or "v3.1",
        latency=latency,
        replan=entry.replan,
        ensemble=entry.ensemble,
        folder=name,
        episodes=size[0],
        ticks=size[1],
    )


def _ruled(suite: SuiteFile, cells: Sequence[SuiteCell]) -> list[SuiteCell]:
    """The cells that the rules of [[cells]] leave: of several rules that fit a cell the last decides."""
    if not cells:
        raise InputError(f"{suite.path}: [matrix] and [[policies]] have no cell in common")
    kept = dict.fromkeys((cell.id for cell in cells), True)
    for rule in suite.rules:
        _check_selector(rule.where, rule.selector, cells)
        fitting = [cell.id for cell in cells if _fits(cell, rule.selector)]
        if not fitting:
            raise InputError(f"{rule.where}: fits no cell")
        kept |= dict.fromkeys(fitting, rule.include)
    left = [cell for cell in cells if kept[cell.id]]
    if not left:
        raise InputError(f"{suite.path}: [[cells]] leave no cell")
    return left


def _fields(cell: SuiteCell) -> dict[str, tuple[str, ...]]:
    """Fields that a selector compares, by its key."""
    matched = "none" if cell.matched is None else str(cell.matched).lower()
    plain = {key: (str(getattr(cell, key)),) for key in SELECTORS if key not in ("trained_on", "matched")}
    return plain | {"trained_on": cell.trained_on or ("none",), "matched": (matched,)}


def _fits(cell: SuiteCell, selector: Selector) -> bool:
    fields = _fields(cell)
    return all(set(fields[key]) & set(values) for key, values in selector.items())


def _check_selector(where: str, selector: Selector, cells: Sequence[SuiteCell]) -> None:
    """Refuse a value that no cell has: it is mistyped."""
    for key, values in selector.items():
        known = list(dict.fromkeys(value for cell in cells for value in _fields(cell)[key]))
        for value in values:
            if value not in known:
                raise InputError(f"{where}: {key} {plain_text(value, 60)}: no cell has it, known are {' '.join(known)}")


def parse_only(text: str | None) -> dict[str, tuple[str, ...]]:
    """The selector of --only: `key=value` or `key=value,value`, with spaces between.

    Raises:
        InputError: It is something else.
    """
    found: dict[str, tuple[str, ...]] = {}
    for part in (text or "").split():
        key, equals, values = part.partition("=")
        parts = tuple(value for value in values.split(",") if value)
        if not equals or not parts:
            raise InputError(f"--only {plain_text(part, 60)}: expected key=value, such as 'policy=act task=boxing'")
        if key not in SELECTORS:
            raise InputError(f"--only {plain_text(key, 60)}: is unknown, known are {' '.join(SELECTORS)}")
        if key in found:
            raise InputError(f"--only {key}: given twice; several values have a comma between")
        found[key] = parts
    if text is not None and not found:
        raise InputError("--only: is empty, name cells such as 'policy=act task=boxing'")
    return found


def selected(cells: Sequence[SuiteCell], only: Selector) -> list[SuiteCell]:
    """The cells that --only names.

    Raises:
        InputError: None is.
    """
    _check_selector("--only", only, cells)
    found = [cell for cell in cells if _fits(cell, only)]
    if not found:
        raise InputError("--only: no cell has all of these")
    return found


def dealt(cells: Sequence[SuiteCell], shard: int, shards: int) -> list[SuiteCell]:
    """Cells of one shard, counted from 1: of each task every so many-th by the hash of their names.

    The deal goes on from task to task, so that shards differ by one cell at most.
    """
    kept: set[str] = set()
    number = 0
    for task in sorted({cell.task for cell in cells}):
        names = [cell.id for cell in cells if cell.task == task]
        for name in sorted(names, key=lambda text: hashlib.sha256(text.encode()).digest()):
            if number % shards == shard - 1:
                kept.add(name)
            number += 1
    return [cell for cell in cells if cell.id in kept]


def check_policies(suite: SuiteFile, cells: Sequence[SuiteCell]) -> list[SuiteCell]:
    """Hold cells to what can be known of their policies without making them.

    Returns:
        The cells with family, labels and trained tasks as their checkpoints say them.

    Raises:
        InputError: An unknown policy, an absent checkpoint, or one that was trained on something else.
    """
    entries = {entry.name: entry for entry in suite.policies}
    problems: dict[str, str] = {}
    facts: dict[str, CheckpointFacts | None] = {}
    chunks: dict[str, tuple[int | None, int | None]] = {}
    for cell in cells:
        if cell.spec not in facts:
            facts[cell.spec], chunks[cell.spec] = None, (None, None)
            try:
                facts[cell.spec], chunks[cell.spec] = _described(cell.spec, entries[cell.policy])
            except InputError as error:
                problems[cell.spec] = f"{suite.path}: [[policies]] {cell.policy}: {error}"
    if problems:
        more = f" (the same or another fault in {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise InputError(f"{next(iter(problems.values()))}{more}")
    found = []
    for cell in cells:
        where, known = f"{suite.path}: [[policies]] {cell.policy}", facts[cell.spec]
        if cell.spec.partition(":")[0] == "expert" and tasks.get(cell.task).expert is None:
            raise InputError(f"{where}: task {cell.task} has no expert; leave it out with tasks, or in [[cells]]")
        _check_chunk(f"{where}: cell {cell.id}", cell, *chunks[cell.spec])
        found.append(cell if known is None else _with_facts(where, cell, entries[cell.policy], known))
    return found


def _check_chunk(where: str, cell: SuiteCell, executed: int | None, predicted: int | None) -> None:
    """Refuse more actions than a checkpoint predicts, and a latency that leaves nothing of what is executed."""
    if cell.replan is not None and predicted is not None and cell.replan > predicted:
        raise InputError(f"{where}: replan is {cell.replan}, the checkpoint predicts {predicted} actions")
    length = cell.replan or (1 if cell.ensemble else executed)
    if length is not None and cell.latency >= length:
        raise InputError(
            f"{where}: latency is {cell.latency} ticks, {length} actions of each chunk are executed; expected fewer"
        )


def _described(spec: str, entry: PolicyEntry) -> tuple[CheckpointFacts | None, tuple[int | None, int | None]]:
    """Facts of the checkpoint of a spec, and the largest numbers of actions that it executes and predicts.

    None for what it does not say, such as one that is somebody else's.
    """
    policies.check_spec(spec)
    scheme, _, argument = spec.partition(":")
    if scheme not in (CHECKPOINTS, PACKED) or entry.hub:
        return None, (None, None)
    folder = learned_card.SHIPPED if spec == PACKED else _checkpoint(scheme, argument)
    if spec == PACKED and not folder.is_dir():
        raise InputError(learned_card.NOT_SHIPPED)
    path = folder / CONFIG_FILE
    try:
        config = parse(read_regular(path.resolve(), MAX_CONFIG_BYTES))
    except ValueError as error:
        raise InputError(f"{path}: not readable as JSON ({error})") from None
    sizes: list[int | None] = []
    for keys in (("n_action_steps",), ("chunk_size", "horizon")):
        values = [config.get(key) for key in keys] if isinstance(config, dict) else []
        sizes.append(next((value for value in values if type(value) is int and value > 0), None))
    return CheckpointFacts.read(folder), (sizes[0], sizes[1])


def _checkpoint(scheme: str, argument: str) -> Path:
    """Folder of a checkpoint that has weights."""
    if not argument:
        raise InputError(f"spec {scheme}: names no checkpoint, expected {scheme}:<folder>")
    folder = checkpoint_folder(Path(argument).expanduser(), f"spec {scheme}:")
    if not any(folder.glob("*.safetensors")):
        raise InputError(f"spec {scheme}:{argument}: {folder} holds no weights (no .safetensors)")
    return folder


def _with_facts(where: str, cell: SuiteCell, entry: PolicyEntry, facts: CheckpointFacts) -> SuiteCell:
    """A cell held to what its checkpoint says of its training."""
    names = {spec.gym_id: spec.name for spec in tasks.specs()}
    learned, path = tuple(names.get(task, task) for task in facts.tasks), cell.spec.partition(":")[2] or cell.spec
    claims = (
        ("labels", (entry.labels,) if entry.labels else (), (facts.labels,)),
        ("family", (entry.family,) if entry.family else (), (facts.family,) if facts.family else ()),
        ("trained_on", cell.trained_on, facts.trackers),
        ("trained_tasks", entry.trained_tasks, learned),
    )
    for key, declared, true in claims:
        if declared and true and set(declared) != set(true):
            raise InputError(f"{where}: {key} is {' '.join(declared)}, but checkpoint {path} says {' '.join(true)}")
    if learned and cell.task not in learned:
        raise InputError(
            f"{where}: checkpoint {path} was trained on {' '.join(learned)}, cell {cell.id} plays {cell.task}"
        )
    return dataclasses.replace(
        cell,
        family=cell.family or facts.family,
        labels=facts.labels,
        trained_on=cell.trained_on or facts.trackers,
        trained_tasks=learned or cell.trained_tasks,
    )


def run_options(suite: SuiteFile, cell: SuiteCell, out: Path, device: str | None = None) -> RunOptions:
    """The flags of `eval run` for a cell."""
    entry = next(entry for entry in suite.policies if entry.name == cell.policy)
    scheme, others = cell.spec.partition(":")[0], set(flags_of(Remote)) - set(Remote.names_for(cell.spec))
    flags: JsonObject = {key: value for key, value in suite.defaults.items() if key not in others}
    flags |= {
        "task": (cell.task,),
        "tracker": (cell.tracker,),
        "mode": (cell.mode,),
        "rules": cell.rules,
        "policy": cell.spec,
        "checkpoint": suite.checkpoints.get(cell.tracker),
        "out": str(out / cell.folder),
    }
    if scheme != CHECKPOINTS and entry.labels:  # a checkpoint says its protocol itself
        flags["labels"] = entry.labels
    if entry.worlds is not None:
        flags["worlds"] = entry.worlds
    if device is not None:
        flags["device"] = device
    flags |= {flag: getattr(cell, key) for key, flag in LATER_FLAGS.items() if getattr(cell, key)}
    return RunOptions(**flags)


def matrix_table(cells: Sequence[SuiteCell], *, each: bool = False) -> str:
    """The matrix as Markdown: a row per policy, training and tracker, a column per task with finished and all cells.

    `each` lists every cell below it.
    """
    shown = [name for name in tasks.names() if any(cell.task == name for cell in cells)]
    shown += [cell.task for cell in cells if cell.task not in shown]
    rows: dict[tuple[str, str, str], dict[str, list[SuiteCell]]] = {}
    for cell in cells:
        key = (cell.policy, "+".join(cell.trained_on) or "–", cell.tracker)
        rows.setdefault(key, {}).setdefault(cell.task, []).append(cell)
    order = list(dict.fromkeys(cell.policy for cell in cells))
    lines = []
    for key in sorted(rows, key=lambda row: (order.index(row[0]), row[1:])):
        states = [rows[key].get(task, []) for task in shown]
        lines.append([*key, *("–" if not s else f"{sum(c.status == 'done' for c in s)}/{len(s)}" for s in states)])
    text = Table(["policy", "trained on", "tracker", *shown], lines, "lllr").markdown()
    if each:
        text += "\n" + "\n".join(
            f"{cell.status:<8} {cell.id}  {counted(cell.episodes, 'episode')}  {cell.spec}" for cell in cells
        )
    waiting = [cell for cell in cells if cell.status != "done"]
    left = f", {len(waiting)} to play: {simulated(sum(cell.ticks for cell in waiting))}" if waiting else ", all done"
    episodes = counted(sum(cell.episodes for cell in cells), "episode")
    return f"{text}\n{counted(len(cells), 'cell')} with {episodes}{left}"
