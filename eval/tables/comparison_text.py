"""A comparison as Markdown, as JSON and as CSV."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from arena_newton.eval.statistics.comparison import LEVEL, Comparison, PairComparison, Standing, StratumPair
from arena_newton.eval.statistics.rate_tests import LARGEST_BOSCHLOO, PairedCounts, UnpairedCounts
from arena_newton.eval.statistics.stats import Contrast
from arena_newton.eval.tables.contenders import ContenderSet
from arena_newton.files.stored_json import JsonObject
from arena_newton.files.text import counted, plain
from arena_newton.pages.tables import Table, between, escaped, percent

__all__ = [
    "METHOD",
    "OVER_ALL",
    "as_csv",
    "as_json",
    "as_markdown",
    "difference_text",
    "p_text",
    "rate_text",
    "remarks",
    "stratum_title",
    "verdict",
]

OVER_ALL = "all"
"""Name of the rows over all tasks."""
CELLS = ("both", "only_first", "only_second", "neither")
"""Endings of a pair of episodes."""
LEAST = 1e-300
"""Probabilities below this are shown as below it: they may be too small for a number."""
METHOD = (
    "Within a task: McNemar's exact test of the episodes that both played; where two runs share no episode, "
    f"Boschloo's exact test (Fisher's where the product of their numbers is above {LARGEST_BOSCHLOO:,}). Over all "
    "tasks: the exact conditional test of Cochran, Mantel and Haenszel, tasks as strata. All are two-sided. p (Holm) "
    "is adjusted over all pairs, within tasks over all pairs in all tasks.",
    f"Those that share a letter do not differ significantly (adjusted p above {LEVEL:g}), which does not show that "
    "they are alike. The first letters are of the best.",
    "Rates have 95 % Wilson intervals. Δ is the first rate minus the second in points, over all tasks the mean of the "
    "tasks' differences, with its 95 % interval (Agresti and Min where paired, Agresti and Caffo where not; of several "
    "tasks the pseudo-episodes that move its middle are shared out, after Price and Bonett).",
    "An episode that ended with an error counts as no success.",
)
"""Paragraphs on the methods behind the figures."""


def stratum_title(stratum: tuple[str, ...]) -> str:
    """A task, and tracker and mode where they vary."""
    return " ".join(map(plain, stratum))


def p_text(p: float) -> str:
    """A probability, such as `0.034` and `3e-05`."""
    if p < LEAST:
        return f"<{LEAST:.0e}"
    return f"{p:.2g}" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def rate_text(standing: Standing) -> tuple[str, str, str]:
    """Successes of episodes, rate and interval [%]."""
    interval = between((standing.low, standing.high))
    return f"{standing.successes}/{standing.episodes}", percent(standing.rate), interval


def difference_text(difference: Contrast) -> str:
    """A difference in points with its interval, such as `+12.0 (3 to 21)`."""
    value, low, high = (100 * part for part in (difference.value, difference.low, difference.high))
    return f"{round(value, 1) + 0.0:+.1f} ({round(low)} to {round(high)})"  # + 0.0: no -0


def verdict(comparison: Comparison, pair: PairComparison) -> str:
    """Result of a pair's test, in a sentence."""
    first, second = comparison.names[pair.first], comparison.names[pair.second]
    if not pair.differs:
        return f"{first} and {second} do not differ significantly"
    better, worse = (first, second) if pair.excess > 0 else (second, first)
    if pair.difference.value == 0.0:
        return f"{better} succeeds in more episodes than {worse}, with equal mean rates"
    if (pair.difference.value > 0) != (pair.excess > 0):
        return f"{better} succeeds in more episodes than {worse}, which has the higher mean rate"
    return f"{better} succeeds more often than {worse}"


def remarks(comparison: Comparison, contenders: ContenderSet) -> list[str]:
    """Notes for a reader: on the runs, and on the match of their episodes."""
    found = list(contenders.notes)
    if comparison.left_out:
        found.append(f"Left out, because not all have it: {', '.join(map(stratum_title, comparison.left_out))}.")
    for pair in comparison.pairs:
        names = f"{comparison.names[pair.first]} and {comparison.names[pair.second]}"
        unpaired = [part for part in pair.strata if not isinstance(part.counts, PairedCounts)]
        if unpaired:
            where = "" if len(unpaired) == len(pair.strata) else f" in {', '.join(_title(part) for part in unpaired)}"
            found.append(f"{names} share no episode seed{where}: compared unpaired.")
        left = sum(part.unpaired for part in pair.strata)
        if left:
            found.append(f"{names}: {counted(left, 'episode')} that one of them lacks left out of their pairs.")
    return found


def _title(part: StratumPair) -> str:
    return stratum_title(part.stratum)


def _cells(part: StratumPair) -> tuple[str, str, str, str, str]:
    """Number of pairs of episodes with each ending, where there are pairs; then the successes of both."""
    counts = part.counts
    each = [str(getattr(counts, name)) if isinstance(counts, PairedCounts) else "" for name in CELLS]
    rates = f"{counts.first}/{counts.first_episodes}, {counts.second}/{counts.second_episodes}"
    both, only_first, only_second, neither = each
    return both, only_first, only_second, neither, rates


def _standings(comparison: Comparison, standings: Sequence[Standing], title: str) -> list[list[str]]:
    rows = [[title, name, *rate_text(one), one.letters] for name, one in zip(comparison.names, standings, strict=True)]
    return sorted(rows, key=lambda row: -float(row[3]))


def as_markdown(comparison: Comparison, contenders: ContenderSet) -> str:
    """Rates and letters, pairs, counts per task, notes and methods."""
    lines = ["# Comparison", ""]
    for one in contenders.compared:
        lines.append(f"- {escaped(one.name)}: " + ", ".join(f"{key} {escaped(value)}" for key, value in one.facts))
    if contenders.alike:
        lines.append("- alike: " + ", ".join(f"{key} {escaped(value)}" for key, value in contenders.alike))
    notes = remarks(comparison, contenders)
    lines += [""] + [f"> {escaped(note)}" for note in notes] + ([""] if notes else [])
    rows = _standings(comparison, comparison.overall, OVER_ALL)
    if len(comparison.strata) > 1:
        for stratum in comparison.strata:
            rows += _standings(comparison, comparison.within[stratum], stratum_title(stratum))
    head = ["task", "policy", "successes", "rate %", "95 % interval", "letters"]
    lines += ["## Rates", "", Table(head, rows, "llr").markdown(), "## Pairs", ""]
    table = []
    for pair in comparison.pairs:
        names = [comparison.names[pair.first], comparison.names[pair.second]]
        table.append([*names, difference_text(pair.difference), p_text(pair.p), p_text(pair.p_holm)])
    lines += [Table(["first", "second", "Δ", "p", "p (Holm)"], table, "llr").markdown()]
    lines += [f"- {escaped(verdict(comparison, pair))}." for pair in comparison.pairs] + [""]
    lines += ["## Within tasks", ""]
    head = ["task", "first", "second", "both", "only first", "only second", "neither", "successes"]
    head += ["Δ", "test", "p", "p (Holm)"]
    table = []
    for position in range(len(comparison.strata)):
        for pair in comparison.pairs:
            part = pair.strata[position]
            names = [comparison.names[pair.first], comparison.names[pair.second]]
            figures = [difference_text(part.difference), part.test, p_text(part.p), p_text(part.p_holm)]
            table.append([stratum_title(part.stratum), *names, *_cells(part), *figures])
    lines += [Table(head, table, "lllr").markdown()]
    lines += [f"{paragraph}\n" for paragraph in METHOD]
    return "\n".join(lines).rstrip() + "\n"


def _difference(difference: Contrast) -> list[float]:
    return [difference.value, difference.low, difference.high]


def _standing(standing: Standing) -> JsonObject:
    values: JsonObject = dataclasses.asdict(standing)
    return {"successes": values["successes"], "episodes": values["episodes"], "rate": standing.rate} | {
        "ci95": [standing.low, standing.high],
        "letters": standing.letters,
    }


def as_json(comparison: Comparison, contenders: ContenderSet) -> JsonObject:
    """Every figure; fractions, not per cent."""
    policies = []
    for number, name in enumerate(comparison.names):
        within = {
            stratum_title(stratum): _standing(comparison.within[stratum][number]) for stratum in comparison.strata
        }
        facts: JsonObject = dict(contenders.compared[number].facts)
        policies.append({"name": name} | facts | {"all": _standing(comparison.overall[number]), "tasks": within})
    pairs = []
    for pair in comparison.pairs:
        parts = []
        for part in pair.strata:
            values: JsonObject = {"task": part.stratum[0], "stratum": list(part.stratum)}
            values |= {"paired": isinstance(part.counts, PairedCounts)} | dataclasses.asdict(part.counts)
            values |= {"left_out": part.unpaired, "test": part.test, "p": part.p, "p_holm": part.p_holm}
            parts.append(values | {"difference": _difference(part.difference)})
        found: JsonObject = {"first": comparison.names[pair.first], "second": comparison.names[pair.second]}
        found |= {"p": pair.p, "p_holm": pair.p_holm, "differs": pair.differs}
        pairs.append(found | {"difference": _difference(pair.difference), "tasks": parts})
    return {
        "level": LEVEL,
        "alike": dict(contenders.alike),
        "notes": remarks(comparison, contenders),
        "policies": policies,
        "pairs": pairs,
    }


def as_csv(comparison: Comparison) -> str:
    """A row per pair and task, and one over all tasks."""
    head = ["task", "first", "second", "first_successes", "first_episodes", "second_successes", "second_episodes"]
    head += [*CELLS, "left_out", "difference", "low", "high", "test", "p", "p_holm"]
    rows: list[list[object]] = []
    for pair in comparison.pairs:
        names = [comparison.names[pair.first], comparison.names[pair.second]]
        for part in pair.strata:
            figures = [part.unpaired, *_difference(part.difference), part.test, part.p, part.p_holm]
            rows.append([stratum_title(part.stratum), *names, *_sums([part.counts]), *figures])
        figures = [sum(part.unpaired for part in pair.strata), *_difference(pair.difference)]
        figures += ["Cochran-Mantel-Haenszel", pair.p, pair.p_holm]
        rows.append([OVER_ALL, *names, *_sums([part.counts for part in pair.strata]), *figures])
    return Table(head, rows).csv()


def _sums(counts: Sequence[PairedCounts | UnpairedCounts]) -> list[object]:
    """Successes and episodes of both; then, where all are paired, how many pairs ended in each way."""
    rates = [sum(getattr(c, name) for c in counts) for name in ("first", "first_episodes", "second", "second_episodes")]
    paired = [c for c in counts if isinstance(c, PairedCounts)]
    whole = len(paired) == len(counts)
    return [*rates, *(sum(getattr(c, name) for c in paired) if whole else "" for name in CELLS)]
