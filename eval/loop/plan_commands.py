"""Commands of a plan: every recording, dataset, training, suite, table and card as a command of its own.

A command is known to be done by what its folder holds, and continues by itself what an earlier one left there.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from arena_newton import tasks
from arena_newton.cli.flags import words
from arena_newton.data.datasets.data_options import BuildOptions
from arena_newton.eval.loop.plan_file import LoopPlan, PlanRow, policy_name, suite_text
from arena_newton.eval.loop.stage_state import continued, played, succeeded, trained
from arena_newton.eval.records.document import CONFIG_FILE, SUITE_FILE
from arena_newton.eval.records.journal import write_atomic
from arena_newton.policies.train.policy_options import PolicyTrainOptions

__all__ = ["STAGES", "PlanCommand", "PlanFolders", "plan_commands"]

STAGES = ("record", "build", "train", "evaluate", "tables", "card")
"""Stages in their order."""
EVAL, TRAIN = "arena_newton.eval", "arena_newton.policies.train"
ALL_GPUS = -1
"""Number of GPUs of a command that divides those of the machine itself."""


@dataclass(frozen=True)
class PlanFolders:
    """Folders of a plan that is played."""

    out: Path

    def recordings(self, task: str, tracker: str, parts: int) -> list[Path]:
        """Recordings of a pair."""
        name = self.out / "demonstrations" / f"{task}_{tracker}"
        return [name] if parts == 1 else [name.with_name(f"{name.name}_{part}") for part in range(1, parts + 1)]

    def dataset(self, task: str, tracker: str) -> Path:
        """Dataset of a pair."""
        return self.out / "datasets" / f"{task}_{tracker}"

    def training(self, row: PlanRow, seed: int) -> Path:
        """A training."""
        return self.out / "trainings" / f"{row.name}_{seed}"

    def suite(self, row: PlanRow) -> Path:
        """The suite of a row; its file is beside it."""
        return self.out / "evaluation" / row.name

    def suites(self, row: PlanRow) -> list[Path]:
        """The suite of a row where it was begun, and those of other machines that were put beside it as `<row>@…`."""
        found = [self.suite(row), *sorted(self.out.glob(f"evaluation/{row.name}@*"))]
        return [suite for suite in found if (suite / SUITE_FILE).is_file()]

    def trained(self, row: PlanRow) -> list[int]:
        """Seeds of the trainings of a row that are whole."""
        found = sorted(int(path.name.rpartition("_")[2]) for path in self.out.glob(f"trainings/{row.name}_[0-9]*"))
        return [seed for seed in found if trained(self.training(row, seed))]

    @property
    def tables(self) -> Path:
        """Tables of all suites."""
        return self.out / "tables"

    def packed(self, row: PlanRow) -> Path:
        """The packed policy of a row."""
        return self.out / "packed" / row.name


@dataclass(frozen=True, kw_only=True)
class PlanCommand:
    """A command of a stage."""

    stage: str
    name: str
    words: Callable[[], Sequence[str]]
    """Module and command line, made when it begins: those that continue what is there."""
    done: Callable[[], bool] = lambda: False
    after: tuple[str, ...] = ()
    """Commands that must be done before."""
    needs_all: bool = True
    """False: one of them is enough, once the others have ended."""
    gpus: int = 0
    """GPUs that it takes."""
    size: float = 0.0
    """The larger of two commands begins first."""

    def __str__(self) -> str:
        """Stage and name."""
        return f"{self.stage} {self.name}".strip()


def plan_commands(
    plan: LoopPlan,
    folders: PlanFolders,
    *,
    rows: Sequence[PlanRow],
    seeds: Sequence[int],
    device: str | None,
    gpus: int,
    minutes: Callable[[], float],
    middle: Callable[[Sequence[Path]], tuple[int, list[Path]]],
) -> list[PlanCommand]:
    """All commands of a plan, each after those that it needs.

    Args:
        plan: The plan.
        rows: Its rows that are trained; the first one's policy is packed.
        seeds: Seeds of the trainings of each row.
        device: Device of all commands; None: the best there is.
        minutes: Time of a training that begins now [min].
        middle: Seed of the training that is packed of those in some suites, and the suites that hold others.
    """
    found: list[PlanCommand] = []
    trackers = plan.record.tracker or ("twist2",)
    for task, tracker in itertools.product(plan.attempts, trackers):
        if any(task in row.tasks and tracker in row.trackers for row in rows):
            found += _demonstrations(plan, folders, task, tracker, device)
    for row in rows:
        datasets = tuple(folders.dataset(*pair) for pair in itertools.product(row.tasks, row.trackers))
        each = max(1, min(plan.settings.gpus, gpus))
        for seed in seeds:
            folder = folders.training(row, seed)
            options = dataclasses.replace(
                row.train, dataset=datasets, out=folder, seed=seed, device=device or row.train.device
            )
            found.append(
                PlanCommand(
                    stage="train",
                    name=folder.name,
                    words=partial(_trained, options, minutes, each, max(1, gpus) * plan.settings.trainings),
                    done=partial(trained, folder),
                    after=tuple(f"build {dataset.name}" for dataset in datasets),
                    gpus=each,
                )
            )
        found.append(
            PlanCommand(
                stage="evaluate",
                name=row.name,
                words=partial(_evaluated, plan, folders, row, device, gpus),
                done=partial(_played, folders, row, seeds),
                after=tuple(f"train {folders.training(row, seed).name}" for seed in seeds),
                needs_all=False,
                gpus=ALL_GPUS,
            )
        )
    found.append(
        PlanCommand(
            stage="tables",
            name="",
            words=partial(_tables, folders, rows),
            after=tuple(f"evaluate {row.name}" for row in rows),
        )
    )
    first = rows[0]
    if first.train.policy == "act":  # other families are not packed
        card = partial(_packed, plan, folders, first, middle)
        found.append(PlanCommand(stage="card", name=first.name, words=card, after=("tables",)))
    return found


def _demonstrations(
    plan: LoopPlan, folders: PlanFolders, task: str, tracker: str, device: str | None
) -> list[PlanCommand]:
    """Recordings of a pair, and the dataset that is built of them."""
    parts, dataset = plan.parts.get(task, 1), folders.dataset(task, tracker)
    sets = folders.recordings(task, tracker, parts)
    build = words(BuildOptions(out=dataset, only_success=not plan.settings.failures_too))
    attempts = plan.attempts[task]
    recorded = [
        PlanCommand(
            stage="record",
            name=folder.name,
            words=partial(_recorded, _recording(plan, task, tracker, f"{number}/{parts}", folder, device), folder),
            done=partial(succeeded, folder),
            gpus=1,
            size=attempts * tasks.get(task).steps.paper / parts,
        )
        for number, folder in enumerate(sets, 1)
    ]
    built = PlanCommand(
        stage="build",
        name=dataset.name,
        words=partial(list, ["arena_newton.data", "build", *map(str, sets), *build]),
        done=dataset.is_dir,
        after=tuple(map(str, recorded)),
    )
    return [*recorded, built]


def _recording(plan: LoopPlan, task: str, tracker: str, part: str, folder: Path, device: str | None) -> list[str]:
    """Flags of a recording."""
    attempts, parts = plan.attempts[task], int(part.partition("/")[2])
    options = dataclasses.replace(
        plan.record,
        task=(task,),
        tracker=(tracker,),
        episodes=attempts,
        worlds=-(-attempts // parts) if plan.at_once else plan.record.worlds,
        shard=part if parts > 1 else None,
        out=str(folder),
        device=device or plan.record.device,
    )
    return words(options)


def _recorded(flags: Sequence[str], folder: Path) -> list[str]:
    """Begin a recording, or go on with it."""
    if (folder / CONFIG_FILE).is_file():
        return [EVAL, "resume", str(folder)]
    return [EVAL, "record", *flags]


def _trained(options: PolicyTrainOptions, minutes: Callable[[], float], each: int, parts: int) -> list[str]:
    """Begin a training, or go on with it, on one of so many parts of the cores."""
    jobs = options.jobs or max(1, len(os.sched_getaffinity(0)) // parts)
    options = continued(options)
    if options.resume is None:
        options = dataclasses.replace(options, minutes=0.0 if options.steps else minutes())
    command = [TRAIN, *words(dataclasses.replace(options, jobs=jobs, quiet=True))]
    if each == 1:
        return command
    return ["torch.distributed.run", "--standalone", "--nproc-per-node", str(each), "-m", *command]


def _evaluated(plan: LoopPlan, folders: PlanFolders, row: PlanRow, device: str | None, gpus: int) -> list[str]:
    """Play all trainings of a row that are whole, those of earlier calls too."""
    suite, seeds = folders.suite(row), folders.trained(row)
    file = suite.with_suffix(".toml")
    file.parent.mkdir(exist_ok=True)
    write_atomic(file, suite_text(plan, row, {seed: folders.training(row, seed) for seed in seeds}))
    jobs = ["--jobs", str(plan.settings.cells * max(1, gpus))]
    return [EVAL, "matrix", str(file), "--out", str(suite), *jobs, *(["--device", device] if device else [])]


def _played(folders: PlanFolders, row: PlanRow, seeds: Sequence[int]) -> bool:
    """True if these trainings of a row were played, here or elsewhere."""
    return played(folders.suites(row), {policy_name(row, seed) for seed in seeds})


def _tables(folders: PlanFolders, rows: Sequence[PlanRow]) -> list[str]:
    suites = [str(suite) for row in rows for suite in folders.suites(row)]
    return [EVAL, "tables", *suites, "--out", str(folders.tables), "--format", "md", "tex", "csv"]


def _packed(
    plan: LoopPlan,
    folders: PlanFolders,
    row: PlanRow,
    middle: Callable[[Sequence[Path]], tuple[int, list[Path]]],
) -> list[str]:
    """Pack a training; cells whose budgets were cut are no results, and are not in its card."""
    suites = folders.suites(row)
    seed, others = middle(suites)
    training, out = str(folders.training(row, seed)), str(folders.packed(row))
    words = [EVAL, "pack", training, "--out", out, "--tasks", *row.tasks]
    for flag, some in () if plan.evaluate.get("max_steps") else (("--results", suites), ("--trainings", others)):
        words += [flag, *map(str, some)] if some else []
    return words
