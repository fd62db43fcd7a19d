"""Episodes of a policy on seeds that the auditor draws, and an exact test of their rate against the claimed one."""

from __future__ import annotations

import dataclasses
import random
from collections import Counter

from arena_newton.eval.audit.action_replay import played, rollout_flags, through
from arena_newton.eval.audit.folder_audit import Audit
from arena_newton.eval.folders.run_folder import stored_options
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import Chunks
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run import check_parts
from arena_newton.eval.play.run_flow import Group, groups
from arena_newton.eval.records.journal import JOURNAL_FILE
from arena_newton.eval.statistics.rate_tests import UnpairedCounts, rate_test
from arena_newton.eval.statistics.stats import holm

__all__ = ["LEVEL", "play_fresh"]

LEVEL = 0.001
"""Adjusted probability below which a rate contradicts the claimed one: one honest folder of a thousand is accused."""
SEEDS = range(1 << 16, 1 << 31)
"""Group seeds that are drawn; those of published protocols are smaller."""


def play_fresh(audit: Audit, policy: str, number: int, seed: int, factories: Factories | None = None) -> None:
    """Play new episodes of every task, tracker and mode, and add what contradicts to the audit.

    Args:
        audit: Of the folder that claims a rate.
        policy: Spec of the policy.
        number: Episodes of each task, tracker and mode.
        seed: The auditor's number, by which, with the head, the group seed is drawn.
        factories: What worlds, trackers and policies are made with; the real ones by default.

    Raises:
        InputError: They cannot be played here.
    """
    run, made = audit.run, factories or Factories()
    stored = stored_options(run.folder)
    drawn = random.Random(f"fresh {audit.head} {seed}").choice(SEEDS)
    won = Counter[Group]()
    flags = dataclasses.replace(rollout_flags(stored, policy, Chunks), seeds=(drawn,), repeats=number)
    plan = resolve(flags)
    for tracker in stored.tracker:
        chosen = tuple(episode for episode in plan.episodes if episode.tracker == tracker)
        config, player = check_parts(through(plan, tracker, chosen), made)
        try:
            for cell, group in groups(chosen).items():
                won[cell] = sum(result.outcome == "success" for result in played(config, made, player, group))
        finally:
            player.close()
    tested = {}
    for cell in won:
        claimed = [r.outcome == "success" for r in run.records if (r.task, r.tracker, r.mode) == cell]
        if claimed:
            tested[cell] = UnpairedCounts(sum(claimed), len(claimed), won[cell], number)
    adjusted = holm([rate_test(counts).p for counts in tested.values()])
    for (cell, counts), p in zip(tested.items(), adjusted, strict=True):
        said = f"{' '.join(cell)}: {counts.second} of {number} succeed on group seed {drawn}"
        said += f", claimed are {counts.first} of {counts.first_episodes} (p {p:.3g})"
        if p < LEVEL:
            audit.faults.append(f"{run.folder / JOURNAL_FILE}: {said}")
        else:
            audit.notes.append(f"Fresh episodes: {said}.")
    audit.fresh = sum(counts.second_episodes for counts in tested.values())
