"""A study of placements as it is played, and its files: a row per episode as they end, one per placement, a summary."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TextIO

from arena_newton.cli.intervals import wilson
from arena_newton.errors import InputError
from arena_newton.eval.folders.run_folder import setting
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.records.identity import differing_key
from arena_newton.eval.records.journal import OUTCOMES, StorageError, write_atomic
from arena_newton.eval.reports.progress import Progress
from arena_newton.eval.studies.placed_play import PlacedEpisode, PlacedWorlds
from arena_newton.eval.studies.placement_axes import Axis
from arena_newton.eval.studies.placement_options import PlacementOptions
from arena_newton.files.new_folder import held_folder
from arena_newton.files.stored_json import Json, JsonObject, read_object
from arena_newton.interfaces import EpisodeResult
from arena_newton.pages.tables import csv_lines
from arena_newton.robot.g1 import TICK

__all__ = ["SLOPES", "PlacedStudy", "PointTally", "point_rows", "rate_text", "study_folder", "summary_json", "tallies"]

EPISODES, SLOPES = "episodes", "slope_episodes"
"""Names, without their endings, of the files with one row per episode: of a grid or a search, and of slopes."""


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


@contextlib.contextmanager
def study_folder(out: str | None, *words: str) -> Iterator[Path]:
    """The folder of a study, made or gone on with, and kept from other processes while the block lasts.

    Args:
        out: What --out says.
        *words: What its usual name below `results` is made of.

    Raises:
        InputError: It holds something else, another process writes it, or it cannot be made.
    """
    usual = Path("results") / "_".join(re.sub(r"[^\w.-]+", "-", word) for word in words)
    folder = Path(out).expanduser() if out is not None else usual
    if folder.exists() and not any((folder / f"{name}.json").is_file() for name in (EPISODES, SLOPES)):
        raise InputError(f"--out {folder}: exists and holds no study of placements; name another folder")
    with held_folder(folder, "plays a study in it"):
        yield folder


class _PlacedRows:
    """A file with a row per episode, on the disk as soon as it has ended; `close` puts them in the plan's order.

    A JSON file next to it says of which run and study they are; rows of the same one are not played again.
    """

    def __init__(self, folder: Path, name: str, worlds: PlacedWorlds, study: JsonObject):
        """Begin the file, or read what an interrupted study left in it.

        Raises:
            InputError: The folder holds another run or study.
        """
        self._path, self._axes = folder / f"{name}.csv", worlds.axes
        self._results: list[EpisodeResult] = []
        self._kept: dict[tuple[str, ...], list[str]] = {}
        self._file: TextIO | None = None
        axes = [axis.name for axis in worlds.axes]
        facts = json.loads(json.dumps({"run": worlds.config.identity(), "study": {**study, "axes": axes}}))
        for one in (EPISODES, SLOPES):
            _check_same(folder / f"{one}.json", facts, other=one != name)
        if self._path.exists():
            self._read()
        else:
            write_atomic(self._path.with_suffix(".json"), json.dumps(facts, indent=2) + "\n")
        write_atomic(self._path, csv_lines([self._head(), *self._kept.values()]))
        try:
            self._file = self._path.open("a", encoding="utf-8", newline="")
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be written ({error.strerror})") from None

    def known(self, placed: PlacedEpisode) -> EpisodeResult | None:
        """Result of an episode that an interrupted study played."""
        row = self._kept.pop(self._key(placed), None)
        if row is None:
            return None
        outcome, reason, steps, margin = row[-4:]
        self._results.append(EpisodeResult(placed, outcome, reason, int(steps), float(margin)))
        return self._results[-1]

    def add(self, result: EpisodeResult) -> None:
        """Write an episode's row."""
        self._results.append(result)
        if self._file is not None:
            try:
                self._file.write(csv_lines([self._row(result)]))
                self._file.flush()
            except OSError as error:
                raise StorageError(f"{self._path}: cannot be written ({error.strerror})") from None

    def close(self) -> None:
        """Write all rows again, in the order of placements and seeds: the same bytes for any number of worlds."""
        if self._file is not None:
            self._file.close()
            self._file = None
        ordered = sorted(self._results, key=lambda one: (one.episode.point, one.episode.episode.index))
        write_atomic(self._path, csv_lines([self._head(), *map(self._row, ordered), *self._kept.values()]))

    def _read(self) -> None:
        """Rows of an interrupted study but for one that was not written whole; errors are played again."""
        try:
            whole, _, _ = self._path.read_text(encoding="utf-8").rpartition("\n")
            head, *rows = csv.reader(whole.splitlines())
            fits = head == self._head() and self._path.with_suffix(".json").exists()
            fits = fits and all(len(row) == len(head) and _is_result(*row[-4:]) for row in rows)
        except (ValueError, csv.Error):  # neither text nor numbers
            fits = False
        if not fits:
            raise InputError(f"{self._path}: is not what a study of placements wrote; name another folder")
        self._kept = {tuple(row[:-4]): row for row in rows if row[-4] != "error"}

    def _head(self) -> list[str]:
        names = [axis.name for axis in self._axes]
        return ["point", *names, "repeat", "episode_seed", "outcome", "reason", "steps", "margin"]

    def _key(self, placed: PlacedEpisode) -> tuple[str, ...]:
        values = map(_number, placed.values)
        return (str(placed.point), *values, str(placed.episode.repeat), str(placed.episode_seed))

    def _row(self, result: EpisodeResult) -> list[object]:
        return [*self._key(result.episode), result.outcome, result.reason, result.steps, repr(float(result.margin))]


def _is_result(outcome: str, reason: str, steps: str, margin: str) -> bool:
    """True if these can be of an episode; raises ValueError where they are no numbers."""
    return outcome in OUTCOMES and int(steps) >= 0 and (outcome == "error" or not math.isnan(float(margin)))


def _check_same(path: Path, wanted: JsonObject, *, other: bool) -> None:
    """Refuse a folder whose episodes are of another run, or of another study; of the `other` file the run counts alone.

    A grid has several seeds at each placement, slopes have one.
    """
    if not path.exists():
        return
    stored = read_object(path, 1 << 20)
    run, study = stored.get("run"), stored.get("study")
    if not isinstance(run, dict) or not isinstance(study, dict):
        raise InputError(f"{path}: is not what a study of placements wrote; name another folder")
    found = differing_key(run, wanted["run"], ("repeats",) if other else ())
    if found is None and not other:
        found = differing_key(study, wanted["study"])
    if found is not None:
        key, was, now = found
        raise InputError(
            f"--out {path.parent}: holds episodes of another study: {key} was {setting(was)}, now {setting(now)}; "
            "name another folder"
        )


class PlacedStudy:
    """Plays placements and keeps what came of them; a context that puts the rows in order."""

    def __init__(self, worlds: PlacedWorlds, folder: Path, count: int, name: str = EPISODES, **study: Json):
        """Begin a study of so many episodes in a folder, or go on with it.

        Args:
            worlds: Where they are played.
            folder: That of `study_folder`.
            count: Episodes.
            name: Name of the file of rows, without its ending.
            study: What makes it another study, besides its run and its axes.
        """
        flags = worlds.config.flags
        self.results: list[EpisodeResult] = []
        self.budget = worlds.config.episodes[0].max_steps
        """Step budget of an episode [ticks]."""
        self._worlds, self._points = worlds, 0
        self._rows = _PlacedRows(folder, name, worlds, study)
        self._progress = Progress(self.budget * count, planned=count)
        self._progress.group(f"{flags.task[0]} {flags.tracker[0]} {flags.mode[0]}")

    def play(
        self, points: Sequence[tuple[float, ...]], episodes: Sequence[Episode] | None = None
    ) -> list[EpisodeResult]:
        """Results of placements, in their order."""
        placed = self._worlds.placed(points, self._points, episodes)
        self._points += len(points)
        found = {one: self._rows.known(one) for one in placed}
        left = [one for one, result in found.items() if result is None]
        for _ in range(len(placed) - len(left)):
            self._progress.episode(self.budget, 0)
        if left:
            found |= dict(zip(left, self._worlds.play(left, self._ended, self._progress.tick), strict=True))
        results = [result for result in found.values() if result is not None]
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
