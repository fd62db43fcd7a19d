"""`python -m arena_newton.eval pack`: a trained checkpoint becomes a small policy with a card of what it reaches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.cli.flags import Several, shell_command, words
from arena_newton.errors import InputError
from arena_newton.files.text import counted

if TYPE_CHECKING:
    from arena_newton.eval.folders.results import RunRecord
    from arena_newton.eval.tables.episode_table import EvaluatedCell
    from arena_newton.policies.learned.learned_card import CellResult, OtherTraining, PolicyCard
    from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts

__all__ = ["PackOptions", "run"]

ENOUGH = 0.75
"""Success rate from which on a task counts as solved."""
PROGRAM = "arena_newton.eval"


@dataclass(frozen=True)
class PackOptions:
    """Pack a trained checkpoint into the form that ships: float16, a card, at most 32 MB; ACT only.

    `eval run --policy learned:<out>` runs it, without LeRobot. Without --out it becomes the policy of this package,
    `--policy learned`.
    """

    out: str | None = None
    """Folder to write; that of the policy that comes with the package when none is named."""
    tasks: Several[str] = ()
    """Tasks that it is offered for, in the order in which it plays them; with results those that it solves at
    75 % in mode base through every tracker of its training, otherwise those of its training, and of a packed policy
    that is packed again those it was offered for."""
    results: Several[str] = ()
    """Results folders or suites of eval whose cells of this checkpoint go into the card; a packed policy that is
    packed again keeps its other cells."""
    trainings: Several[str] = ()
    """Results folders or suites of other trainings of this recipe on these datasets, whose successes stand in the card
    next to this one's."""
    command: str = ""
    """Command of the training, if not as the checkpoint remembers it."""
    note: str = ""
    """A sentence for the card."""


def run(checkpoints: Sequence[Path], options: PackOptions) -> int:
    """Write the packed policy, and print what it is.

    Raises:
        InputError: The checkpoint or a flag is unfit, or the results are of another policy.
    """
    from arena_newton import tasks
    from arena_newton.policies.learned.learned_card import CARD_FILE, SHIPPED, PolicyCard, read_card
    from arena_newton.policies.learned.packed_checkpoint import read_act_checkpoint
    from arena_newton.policies.lerobot.checkpoint_facts import checkpoint_folder
    from arena_newton.policies.train.checkpoint_packing import changed_looks, pack, packed_digest, training_command

    (given,) = checkpoints
    if options.out is not None and not options.out.strip():
        raise InputError("--out: is empty, name a folder")
    folder = checkpoint_folder(given, "pack ")
    checkpoint = read_act_checkpoint(folder)
    facts = checkpoint.facts
    before = read_card(folder) if (folder / CARD_FILE).is_file() else None  # of one that is packed again
    digests = (checkpoint.digest, packed_digest(folder), *filter(None, [before.trained_weights if before else ""]))
    found = _results([Path(name).expanduser() for name in options.results], digests)
    kept = _kept(before, digests, found)
    found = (*found, *kept)
    others = _trainings([Path(name).expanduser() for name in options.trainings], facts, digests)
    # Of equally good tasks the first stays the first.
    trained = tuple(dict.fromkeys((*(before.tasks if before else ()), *(facts.tasks or facts.task_vector))))
    again = before.tasks if before is not None and not options.results else ()  # nothing new is known of them
    chosen = options.tasks or again or (_solved(found, trained, facts.trackers) if found else trained)
    for task in chosen:
        if task not in tasks.names():
            known = f"choose from {', '.join(tasks.names())}"
            if options.tasks:
                raise InputError(f"--tasks {task}: unknown, {known}")
            raise InputError(
                f"{folder}: was trained on {task}, a task that is not known; --tasks takes others, {known}"
            )
    if not chosen:
        why = f"none is solved at {100 * ENOUGH:.0f} %" if found else "the checkpoint names none"
        raise InputError(f"--tasks: {why}; name those that it is offered for")
    out = SHIPPED if options.out is None else Path(options.out).expanduser()
    results, trainings = (tuple(Path(name).name for name in names) for names in (options.results, options.trainings))
    flags = PackOptions(tasks=options.tasks, results=results, trainings=trainings)
    packed_by = shell_command(PROGRAM, "pack", given.name or given.resolve().name, *words(flags))
    card = PolicyCard(
        tasks=tuple(dict.fromkeys(chosen)),
        command=options.command or training_command(facts) or (before.command if before is not None else ""),
        looks=changed_looks(facts) or (before.looks if before is not None else ()),
        trained_weights=before.trained_weights if before is not None else checkpoint.digest,
        packed_by="; then ".join([*([before.packed_by] if before and kept else []), packed_by]),
        note=options.note or (before.note if before is not None else ""),
        results=_in_order(found, chosen, facts.trackers),
        trainings=others or (before.trainings if before is not None and kept else ()),
    )
    card = pack(folder, out, card)
    print(f"{out}: {card.bytes / 1e6:.2f} MB, weights {card.weights}, tasks {', '.join(card.tasks)}")
    for one in card.results:
        print(f"  {one.task} {one.tracker} {one.mode}: {one.successes}/{one.episodes}")
    spec = "learned" if out == SHIPPED else f"learned:{out}"
    print(f"run it: {shell_command(PROGRAM, '--task', card.tasks[0], '--policy', spec)}")
    return 0


def _results(folders: Sequence[Path], digests: Sequence[str]) -> tuple[CellResult, ...]:
    """Results of a checkpoint: its cells, with chunks executed as its own facts say, without latency.

    Raises:
        InputError: A folder is unfit or unfinished, was played under conditions of its own, or holds no cell of this
            checkpoint.
    """
    if not folders:
        return ()
    mine = f"this checkpoint (weights {' or '.join(digests)})"
    _, cells, notes = _usual("--results", folders, digests.__contains__, mine)
    for note in notes:
        print(note)
    return _counts("--results", cells)


def _trainings(folders: Sequence[Path], facts: CheckpointFacts, digests: Sequence[str]) -> tuple[OtherTraining, ...]:
    """Results of other trainings, in the order of their folders.

    Raises:
        InputError: A folder is unfit or unfinished, was played under conditions of its own, or holds no cell of another
            training of this recipe on these datasets.
    """
    from arena_newton.policies.learned.learned_card import OtherTraining

    datasets = [dict(one) for one in facts.datasets]
    ours = {"family": facts.family, "recipe": facts.recipe, "datasets": _names_of(datasets)}
    seeds: dict[str, int] = {}
    again: set[str] = set()
    found: dict[str, list[EvaluatedCell]] = {}
    for folder in folders:  # one by one: cells of two trainings have the same names
        runs, cells, _ = _usual(
            "--trainings", [folder], lambda weights: weights not in ("", *digests), "another training"
        )
        for run in runs:
            stated = run.config.get("policy_facts") or {}
            theirs = stated.get("datasets", datasets)
            for name, value in ours.items():
                if (_names_of(theirs) if name == "datasets" else stated.get(name, value)) != value:
                    raise InputError(f"--trainings {folder}: is of another {name} than this checkpoint")
            weights = str(stated.get("weights"))
            seeds[weights] = int(stated.get("seed") or 0)
            again |= {weights} if theirs != datasets else set()
        for cell in cells:
            found.setdefault(cell.weights, []).append(cell)
    return tuple(
        OtherTraining(
            seed=seeds.get(weights, 0),
            weights=weights,
            results=_counts("--trainings", cells),
            recorded_again=weights in again,
        )
        for weights, cells in found.items()
    )


def _names_of(datasets: object) -> list[object]:
    """Names of datasets as a checkpoint's facts have them."""
    return [one.get("name") for one in datasets if isinstance(one, dict)] if isinstance(datasets, list) else []


def _usual(
    flag: str, folders: Sequence[Path], wanted: Callable[[str], bool], whose: str
) -> tuple[list[RunRecord], list[EvaluatedCell], tuple[str, ...]]:
    """Runs and cells of wanted weights, chunks executed as the checkpoint's own facts say, and notes for a reader.

    Raises:
        InputError: There is none, or a run is no result of the benchmark: cut budgets, another scene, or unfinished.
    """
    from arena_newton.eval.folders.results import is_complete, load_run
    from arena_newton.eval.tables.evaluated_cells import read_cells

    read = read_cells(folders)
    cells = [cell for cell in read.cells if wanted(cell.weights)]
    cells = [cell for cell in cells if not cell.latency and cell.replan is None and not cell.ensemble]
    if not cells:
        raise InputError(f"{flag} {' '.join(map(str, folders))}: no cell of {whose}, its chunks executed whole")
    runs = [load_run(folder) for folder in dict.fromkeys(cell.folder for cell in cells)]
    for run in runs:
        where = f"{flag} {run.folder}"
        if not is_complete(run):
            # Successes end before timeouts do: the first episodes of a run are no fair sample of it.
            played = f"({len(run.records):,} of {counted(run.document['planned'], 'episode')})"
            raise InputError(f"{where}: is unfinished {played}, and what ends first is no fair sample; eval resume it")
        for name, text in (("max_steps", "--max-steps"), ("variant", "--variant")):
            if run.config.get(name) is not None:
                raise InputError(f"{where}: was played with {text}, which makes it no result of the benchmark")
    return runs, cells, read.notes


def _counts(flag: str, cells: Sequence[EvaluatedCell]) -> tuple[CellResult, ...]:
    """Counts of a network's cells.

    Raises:
        InputError: A cell is in two folders.
    """
    from arena_newton.policies.learned.learned_card import CellResult

    ordered = sorted(cells, key=_names)
    for cell, other in itertools.pairwise(ordered):
        if _names(cell) == _names(other):
            names = f"{cell.task} {cell.tracker} {cell.mode}"
            raise InputError(f"{flag} {other.folder}: {names} is in {cell.folder} too; leave one of them out")
    return tuple(
        CellResult(
            task=cell.task,
            tracker=cell.tracker,
            mode=cell.mode,
            episodes=len(cell.records),
            successes=sum(cell.held().values()),
            falls=sum(cell.held("fall").values()),
        )
        for cell in ordered
    )


def _kept(before: PolicyCard | None, digests: Sequence[str], found: Sequence[CellResult]) -> list[CellResult]:
    """Cells of the card of a policy that is packed again, whose weights stay; those that were found anew are not."""
    if before is None or before.weights not in digests:
        return []
    return [cell for cell in before.results if _names(cell) not in {_names(one) for one in found}]


def _names(cell: EvaluatedCell | CellResult) -> tuple[str, str, str]:
    return cell.task, cell.tracker, cell.mode


def _in_order(cells: Sequence[CellResult], offered: Sequence[str], trackers: Sequence[str]) -> tuple[CellResult, ...]:
    """Cells as a card lists them: tasks that it is offered for and trackers of its training come first."""
    from arena_newton import tasks
    from arena_newton.rules import modes

    def place(name: str, known: Sequence[str]) -> tuple[int, str]:
        return (known.index(name) if name in known else len(known)), name

    first = (*offered, *tasks.names())
    order = modes.names()
    return tuple(sorted(cells, key=lambda c: (place(c.task, first), place(c.tracker, trackers), place(c.mode, order))))


def _solved(found: Sequence[CellResult], trained: Sequence[str], trackers: Sequence[str]) -> tuple[str, ...]:
    """Tasks solved often enough in mode base through every tracker of the training, the best first."""
    rates: dict[str, list[float]] = {}
    for one in found:
        if one.mode == "base" and one.tracker in (trackers or (one.tracker,)):
            rates.setdefault(one.task, []).append(one.rate)
    solved = [task for task in trained if len(rates.get(task, ())) >= max(len(trackers), 1)]
    solved = [task for task in solved if min(rates[task]) >= ENOUGH]
    return tuple(sorted(solved, key=lambda task: -min(rates[task])))
