"""The paper's findings as measurable claims, each with a statistic on our episodes, its interval and a verdict.

Claims and numbers are those of the paper's main results ("Finding 1", "Finding 2", the paragraph on perturbations) and
of its appendix on merged training; its own values are computed here from its tables.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from arena_newton.eval.evaluated_cells import EvaluatedCell
from arena_newton.eval.paper_numbers import FAMILIES, TRAINING_SETS, PaperNumbers
from arena_newton.eval.stats import Contrast, Outcomes, contrast, holm, paired_rates, suites
from arena_newton.eval.table_entries import PAPER_NAMES, points, probability
from arena_newton.eval.wording import escaped
from arena_newton.text import counted

__all__ = ["NEGLIGIBLE", "ClaimResult", "findings", "findings_text"]

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
    """In the paper's sense, in our words."""
    paper: str
    """Its numbers."""
    ours: str
    """The statistic on our episodes, with interval and size; why it is missing where it is."""
    verdict: Verdict


type Term = tuple[str, float, Outcomes]
"""Task, weight and outcomes of one condition."""


def _contrast(terms: Iterable[Term]) -> Contrast | None:
    """Contrast whose strata are tasks."""
    strata: dict[str, list[tuple[float, Outcomes]]] = {}
    for task, weight, outcomes in terms:
        strata.setdefault(task, []).append((weight, outcomes))
    return contrast([strata[task] for task in sorted(strata)])


def _said(found: Contrast | None, of: str) -> str:
    if found is None:
        return "no common episodes"
    text = f"{points(found.value)} points ({points(found.low)} to {points(found.high)}; {of}, "
    text += f"{found.episodes} paired episode starts"
    return text + (f", {found.unpaired} unpaired left out)" if found.unpaired else ")")


def _greater(found: Contrast | None) -> Verdict:
    """Of a claim that a difference is positive."""
    if found is None:
        return "not measured"
    return "reproduces" if found.low > 0 else "does not" if found.high < NEGLIGIBLE else "undecided"


def _different(found: Contrast | None) -> Verdict:
    """Of a claim that a difference is not zero."""
    if found is None:
        return "not measured"
    if found.low > 0 or found.high < 0:
        return "reproduces"
    return "does not" if -NEGLIGIBLE < found.low and found.high < NEGLIGIBLE else "undecided"


def _named(family: str) -> str:
    return PAPER_NAMES.get(family, family)


class _Cells:
    """Cells of learned policies without latency, found by what they are."""

    def __init__(self, cells: Sequence[EvaluatedCell]):
        learned = [cell for cell in cells if cell.trained_on and cell.latency == 0]
        self.single = [cell for cell in learned if not cell.merged]
        self.merged = [cell for cell in learned if cell.merged]
        self.matched: dict[tuple[str, str, str, str], EvaluatedCell] = {
            (c.mode, c.tracker, c.policy, c.task): c for c in self.single if c.matched
        }
        """By mode, tracker, policy, task."""

    def policies(self, mode: str, tracker: str) -> list[str]:
        """Policies with matched cells."""
        return sorted({p for m, t, p, _ in self.matched if (m, t) == (mode, tracker)})

    def tasks(self, mode: str, tracker: str, policy: str) -> set[str]:
        """Tasks of a policy's matched cells."""
        return {task for m, t, p, task in self.matched if (m, t, p) == (mode, tracker, policy)}

    def mean(
        self, tracker: str, policy: str, tasks: Iterable[str], sign: float = 1.0, outcome: str = "success"
    ) -> list[Term]:
        """Terms of a policy's mean rate over tasks."""
        names = sorted(tasks)
        cells = [self.matched["base", tracker, policy, task] for task in names]
        return [(cell.task, sign / len(names), cell.held(outcome)) for cell in cells]


def findings(cells: Sequence[EvaluatedCell], paper: PaperNumbers) -> list[ClaimResult]:
    """Every claim, in the paper's order; one that our episodes cannot test is `not measured`."""
    found = _Cells(cells)
    return [
        _same_family(found, paper),
        _best_family(found, paper),
        *_better_tracker(found, paper),
        *_swapped(found, paper),
        *_visual(found, paper),
        *_stability(found, paper),
        *_merged(found, paper),
    ]


def _same_family(cells: _Cells, paper: PaperNumbers) -> ClaimResult:
    pairs = []
    for (mode, tracker, policy, task), cell in sorted(cells.matched.items()):
        other = cells.matched.get((mode, "sonic", policy, task))
        if mode == "base" and tracker == "twist2" and other is not None:
            pairs.append((f"{policy} {task}", cell.held(), other.held()))
    results = [(name, paired_rates(a, b), contrast([[(1.0, a), (-1.0, b)]])) for name, a, b in pairs]
    tested = [(name, r, c) for name, r, c in results if r.p is not None and c is not None]
    adjusted = holm([r.p for _, r, _ in tested if r.p is not None])
    apart = [(p, name, c) for p, (name, _, c) in zip(adjusted, tested, strict=True) if p < SIGNIFICANT]
    verdict: Verdict = "not measured"
    said = "no policy was evaluated matched through both trackers"
    if tested:
        said = f"{len(apart)} of {len(tested)} pairs of cells differ (exact McNemar, Holm)"
        if apart:
            p, name, c = min(apart, key=lambda one: (one[0], one[1]))
            said += f"; most: {name} {points(c.value)} points, p {probability(p)}"
        close = all(-WIDE < c.low and c.high < WIDE for _, _, c in tested)
        verdict = "reproduces" if apart else "does not" if close else "undecided"
    rates = {
        (f, t): tuple(paper.in_gmt[tracker, "base", f, t].sr for tracker in ("twist2", "sonic"))
        for f, t in itertools.product(FAMILIES.values(), suites()["ALL_AVG"])
    }
    (family, task), (first, second) = max(rates.items(), key=lambda item: abs(item[1][0] - item[1][1]))
    return ClaimResult(
        "tracker-conditioned: same family",
        "The same policy family succeeds differently when it is trained and executed with another tracker.",
        f"most: {_named(family)} {task}, {100 * first:.1f} % with TWIST2, {100 * second:.1f} % with SONIC",
        said,
        verdict,
    )


def _ranked(cells: _Cells, tracker: str, policies: Sequence[str], tasks: Sequence[str]) -> list[tuple[float, str]]:
    """Mean rates of policies over tasks, the highest first."""
    found = []
    for policy in policies:
        c = _contrast(cells.mean(tracker, policy, tasks))
        found.append((c.value if c is not None else 0.0, policy))
    return sorted(found, key=lambda one: (-one[0], one[1]))


def _common(cells: _Cells, trackers: Sequence[str]) -> tuple[list[str], list[str]]:
    """Policies that all trackers played, and the tasks that all of them have; as many tasks as the most have."""
    shared = sorted(set.intersection(*(set(cells.policies("base", t)) for t in trackers)))
    played = {p: set.intersection(*(cells.tasks("base", t, p) for t in trackers)) for p in shared}
    known = {p: tasks & set(suites()["ALL_AVG"]) for p, tasks in played.items()}
    most = max((len(tasks) for tasks in known.values()), default=0)
    kept = [p for p in shared if most and 2 * len(known[p]) >= most]
    return kept, sorted(set.intersection(*(known[p] for p in kept))) if kept else []


def _best_family(cells: _Cells, paper: PaperNumbers) -> ClaimResult:
    policies, tasks = _common(cells, ("twist2", "sonic"))
    verdict: Verdict = "not measured"
    said = "fewer than two policies were evaluated matched through both trackers on common tasks"
    if len(policies) > 1 and tasks:
        top = {t: _ranked(cells, t, policies, tasks) for t in ("twist2", "sonic")}
        a, b = top["twist2"][0][1], top["sonic"][0][1]
        if a == b:
            rest = {t: next(p for _, p in top[t] if p != a) for t in top}
            leads = [_contrast([*cells.mean(t, a, tasks), *cells.mean(t, rest[t], tasks, -1.0)]) for t in top]
            clear = all(lead is not None and lead.low > 0 for lead in leads)
            verdict = "does not" if clear else "undecided"
            said = f"{a} is best with both over {counted(len(tasks), 'task')}"
        else:
            leads = [
                _contrast([*cells.mean("twist2", a, tasks), *cells.mean("twist2", b, tasks, -1.0)]),
                _contrast([*cells.mean("sonic", b, tasks), *cells.mean("sonic", a, tasks, -1.0)]),
            ]
            clear = all(lead is not None and lead.low > 0 for lead in leads)
            verdict = "reproduces" if clear else "undecided"
            said = f"{a} is best with twist2, {b} with sonic over {counted(len(tasks), 'task')}"
        said += f"; leads {_said(leads[0], 'twist2')} and {_said(leads[1], 'sonic')}"
    theirs = []
    for tracker, suite in itertools.product(("twist2", "sonic"), HALVES):
        rate = max((paper.in_gmt[tracker, "base", f, suite] for f in FAMILIES.values()), key=lambda r: r.sr)
        theirs.append(f"{tracker} {suite.removesuffix('_AVG')}: {_named(rate.family)} {100 * rate.sr:.1f} %")
    return ClaimResult(
        "tracker-conditioned: best family",
        "The best policy under one tracker is not the best under the other.",
        "; ".join(theirs),
        said,
        verdict,
    )


def _better_tracker(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    found = []
    for suite in HALVES:
        policies, common = _common(cells, ("twist2", "sonic"))
        tasks = [task for task in common if task in suites()[suite]]
        result, said = None, "no policy was evaluated matched through both trackers on tasks of the suite"
        if policies and tasks:
            best = {t: _ranked(cells, t, policies, tasks)[0][1] for t in ("twist2", "sonic")}
            terms = cells.mean("sonic", best["sonic"], tasks) + cells.mean("twist2", best["twist2"], tasks, -1.0)
            result = _contrast(terms)
            said = _said(
                result, f"{best['sonic']} with sonic minus {best['twist2']} with twist2, {counted(len(tasks), 'task')}"
            )
        theirs = {t: max(paper.in_gmt[t, "base", f, suite].sr for f in FAMILIES.values()) for t in ("twist2", "sonic")}
        name = suite.removesuffix("_AVG")
        found.append(
            ClaimResult(
                f"tracker-conditioned: SONIC ahead on {name}",
                f"The best average over {name} is higher with SONIC than with TWIST2.",
                f"{points(theirs['sonic'] - theirs['twist2'])} points",
                said,
                _greater(result),
            )
        )
    return found


def _transfer(cells: _Cells, a: str, b: str) -> list[tuple[EvaluatedCell, EvaluatedCell]]:
    """Matched and swapped cells of one direction."""
    swapped = [c for c in cells.single if c.mode == "base" and c.trained_on == (a,) and c.tracker == b and a != b]
    pairs = [(cells.matched.get(("base", a, c.policy, c.task)), c) for c in swapped]
    return [(first, second) for first, second in pairs if first is not None]


def _drop(pairs: Sequence[tuple[EvaluatedCell, EvaluatedCell]], sign: float = 1.0) -> list[Term]:
    weight = sign / len(pairs) if pairs else 0.0
    return [term for a, b in pairs for term in ((a.task, weight, a.held()), (b.task, -weight, b.held()))]


def _swapped(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    directions = (("twist2", "sonic"), ("sonic", "twist2"))
    pairs = {d: _transfer(cells, *d) for d in directions}
    found = []
    means = {}
    for a, b in directions:
        theirs = [c for c in paper.cross_gmt.values() if (c.trained_on, c.tracker) == (a, b)]
        means[a] = sum(c.drop for c in theirs) / len(theirs), sum(c.task_afr for c in theirs) / len(theirs)
        mine = pairs[a, b]
        result = _contrast(_drop(mine)) if mine else None
        gone = sum(not any(second.held().values()) and any(first.held().values()) for first, second in mine)
        lost = sum(c.retention == 0 for c in theirs)
        said = f"{_said(result, f'{len(mine)} cells')}; nothing left in {gone} of {len(mine)}" if mine else _NO_SWAP
        found.append(
            ClaimResult(
                f"cross-GMT: {a} → {b}",
                "Replacing the tracker costs success.",
                f"{points(means[a][0])} points on average; nothing left in {lost} of {len(theirs)} cells",
                said,
                _greater(result),
            )
        )
    both = {(p.policy, p.task) for p, _ in pairs["twist2", "sonic"]}
    both &= {(p.policy, p.task) for p, _ in pairs["sonic", "twist2"]}
    alike = {d: [(a, b) for a, b in pairs[d] if (a.policy, a.task) in both] for d in directions}
    result = _contrast(_drop(alike[directions[0]]) + _drop(alike[directions[1]], -1.0)) if both else None
    found.append(
        ClaimResult(
            "cross-GMT: asymmetric drop",
            "The two directions differ in the drop of success.",
            f"{points(means['twist2'][0] - means['sonic'][0])} points more from TWIST2 to SONIC",
            _said(result, f"{len(both)} cells a direction") if both else _NO_SWAP,
            _different(result),
        )
    )
    falls = None
    if both:
        terms: list[Term] = []
        for d, sign in ((directions[1], 1.0), (directions[0], -1.0)):
            terms += [(b.task, sign / len(alike[d]), b.held("fall")) for _, b in alike[d]]
        falls = _contrast(terms)
    found.append(
        ClaimResult(
            "cross-GMT: asymmetric falls",
            "Swapped policies fall more often from SONIC to TWIST2 than in the other direction.",
            f"{points(means['sonic'][1] - means['twist2'][1])} points",
            _said(falls, f"{len(both)} cells a direction") if both else _NO_SWAP,
            _greater(falls),
        )
    )
    return found


_NO_SWAP = "no policy was evaluated matched and swapped"


def _visual(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    """Drops from base by mode, over (tracker, policy, task) cells that have the modes compared."""
    groups: dict[tuple[str, str, str], dict[str, EvaluatedCell]] = {}
    for (mode, *rest), cell in cells.matched.items():
        groups.setdefault((rest[0], rest[1], rest[2]), {})[mode] = cell

    def ours(weights: Mapping[str, float], tasks: Iterable[str]) -> tuple[Contrast | None, int]:
        known = set(tasks)
        chosen = [g for (_, _, task), g in sorted(groups.items()) if task in known and set(weights) <= set(g)]
        terms = [(g[m].task, w / len(chosen), g[m].held()) for g in chosen for m, w in weights.items()]
        return (_contrast(terms) if terms else None), len(chosen)

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
        result, number = ours(weights, every)
        said = _said(result, f"{number} cells") if number else f"no cell was evaluated in modes {' and '.join(weights)}"
        found.append(
            ClaimResult(
                f"perturbation: {name}", claim, f"{points(theirs(weights, every))} points", said, _greater(result)
            )
        )
    drop = compared[0][2]
    halves = [ours(drop, suites()[suite]) for suite in HALVES]
    result = None
    if all(number for _, number in halves):
        terms = []
        for suite, sign, (_, number) in zip(HALVES, (1.0, -1.0), halves, strict=True):
            for (_, _, task), g in sorted(groups.items()):
                if task in suites()[suite] and set(drop) <= set(g):
                    terms += [(task, sign * w / number, g[m].held()) for m, w in drop.items()]
        result = _contrast(terms)
    first, second = (theirs(drop, suites()[suite]) for suite in HALVES)
    found.append(
        ClaimResult(
            "perturbation: visual on HOI",
            "Visual perturbations cost more on human-object than on human-scene tasks.",
            f"{points(first - second)} points",
            _said(result, f"{halves[0][1]} and {halves[1][1]} cells") if result else "not both suites in mode visual",
            _greater(result),
        )
    )
    return found


def _stability(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    found = []
    for tracker in ("twist2", "sonic"):
        rates = {f: [paper.in_gmt[tracker, "base", f, task] for task in suites()["ALL_AVG"]] for f in FAMILIES.values()}
        most = max(rates, key=lambda f: sum(r.sr for r in rates[f]))
        least = min(rates, key=lambda f: rates[f][0].afr)
        theirs = f"highest success: {_named(most)}, fewest falls: {_named(least)} ({100 * rates[least][0].afr:.2f} %)"
        policies, tasks = _common(cells, (tracker,))
        verdict: Verdict = "not measured"
        said = "fewer than two policies were evaluated on common tasks"
        if len(policies) > 1 and tasks:
            falls = {
                p: c.value if (c := _contrast(cells.mean(tracker, p, tasks, 1.0, "fall"))) is not None else 1.0
                for p in policies
            }
            best = _ranked(cells, tracker, policies, tasks)[0][1]
            calm = min(policies, key=lambda p: (falls[p], p != best, p))
            said = f"highest success: {best}, fewest falls: {calm} ({100 * falls[calm]:.2f} %)"
            if max(falls.values()) == 0.0:
                said, verdict = f"highest success: {best}; no policy fell, so falls rank nothing", "undecided"
            elif best == calm:
                rest = [p for p in policies if p != best]
                sure = all(
                    (c := _contrast([*cells.mean(tracker, best, tasks), *cells.mean(tracker, p, tasks, -1.0)]))
                    and c.low > 0
                    for p in rest
                )
                verdict = "does not" if sure else "undecided"
            else:
                more = _contrast([*cells.mean(tracker, best, tasks), *cells.mean(tracker, calm, tasks, -1.0)])
                fewer = _contrast(
                    [
                        *cells.mean(tracker, best, tasks, 1.0, "fall"),
                        *cells.mean(tracker, calm, tasks, -1.0, "fall"),
                    ]
                )
                said += f"; success {_said(more, 'difference')}, falls {_said(fewer, 'difference')}"
                verdict = "reproduces" if more and fewer and more.low > 0 and fewer.low > 0 else "undecided"
        found.append(
            ClaimResult(
                f"SR and AFR disagree: {tracker}",
                "The policy that falls least is not the one that succeeds most.",
                theirs,
                said,
                verdict,
            )
        )
    return found


def _merged(cells: _Cells, paper: PaperNumbers) -> list[ClaimResult]:
    """Merged minus single-task training of the same family, per training set and suite."""
    found = []
    for name, trackers in TRAINING_SETS.items():
        for suite in HALVES:
            results = []
            families = {c.family for c in cells.merged if c.trained_on == trackers}
            for family in sorted(families):
                terms: list[Term] = []
                pairs = [
                    (m, s)
                    for m in cells.merged
                    for s in cells.single
                    if m.family == s.family == family and m.trained_on == trackers and m.task in suites()[suite]
                    if (m.mode, m.tracker, m.task, m.labels) == (s.mode, s.tracker, s.task, s.labels)
                    if m.mode == "base" and m.tracker in m.trained_on and s.matched
                ]
                for m, s in pairs:
                    terms += [(m.task, 1 / len(pairs), m.held()), (s.task, -1 / len(pairs), s.held())]
                if terms and (result := _contrast(terms)) is not None:
                    results.append((family, result))
            theirs = []
            for family in FAMILIES.values():
                base = [paper.in_gmt[t, "base", family, suite].sr for t in trackers]
                theirs.append(
                    f"{_named(family)} {points(paper.merged[name, family, suite].sr - sum(base) / len(base))}"
                )
            said_each = {_different(c) for _, c in results}
            verdict: Verdict = "not measured"
            if results:
                rest: Verdict = "undecided" if "undecided" in said_each else "does not"
                verdict = "reproduces" if "reproduces" in said_each else rest
            said = "; ".join(f"{family}: {_said(c, 'merged minus single')}" for family, c in results)
            half = suite.removesuffix("_AVG")
            found.append(
                ClaimResult(
                    f"merged training: {name} {half}",
                    "Merged demonstrations change the success rate, for better or worse.",
                    f"{', '.join(theirs)} points",
                    said or "no merged policy next to single ones of its family",
                    verdict,
                )
            )
    return found


def findings_text(found: Sequence[ClaimResult]) -> str:
    """The findings as Markdown."""
    parts = ["# The paper's findings on these episodes\n"]
    parts.append(
        "Differences are paired by episode seeds within tasks; in parentheses 95 % intervals. Reproduces: the interval "
        "is on the claim's side of 0. Does not: it excludes an effect of "
        f"{100 * NEGLIGIBLE:.0f} points. Undecided: neither.\n"
    )
    for one in found:
        parts.append(f"## {escaped(one.name)}: {one.verdict}\n")
        parts.append(f"- Claim: {escaped(one.claim)}\n- Paper: {escaped(one.paper)}\n- Ours: {escaped(one.ours)}\n")
    return "\n".join(parts)
