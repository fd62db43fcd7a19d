"""`python -m arena_newton.eval adversary`: where a policy does worst, beside its mean over the range of placements."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

from arena_newton.cli.flags import check_least
from arena_newton.cli.intervals import wilson
from arena_newton.errors import InputError
from arena_newton.eval.studies.placement_options import PlacementOptions
from arena_newton.files.text import counted

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories
    from arena_newton.eval.studies.placement_axes import Axis
    from arena_newton.eval.studies.placement_files import PointTally
    from arena_newton.eval.studies.worst_placement import Point

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
    """Folder to write, or to go on with; results/adversary_<task>_<tracker>_<mode> when none is named."""


def run(options: AdversaryOptions, factories: Factories | None = None) -> int:
    """Search, confirm, write episodes.csv, placements.csv and adversary.json, and print what was found.

    Returns:
        Exit code: 0, or 1 when an episode ended with an error.

    Raises:
        InputError: A flag is unfit; raised before the first episode.
        StorageError: A file cannot be written.
    """
    from arena_newton.eval.studies.placement_run import placement_run

    config, axes = placement_run(options)
    _check(options)
    confirming, _ = placement_run(dataclasses.replace(options, seed=options.seed + 1, repeats=options.confirm))
    from arena_newton.eval.records.journal import write_atomic
    from arena_newton.eval.studies.placed_play import PlacedWorlds
    from arena_newton.eval.studies.placement_files import PlacedStudy, point_rows, study_folder, summary_json, tallies
    from arena_newton.eval.studies.worst_placement import score_of, search, worst_of

    words = "adversary", config.flags.task[0], options.tracker, options.mode
    asked = {name: getattr(options, name) for name in ("batch", "batches", "confirm", "search_seed")}
    with PlacedWorlds(config, axes, factories) as worlds, study_folder(options.out, *words) as folder:
        with PlacedStudy(worlds, folder, _episodes(options), method="adversary", **asked) as study:

            def scores(points: list[Point]) -> list[float]:
                results, each = study.play(points), options.repeats
                return [score_of(results[k * each : (k + 1) * each], study.budget) for k in range(len(points))]

            points, found_scores = search(
                axes, scores, batches=options.batches, size=options.batch, seed=options.search_seed
            )
            number = worst_of(axes, points, found_scores)
            fresh = study.play([points[number]], confirming.episodes) if number is not None else []
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
    summary = {
        "episodes": found.episodes,
        "mean": {"successes": found.mean[0], "judged": found.mean[1], "interval": wilson(*found.mean)},
        "worst": found.worst and found.worst.to_json(),
        "confirmed": found.confirmed and found.confirmed.to_json(),
    }
    described = [dataclasses.asdict(axis) | {"name": axis.name} for axis in axes]
    write_atomic(folder / "adversary.json", summary_json(FORMAT, options, described, **summary))
    print("\n".join(found.lines()))
    print(f"written: {folder / 'adversary.json'}, placements.csv, episodes.csv")
    return 1 if any(result.outcome == "error" for result in study.results) else 0


def _check(options: AdversaryOptions) -> None:
    from arena_newton.eval.studies.placement_run import MOST_EPISODES

    check_least(options, 10, "batch")
    check_least(options, 1, "batches", "confirm")
    check_least(options, 0, "search_seed")
    if (count := _episodes(options)) > MOST_EPISODES:
        raise InputError(f"--batch, --batches and --repeats: make {count:,} episodes, at most {MOST_EPISODES:,}")


def _episodes(options: AdversaryOptions) -> int:
    """Episodes of search and confirmation."""
    return options.batch * options.batches * options.repeats + options.confirm


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
        """Lines for the console."""
        from arena_newton.eval.studies.placement_files import rate_text

        parts = [f"mean over the range: {rate_text(*self.mean)}"]
        if self.worst is None or self.confirmed is None:
            return [*parts, "worst: none judged"]
        parts.append(f"worst of {counted(self.episodes, 'episode')}: {self.worst.where(self.axes)}")
        ended = (
            f"slowest of its successes {self.worst.success_s:.1f} s"
            if self.worst.rate == 1.0
            else (f"{self.worst.successes}/{self.worst.judged}, mean margin {self.worst.mean_margin:+.3f} m")
        )
        parts.append(f"  as found: {ended}")
        parts.append(f"  with new seeds: {rate_text(self.confirmed.successes, self.confirmed.judged)}")
        return parts
