"""Conditions that a run claims, held to its flags and to those under which its episodes are played again."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from arena_newton.eval.audit.folder_audit import Audit
from arena_newton.eval.plan.config import RunConfig, plain_facts
from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.eval.records.journal import JOURNAL_FILE, EpisodeRecord
from arena_newton.files.stored_json import Json, shown
from arena_newton.interfaces import World

if TYPE_CHECKING:
    from arena_newton.eval.play.signal_recorder import SignalRecorder

__all__ = ["POLICY", "hold_environment", "hold_plan", "hold_policy", "hold_signals", "note_difference"]
__all__ += ["misnamed_policy", "named_policy", "policy_kind"]

CLAIMED = "task mode seeds repeats rules max_steps variant fast_physics drive checkpoint".split()
"""Keys of a run's identity that a replay must have too."""
DESCRIBED = "tracker_facts mode_facts foreign_tasks".split()
"""Keys that say what code is: they may differ where that is another version's."""
ELSEWHERE = ("device", "tracker", "recorders")
"""Facts of an environment that depend on the machine, or on the programs that are here."""
POLICY = "policy policy_file labels policy_facts".split()
"""Keys of a run's identity that name its policy."""
TABLED = "privileged weights family recipe tasks trackers labels".split()
"""Facts of a policy that tables are made of: no other version of the code explains them."""
RATES = ("physics_dt", "substeps", "startup_ticks")
"""Facts of an environment that no other version of the code explains: without them no replay gives the same bits."""
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


def policy_kind(spec: Json) -> str:
    """Kind of a policy, such as `lerobot`; the path after it is shortened in an identity."""
    return str(spec).partition(":")[0]


def named_policy(config: Mapping[str, Json]) -> dict[str, Json]:
    """Spec, file, labels and facts of the policy that an identity names, and the code that gives the facts."""
    return {key: config.get(key) for key in (*POLICY, "code")}


def hold_policy(audit: Audit, config: RunConfig) -> dict[str, Json]:
    """Hold the policy that the run names to one that was made here; its names (`named_policy`)."""
    claimed, here = named_policy(audit.run.config), named_policy(config.identity())
    for text in misnamed_policy(claimed, here):
        _contradict(audit, f"{audit.run.folder / CONFIG_FILE}: config: {text}")
    for key in POLICY:
        if claimed[key] != here[key]:
            note_difference(audit, key)
    return here


def misnamed_policy(claimed: Mapping[str, Json], asked: Mapping[str, Json]) -> Iterator[str]:
    """Differences of a policy that a run names from the one that was asked again, both as `named_policy` gives them.

    Those of another kind, such as a server, are not known. Facts of which no table is made may differ where code does.
    """
    if policy_kind(claimed["policy"]) != policy_kind(asked["policy"]):
        return
    facts, others = (_object(one["policy_facts"]) for one in (claimed, asked))
    pairs = [(key, claimed[key], asked[key]) for key in ("policy_file", "labels")]
    names = {*facts, *others} if claimed["code"] == asked["code"] else TABLED
    pairs += [(f"policy_facts: {key}", facts.get(key), others.get(key)) for key in sorted(names)]
    for key, was, now in pairs:
        if was != now:
            yield f"{key} is {shown(was)}, of the policy itself {shown(now)}"


def _object(value: Json) -> dict[str, Json]:
    return value if isinstance(value, dict) else {}


def hold_environment(audit: Audit, config: RunConfig, group: str, env: World) -> None:
    """Hold what the run says of an environment to the one in which its episodes are played again."""
    claimed = audit.run.document.get("environments", {}).get(group, {})
    facts = plain_facts(env.describe())
    for key, was, now in _differing(claimed, facts, [key for key in claimed if key in facts]):
        same = audit.run.config.get("code") == config.code_hash
        if key in ELSEWHERE or not (same or key in RATES):
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
