"""Conditions that a run claims, held to its flags and to those under which its episodes are played again."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

from arena_newton.eval.audit.folder_audit import Audit
from arena_newton.eval.plan.config import RunConfig, plain_facts
from arena_newton.eval.play.signal_recorder import SignalRecorder
from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.eval.records.journal import JOURNAL_FILE, EpisodeRecord
from arena_newton.files.stored_json import Json, shown
from arena_newton.interfaces import World

__all__ = ["hold_environment", "hold_plan", "hold_policy", "hold_signals", "note_difference"]

CLAIMED = "task mode seeds repeats rules max_steps variant fast_physics drive checkpoint".split()
"""Keys of a run's identity that a replay must have too."""
DESCRIBED = "tracker_facts mode_facts foreign_tasks".split()
"""Keys that say what code is: they may differ where that is another version's."""
ELSEWHERE = ("device", "tracker", "recorders")
"""Facts of an environment that depend on the machine, or on the programs that are here."""
ROUNDED = 2e-4
"""Largest difference of a signal, which a line holds with four digits."""


def note_difference(audit: Audit, key: str) -> None:
    """Say that a replay has another part than the run."""
    note = f"Replayed with another {key} than the run's: what differs may come of that."
    if note not in audit.notes:
        audit.notes.append(note)


def hold_plan(audit: Audit, config: RunConfig) -> None:
    """Hold the configuration that tables are made of to the run as its flags give it here.

    Args:
        audit: Of the run.
        config: The run through one of its trackers, with what that says of itself.
    """
    claimed, here = audit.run.config, config.identity()
    same = claimed.get("code") == here.get("code")
    for key, was, now in _differing(claimed, here, (*CLAIMED, *DESCRIBED)):
        if key in DESCRIBED and not same:
            note_difference(audit, key)
        else:
            where = f"{audit.run.folder / CONFIG_FILE}: config: {key}"
            _contradict(audit, f"{where} is {shown(was)}, its flags give {shown(now)}")


def hold_policy(audit: Audit, config: RunConfig) -> None:
    """Hold the weights that the run names to those of the policy that is asked again; a server's are not known."""
    was, now = audit.run.config.get("policy_file"), config.policy_hash
    if was is None or now is None:
        if was != now:
            note_difference(audit, "policy_file")
    elif was != now:
        where = f"{audit.run.folder / CONFIG_FILE}: config: policy_file"
        _contradict(audit, f"{where} is {shown(was)}, the policy that was asked again has {shown(now)}")


def hold_environment(audit: Audit, config: RunConfig, group: str, env: World) -> None:
    """Hold what the run says of an environment to the one in which its episodes are played again."""
    claimed = audit.run.document.get("environments", {}).get(group, {})
    facts = plain_facts(env.describe())
    for key, was, now in _differing(claimed, facts, [key for key in claimed if key in facts]):
        if key in ELSEWHERE or audit.run.config.get("code") != config.code_hash:
            note_difference(audit, f"{key} of {group}")
        else:
            where = f"{audit.run.folder / CONFIG_FILE}: environments: {group}: {key}"
            _contradict(audit, f"{where} is {shown(was)}, played again it is {shown(now)}")


def hold_signals(audit: Audit, record: EpisodeRecord, signals: SignalRecorder) -> None:
    """Hold the signals that tell why an episode failed to those of its replay."""
    again = signals.taken(record.index)
    if record.signals is None or again is None:
        return
    was, now = dataclasses.asdict(record.signals), dataclasses.asdict(again)
    for key, value in was.items():
        if value != now[key] and (None in (value, now[key]) or abs(value - now[key]) > ROUNDED):
            where = f"{audit.run.folder / JOURNAL_FILE}: episode {record.index}: signals"
            audit.faults.append(f"{where}: {key} is {shown(value)}, its actions give {shown(now[key])}")


def _differing(was: Mapping[str, Json], now: Mapping[str, Json], keys: object) -> Iterator[tuple[str, Json, Json]]:
    """Keys that both have with other values, of objects their shared keys alone, and both values."""
    for key in keys:  # type: ignore[attr-defined]
        if key not in was or key not in now:
            continue
        one, other = was[key], now[key]
        if isinstance(one, dict) and isinstance(other, dict):
            shared = [name for name in one if name in other]
            one, other = {name: one[name] for name in shared}, {name: other[name] for name in shared}
        if one != other:
            yield key, one, other


def _contradict(audit: Audit, text: str) -> None:
    if text not in audit.faults:
        audit.faults.append(text)
