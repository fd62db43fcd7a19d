"""Cost of a swapped tracker: an expert's actions, recorded through one tracker, replayed through the other."""

from __future__ import annotations

import itertools

from arena_newton.eval.certification.checks.replays import own_replay, recorded
from arena_newton.eval.certification.context import CertifyCell, Context
from arena_newton.eval.certification.finding import (
    Check,
    CheckFinding,
    Score,
    Verdict,
    discordant,
    pooled_score,
    score,
    skipped,
)
from arena_newton.eval.statistics.stats import mcnemar
from arena_newton.pages.tables import Table, percent

__all__ = ["CHECKS", "retention"]

ENOUGH = 60
"""Episodes of all tasks together below which a loss that is not shown proves nothing."""
SHOWN_BY = 0.05
"""Largest p-value of McNemar's exact test, all tasks together, at which the loss counts as shown."""


def retention(own: Score, other: Score) -> str:
    """Ret, the fraction of the success rate that the other tracker keeps (paper, cross-GMT)."""
    return f"{percent(other.rate / own.rate, 0)} %" if own.successes else "-"


def swap(context: Context) -> CheckFinding:
    """Replay the experts' recordings open loop through every other tracker and, as a control, through their own."""
    if len(context.trackers) < 2:
        return skipped("needs two trackers: --tracker twist2 sonic")
    rows, notes, kept, shown, unlike, few = [], [], [], [], [], False
    for source, target in itertools.product(context.trackers, repeat=2):
        if source == target:
            unlike += [gap for task in context.tasks for gap in own_replay(context, task, source)[1]]
            if context.options.quick:
                continue
        own, other, gained, lost = [], [], 0, 0
        for task in context.tasks:
            episodes = recorded(context, task, source)
            records = context.evaluate(episodes)
            if not any(record.steps for record in records):
                notes.append(f"{task} through {source}: nothing was recorded")
                continue
            actions = context.path(episodes) / "actions"
            replay = CertifyCell(task, target, policy=f"replay:{actions}", label=f"replay-of-{source}")
            replayed = own_replay(context, task, source)[0] if source == target else context.evaluate(replay)
            own.append(score(records))
            other.append(score(replayed))
            only_first, only_second = discordant(records, replayed)
            lost, gained = lost + only_first, gained + only_second
            falls = sum(record.outcome == "fall" for record in replayed)
            delta = 100.0 * (other[-1].rate - own[-1].rate)
            counts = (own[-1].cells()[0], *other[-1].cells(), str(falls))
            rows.append((task, source, target, *counts, f"{delta:+.0f}", retention(own[-1], other[-1])))
        a, b = pooled_score(own), pooled_score(other)
        p = mcnemar(lost, gained)  # a replay meets the episode that was recorded
        delta = 100.0 * (b.rate - a.rate)
        rows.append(("all", source, target, a.cells()[0], *b.cells(), "", f"{delta:+.0f}", retention(a, b)))
        if source == target:
            continue
        shown.append(b.rate < a.rate and p <= SHOWN_BY)
        few = few or a.episodes < ENOUGH
        kept.append(f"{source} to {target} keeps {retention(a, b)} (p = {p:.2g})")
    head = ("task", "recorded through", "replayed through", "recorded", "replayed", "95 % interval", "falls")
    sheet = Table((*head, "Delta [points]", "Ret"), rows, title="The swap")
    notes.append(
        "No policy is in the loop of the replay: the same 40 numbers per tick meet the same episodes, and only what "
        "executes them differs. Delta is the difference of the success rates, Ret their quotient, p that of McNemar's "
        "exact test of all episodes."
    )
    if few and not all(shown):
        notes.append(
            f"A loss shows from p = {SHOWN_BY} on; fewer than {ENOUGH} episodes of a direction cannot rule it out."
        )
    verdict: Verdict = "fail" if unlike else "pass" if all(shown) else "note" if few else "fail"
    unlike = [f"A replay through the tracker of the recording ends otherwise: {gap}." for gap in unlike]
    return CheckFinding(verdict, "; ".join(kept), (sheet,), (*unlike, *notes))


CHECKS = (Check("swap", "Do recorded actions lose their success through the other tracker, without any policy?", swap),)
"""This module's checks."""
