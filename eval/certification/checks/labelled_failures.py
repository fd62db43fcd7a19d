"""Real failures of learned policies, judged by eye by two readers who did not know what the rules say of them."""

from __future__ import annotations

import csv
import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.folders.failure_rules import stage_of
from arena_newton.eval.folders.failure_stage import FailureStage
from arena_newton.eval.records.journal import EpisodeRecord, read_journal
from arena_newton.pages.tables import Table

__all__ = ["LABELLED", "JudgeAgreement", "LabelledFailure", "agreements", "labelled_failures", "labelled_sheets"]

LABELLED = Path(__file__).parent / "labelled"
"""Folder of the journal's lines and of the readers' answers; docs/results/failures_labelled/ has strips of them."""


@dataclass(frozen=True)
class LabelledFailure:
    """One failure, with the stage that the rules and each reader say."""

    number: int
    """Even: thresholds were set with it; odd: they were not."""
    stages: tuple[FailureStage, ...]
    """Stages by the rules, then by each reader."""


@dataclass(frozen=True)
class JudgeAgreement:
    """Agreement of two judges on the stage."""

    judges: tuple[str, str]
    part: str
    """`even`, `odd` or `all` numbers."""
    same: int
    failures: int

    @property
    def rate(self) -> float:
        """Fraction of the failures of which both say the same."""
        return self.same / self.failures if self.failures else 0.0


JUDGES = ("rules", "reader 1", "reader 2")
SAYS = ("the rules say", "reader 1 says", "reader 2 says")
PARTS = {"even": (0,), "odd": (1,), "all": (0, 1)}
"""Part → remainders of the numbers by 2."""


def labelled_failures(folder: Path = LABELLED) -> list[LabelledFailure]:
    """The set in the order of its numbers.

    Raises:
        InputError: Episodes and answers do not belong together, or a stage is none.
    """
    records, _ = read_journal(folder / "episodes.jsonl")
    path = folder / "readers.csv"
    with path.open(newline="") as file:
        rows = {int(row["number"]): row for row in csv.DictReader(file)}
    if sorted(rows) != [record.index for record in records]:
        raise InputError(f"{path}: its numbers are not those of episodes.jsonl")
    return [LabelledFailure(record.index, _judgements(path, record, rows[record.index])) for record in records]


def _judgements(path: Path, record: EpisodeRecord, row: dict[str, str]) -> tuple[FailureStage, ...]:
    ruled = stage_of(record)
    try:
        read = [FailureStage(row[judge]) for judge in JUDGES[1:] if judge in row]
    except ValueError as error:
        raise InputError(f"{path}: number {record.index}: {error}") from None
    if ruled is None:
        raise InputError(f"{path}: number {record.index}: is no failure with signals")
    return (ruled, *read)


def agreements(failures: Sequence[LabelledFailure]) -> list[JudgeAgreement]:
    """Agreements of the rules with each reader and of the readers, for even and odd numbers and for all."""
    found = []
    for a, b in itertools.combinations(range(len(failures[0].stages)), 2):
        for part, remainders in PARTS.items():
            some = [one for one in failures if one.number % 2 in remainders]
            same = sum(one.stages[a] == one.stages[b] for one in some)
            found.append(JudgeAgreement((JUDGES[a], JUDGES[b]), part, same, len(some)))
    return found


def labelled_sheets(failures: Sequence[LabelledFailure]) -> list[Table]:
    """The agreements, and for each pair of judges what the one says of the failures of a stage that the other says."""
    rows = [
        (*one.judges, one.part, str(one.failures), str(one.same), f"{one.rate:.2f}") for one in agreements(failures)
    ]
    sheets = [Table(("judge", "and", "numbers", "failures", "same", "rate"), rows, title="real failures: agreement")]
    for a, b in itertools.combinations(range(len(failures[0].stages)), 2):
        counts = Counter((one.stages[b], one.stages[a]) for one in failures)
        table = tuple((str(row), *(str(counts[row, text]) for text in FailureStage)) for row in FailureStage)
        head = (JUDGES[b], *(f"found {stage}" for stage in FailureStage))
        sheets.append(Table(head, table, title=f"real failures: {JUDGES[b]} (rows) and what {SAYS[a]} (columns)"))
    return sheets
