"""The numbers that the HumanoidArena paper prints, read from `eval/tables/paper/*.csv` and checked."""

from __future__ import annotations

import csv
import functools
import io
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.statistics.stats import suites, wilson

__all__ = [
    "FAMILIES",
    "FOLDER",
    "PAPER_MODES",
    "PaperNumbers",
    "PaperRate",
    "PaperTransfer",
    "PublishedRow",
    "paper_numbers",
    "published",
    "read_paper",
]

FOLDER = Path(__file__).parent / "paper"
"""Folder of the files, with a README that explains each column."""
FAMILIES: Mapping[str, str] = {"act": "act", "dp": "diffusion", "fm": "flow", "pi05": "pi05"}
"""Policy as the paper's tables abbreviate it → our name of the family."""
PAPER_MODES = ("base", "execution", "semantic", "visual")
"""The paper's modes; `rules.MODES`, what can be played, may have more."""
TRACKERS = ("twist2", "sonic")
"""The paper's trackers."""
TRAINING_SETS: Mapping[str, tuple[str, ...]] = {
    "TWIST2x7": ("twist2",),
    "SONICx7": ("sonic",),
    "TWIST2+SONICx14": ("twist2", "sonic"),
}
"""Merged training set → trackers of its demonstrations."""
AVERAGES = ("HOI_AVG", "HSI_AVG")
"""Suites whose averages the paper prints."""
EPISODES = 60
"""Episodes of a cell of the paper: 3 seeds x 20 (its appendix on the evaluation protocol)."""
POSSIBLE_EPISODES: Mapping[int, tuple[int, ...]] = {1: (EPISODES, 40), 2: (2 * EPISODES, 100)}
"""Trackers of a row's demonstrations → episodes that a cell may have, the likeliest first.

A policy of both trackers' demonstrations is evaluated through both. 40 and 100 are for two cells of ACT that lack one
seed: 17.5 ± 2.5 % and 36.0 ± 12.8 % are no rates of 60 and 120 episodes, and the rows' fall rates are 31/400 and
57/820.
"""
ROUNDING = 0.0501
"""Half of the last digit of a rate [percentage points], and room for binary fractions."""
MOST_BYTES = 1 << 20
"""Largest file that is read."""


@dataclass(frozen=True)
class PaperRate:
    """One success rate of the paper, fractions in [0, 1]."""

    family: str
    """`act`, `diffusion`, `flow`, `pi05`."""
    tracker: str
    """Tracker of training and execution; the merged training set's name in that table."""
    mode: str
    task: str
    """Task, or `HOI_AVG`, `HSI_AVG`."""
    sr: float
    sr_std: float
    """Population standard deviation over seeds; of an average over all task x seed rates."""
    afr: float
    """Fall rate over all tasks of the row."""
    episodes: int
    """Derived: the paper prints none."""

    @property
    def successes(self) -> int:
        """Derived from rate and episodes."""
        return round(self.sr * self.episodes)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the derived successes."""
        low, high = wilson(self.successes, self.episodes) or (0.0, 1.0)
        return low, high


@dataclass(frozen=True)
class PaperTransfer:
    """One cell of the paper's table of cross-GMT evaluation, fractions in [0, 1]."""

    family: str
    trained_on: str
    tracker: str
    """Tracker that executed it."""
    task: str
    drop: float
    """Matched minus swapped success rate."""
    retention: float
    """Swapped over matched success rate."""
    task_afr: float
    """Fall rate of this task and direction over all four policies."""


@dataclass(frozen=True)
class PaperNumbers:
    """All numbers of the paper's tables."""

    in_gmt: Mapping[tuple[str, str, str, str], PaperRate]
    """Rates by tracker, mode, family and task or average."""
    cross_gmt: Mapping[tuple[str, str, str, str], PaperTransfer]
    """Transfers by tracker of training, tracker of execution, family and task."""
    merged: Mapping[tuple[str, str, str], PaperRate]
    """Rates by training set, family and task or average."""

    def best(self, tracker: str, task: str, mode: str = "base") -> PaperRate:
        """The family with the highest rate."""
        return max((self.in_gmt[tracker, mode, family, task] for family in FAMILIES.values()), key=lambda r: r.sr)


def _rows(path: Path, columns: tuple[str, ...]) -> list[tuple[str, dict[str, str]]]:
    try:
        data = path.read_bytes()
        text = data.decode("utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is no UTF-8 text") from None
    if len(data) > MOST_BYTES:
        raise InputError(f"{path}: has {len(data)} bytes, expected at most {MOST_BYTES}")
    try:
        lines = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except csv.Error as error:
        raise InputError(f"{path}: is no table of CSV ({error})") from None
    if not lines or tuple(lines[0]) != columns:
        raise InputError(f"{path}: expected the columns {','.join(columns)}")
    found = []
    for number, line in enumerate(lines[1:], 2):
        if len(line) != len(columns):
            raise InputError(f"{path}: line {number}: has {len(line)} columns, expected {len(columns)}")
        found.append((f"{path}: line {number}", dict(zip(columns, line, strict=True))))
    return found


def _one_of(where: str, row: Mapping[str, str], column: str, known: Iterable[str]) -> str:
    names = tuple(known)
    if row[column] not in names:
        raise InputError(f"{where}: {column} is {row[column][:60]!r}, expected one of {' '.join(names)}")
    return row[column]


def _fraction(where: str, row: Mapping[str, str], column: str) -> float:
    try:
        value = float(row[column])
    except ValueError:
        value = math.nan
    if not 0 <= value <= 100:
        raise InputError(f"{where}: {column} is {row[column][:60]!r}, expected a percentage")
    return value / 100


def _episodes(where: str, sr: float, choices: tuple[int, ...]) -> int:
    """Number of episodes of which a rate can be printed."""
    for episodes in choices:
        if abs(round(sr * episodes) / episodes - sr) * 100 <= ROUNDING:
            return episodes
    raise InputError(f"{where}: sr_mean_pct is {100 * sr:g}, no rate of {' or '.join(map(str, choices))} episodes")


def _rate(
    where: str, row: Mapping[str, str], tracker: str, mode: str, choices: tuple[int, ...], counts: Mapping[str, int]
) -> PaperRate:
    """One row of rates; `counts` are the episodes of the row's tasks, for the averages after them."""
    task = _one_of(where, row, "task", (*suites()["ALL_AVG"], *AVERAGES))
    sr = _fraction(where, row, "sr_mean_pct")
    if task in AVERAGES:
        missing = [name for name in suites()[task] if name not in counts]
        if missing:
            raise InputError(f"{where}: {task} comes before its task {missing[0]}")
        episodes = sum(counts[name] for name in suites()[task])
    else:
        episodes = _episodes(where, sr, choices)
    family = FAMILIES[_one_of(where, row, "policy", FAMILIES)]
    std, afr = _fraction(where, row, "sr_std_pct"), _fraction(where, row, "afr_pct")
    return PaperRate(family, tracker, mode, task, sr, std, afr, episodes)


def _distinct[K, V](where: str, found: dict[K, V], key: K, value: V) -> None:
    if key in found:
        raise InputError(f"{where}: is there twice ({' '.join(map(str, key)) if isinstance(key, tuple) else key})")
    found[key] = value


def _complete(path: Path, found: int, wanted: int) -> None:
    if found != wanted:
        raise InputError(f"{path}: has {found} cells, the paper's table has {wanted}")


def _rates(
    path: Path, first: str, groups: Callable[[str, Mapping[str, str]], tuple[tuple[str, ...], str, int]]
) -> dict[tuple[str, ...], PaperRate]:
    """A table of rates by what `groups` names of a row: key, mode and number of trackers."""
    extra = ("mode",) if first == "tracker" else ()
    columns = (first, *extra, "policy", "task", "sr_mean_pct", "sr_std_pct", "afr_pct")
    found: dict[tuple[str, ...], PaperRate] = {}
    counts: dict[tuple[str, ...], dict[str, int]] = {}
    for where, row in _rows(path, columns):
        key, mode, trackers = groups(where, row)
        family = FAMILIES[_one_of(where, row, "policy", FAMILIES)]
        seen = counts.setdefault((*key, family), {})
        rate = _rate(where, row, key[0], mode, POSSIBLE_EPISODES[trackers], seen)
        seen[rate.task] = rate.episodes
        _distinct(where, found, (*key, family, rate.task), rate)
    return found


def read_paper(folder: Path = FOLDER) -> PaperNumbers:
    """Read the three files.

    Raises:
        InputError: One is missing or damaged, a name or number in it is unfit, a cell is missing or there twice, or a
            drop and a retention contradict the matched rate; the message names file and line.
    """

    def in_gmt(where: str, row: Mapping[str, str]) -> tuple[tuple[str, ...], str, int]:
        tracker, mode = _one_of(where, row, "tracker", TRACKERS), _one_of(where, row, "mode", PAPER_MODES)
        return (tracker, mode), mode, 1

    def merged(where: str, row: Mapping[str, str]) -> tuple[tuple[str, ...], str, int]:
        name = _one_of(where, row, "training_set", TRAINING_SETS)
        return (name,), "base", len(TRAINING_SETS[name])

    columns = len(suites()["ALL_AVG"]) + len(AVERAGES)
    rates = _rates(folder / "in_gmt.csv", "tracker", in_gmt)
    _complete(folder / "in_gmt.csv", len(rates), len(TRACKERS) * len(PAPER_MODES) * len(FAMILIES) * columns)
    joined = _rates(folder / "merge_all.csv", "training_set", merged)
    _complete(folder / "merge_all.csv", len(joined), len(TRAINING_SETS) * len(FAMILIES) * columns)
    by_mode = {(t, m, f, task): rate for (t, m, f, task), rate in rates.items()}
    by_set = {(s, f, task): rate for (s, f, task), rate in joined.items()}
    return PaperNumbers(by_mode, _transfers(folder / "cross_gmt.csv", by_mode), by_set)


def _transfers(
    path: Path, rates: Mapping[tuple[str, str, str, str], PaperRate]
) -> dict[tuple[str, str, str, str], PaperTransfer]:
    found: dict[tuple[str, str, str, str], PaperTransfer] = {}
    columns = ("direction", "policy", "task", "drop_pct", "retention_pct", "task_afr_pct")
    directions = [f"{a}->{b}" for a in TRACKERS for b in TRACKERS if a != b]
    for where, row in _rows(path, columns):
        trained_on, _, tracker = _one_of(where, row, "direction", directions).partition("->")
        family = FAMILIES[_one_of(where, row, "policy", FAMILIES)]
        task = _one_of(where, row, "task", suites()["ALL_AVG"])
        drop, retention = _fraction(where, row, "drop_pct"), _fraction(where, row, "retention_pct")
        matched = rates[trained_on, "base", family, task].sr
        if matched > 0 and abs((matched - drop) / matched - retention) > 0.001:
            raise InputError(
                f"{where}: a drop of {100 * drop:g} from {100 * matched:g} is no retention of {100 * retention:g} %"
            )
        cell = PaperTransfer(family, trained_on, tracker, task, drop, retention, _fraction(where, row, "task_afr_pct"))
        _distinct(where, found, (trained_on, tracker, family, task), cell)
    _complete(path, len(found), len(directions) * len(FAMILIES) * len(suites()["ALL_AVG"]))
    return found


@dataclass(frozen=True)
class PublishedRow:
    """Success rates of base mode that others published of a policy of theirs, as they report them."""

    policy: str
    tracker: str
    source: str
    """Source of the numbers, with the date."""
    simulator: str
    rates: Mapping[str, float]
    """Rates by task, from 0 to 1."""

    def __str__(self) -> str:
        return f"{self.policy} by its authors ({self.source}) in {self.simulator}"


@functools.cache
def published() -> tuple[PublishedRow, ...]:
    """Rows of `published.csv`: what stands on the original's leaderboard beside the paper.

    Raises:
        InputError: The file is missing or damaged; the message names file and line.
    """
    path, columns = FOLDER / "published.csv", ("policy", "tracker", "source", "simulator", "task", "sr_pct")
    found: dict[tuple[str, str, str, str], dict[str, float]] = {}
    for where, row in _rows(path, columns):
        rates = found.setdefault((row["policy"], row["tracker"], row["source"], row["simulator"]), {})
        _distinct(where, rates, _one_of(where, row, "task", suites()["ALL_AVG"]), _fraction(where, row, "sr_pct"))
    return tuple(PublishedRow(*key, rates) for key, rates in found.items())


@functools.cache
def paper_numbers() -> PaperNumbers:
    """The numbers that come with the package."""
    return read_paper()
