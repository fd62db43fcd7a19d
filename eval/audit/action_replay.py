"""Episodes of a results folder played again on engine mujoco, from their actions alone, and compared bit for bit."""

from __future__ import annotations

import dataclasses
import math
import random
from collections.abc import Sequence

from arena_newton.errors import InputError
from arena_newton.eval.audit.folder_audit import Audit
from arena_newton.eval.folders.run_folder import actions_folder, stored_options
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.plan.options import Batch, Conditions, RunOptions, Stepping, flags_of
from arena_newton.eval.play.run import Factories, check_parts, make_env
from arena_newton.eval.play.run_flow import groups
from arena_newton.eval.records.journal import JOURNAL_FILE, EpisodeRecord
from arena_newton.files.stored_json import shown
from arena_newton.files.text import counted
from arena_newton.interfaces import EpisodeResult
from arena_newton.rollout import Rollout

__all__ = ["drawn", "replay"]

COMPARED = "outcome reason steps margin startup_fall overflow predicates progress events".split()
"""Keys of a line that a replay must give again, numbers to the last bit."""
ENGINE = "mujoco"
FORGED = 0.1
"""Fraction of forged lines for which a note says how probably the drawn episodes find one."""


def drawn(audit: Audit, count: int | None, seed: int) -> list[EpisodeRecord]:
    """Episodes to play again, drawn by the head of the journal and a number of the auditor's own.

    Args:
        audit: Of the folder; episodes without actions, and those that ended as errors, cannot be drawn.
        count: Number of them; None: all.
        seed: The auditor's number. Whoever forged the folder must not know it before the head is published.
    """
    lacking = set(audit.lacking)
    candidates = [r for r in audit.run.records if r.index not in lacking and r.steps and r.outcome != "error"]
    if count is None or count >= len(candidates):
        return candidates
    chosen = random.Random(f"{audit.head} {seed}").sample(range(len(candidates)), count)
    return [candidates[number] for number in sorted(chosen)]


def replay(audit: Audit, records: Sequence[EpisodeRecord], factories: Factories | None = None) -> None:
    """Play episodes again, and add what differs to the audit's contradictions.

    Args:
        audit: Of their folder.
        records: The episodes.
        factories: What worlds and trackers are made with; the real ones by default.

    Raises:
        InputError: They were not played on engine mujoco, are demonstrations, or cannot be played here.
    """
    run, made = audit.run, factories or Factories()
    stored, where = stored_options(run.folder), f"--replay: {run.folder}"
    if run.config.get("engine") != ENGINE:
        raise InputError(f"{where} was played on engine {shown(run.config.get('engine'))}; {ENGINE} alone repeats bits")
    if stored.series is not None:
        raise InputError(f"{where} holds demonstrations; `eval record --from` plays them again")
    if records:
        _play(audit, stored, records, made)
    audit.replayed = len(records)
    found = 1.0 - (1.0 - FORGED) ** len(records)
    sure = (
        "any forged line" if len(records) == len(run.records) else f"one of {FORGED:.0%} forged lines with {found:.0%}"
    )
    audit.notes.append(f"{counted(len(records), 'episode')} played again: that finds {sure}.")


def _play(audit: Audit, stored: RunOptions, records: Sequence[EpisodeRecord], made: Factories) -> None:
    """Play these episodes of a folder's plan, and compare each."""
    run, wanted = audit.run, {_key(record): record for record in records}
    names = (*flags_of(Conditions), *flags_of(Batch), *flags_of(Stepping), "task", "seeds", "repeats", "checkpoint")
    flags = {name: getattr(stored, name) for name in names} | {"tracker": stored.tracker, "engine": ENGINE}
    plan = resolve(RunOptions(**flags | {"policy": f"replay:{run.folder / 'actions'}", "actions": False}))
    installed = plan.identity()
    for key in ("code", "scenes", "rules_hash"):
        if installed.get(key) != run.config.get(key):
            audit.notes.append(f"Replayed with another {key} than the run's: what differs may come of that.")
    for tracker in dict.fromkeys(record.tracker for record in records):
        actions = run.folder / actions_folder(stored.tracker, tracker)
        chosen = tuple(episode for episode in plan.episodes if episode.tracker == tracker and _key(episode) in wanted)
        own = dataclasses.replace(plan.flags, tracker=(tracker,))
        config = dataclasses.replace(plan, flags=own, policy=f"replay:{actions}", episodes=chosen)
        config, policy = check_parts(config, made)
        try:
            for group in groups(chosen).values():
                env = make_env(config, made, group[0], min(own.worlds, len(group)))
                try:
                    results: list[EpisodeResult] = []
                    Rollout(env, policy, group, max_steps=group[0].max_steps, on_finish=results.append).run()
                finally:
                    env.close()
                for result in results:
                    _compare(audit, wanted[_key(result.episode)], result)
        finally:
            policy.close()


def _key(one: EpisodeRecord | Episode) -> tuple[object, ...]:
    return one.task, one.tracker, one.mode, one.group_seed, one.repeat


def _compare(audit: Audit, record: EpisodeRecord, result: EpisodeResult) -> None:
    """Hold an episode that was played again to its line."""
    margin = float(result.margin) if math.isfinite(result.margin) else None
    again = {name: getattr(result, name) for name in COMPARED} | {"margin": margin}
    for name, value in again.items():
        was = getattr(record, name)
        if was != (tuple(value) if isinstance(was, tuple) else value):
            where = f"{audit.run.folder / JOURNAL_FILE}: episode {record.index}"
            audit.faults.append(f"{where}: {name} is {_short(was)}, its actions give {_short(value)}")


def _short(value: object) -> str:
    """A value of a line in a message."""
    if isinstance(value, tuple | list):
        return " ".join(f"{event.kind} at {event.tick}" for event in value) or "none"
    return shown(dict(value) if isinstance(value, dict) else value)
