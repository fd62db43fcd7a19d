"""A comparison as one HTML page: intervals and posteriors, pairs, and per task who won which episode.

What comes from results folders is text to this page, as to the report's (`html_report`); it needs no script. Episodes
that two policies ended differently are linked with their recordings, by paths from the page to the results folders.
"""

from __future__ import annotations

import math
import os
import urllib.parse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.eval.reports.html_report import FOLDER
from arena_newton.eval.reports.wording import MEDIA, media_of, replay_command
from arena_newton.eval.statistics.comparison import Comparison, PairComparison, Standing
from arena_newton.eval.statistics.rate_tests import PairedCounts
from arena_newton.eval.tables.comparison_text import (
    METHOD,
    difference_text,
    p_text,
    rate_text,
    remarks,
    stratum_title,
    verdict,
)
from arena_newton.eval.tables.contenders import ContenderSet, PlayedEpisode
from arena_newton.files.text import plain
from arena_newton.pages.html import render
from arena_newton.pages.tables import percent

__all__ = ["beta_density", "comparison_page"]

POINTS = 120
"""Steps of a violin's outline."""
VIOLIN = (1000, 40)
"""Width and height of a violin's drawing, in its own units."""
TICKS = (0, 25, 50, 75, 100)
"""Marks of the axis of rates [%]."""
SHOWN_EPISODES = 400
"""Episodes of one pair and task that are listed; a longer list is cut, and says so."""


@dataclass(frozen=True)
class _Side:
    """How one of two policies ended an episode."""

    outcome: str
    why: str
    links: tuple[tuple[str, str], ...]
    """Text and address of its recordings."""
    command: str
    """Plays it again, where there is no recording."""


def beta_density(successes: int, episodes: int, rate: float) -> float:
    """Density of the success rate after these episodes, all rates alike before: Beta(1 + successes, 1 + failures)."""
    failures = episodes - successes
    if rate in (0.0, 1.0):
        return (episodes + 1.0) if (failures if rate == 1.0 else successes) == 0 else 0.0
    logarithm = math.lgamma(episodes + 2) - math.lgamma(successes + 1) - math.lgamma(failures + 1)
    return math.exp(logarithm + successes * math.log(rate) + failures * math.log1p(-rate))


def comparison_page(out: Path, comparison: Comparison, contenders: ContenderSet) -> str:
    """The page as text, the same for the same content and folders byte for byte; `out` is the folder it will be in."""
    several = len(comparison.strata) > 1
    return render(
        FOLDER / "compare.html",
        styles=["report.css", "compare.css"],
        facts=[("policies", len(comparison.names)), ("tasks", _task_count(comparison)), *contenders.alike],
        notes=remarks(comparison, contenders),
        ticks=TICKS,
        size=VIOLIN,
        policies=[(one.name, dict(one.facts)) for one in contenders.compared],
        reports=[_report(out, one.folder) for one in contenders.compared],
        overall=_rows(comparison, comparison.overall),
        verdicts=[verdict(comparison, pair) for pair in comparison.pairs],
        pairs=[_pair(comparison, pair) for pair in comparison.pairs],
        tasks=[
            {
                "title": stratum_title(stratum),
                "rows": _rows(comparison, comparison.within[stratum]) if several else [],
                "pairs": [_within(out, comparison, contenders, pair, position) for pair in comparison.pairs],
            }
            for position, stratum in enumerate(comparison.strata)
        ],
        method=METHOD,
    )


def _task_count(comparison: Comparison) -> str:
    named = list(dict.fromkeys(stratum[0] for stratum in comparison.strata))
    return " ".join(named)


def _report(out: Path, folder: Path) -> str | None:
    """Address of a folder's own report, where it has one."""
    return _address(out, folder, "report.html") if (folder / "report.html").is_file() else None


def _address(out: Path, folder: Path, name: str) -> str:
    """Path from the page to a file of a results folder, as an address."""
    relative = os.path.relpath(folder.resolve() / name, out.resolve())
    return urllib.parse.quote(os.fsencode(Path(relative).as_posix()))  # names of folders need not be text


def _rows(comparison: Comparison, standings: Sequence[Standing]) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for name, standing in sorted(zip(comparison.names, standings, strict=True), key=lambda row: -row[1].rate):
        count, rate, interval = rate_text(standing)
        rows.append(
            {
                "name": name,
                "count": count,
                "rate": rate,
                "interval": interval,
                "letters": standing.letters,
                "path": _outline(standing),
                "ends": [percent(bound, 2) + "%" for bound in (standing.low, standing.high)],
                "dot": percent(standing.rate, 2) + "%",
                "mean": percent((standing.successes + 1) / (standing.episodes + 2), 2) + "%",
            }
        )
    return rows


def _outline(standing: Standing) -> str:
    """Path of the violin of a rate's posterior."""
    width, height = VIOLIN
    rates = [number / POINTS for number in range(POINTS + 1)]
    # Where the mass is there are more points: a narrow posterior has its peak between two of an even grid.
    rates += [standing.low + (standing.high - standing.low) * number / POINTS for number in range(POINTS + 1)]
    rates = sorted({min(1.0, max(0.0, rate)) for rate in (*rates, standing.rate)})
    density = [beta_density(standing.successes, standing.episodes, rate) for rate in rates]
    highest = max(density)
    shown = [(rate, value / highest) for rate, value in zip(rates, density, strict=True) if value > 1e-3 * highest]
    half = height / 2
    upper = [f"{width * rate:.1f},{half - value * (half - 2):.1f}" for rate, value in shown]
    lower = [f"{width * rate:.1f},{half + value * (half - 2):.1f}" for rate, value in reversed(shown)]
    return "M" + "L".join(upper + lower) + "Z"


def _pair(comparison: Comparison, pair: PairComparison) -> dict[str, object]:
    return {
        "first": comparison.names[pair.first],
        "second": comparison.names[pair.second],
        "difference": difference_text(pair.difference),
        "p": p_text(pair.p),
        "p_holm": p_text(pair.p_holm),
        "differs": pair.differs,
        "verdict": verdict(comparison, pair),
    }


def _within(
    out: Path, comparison: Comparison, contenders: ContenderSet, pair: PairComparison, position: int
) -> dict[str, object]:
    part = pair.strata[position]
    first, second = (contenders.compared[n].episodes for n in (pair.first, pair.second))
    outcomes = [contenders.contenders[n].outcomes[part.stratum] for n in (pair.first, pair.second)]
    differing = [key for key in outcomes[0] if key in outcomes[1] and outcomes[0][key] != outcomes[1][key]]
    # Those of the first alone come first.
    differing.sort(key=lambda key: not outcomes[0][key])
    episodes = [
        {
            "title": _title(first[part.stratum, key]),
            "sides": [_side(out, one[part.stratum, key]) for one in (first, second)],
        }
        for key in differing[:SHOWN_EPISODES]
    ]
    return {
        "first": comparison.names[pair.first],
        "second": comparison.names[pair.second],
        "paired": isinstance(part.counts, PairedCounts),
        "counts": part.counts,
        "left_out": part.unpaired,
        "difference": difference_text(part.difference),
        "test": part.test,
        "p": p_text(part.p),
        "p_holm": p_text(part.p_holm),
        "episodes": episodes,
        "cut": len(differing) - len(episodes),
    }


def _title(played: PlayedEpisode) -> str:
    return f"seed {played.record.group_seed} repeat {played.record.repeat}"


def _side(out: Path, played: PlayedEpisode) -> _Side:
    record, run = played.record, played.run
    links = tuple(
        (f"{'strip' if name.endswith('strip') else 'video'}, {MEDIA[name]}", _address(out, run.folder, path))
        for name, path in media_of(record).items()
        if (run.folder / path).is_file()  # results may have come without their recordings
    )
    why = plain(record.reason) if record.reason and record.reason != record.outcome else ""
    command = "" if links else replay_command(run.document["options"], record, worlds=run.config.get("worlds"))
    return _Side(record.outcome, why, links, command)
