"""`python -m arena_newton.eval compare`: policies against each other by their episodes, written as files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.cli.flags import Several, user_path
from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.eval.statistics.comparison import Comparison

__all__ = ["CompareOptions", "run"]


@dataclass(frozen=True)
class CompareOptions:
    """Compare policies over the episodes that they share: exact tests, intervals, letters, and who won which episode.

    Results folders are one policy each; a suite has all of its own. Episodes are paired by task, tracker, mode and
    episode seed; runs of other seeds are compared unpaired. Where each has one tracker, trackers may differ.
    """

    out: str = "comparison"
    """Folder to write: compare.html, compare.md, compare.json and compare.csv."""
    only: Several[str] = ()
    """Names of those to compare, as the command prints them; all when none is named."""
    differ: Several[str] = ()
    """Conditions that may differ between them, as they are compared: rules engine max_steps variant fast_physics."""
    per_tracker: bool = False
    """Each tracker of a folder is compared as one of its own, and against the others."""


def run(folders: Sequence[Path], options: CompareOptions) -> int:
    """Compare, print rates and verdicts, and write compare.html, compare.md, compare.json and compare.csv.

    Raises:
        InputError: A folder is unfit, a flag, or the runs cannot be compared.
        StorageError: A file cannot be written.
    """
    from arena_newton.eval.records.document import CONFIG_FILE, SUITE_FILE
    from arena_newton.eval.records.journal import StorageError, write_atomic
    from arena_newton.eval.statistics.comparison import compare
    from arena_newton.eval.tables.comparison_page import comparison_page
    from arena_newton.eval.tables.comparison_text import as_csv, as_json, as_markdown, remarks
    from arena_newton.eval.tables.contenders import read_contenders
    from arena_newton.files.text import plain

    if not options.out.strip():
        raise InputError("--out: is empty, name a folder")
    out = user_path(options.out)
    for held, what in ((CONFIG_FILE, "a run"), (SUITE_FILE, "a suite")):
        if (out / held).is_file():
            raise InputError(f"--out {out}: holds {what}; name a folder of its own")
    contenders = read_contenders(folders, differ=options.differ, only=options.only, per_tracker=options.per_tracker)
    comparison = compare(contenders.contenders)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"--out {out}: cannot be made ({error.strerror})") from None
    files = {
        "compare.html": comparison_page(out, comparison, contenders),
        "compare.md": as_markdown(comparison, contenders),
        "compare.json": json.dumps(as_json(comparison, contenders), indent=2) + "\n",
        "compare.csv": as_csv(comparison),
    }
    for name, text in files.items():
        write_atomic(out / name, text, "what was compared is as it was")
    for line in _summary(comparison):
        print(plain(line))
    for note in remarks(comparison, contenders):
        print(note)
    print(f"comparison: {out / 'compare.html'}")
    return 0


def _summary(comparison: Comparison) -> list[str]:
    """Rates with letters, best first, and a sentence per pair."""
    from arena_newton.eval.tables.comparison_text import p_text, rate_text, verdict

    width = max(map(len, comparison.names))
    ranked = sorted(zip(comparison.names, comparison.overall, strict=True), key=lambda row: -row[1].rate)
    lines = []
    for name, standing in ranked:
        count, rate, interval = rate_text(standing)
        lines.append(f"{name:<{width}}  {count:>9}  {rate:>5} % ({interval})  {standing.letters}")
    p = "p" if len(comparison.pairs) == 1 else "adjusted p"
    return lines + [f"{verdict(comparison, pair)} ({p} {p_text(pair.p_holm)})" for pair in comparison.pairs]
