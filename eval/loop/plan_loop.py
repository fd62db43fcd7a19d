"""``python -m arena_newton.eval loop --plan``: many tasks, trackers and trainings as one command that continues.

The folder holds the plan itself, the folders of its commands, and `plan.md` with times, successes and failures.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from arena_newton.cli.flags import flag_name, shell_command, words
from arena_newton.errors import InputError, check_once
from arena_newton.eval.folders.run_folder import results_folder
from arena_newton.eval.loop import plan_report
from arena_newton.eval.loop.loop_options import LoopOptions
from arena_newton.eval.loop.loop_requirements import check_folder
from arena_newton.eval.loop.plan_commands import STAGES, PlanCommand, PlanFolders, plan_commands
from arena_newton.eval.loop.plan_file import LoopPlan, read_plan
from arena_newton.eval.loop.plan_run import CommandPlayer, command_times, stage_seconds
from arena_newton.eval.records.journal import write_atomic
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES
from arena_newton.files.new_folder import held_folder
from arena_newton.files.stored_json import read_regular
from arena_newton.physics.devices import visible_gpus

__all__ = ["PLAN_FLAGS", "PLAN_COPY", "commands_at_once", "run", "training_minutes"]

PLAN_COPY = "plan.toml"
"""The plan in the folder that it is played in."""
PLAN_FLAGS = ("plan", "rows", "seeds", "only")
"""Flags that belong to a plan."""
OF_ALL = (*PLAN_FLAGS, "minutes", "device", "out")
"""Flags that a loop by a plan has; the plan says what the others do."""
LEAST_MINUTES = 0.05
"""Shortest training [min]."""


def run(options: LoopOptions) -> int:
    """Play a plan, or continue it.

    Returns:
        Exit code: 0 when all commands of this call are done, 1 when one failed, 130 interrupted.

    Raises:
        InputError: A flag, the plan or the folder is unfit, or --only names a stage that lacks an earlier one.
    """
    for one in dataclasses.fields(LoopOptions):
        if one.name not in OF_ALL and getattr(options, one.name) != one.default:
            raise InputError(f"{flag_name(one.name)}: belongs to a loop without --plan, whose file says it")
    plan = read_plan(str(options.plan))
    for name in ("rows", "seeds", "only"):
        check_once(f"--{name}", getattr(options, name))
    rows = [plan.row(name) for name in options.rows] or [plan.rows[0]]
    seeds = sorted(options.seeds) or list(plan.settings.seeds)
    if not all(1 <= seed <= 9999 for seed in seeds):
        raise InputError(f"--seeds {' '.join(map(str, options.seeds))}: expected numbers 1 to 9999")
    for stage in options.only:
        if stage not in STAGES:
            raise InputError(f"--only {stage}: unknown, choose from {' '.join(STAGES)}")
    if options.minutes is not None and not options.minutes > plan.settings.reserve:
        kept = f"{plan.settings.reserve:g} are kept for decoding, evaluation and tables"
        raise InputError(f"--minutes {options.minutes:g}: {kept} ({plan.path}: [plan])")
    out = results_folder(options.out or f"results/loop_{plan.name}")
    check_folder(out)
    _is_this(out, plan)
    gpus = [] if options.device == "cpu" else visible_gpus()
    with held_folder(out, "works in it") as held:
        _is_this(out, plan)  # another process may have begun one meanwhile
        write_atomic(out / PLAN_COPY, plan.text.decode())
        for name in ("demonstrations", "datasets", "trainings", "evaluation"):
            (out / name).mkdir(exist_ok=True)
        folders = PlanFolders(out)
        commands = plan_commands(
            plan,
            folders,
            rows=rows,
            seeds=seeds,
            device=options.device,
            gpus=len(gpus),
            minutes=lambda: training_minutes(plan, options.minutes, out, len(rows) * len(seeds), len(gpus)),
            middle=plan_report.middle_training,
        )
        player = CommandPlayer(out, gpus, commands_at_once(plan, len(gpus)), held, plan.settings.again)
        return _play(player, _chosen(commands, options.only), plan, folders, options)


def training_minutes(plan: LoopPlan, given: float | None, out: Path, trainings: int, gpus: int) -> float:
    """Time of each training [min]: the plan's, or an equal part of what recording and building leave of a time for all.

    Args:
        given: Time of all stages [min].
        out: Folder in which demonstrations were recorded and datasets built, and trainings perhaps failed.
        gpus: GPUs of this machine, on which some of them run at once.

    Raises:
        InputError: Nothing is left.
    """
    if given is None:
        return plan.settings.minutes
    times = command_times(out)
    before = [one for one in times if one.stage in ("record", "build") or (one.stage == "train" and one.code)]
    spent = stage_seconds(before).get("all", 0.0) / 60.0
    waves = math.ceil(trainings / _trainings_at_once(plan, gpus))
    left = (given - plan.settings.reserve - spent) / waves
    if left < LEAST_MINUTES:
        raise InputError(f"--minutes {given:g}: recording and building took {spent:.1f}, nothing is left to train in")
    return round(left, 3)


def _trainings_at_once(plan: LoopPlan, gpus: int) -> int:
    """Trainings that run at once, on GPUs of their own or as many on the same ones as the plan says."""
    return max(1, gpus // plan.settings.gpus) * plan.settings.trainings


def commands_at_once(plan: LoopPlan, gpus: int) -> dict[str, int]:
    """Commands of each stage at once."""
    settings = plan.settings
    return {
        "record": settings.recordings,
        "build": settings.datasets,
        "train": _trainings_at_once(plan, gpus),
        "evaluate": settings.suites,
    }


def _is_this(out: Path, plan: LoopPlan) -> None:
    """Refuse a folder that holds another plan, or something else.

    Raises:
        InputError: It does.
    """
    try:
        stored = read_regular(out / PLAN_COPY, MAX_CONFIG_BYTES)
    except FileNotFoundError:
        if out.is_dir() and any(out.iterdir()):
            raise InputError(f"--out {out}: is not empty and holds no plan; choose another folder") from None
        return
    if stored != plan.text:
        raise InputError(f"--out {out}: was begun with another plan than {plan.path} holds now ({out / PLAN_COPY})")


def _chosen(commands: Sequence[PlanCommand], only: Sequence[str]) -> list[PlanCommand]:
    """Commands of the stages that are played, and those that are done.

    Raises:
        InputError: One needs a command of another stage that is not done.
    """
    chosen = [command for command in commands if not only or command.stage in only or command.done()]
    names = {str(command) for command in chosen}
    for command in chosen:
        missing = [name for name in command.after if name not in names and command.stage in only]
        if missing:
            raise InputError(f"--only {' '.join(only)}: {command} needs {missing[0]}, which is not done")
    return chosen


def _play(
    player: CommandPlayer, commands: Sequence[PlanCommand], plan: LoopPlan, folders: PlanFolders, options: LoopOptions
) -> int:
    """Play commands, and report whatever is there."""
    again = shell_command("arena_newton.eval", "loop", *words(options))
    code = 1
    try:
        code = 0 if player.play(commands) else 1
    except KeyboardInterrupt:
        code = 130
        print(f"\ninterrupted; continue with: {again}")
    for line in plan_report.write(plan, folders, command_times(player.out), again):
        print(line)
    for name, why in player.failed.items():
        print(f"failed: {name}: {why}")
    if player.failed:
        print(f"continue with: {again}")
    return code
