"""`python -m arena_newton.eval adversary`: where a policy does worst, beside its mean over the range of placements."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from arena_newton.cli.flags import check_least
from arena_newton.cli.intervals import wilson
from arena_newton.errors import InputError
from arena_newton.eval.studies.placement_options import PlacementOptions
from arena_newton.files.text import counted
from arena_newton.robot.g1 import TICK

if TYPE_CHECKING:
    from arena_newton.eval.plan.episode_plan import Episode
    from arena_newton.eval.play.run import Factories
    from arena_newton.eval.studies.placed_play import PlacedWorlds
    from arena_newton.eval.studies.placement_axes import Axis
    from arena_newton.eval.studies.placement_files import PlacedRows, PointTally
    from arena_newton.eval.studies.worst_placement import Point
    from arena_newton.interfaces import EpisodeResult

__all__ = ["AdversaryOptions", "run"]

FORMAT = 1
"""Version of adversary.json."""


@dataclass(frozen=True)
class AdversaryOptions(PlacementOptions):
    """Search the placement of a task at which a policy does worst, and report it beside the mean over the range.

    The cross-entropy method on margins: batches of placements, all played at once; on CUDA thousands of worlds.
    """

    batch: int = 60
    """Placements of a batch; the first is drawn from the whole range and gives the mean."""
    batches: int = 5
    """Batches, each drawn where the ones before did worst."""
    confirm: int = 10
    """Episodes with new seeds at the placement that was found worst."""
    search_seed: int = 0
    """Seed of the search itself."""
    out: str | None = None
    """Folder to write, which must not exist; results/adversary_<task>_<tracker>_<mode> when none is named."""


def run(options: AdversaryOptions, factories: Factories | None = None) -> int:
    """Search, confirm, write episodes.csv, placements.csv and adversary.json, and print what was found.

    Returns:
        Exit code: 0, or 1 when an episode ended with an error.

    Raises:
        InputError: A flag is unfit; raised before the first episode.
        StorageError: A file cannot be written.
    """
    from arena_newton.eval.records.journal import write_atomic
    from arena_newton.eval.studies.placed_play import PlacedWorlds, placement_run
    from arena_newton.eval.studies.placement_files import PlacedRows, point_rows, study_folder, tallies
    from arena_newton.eval.studies.worst_placement import search, worst_of

    config, axes = placement_run(options)
    _check(options)
    confirming, _ = placement_run(dataclasses.replace(options, seed=options.seed + 1, repeats=options.confirm))
    with PlacedWorlds(config, axes, factories) as worlds:
        folder = study_folder(options.out, "adversary", config.flags.task[0], options.tracker, options.mode)
        study = _Study(worlds, options, PlacedRows(folder, axes))
        try:
            points, scores = search(
                axes, study.scores, batches=options.batches, size=options.batch, seed=options.search_seed
            )
            number = worst_of(axes, points, scores)
            fresh = study.play([points[number]], confirming.episodes) if number is not None else []
        finally:
            study.close()
    searched = tallies(study.results)[: len(points)]
    first = searched[: options.batch]
    found = _Found(
        axes,
        mean=(sum(one.successes for one in first), sum(one.judged for one in first)),
        worst=None if number is None else searched[number],
        confirmed=tallies(fresh)[0] if fresh else None,
        episodes=len(study.results),
    )
    write_atomic(folder / "placements.csv", point_rows(axes, searched))
    write_atomic(folder / "adversary.json", _json(options, found))
    print("\n".join(found.lines()))
    print(f"written: {folder / 'adversary.json'}, placements.csv, episodes.csv")
    return 1 if any(result.outcome == "error" for result in study.results) else 0


def _check(options: AdversaryOptions) -> None:
    from arena_newton.eval.studies.placed_play import MOST_EPISODES

    check_least(options, 10, "batch")
    check_least(options, 1, "batches", "confirm")
    check_least(options, 0, "search_seed")
    count = options.batch * options.batches * options.repeats + options.confirm
    if count > MOST_EPISODES:
        raise InputError(f"--batch, --batches and --repeats: make {count:,} episodes, at most {MOST_EPISODES:,}")


class _Study:
    """Plays batches and keeps what came of them."""

    def __init__(self, worlds: PlacedWorlds, options: AdversaryOptions, rows: PlacedRows):
        from arena_newton.eval.reports.progress import Progress

        self.results: list[EpisodeResult] = []
        self._worlds, self._rows = worlds, rows
        self._budget = worlds.config.episodes[0].max_steps
        count = options.batch * options.batches * options.repeats + options.confirm
        self._progress = Progress(self._budget * count, planned=count)
        self._progress.group(f"{worlds.config.flags.task[0]} {options.tracker} {options.mode}")
        self._points = 0

    def play(self, points: Sequence[Point], episodes: Sequence[Episode] | None = None) -> list[EpisodeResult]:
        """Results of placements, in their order."""
        placed = self._worlds.placed(points, self._points, episodes)
        self._points += len(points)
        results = self._worlds.play(placed, self._ended, self._progress.tick)
        self.results += results
        return results

    def scores(self, points: list[Point]) -> list[float]:
        """Score of each placement."""
        from arena_newton.eval.studies.worst_placement import score_of

        results = self.play(points)
        each = len(results) // len(points)
        return [score_of(results[k * each : (k + 1) * each], self._budget) for k in range(len(points))]

    def close(self) -> None:
        """Put the rows in order."""
        self._progress.close()
        self._rows.close()

    def _ended(self, result: EpisodeResult) -> None:
        self._rows.add(result)
        self._progress.episode(self._budget, round(result.sim_s / TICK))


@dataclasses.dataclass(frozen=True)
class _Found:
    """Result of the search."""

    axes: tuple[Axis, ...]
    mean: tuple[int, int]
    """Successes and judged episodes of the first batch, which is drawn from the whole range."""
    worst: PointTally | None
    """The placement around which most failed; None where all ended with errors."""
    confirmed: PointTally | None
    """The same placement with new seeds."""
    episodes: int

    def lines(self) -> list[str]:
        """In words."""
        parts = [f"mean over the range: {_rate(*self.mean)}"]
        if self.worst is None or self.confirmed is None:
            return [*parts, "worst: none judged"]
        parts.append(f"worst of {counted(self.episodes, 'episode')}: {self.worst.where(self.axes)}")
        ended = (
            f"slowest of its successes {self.worst.success_s:.1f} s"
            if self.worst.rate == 1.0
            else (f"{self.worst.successes}/{self.worst.judged}, mean margin {self.worst.mean_margin:+.3f} m")
        )
        parts.append(f"  as found: {ended}")
        parts.append(f"  with new seeds: {_rate(self.confirmed.successes, self.confirmed.judged)}")
        return parts


def _rate(successes: int, judged: int) -> str:
    low, high = wilson(successes, judged)
    rate = f"{successes / judged:.1%}" if judged else "none judged"
    return f"{successes}/{judged} ({rate}, 95 % {low:.1%} to {high:.1%})"


def _json(options: AdversaryOptions, found: _Found) -> str:
    def plain(one: PointTally | None) -> dict[str, object] | None:
        if one is None:
            return None
        facts = dataclasses.asdict(one) | {"success_rate": one.rate}
        return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in facts.items()}

    document = {
        "format": FORMAT,
        "flags": {name: value for name, value in dataclasses.asdict(options).items() if name not in ("out", "worlds")},
        "axes": [dataclasses.asdict(axis) | {"name": axis.name} for axis in found.axes],
        "episodes": found.episodes,
        "mean": {"successes": found.mean[0], "judged": found.mean[1], "interval": wilson(*found.mean)},
        "worst": plain(found.worst),
        "confirmed": plain(found.confirmed),
    }
    return json.dumps(document, indent=2, allow_nan=False) + "\n"
