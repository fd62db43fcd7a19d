"""The paper's findings as measurable claims, each with a statistic on our episodes, its interval and a verdict.

Claims and numbers are those of the paper's main results ("Finding 1", "Finding 2", the paragraph on perturbations) and
of its appendix on merged training; its own values are computed here from its tables. They are claims about families,
trackers and modes, so their unit is a training: intervals are those of `trainings.trained_contrast`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from arena_newton import tasks
from arena_newton.eval.statistics.stats import holm, suites
from arena_newton.eval.statistics.trainings import (
    RateTerm,
    TrainedContrast,
    trained_contrast,
)
from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.paper_numbers import FAMILIES, TRAINING_SETS, PaperNumbers
from arena_newton.eval.tables.table_entries import PAPER_NAMES
from arena_newton.files.text import counted
from arena_newton.pages.tables import points
from arena_newton.tasks.semantic_mode import semantic_note

__all__ = ["NEGLIGIBLE", "SIGNIFICANT", "ClaimResult", "findings"]

type Verdict = Literal["reproduces", "does not", "undecided", "not measured"]

NEGLIGIBLE = 0.05
"""A difference of rates below this is no effect: a claim whose whole interval is below it does not reproduce."""
WIDE = 0.10
"""Half-width within which all differences must be for "no tracker matters": single cells have wide intervals."""
SIGNIFICANT = 0.05
"""Level of adjusted p-values."""
HALVES = ("HOI_AVG", "HSI_AVG")


@dataclass(frozen=True)
class ClaimResult:
    """A claim of the paper and what our episodes say of it."""

    name: str
    claim: str
    """Claim in the paper's sense, in our words."""
    paper: str
    """Its numbers."""
    ours: str
    """The statistic on our episodes, with interval and size; why it is missing where it is."""
    verdict: Verdict
    remark: str = ""
    """Sentences to read with the statistic."""
    p: float | None = None
    """Probability of the test behind the verdict, two-sided; None where nothing was tested."""
    p_holm: float | None = None
    """Adjusted for the number of claims that were tested."""


type Test = tuple[Verdict, float]
"""The verdict that a claim has if this probability is small enough."""
UNTESTED: Test = ("not measured", 1.0)


def _described(found: TrainedContrast | None, of: str) -> str:
    if found is None:
        return "no common episodes"
    spread = (
        "measured" if found.measured == found.recipes else f"measured in {found.measured} of {found.recipes} recipes"
    )
    return (
        f"{points(found.value)} points ({points(found.low)} to {points(found.high)}; {of}, "
        f"{counted(found.trainings, 'training')}, {counted(found.episodes, 'episode start')}"
        + (f"; their standard deviation {spread})" if found.measured else ")")
    )


def _greater(found: TrainedContrast | None) -> Test:
    """Test of a claim that a difference is positive."""
    if found is None:
        return UNTESTED
    above = found.p(0.0) if found.middle > 0 else 1.0
    below = found.p(NEGLIGIBLE) if found.middle < NEGLIGIBLE else 1.0
    return ("reproduces", above) if above <= below else ("does not", below)


def _different(found: TrainedContrast | None, negligible: float = NEGLIGIBLE) -> Test:
    """Test of a claim that a difference is not zero: beyond what is negligible, or within it."""
    if found is None:
        return UNTESTED
    if abs(found.middle) >= NEGLIGIBLE:
        beyond = found.p(NEGLIGIBLE if found.middle > 0 else -NEGLIGIBLE)
        if beyond < SIGNIFICANT or abs(found.middle) >= negligible:
            return "reproduces", beyond
    return "does not", max(found.p(negligible), found.p(-negligible))


def _leads(found: Sequence[TrainedContrast | None]) -> float:
    """Probability by which all differences are positive: that of the least certain one."""
    return max((c.p() if c is not None and c.middle > 0 else 1.0 for c in found), default=1.0)


def _named(family: str) -> str:
    return PAPER_NAMES.get(family, family)


def _term(cell: EvaluatedCell, weight: float) -> RateTerm:
    recipe = (cell.recipe, *cell.training[1:])
    return RateTerm(cell.task, weight, cell.held(), recipe, cell.training, not cell.matched and not cell.merged)


def _falls(cells: Sequence[EvaluatedCell], weight: float) -> list[RateTerm]:
    """Terms of a mean fall rate; how much trainings differ in it is read from all of these cells."""
    key: Hashable = tuple(sorted({(cell.recipe, cell.trained_on, cell.tracker) for cell in cells}))
    each = weight / len(cells) if cells else 0.0
    return [RateTerm(c.task, each, c.held("fall"), key, (c.training, c.tracker)) for c in cells]


class _Cells:
    """Cells of learned policies without latency, found by what they are; of a recipe all trainings."""

    def __init__(self, cells: Sequence[EvaluatedCell]):
        learned = [cell for cell in cells if cell.trained_on and cell.latency == 0]
        self.single = [cell for cell in learned if not cell.merged]
        self.merged = [cell for cell in learned if cell.merged]
        self.matched: dict[tuple[str, str, str, str], list[EvaluatedCell]] = {}
        """Cells by mode, tracker, recipe, task."""
        for c in self.single:
            if c.matched:
                self.matched.setdefault((c.mode, c.tracker, c.recipe, c.task), []).append(c)
        self.families = {cell.recipe: cell.family or cell.recipe for cell in self.single}
        """Families by recipe."""

    def recipes(self, mode: str, tracker: str) -> list[str]:
        """Recipes with matched cells."""
        return sorted({p for m, t, p, _ in self.matched if (m, t) == (mode, tracker)})

    def tasks(self, mode: str, tracker: str, recipe: str) -> set[str]:
        """Tasks of a recipe's matched cells."""
        return {task for m, t, p, task in self.matched if (m, t, p) == (mode, tracker, recipe)}

    def mean(self, tracker: str, recipe: str, tasks: Iterable[str], sign: float = 1.0) -> list[RateTerm]:
        """Terms of a recipe's mean rate over tasks."""
        names = sorted(tasks)
        groups = [self.matched["base", tracker, recipe, task] for task in names]
        return [_term(cell, sign / len(names) / len(group)) for group in groups for cell in group]

    def falls(self, tracker: str, recipe: str, tasks: Iterable[str], sign: float = 1.0) -> list[RateTerm]:
        """Terms of its mean fall rate."""
        return _falls([cell for task in sorted(tasks) for cell in self.matched["base", tracker, recipe, task]], sign)


def findings(cells: Sequence[EvaluatedCell], paper: PaperNumbers) -> list[ClaimResult]:
    """Every claim, in the paper's order; one that our episodes cannot test is `not measured`.

    A verdict stands where its p, adjusted for the number of claims that were tested, is below the level.
    """
    found = _Cells(cells)
    claims = [
        _same_family(found, paper),
        _best_family(found, paper),
        *_better_tracker(found, paper),
        *_swapped(found, paper),
        *_visual(found, paper),
        *_stability(found, paper),
        *_merged(found, paper),
    ]
    adjusted = iter(holm([one.p for one in claims if one.p is not None]))
    judged = []
    for one in claims:
        p_holm = next(adjusted) if one.p is not None else None
        verdict = one.verdict if p_holm is None or p_holm < SIGNIFICANT else "undecided"
        judged.append(dataclasses.replace(one, verdict=verdict, p_holm=p_holm))
    return judged


def _result(name: str, claim: str, paper: str, ours: str, test: Test, remark: str = "") -> ClaimResult:
    verdict, p = test
    tested = verdict in ("reproduces", "does not")
    return ClaimResult(name, claim, paper, ours, verdict, remark, p if tested else None)


def _same_family(cells: _Cells, paper: PaperNumbers) -> ClaimResult:
    tested: list[tuple[str, TrainedContrast]] = []
    for mode, tracker, recipe, task in sorted(cells.matched):
        if (mode, tracker) == ("base", "twist2") and (mode, "sonic", recipe, task) in cells.matched:
            terms = [*cells.mean("twist2", recipe, [task]), *cells.mean("sonic", recipe, [task], -1.0)]
            if (c := trained_contrast(terms)) is not None:
                tested.append((f"{recipe} {task}", c))
    test = UNTESTED
    text = "no policy was evaluated matched through both trackers"
    if tested:
        tests = [_different(c, WIDE) for _, c in tested]
        adjusted = holm([p if verdict == "reproduces" else 1.0 for verdict, p in tests])
        apart = sum(p < SIGNIFICANT for p in adjusted)
        least = min(range(len(tested)), key=lambda k: (adjusted[k], -abs(tested[k][1].value), tested[k][0]))
        name, c = tested[least]
        text = (
            f"{apart} of {len(tested)} pairs of cells differ by more than {100 * NEGLIGIBLE:.0f} points (Holm); "
            f"most: {name} {_described(c, 'twist2 minus sonic')}"
        )
        test = "reproduces", adjusted[least]
        if all(verdict == "does not" for verdict, _ in tests):
            test = "does not", max(p for _, p in tests)
    rates = {
        (f, t): tuple(paper.in_gmt[tracker, "base", f, t].sr for tracker in ("twist2", "sonic"))
        for f, t in itertools.product(FAMILIES.values(), suites()["ALL_AVG"])
    }
    (family, task), (first, second) = max(rates.items(), key=lambda item: abs(item[1][0] - item[1][1]))
    return _result(
        "tracker-conditioned: same family",
        "The same policy family succeeds differently when it is trained and executed with another tracker.",
        f"most: {_named(family)} {task}, {100 * first:.1f} % with TWIST2, {100 * second:.1f} % with SONIC",
        text,
        test,
    )


def _ranked(cells: _Cells, tracker: str, recipes: Sequence[str], tasks: Sequence[str]) -> list[tuple[float, str]]:
    """Mean rates of recipes over tasks, the highest first."""
    found = []
    for recipe in recipes:
        c = trained_contrast(cells.mean(tracker, recipe, tasks))
        found.append((c.value if c is not None else 0.0, recipe))
    return sorted(found, key=lambda one: (-one[0], one[1]))


@dataclass(frozen=True)
class _Compared:
    """Recipes on the tasks that all of them have through all trackers."""

    recipes: tuple[str, ...]
    tasks: tuple[str, ...]
    left_out: tuple[str, ...]
    """Recipes, each with the tasks that it has."""

    def __str__(self) -> str:
        text = f"{', '.join(self.recipes)} on {' '.join(self.tasks)}"
        return text + (f"; left out: {', '.join(self.left_out)}" if self.left_out else "")


def _common(cells: _Cells, trackers: Sequence[str], among: Sequence[str]) -> _Compared | None:
    """Largest set of families that share tasks, with these tasks; rather more families than more tasks."""
    played = {}
    for recipe in sorted(set().union(*(cells.recipes("base", t) for t in trackers))):
        played[recipe] = set.intersection(*(cells.tasks("base", t, recipe) for t in trackers)) & set(among)
    best: tuple[tuple[int, int, int], _Compared] | None = None
    for number in range(len(among), 0, -1):
        for common in itertools.combinations(among, number):
            kept = tuple(recipe for recipe, own in played.items() if set(common) <= own)
            score = (len({cells.families[recipe] for recipe in kept}), number, len(kept))
            if kept and (best is None or score > best[0]):
                others = (
                    f"{recipe} ({' '.join(sorted(own)) or 'no task'})"
                    for recipe, own in played.items()
                    if recipe not in kept
                )
                best = score, _Compared(kept, common, tuple(others))
    return best[1] if best is not None else None


def _best_family(cells: _Cells, paper: PaperNumbers) -> ClaimResult:
    compared = _common(cells, ("twist2", "sonic"), suites()["ALL_AVG"])
    test = UNTESTED
    text = "fewer than two policies were evaluated matched through both trackers on common tasks"
    if compared is not None and len(compared.recipes) > 1:
        tasks = compared.tasks
        top = {t: [name for _, name in _ranked(cells, t, compared.recipes, tasks)] for t in ("twist2", "sonic")}

        def lead(tracker: str, first: str, second: str) -> TrainedContrast | None:
            terms = [*cells.mean(tracker, first, tasks), *cells.mean(tracker, second, tasks, -1.0)]
            return trained_contrast(terms)

        a, b = top["twist2"][0], top["sonic"][0]
        if a == b:
            leads = [lead(t, a, other) for t in top for other in top[t][1:]]
            shown = [lead(t, a, top[t][1]) for t in top]
            test = "does not", _leads(leads)
            seconds = " and ".join(dict.fromkeys((top["twist2"][1], top["sonic"][1])))
            text = f"{a} is best with both; leads over the second, {seconds}:"
        else:
            shown = [lead("twist2", a, b), lead("sonic", b, a)]
            test = "reproduces", _leads(shown)
            text = f"{a} is best with twist2, {b} with sonic; leads over the other:"
        text += f" {_described(shown[0], 'twist2')} and {_described(shown[1], 'sonic')}. Compared: {compared}"
    theirs = []
    for tracker, suite in itertools.product(("twist2", "sonic"), HALVES):
        rate = max((paper.in_gmt[tracker, "base", f, suite] for f in FAMILIES.values()), key=lambda r: r.sr)
        theirs.append(f"{tracker} {suite.removesuffix('_AVG')}: {_named(rate.family)} {100 * rate.sr:.1f} %")
    return _result(
        "tracker-conditioned: best family",
        "The best policy under one tracker is not the best under the other.",
        "; ".join(theirs),
        text,
        test,
    )


def _better_tracker(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    found = []
    for suite in HALVES:
        compared = _common(cells, ("twist2", "sonic"), suites()[suite])
        result, text = None, "no policy was evaluated matched through both trackers on tasks of the suite"
        if compared is not None:
            best = {t: _ranked(cells, t, compared.recipes, compared.tasks)[0][1] for t in ("twist2", "sonic")}
            result = trained_contrast(
                cells.mean("sonic", best["sonic"], compared.tasks)
                + cells.mean("twist2", best["twist2"], compared.tasks, -1.0)
            )
            of = f"{best['sonic']} with sonic minus {best['twist2']} with twist2"
            text = f"{_described(result, of)}. Compared: {compared}"
        theirs = {t: max(paper.in_gmt[t, "base", f, suite].sr for f in FAMILIES.values()) for t in ("twist2", "sonic")}
        name = suite.removesuffix("_AVG")
        found.append(
            _result(
                f"tracker-conditioned: SONIC ahead on {name}",
                f"The best average over {name} is higher with SONIC than with TWIST2.",
                f"{points(theirs['sonic'] - theirs['twist2'])} points",
                text,
                _greater(result),
            )
        )
    return found


type _Swap = tuple[EvaluatedCell, EvaluatedCell]
"""Matched and swapped cell of one training."""


def _transfer(cells: _Cells, a: str, b: str) -> dict[tuple[str, str], list[_Swap]]:
    """Matched and swapped cells of one direction, by recipe and task."""
    found: dict[tuple[str, str], list[_Swap]] = {}
    for swapped in cells.single:
        if (swapped.mode, swapped.trained_on, swapped.tracker) != ("base", (a,), b) or a == b:
            continue
        for first in cells.matched.get(("base", a, swapped.recipe, swapped.task), ()):
            if first.training == swapped.training:
                found.setdefault((swapped.recipe, swapped.task), []).append((first, swapped))
    return found


def _drop(groups: Mapping[tuple[str, str], Sequence[_Swap]], sign: float = 1.0) -> list[RateTerm]:
    terms = []
    for pairs in groups.values():
        weight = sign / len(groups) / len(pairs)
        terms += [term for a, b in pairs for term in (_term(a, weight), _term(b, -weight))]
    return terms


def _swapped(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    directions = (("twist2", "sonic"), ("sonic", "twist2"))
    swaps = {d: _transfer(cells, *d) for d in directions}
    found = []
    means = {}
    for a, b in directions:
        theirs = [c for c in paper.cross_gmt.values() if (c.trained_on, c.tracker) == (a, b)]
        means[a] = sum(c.drop for c in theirs) / len(theirs), sum(c.task_afr for c in theirs) / len(theirs)
        mine = swaps[a, b]
        result = trained_contrast(_drop(mine))
        gone = sum(
            any(any(first.held().values()) for first, _ in pairs)
            and not any(any(second.held().values()) for _, second in pairs)
            for pairs in mine.values()
        )
        lost = sum(c.retention == 0 for c in theirs)
        text = (
            f"{_described(result, f'{len(mine)} cells')}; nothing left in {gone} of {len(mine)}" if mine else _NO_SWAP
        )
        found.append(
            _result(
                f"cross-GMT: {a} → {b}",
                "Replacing the tracker costs success.",
                f"{points(means[a][0])} points on average; nothing left in {lost} of {len(theirs)} cells",
                text,
                _greater(result),
            )
        )
    both = set.intersection(*(set(swaps[d]) for d in directions))
    alike = {d: {key: pairs for key, pairs in swaps[d].items() if key in both} for d in directions}
    result = trained_contrast(_drop(alike[directions[0]]) + _drop(alike[directions[1]], -1.0))
    found.append(
        _result(
            "cross-GMT: asymmetric drop",
            "The two directions differ in the drop of success.",
            f"{points(means['twist2'][0] - means['sonic'][0])} points more from TWIST2 to SONIC",
            _described(result, f"{len(both)} cells a direction") if both else _NO_SWAP,
            _different(result),
        )
    )
    terms: list[RateTerm] = []
    for d, sign in ((directions[1], 1.0), (directions[0], -1.0)):
        terms += _falls([swapped for pairs in alike[d].values() for _, swapped in pairs], sign)
    falls = trained_contrast(terms)
    fell = counted(sum(sum(term.outcomes.values()) for term in terms), "fall")
    found.append(
        _result(
            "cross-GMT: asymmetric falls",
            "Swapped policies fall more often from SONIC to TWIST2 than in the other direction.",
            f"{points(means['sonic'][1] - means['twist2'][1])} points",
            f"{_described(falls, f'{len(both)} cells a direction')}; {fell} in all" if both else _NO_SWAP,
            _greater(falls),
        )
    )
    return found


_NO_SWAP = "no policy was evaluated matched and swapped"


type _Modes = Mapping[str, Sequence[EvaluatedCell]]
"""Matched cells of a recipe, tracker and task by mode; of each the same trainings in the same order."""


def _visual(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    """Drops from base by mode, over (tracker, recipe, task) cells that have the modes compared."""
    groups: dict[tuple[str, str, str], dict[str, list[EvaluatedCell]]] = {}
    for (mode, *rest), found_cells in cells.matched.items():
        groups.setdefault((rest[0], rest[1], rest[2]), {})[mode] = found_cells

    def chosen(weights: Iterable[str], names: Iterable[str]) -> list[_Modes]:
        """Groups of these tasks that were played in these modes, reduced to trainings that were played in all."""
        known, kept = set(names), list[_Modes]()
        for (_, _, task), group in sorted(groups.items()):
            modes = {mode: {cell.training: cell for cell in group.get(mode, ())} for mode in weights}
            common = [training for training in next(iter(modes.values())) if all(training in m for m in modes.values())]
            if task in known and common:
                kept.append({mode: [own[training] for training in common] for mode, own in modes.items()})
        return kept

    def terms(weights: Mapping[str, float], kept: Sequence[_Modes], sign: float = 1.0) -> list[RateTerm]:
        each = [(g, m, sign * w / len(kept) / len(g[m])) for g in kept for m, w in weights.items()]
        return [_term(cell, weight) for g, m, weight in each for cell in g[m]]

    def theirs(weights: Mapping[str, float], tasks: Sequence[str]) -> float:
        rows = list(itertools.product(("twist2", "sonic"), FAMILIES.values(), tasks))
        return sum(w * paper.in_gmt[t, m, f, task].sr for t, f, task in rows for m, w in weights.items()) / len(rows)

    every = suites()["ALL_AVG"]
    compared = (
        ("visual drop", "Visual perturbations lower the success rate.", {"base": 1.0, "visual": -1.0}),
        ("visual against semantic", "Visual ones lower it more than semantic ones.", {"semantic": 1.0, "visual": -1.0}),
        ("visual against execution", "They lower it more than execution ones.", {"execution": 1.0, "visual": -1.0}),
    )
    found = []
    for name, claim, weights in compared:
        kept = chosen(weights, every)
        result = trained_contrast(terms(weights, kept))
        text = (
            _described(result, f"{len(kept)} cells")
            if kept
            else f"no cell was evaluated in modes {' and '.join(weights)}"
        )
        if kept and "semantic" in weights:
            text += f". Semantic mode costs, by what it changes: {_by_change(chosen(('base', 'semantic'), every))}"
        paper_text = f"{points(theirs(weights, every))} points"
        remark = semantic_note() if "semantic" in weights else ""
        found.append(_result(f"perturbation: {name}", claim, paper_text, text, _greater(result), remark))
    drop = compared[0][2]
    halves = [chosen(drop, suites()[suite]) for suite in HALVES]
    result = trained_contrast(terms(drop, halves[0]) + terms(drop, halves[1], -1.0)) if all(halves) else None
    first, second = (theirs(drop, suites()[suite]) for suite in HALVES)
    of = f"{len(halves[0])} and {len(halves[1])} cells"
    found.append(
        _result(
            "perturbation: visual on HOI",
            "Visual perturbations cost more on human-object than on human-scene tasks.",
            f"{points(first - second)} points",
            _described(result, of) if result else "not both suites in mode visual",
            _greater(result),
        )
    )
    return found


def _by_change(kept: Sequence[_Modes]) -> str:
    """Mean drop from base to semantic mode, of texture, clutter and shape each."""
    drops: dict[str, list[float]] = {}
    for group in kept:
        rates = [
            [sum(cell.held().values()) / len(cell.held()) for cell in group[mode]] for mode in ("base", "semantic")
        ]
        change = tasks.get(group["base"][0].task).semantic_change or "other"
        drops.setdefault(change, []).append(sum(rates[0]) / len(rates[0]) - sum(rates[1]) / len(rates[1]))
    parts = (f"{name} {points(sum(d) / len(d))} ({counted(len(d), 'cell')})" for name, d in sorted(drops.items()))
    return ", ".join(parts)


def _stability(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    found = []
    for tracker in ("twist2", "sonic"):
        rates = {f: [paper.in_gmt[tracker, "base", f, task] for task in suites()["ALL_AVG"]] for f in FAMILIES.values()}
        most = max(rates, key=lambda f: sum(r.sr for r in rates[f]))
        least = min(rates, key=lambda f: rates[f][0].afr)
        theirs = f"highest success: {_named(most)}, fewest falls: {_named(least)} ({100 * rates[least][0].afr:.2f} %)"
        compared = _common(cells, (tracker,), suites()["ALL_AVG"])
        test = UNTESTED
        text = "fewer than two policies were evaluated on common tasks"
        if compared is not None and len(compared.recipes) > 1:
            recipes, tasks = compared.recipes, compared.tasks
            falls = {p: sum(term.part for term in cells.falls(tracker, p, tasks)) for p in recipes}
            best = _ranked(cells, tracker, recipes, tasks)[0][1]
            calm = min(recipes, key=lambda p: (falls[p], p != best, p))
            text = f"highest success: {best}, fewest falls: {calm} ({100 * falls[calm]:.2f} %)"
            if max(falls.values()) == 0.0:
                text, test = f"highest success: {best}; no policy fell, so falls rank nothing", ("undecided", 1.0)
            else:
                others = [p for p in recipes if p != best] if best == calm else [calm]
                leads = [
                    trained_contrast([*cells.mean(tracker, best, tasks), *cells.mean(tracker, p, tasks, -1.0)])
                    for p in others
                ]
                if best == calm:
                    test = "does not", _leads(leads)
                else:
                    fewer = trained_contrast(
                        [*cells.falls(tracker, best, tasks), *cells.falls(tracker, calm, tasks, -1.0)]
                    )
                    text += f"; success {_described(leads[0], 'difference')}, falls {_described(fewer, 'difference')}"
                    test = "reproduces", _leads([*leads, fewer])
            text += f". Compared: {compared}"
        found.append(
            _result(
                f"SR and AFR disagree: {tracker}",
                "The policy that falls least is not the one that succeeds most.",
                theirs,
                text,
                test,
            )
        )
    return found


def _merged(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    """Merged minus single-task training of the same family, per training set and suite."""
    found = []
    for name, trackers in TRAINING_SETS.items():
        for suite in HALVES:
            results = []
            for family in sorted({c.family for c in cells.merged if c.trained_on == trackers}):
                if (result := trained_contrast(_merging(cells, family, trackers, suites()[suite]))) is not None:
                    results.append((family, result))
            theirs = []
            for family in FAMILIES.values():
                base = [paper.in_gmt[t, "base", family, suite].sr for t in trackers]
                theirs.append(
                    f"{_named(family)} {points(paper.merged[name, family, suite].sr - sum(base) / len(base))}"
                )
            tests = [_different(c) for _, c in results]
            changed = [p for verdict, p in tests if verdict == "reproduces"]
            test = UNTESTED
            if changed:
                test = "reproduces", min(1.0, min(changed) * len(changed))
            elif tests:
                test = "does not", max(p for _, p in tests)
            text = "; ".join(f"{family}: {_described(c, 'merged minus single')}" for family, c in results)
            half = suite.removesuffix("_AVG")
            found.append(
                _result(
                    f"merged training: {name} {half}",
                    "Merged demonstrations change the success rate, for better or worse.",
                    f"{', '.join(theirs)} points",
                    text or "no merged policy next to single ones of its family",
                    test,
                    _CONFOUNDED if text else "",
                )
            )
    return found


_CONFOUNDED = "What is due to merging is not separated from other numbers of demonstrations and steps."


def _merging(cells: _Cells, family: str, trackers: tuple[str, ...], suite: Sequence[str]) -> list[RateTerm]:
    """Terms of merged minus single over the tasks and trackers that both have, each counting the same."""
    slots: dict[tuple[str, str, str], tuple[list[EvaluatedCell], list[EvaluatedCell]]] = {}
    for m in cells.merged:
        own = m.tracker.split("+")
        if (m.family, m.trained_on, m.mode) != (family, trackers, "base") or not set(own) <= set(trackers):
            continue
        singles = [
            [s for s in cells.matched.get(("base", tracker, recipe, m.task), ()) if s.labels == m.labels]
            for tracker in own
            for recipe, known in cells.families.items()
            if known == family
        ]
        if m.task in suite and all(any(s.tracker == t for group in singles for s in group) for t in own):
            slot = slots.setdefault((m.recipe, m.tracker, m.task), ([], []))
            slot[0].append(m)
            slot[1][:] = [s for group in singles for s in group]
    terms = []
    total = sum(len(tracker.split("+")) for _, tracker, _ in slots)
    for (_, tracker, _), (merged, single) in slots.items():
        weight = len(tracker.split("+")) / total
        terms += [_term(m, weight / len(merged)) for m in merged]
        terms += [_term(s, -weight / len(single)) for s in single]
    return terms
