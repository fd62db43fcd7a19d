"""The run behind a study of placements, checked before any library of physics is loaded."""

from __future__ import annotations

from arena_newton import rule_sets
from arena_newton.cli.flags import check_least, shared
from arena_newton.errors import InputError
from arena_newton.eval.plan.config import RunConfig, resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.studies.placement_axes import Axis, axes_of, chosen
from arena_newton.eval.studies.placement_options import PlacementOptions

__all__ = ["MOST_EPISODES", "placement_run"]

MOST_EPISODES = 200_000
"""Episodes of one study, as of one run."""
MOST_WORLDS = 65_536
"""Worlds of one batch."""


def placement_run(options: PlacementOptions) -> tuple[RunConfig, tuple[Axis, ...]]:
    """The run behind a study, checked: one task, tracker and mode, and its axes.

    Raises:
        InputError: A flag is unfit.
    """
    if not options.task:
        raise InputError("--task: name the task whose placements are moved")
    if options.task == "all":
        raise InputError("--task all: name one task; each has axes of its own")
    check_least(options, 0, "seed")
    check_least(options, 1, "repeats")
    if not 1 <= options.worlds <= MOST_WORLDS:
        raise InputError(f"--worlds {options.worlds}: expected 1 to {MOST_WORLDS:,}")
    config = resolve(
        shared(
            options,
            RunOptions,
            task=(options.task,),
            tracker=(options.tracker,),
            mode=(options.mode,),
            seeds=(options.seed,),
            out=None,
        )
    )
    task = config.flags.task[0]
    axes = axes_of(rule_sets.get(options.rules).task(task), options.mode)
    if not axes:
        raise InputError(f"--task {task}: draws no placement in mode {options.mode}")
    return config, chosen(axes, options.axes, task) if options.axes else axes
