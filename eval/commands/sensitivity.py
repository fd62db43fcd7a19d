"""`python -m arena_newton.eval sensitivity`: success and margin over a grid of a task's placements."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from arena_newton.cli.flags import Several
from arena_newton.cli.intervals import wilson
from arena_newton.errors import InputError
from arena_newton.eval.studies.placement_options import PlacementOptions
from arena_newton.files.text import counted

if TYPE_CHECKING:
    from arena_newton.eval.plan.config import RunConfig
    from arena_newton.eval.play.factories import Factories
    from arena_newton.eval.studies.placement_axes import Axis
    from arena_newton.eval.studies.placement_files import PointTally

__all__ = ["SensitivityOptions", "run"]

FORMAT = 1
"""Version of sensitivity.json."""
MOST_AXES = 2
"""Axes of a picture."""


@dataclass(frozen=True)
class SensitivityOptions(PlacementOptions):
    """Map success and margin of a policy over the placements of a task: a grid over one or two numbers.

    At every point the same seeds are played (common random numbers), so that neighbours differ by the placement alone.
    Needs the extra [plots]. `--method adjoint` gives slopes of one episode's margin instead, to every placement, mass,
    friction and gain, from one play and one backward run (engine mujoco).
    """

    method: Literal["grid", "adjoint"] = "grid"
    """A grid of episodes, or the exact slopes of one."""
    reach: Several[float] = (0.001, 0.01)
    """With `--method adjoint`, the two scales at which differences must not contradict a slope: metres, radians or
    fractions of a factor."""
    grid: Several[int] = (7, 7)
    """Points along each axis, the ends of its range among them."""
    out: str | None = None
    """Folder to write, or to go on with; results/sensitivity_<task>_<tracker>_<mode> when none is named. Slopes of the
    same run may be added to a grid's folder: its page shows both."""


def run(options: SensitivityOptions, factories: Factories | None = None) -> int:
    """Play the grid; write its page, picture, tables and episodes; print what was found.

    Returns:
        Exit code: 0, or 1 when an episode ended with an error.

    Raises:
        InputError: A flag is unfit; raised before the first episode.
        StorageError: A file cannot be written.
    """
    from arena_newton.eval.studies.placement_run import MOST_EPISODES, placement_run

    config, all_axes = placement_run(options)
    if options.method == "adjoint":
        return _adjoint(options, config, all_axes, factories)
    axes = all_axes if options.axes else _widest(all_axes)
    if len(axes) > MOST_AXES:
        raise InputError(f"--axes {' '.join(options.axes)}: a map has one or two")
    grid = _grid(axes, options.grid, MOST_EPISODES)
    points = list(itertools.product(*grid))
    count = len(points) * len(config.episodes)
    if count > MOST_EPISODES:
        raise InputError(f"--grid and --repeats: make {count:,} episodes, at most {MOST_EPISODES:,}")
    from arena_newton.eval.records.journal import write_atomic
    from arena_newton.eval.studies.placed_play import PlacedWorlds
    from arena_newton.eval.studies.placement_files import PlacedStudy, point_rows, study_folder, summary_json, tallies
    from arena_newton.eval.studies.placement_map import draw_grid
    from arena_newton.eval.studies.placement_page import write_page
    from arena_newton.eval.tables.suite_figures import save

    words = "sensitivity", config.flags.task[0], options.tracker, options.mode
    with PlacedWorlds(config, axes, factories) as worlds, study_folder(options.out, *words) as folder:
        with PlacedStudy(worlds, folder, count, method="grid", grid=grid) as study:
            study.play(points)
        found = tallies(study.results)
        write_atomic(folder / "sensitivity.csv", point_rows(axes, found))
        successes, judged = sum(one.successes for one in found), sum(one.judged for one in found)
        described = [
            dataclasses.asdict(axis) | {"name": axis.name, "grid": values}
            for axis, values in zip(axes, grid, strict=True)
        ]
        lines = summary(axes, found)
        counts = {"interval": wilson(successes, judged), "points": [one.to_json() for one in found], "summary": lines}
        document = summary_json(FORMAT, options, described, successes=successes, judged=judged, **counts)
        write_atomic(folder / "sensitivity.json", document)
        title = f"{config.policy_label} through {options.tracker}: {config.flags.task[0]}, {options.mode}"
        save(draw_grid(axes, grid, found, title), folder / "sensitivity.png")
        page = write_page(folder, title)
    print("\n".join(lines))
    print(f"written: {page}, sensitivity.png, sensitivity.csv, sensitivity.json, episodes.csv")
    return 1 if any(one.errors for one in found) else 0


def _adjoint(options: SensitivityOptions, config: RunConfig, axes: Sequence[Axis], factories: Factories | None) -> int:
    """Write and print the slopes of one episode."""
    from arena_newton.rules.modes import DYNAMICS

    scales = options.reach
    if len(scales) != 2 or not 0.0 < scales[0] < scales[1]:
        shown = " ".join(f"{scale:g}" for scale in scales)
        raise InputError(f"--reach {shown}: expected two scales, the smaller first")
    if options.repeats != 1 or options.latency_ticks:
        raise InputError("--method adjoint: one episode without latency has slopes, not --repeats or --latency-ticks")
    smooth = [axis for axis in axes if not axis.counts and axis.record != DYNAMICS]
    from arena_newton.eval.play.factories import Factories
    from arena_newton.eval.studies.adjoint_slopes import play_slopes
    from arena_newton.eval.studies.placed_play import PlacedWorlds
    from arena_newton.eval.studies.placement_files import study_folder
    from arena_newton.eval.studies.placement_page import write_page

    words = "sensitivity", config.flags.task[0], options.tracker, options.mode
    with PlacedWorlds(config, smooth, factories) as worlds, study_folder(options.out, *words) as folder:
        lines = play_slopes(options, scales, worlds, folder, factories or Factories())
        title = f"{config.policy_label} through {options.tracker}: {config.flags.task[0]}, {options.mode}"
        page = write_page(folder, title)
    print("\n".join(lines))
    print(f"written: {page}, slopes.csv, slopes.json, slope_episodes.csv")
    return 0


def _widest(axes: Sequence[Axis]) -> tuple[Axis, ...]:
    """Both coordinates of the object with the largest area; without one, the first two axes that are no numbers."""
    by_record: dict[str, dict[str, Axis]] = {}
    for axis in axes:
        by_record.setdefault(axis.record, {})[axis.key] = axis
    flat = [(one["x"], one["y"]) for one in by_record.values() if {"x", "y"} <= set(one)]
    if flat:
        return max(flat, key=lambda pair: math.prod(axis.high - axis.low for axis in pair))
    return tuple(axis for axis in axes if not axis.counts)[:MOST_AXES] or tuple(axes[:MOST_AXES])


def _grid(axes: Sequence[Axis], points: Sequence[int], most: int) -> list[tuple[float, ...]]:
    shown = " ".join(map(str, points))
    if len(points) not in (1, len(axes)) and not (len(axes) == 1 and points == SensitivityOptions.grid):
        raise InputError(f"--grid {shown}: expected one number, or one for each of the {len(axes)} axes")
    if any(not 1 <= number <= most for number in points):
        raise InputError(f"--grid {shown}: expected at least 1 point along an axis, at most {most:,}")
    numbers = list(points) * len(axes) if len(points) == 1 else points
    return [axis.grid(number) for axis, number in zip(axes, numbers, strict=False)]


def summary(axes: Sequence[Axis], points: Sequence[PointTally]) -> list[str]:
    """Rate over all placements and the worst of them, in words."""
    from arena_newton.eval.studies.placement_files import rate_text

    successes, judged = sum(one.successes for one in points), sum(one.judged for one in points)
    errors = sum(one.errors for one in points)
    lines = [f"success over {counted(len(points), 'placement')}: {rate_text(successes, judged)}"]
    if errors:
        lines.append(f"{counted(errors, 'episode')} ended with an error and are in no rate")
    rated = [one for one in points if one.judged]
    if successes < judged:
        worst = min(rated, key=lambda one: (one.rate, one.mean_margin))
        counts = f"{worst.successes}/{worst.judged}, mean margin {worst.mean_margin:+.3f} m"
        lines.append(f"worst at {worst.where(axes)}: {counts}")
    elif rated:
        slowest = max(rated, key=lambda one: one.success_s)
        lines.append(f"slowest at {slowest.where(axes)}: {slowest.success_s:.1f} s")
    return lines
