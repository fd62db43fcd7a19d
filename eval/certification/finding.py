"""Checks and their findings: records that the page, the JSON and the console show in their own ways."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from arena_newton.cli.intervals import wilson
from arena_newton.eval.statistics.stats import paired_rates
from arena_newton.pages.tables import Table, percent

if TYPE_CHECKING:
    from arena_newton.eval.certification.context import Context
    from arena_newton.eval.records.journal import EpisodeRecord

__all__ = [
    "Check",
    "CheckFinding",
    "Picture",
    "Score",
    "Verdict",
    "discordant",
    "pooled_score",
    "score",
    "skipped",
]

Verdict = Literal["pass", "fail", "note", "skip"]
"""`note`: something that a reader must know and that no change of the benchmark repairs; `skip`: was not measured."""


@dataclass(frozen=True)
class Picture:
    """A picture for the page."""

    caption: str
    path: Path


@dataclass(frozen=True)
class CheckFinding:
    """Measurement of a check and its conclusion."""

    verdict: Verdict
    summary: str
    """Measurement in one line."""
    sheets: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()
    """Notes for a reader besides the numbers: causes, exceptions, limits."""
    pictures: tuple[Picture, ...] = ()
    claim: str = ""
    """Words for the line of the claim itself."""


@dataclass(frozen=True)
class Check:
    """One question that the benchmark answers about itself."""

    name: str
    """Name on the command line."""
    question: str
    run: Callable[[Context], CheckFinding]
    """Measures; raises `InputError` only for input that a user can repair."""


@dataclass(frozen=True)
class Score:
    """Successes of some episodes."""

    successes: int
    episodes: int
    errors: int = 0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the rate."""
        return wilson(self.successes, self.episodes)

    @property
    def rate(self) -> float:
        """Success rate; 0 without episodes."""
        return self.successes / self.episodes if self.episodes else 0.0

    def cells(self) -> tuple[str, str]:
        """Count and interval as a table shows them."""
        low, high = (percent(bound, 0) for bound in self.interval)
        errors = f", {self.errors} errors" if self.errors else ""
        return f"{self.successes}/{self.episodes}{errors}", f"{low} % to {high} %"


def score(records: Sequence[EpisodeRecord]) -> Score:
    """Successes among journal records; an error counts as an episode without success."""
    outcomes = [record.outcome for record in records]
    return Score(outcomes.count("success"), len(outcomes), outcomes.count("error"))


def pooled_score(scores: Sequence[Score]) -> Score:
    """All episodes together."""
    return Score(
        sum(one.successes for one in scores), sum(one.episodes for one in scores), sum(one.errors for one in scores)
    )


def discordant(
    first: Sequence[EpisodeRecord], second: Sequence[EpisodeRecord], outcome: str = "success"
) -> tuple[int, int]:
    """Episodes with an outcome the first time alone, and the second time alone, paired by their seeds."""

    def ended(records: Sequence[EpisodeRecord]) -> dict[Hashable, bool]:
        return {record.episode_seed: record.outcome == outcome for record in records}

    found = paired_rates(ended(first), ended(second))
    assert not found.unpaired, "the same episodes, whatever plays them"
    return found.only_first, found.only_second


def skipped(reason: str) -> CheckFinding:
    """A check that was not measured."""
    return CheckFinding("skip", reason)
