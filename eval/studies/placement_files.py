"""A study of placements as it is played, and its files: a row per episode as they end, one per placement, a summary."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TextIO

from arena_newton.cli.intervals import wilson
from arena_newton.errors import InputError
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.records.journal import StorageError, write_atomic
from arena_newton.eval.reports.progress import Progress
from arena_newton.eval.studies.placed_play import PlacedEpisode, PlacedWorlds
from arena_newton.eval.studies.placement_axes import Axis
from arena_newton.eval.studies.placement_options import PlacementOptions
from arena_newton.interfaces import EpisodeResult
from arena_newton.pages.tables import csv_lines
from arena_newton.robot.g1 import TICK

__all__ = ["PlacedStudy", "PointTally", "point_rows", "rate_text", "study_folder", "summary_json", "tallies"]

EPISODES = "episodes.csv"
"""Name of the file with one row per episode."""


@dataclass(frozen=True)
class PointTally:
    """Results of the episodes at one placement."""

    values: tuple[float, ...]
    """Value of each axis."""
    episodes: int
    successes: int
    falls: int
    errors: int
    """Episodes that say nothing about the policy; they are in no rate and no margin."""
    mean_margin: float
    """Mean over the others of the margin at their ends [m]; NaN without any."""
    least_margin: float
    """The smallest of these margins [m]; NaN without any."""
    success_s: float
    """Mean time that the successes took [s]; NaN without any."""

    @property
    def judged(self) -> int:
        """Episodes without an error."""
        return self.episodes - self.errors

    @property
    def rate(self) -> float:
        """Successes of the judged episodes; NaN without any."""
        return self.successes / self.judged if self.judged else math.nan

    def to_json(self) -> dict[str, object]:
        """Its numbers and rate, null where they are NaN."""
        values = dataclasses.asdict(self) | {"success_rate": self.rate}
        return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()}

    def where(self, axes: Sequence[Axis]) -> str:
        """The placement in words."""
        columns = zip(axes, self.values, strict=True)
        return ", ".join(f"{axis.name} {value:.3g} {axis.unit}".rstrip() for axis, value in columns)


def tallies(results: Sequence[EpisodeResult]) -> list[PointTally]:
    """One per placement, in the order of the placements."""
    by_point: dict[int, list[EpisodeResult]] = {}
    for result in results:
        by_point.setdefault(result.episode.point, []).append(result)
    return [_tally(by_point[point]) for point in sorted(by_point)]


def _tally(results: Sequence[EpisodeResult]) -> PointTally:
    outcomes = [result.outcome for result in results]
    margins = [result.margin for result in results if result.outcome != "error" and math.isfinite(result.margin)]
    times = [result.steps * TICK for result in results if result.outcome == "success"]
    return PointTally(
        values=results[0].episode.values,
        episodes=len(results),
        successes=outcomes.count("success"),
        falls=outcomes.count("fall"),
        errors=outcomes.count("error"),
        mean_margin=math.fsum(margins) / len(margins) if margins else math.nan,
        least_margin=min(margins, default=math.nan),
        success_s=math.fsum(times) / len(times) if times else math.nan,
    )


def study_folder(out: str | None, *words: str) -> Path:
    """A new folder for a study.

    Args:
        out: What --out says.
        *words: What its usual name below `results` is made of.

    Raises:
        InputError: It exists.
        StorageError: It cannot be made.
    """
    usual = Path("results") / "_".join(re.sub(r"[^\w.-]+", "-", word) for word in words)
    folder = Path(out).expanduser() if out is not None else usual
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise InputError(f"--out {folder}: exists; name another folder") from None
    except OSError as error:
        raise StorageError(f"--out {folder}: cannot be made ({error.strerror})") from None
    return folder


class _PlacedRows:
    """`episodes.csv`: a row is on the disk as soon as its episode has ended; `close` puts them in the plan's order."""

    def __init__(self, folder: Path, axes: Sequence[Axis]):
        """Begin the file."""
        self._path, self._axes = folder / EPISODES, tuple(axes)
        self._results: list[EpisodeResult] = []
        self._file: TextIO | None = None
        try:
            self._file = self._path.open("x", encoding="utf-8", newline="")
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be written ({error.strerror})") from None
        self._put(self._file, [self._head()])

    def add(self, result: EpisodeResult) -> None:
        """Write an episode's row."""
        self._results.append(result)
        if self._file is not None:
            self._put(self._file, [self._row(result)])

    def close(self) -> None:
        """Write all rows again, in the order of placements and seeds: the same bytes for any number of worlds."""
        if self._file is not None:
            self._file.close()
            self._file = None
        ordered = sorted(self._results, key=lambda one: (one.episode.point, one.episode.episode.index))
        write_atomic(self._path, csv_lines([self._head(), *map(self._row, ordered)]))

    def _put(self, file: TextIO, rows: Sequence[Sequence[object]]) -> None:
        try:
            file.write(csv_lines(rows))
            file.flush()
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be written ({error.strerror})") from None

    def _head(self) -> list[str]:
        names = [axis.name for axis in self._axes]
        return ["point", *names, "repeat", "episode_seed", "outcome", "reason", "steps", "margin"]

    def _row(self, result: EpisodeResult) -> list[object]:
        placed: PlacedEpisode = result.episode
        columns = (result.outcome, result.reason, result.steps, f"{result.margin:.6g}")
        return [placed.point, *map(_number, placed.values), placed.episode.repeat, placed.episode_seed, *columns]


class PlacedStudy:
    """Plays placements and keeps what came of them; a context that puts the rows in order."""

    def __init__(self, worlds: PlacedWorlds, folder: Path, count: int):
        """Begin a study of so many episodes in a new folder."""
        flags = worlds.config.flags
        self.results: list[EpisodeResult] = []
        self.budget = worlds.config.episodes[0].max_steps
        """Step budget of an episode [ticks]."""
        self._worlds, self._rows, self._points = worlds, _PlacedRows(folder, worlds.axes), 0
        self._progress = Progress(self.budget * count, planned=count)
        self._progress.group(f"{flags.task[0]} {flags.tracker[0]} {flags.mode[0]}")

    def play(
        self, points: Sequence[tuple[float, ...]], episodes: Sequence[Episode] | None = None
    ) -> list[EpisodeResult]:
        """Results of placements, in their order."""
        placed = self._worlds.placed(points, self._points, episodes)
        self._points += len(points)
        results = self._worlds.play(placed, self._ended, self._progress.tick)
        self.results += results
        return results

    def _ended(self, result: EpisodeResult) -> None:
        self._rows.add(result)
        self._progress.episode(self.budget, round(result.sim_s / TICK))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.close()
        self._rows.close()


def rate_text(successes: int, judged: int) -> str:
    """Successes of judged episodes, their rate and its interval."""
    low, high = wilson(successes, judged)
    rate = f"{successes / judged:.1%}" if judged else "none judged"
    return f"{successes}/{judged} ({rate}, 95 % {low:.1%} to {high:.1%})"


def summary_json(version: int, options: PlacementOptions, axes: Sequence[Mapping[str, object]], **found: object) -> str:
    """Summary of a study: its flags, axes and what was found, as JSON."""
    flags = {name: value for name, value in dataclasses.asdict(options).items() if name not in ("out", "worlds")}
    document = {"format": version, "flags": flags, "axes": axes, **found}
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def _number(value: float) -> str:
    return f"{value:.6g}"


def point_rows(axes: Sequence[Axis], points: Sequence[PointTally]) -> str:
    """CSV with one row per placement."""
    columns = ("episodes", "successes", "falls", "errors", "success_rate", "mean_margin", "least_margin", "success_s")
    rows = []
    for one in points:
        counts = (one.episodes, one.successes, one.falls, one.errors)
        measured = (one.rate, one.mean_margin, one.least_margin, one.success_s)
        rows.append((*map(_number, one.values), *counts, *map(_number, measured)))
    return csv_lines([(*(axis.name for axis in axes), *columns), *rows])
