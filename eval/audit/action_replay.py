"""Episodes of a results folder played again on engine mujoco, from their actions alone, and compared bit for bit.

What the policy was shown is drawn again at its queries; a policy is asked again there, and its answers are compared.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.audit.asked_again import Answers, AskedAgain, RecordedQueries
from arena_newton.eval.audit.claimed_conditions import (
    hold_environment,
    hold_plan,
    hold_policy,
    hold_signals,
    note_difference,
)
from arena_newton.eval.audit.folder_audit import CONSISTENT, ENGINE, Audit
from arena_newton.eval.audit.tick_check import EPISODE, SECOND, START, STILL, StatesAgain, TickDifferences
from arena_newton.eval.folders.run_folder import CAMERAS, actions_folder, stored_options
from arena_newton.eval.plan.config import RunConfig, resolve
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.plan.options import Batch, Chunks, Conditions, Remote, RunOptions, Stepping, flags_of
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run import check_parts, make_env
from arena_newton.eval.play.run_flow import groups
from arena_newton.eval.play.signal_recorder import SignalRecorder
from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.eval.records.identity import differing_key
from arena_newton.eval.records.journal import JOURNAL_FILE, EpisodeRecord
from arena_newton.files.stored_json import loaded, shown
from arena_newton.files.text import counted
from arena_newton.interfaces import EpisodeResult, Recorder, World
from arena_newton.pictures.settings import SIZE_LIMITS, CameraConfig
from arena_newton.policies.base import Policy
from arena_newton.rollout import Rollout
from arena_newton.trackers.base import Tracker

__all__ = ["ENGINE", "played", "replay", "rollout_flags", "stored_cameras", "through"]

COMPARED = "outcome reason steps margin startup_fall overflow predicates progress events".split()
"""Keys of a line that a replay must give again, numbers to the last bit."""
EVIDENCE = ("final_state", "shown")
"""Hashes of a line that it must give again, where the line has them."""
DECIDED = ("outcome", "reason")
"""Keys of a line that episodes of another engine must give when each tick is checked from its recorded state."""
STANDING = "stand"
"""Policy by which falls in the start-up are played again: it ends before the first action."""
SCRIPTED = ("expert", "stand")
"""Policies that are made of this package alone, so that what they say of themselves is known without a file."""
DRIFT = 4.0
"""Tolerances of a tick that the differences of a second may add up to."""
UNITS = {"positions": "m", "velocities": "m/s or rad/s"}
MEASURED = ("position", "velocity", "position over a second", "velocity over a second")
LATE = 2
"""Ticks by which such an episode may end earlier or later: a force or margin near its bar."""
MOST_SAMPLES = 4
"""Most rays per pixel along each axis of a stored camera that is drawn again."""


def rollout_flags(stored: RunOptions, policy: str, *kinds: type) -> RunOptions:
    """Flags by which the episodes of a run are played here with a policy, and flags of more kinds of the run."""
    groups_of = (name for kind in (Conditions, Batch, Stepping, *kinds) for name in flags_of(kind))
    others = (*Remote.names_for(policy), "task", "tracker", "seeds", "repeats", "checkpoint", "recorder")
    same = {name: getattr(stored, name) for name in (*groups_of, *others)}
    return RunOptions(**same | {"policy": policy, "engine": ENGINE, "device": "cpu", "actions": False})


def replay(
    audit: Audit,
    records: Sequence[EpisodeRecord],
    factories: Factories | None = None,
    *,
    policy: str | None = None,
    tolerance: float = 0.0,
    tick_tolerance: float = 0.005,
    velocity_tolerance: float = 1.0,
) -> None:
    """Play episodes again, and add what differs to the audit's contradictions.

    Args:
        audit: Of their folder.
        records: The episodes.
        factories: What worlds, trackers and policies are made with; the real ones by default.
        policy: Spec of a policy to ask again at the recorded queries.
        tolerance: Largest difference of an action that is still the policy's.
        tick_tolerance: Largest distance of a body after a tick of another engine [m].
        velocity_tolerance: Largest difference of a velocity then [m/s, rad/s].

    Raises:
        InputError: They were played on another engine and no states were recorded, are demonstrations, were played
            through a tracker with a lookahead, or cannot be played here.
    """
    run, made = audit.run, factories or Factories()
    stored, where = stored_options(run.folder), f"--replay: {run.folder}"
    by_tick = run.config.get("engine") != ENGINE
    if by_tick and not all(EPISODE in (record.media or {}) for record in records if record.steps):
        engine = f"was played on engine {shown(run.config.get('engine'))}, and {ENGINE} alone repeats bits"
        raise InputError(f"{where} {engine}; ticks are checked one by one where states were recorded (--record)")
    if stored.series is not None:
        raise InputError(f"{where} holds demonstrations; `eval record --from` plays them again")
    totals = _Totals()
    if fell := [record for record in records if by_tick and not record.steps]:
        audit.notes.append(f"{counted(len(fell), 'fall')} in the start-up not played again: no state was recorded.")
        records = [record for record in records if record.steps]
    drawn, records = len(records), [record for record in records if record.index not in audit.lacking]
    if absent := drawn - len(records):
        audit.absent = absent
        audit.notes.append(f"Of {counted(absent, 'episode')} to play again the actions are not there: {CONSISTENT}.")
    if records:
        tolerances = tick_tolerance, velocity_tolerance
        _play(audit, stored, records, made, policy, tolerance, totals, by_tick=by_tick, tolerances=tolerances)
    audit.replayed, audit.played = len(records), [record.index for record in records]
    audit.policy, audit.tolerance, audit.asked = policy, tolerance, None if policy is None else len(records)
    audit.largest |= {"answer": totals.largest} if policy is not None else {}
    audit.largest |= dict(zip(MEASURED, totals.furthest, strict=True)) if by_tick else {}
    if by_tick and records:
        audit.notes.append(
            f"Played on another engine: each tick was checked on {ENGINE} from the recorded state before it, no bit "
            f"counts. At most off are bodies {totals.furthest[0]:.2g} m (--tick-tolerance {tick_tolerance:g}) and "
            f"velocities {totals.furthest[1]:.2g} m/s or rad/s (--velocity-tolerance {velocity_tolerance:g}); over a "
            f"second they add up to {totals.furthest[2]:.2g} and {totals.furthest[3]:.2g}, allowed are {DRIFT:g} times."
        )
    if policy is not None and records:
        audit.notes.append(
            f"The policy was asked again: {totals.equal} of {counted(totals.compared, 'action')} are equal to the bit, "
            f"the largest difference is {totals.largest:.3g} (--tolerance {tolerance:g})."
        )


@dataclass
class _Totals:
    """Sums over the episodes of an audit."""

    compared: int = 0
    """Actions of a policy that was asked again."""
    equal: int = 0
    largest: float = 0.0
    """Largest difference of one."""
    furthest: tuple[float, ...] = (0.0,) * 4
    """Largest difference of a position [m] and a velocity [m/s, rad/s] in the first state or after a tick, and added
    up over a second."""

    def add(self, found: TickDifferences) -> None:
        """Take up the ticks of an episode."""
        largest = (float(values.max()) for values in (*found.of_ticks(), *found.of_seconds()))
        self.furthest = tuple(map(max, self.furthest, largest, (found.first, found.first_speed, 0.0, 0.0)))


def _play(
    audit: Audit,
    stored: RunOptions,
    records: Sequence[EpisodeRecord],
    made: Factories,
    policy: str | None,
    tolerance: float,
    totals: _Totals,
    *,
    by_tick: bool,
    tolerances: tuple[float, float],
) -> None:
    """Play these episodes of a folder's plan, and compare each."""
    run, wanted = audit.run, {_key(record): record for record in records}
    acted = any(record.steps for record in records)
    plan = resolve(rollout_flags(stored, f"replay:{run.folder / 'actions'}" if acted else STANDING))
    _note_differences(audit, plan, ("code", "scenes", "rules_hash"))
    measured = bool(stored.recorder) or made.recorders is not Factories.recorders
    own = policy or (str(run.config["policy"]) if run.config["policy"] in SCRIPTED else None)
    asked = plan if own is None else resolve(rollout_flags(stored, own, Chunks))
    made = dataclasses.replace(made, tracker=_without_window(made, f"--replay: {run.folder}"))
    with contextlib.ExitStack() as ended:
        parts = []
        for tracker in dict.fromkeys(record.tracker for record in records):
            actions = run.folder / actions_folder(stored.tracker, tracker)
            mine = [one for one in plan.episodes if one.tracker == tracker and _key(one) in wanted]
            for spec, acts in ((f"replay:{actions}", True), (STANDING, False)):
                if chosen := tuple(one for one in mine if bool(wanted[_key(one)].steps) is acts):
                    config = dataclasses.replace(through(plan, tracker, chosen), policy=spec)
                    config, player = check_parts(config, made, replayed=True)
                    ended.callback(player.close)
                    parts.append((tracker, chosen, config, player))
        for tracker, chosen, config, player in parts:
            hold_plan(audit, config)
            again: Policy | None = None
            if own is not None and config.policy != STANDING:
                other, itself = check_parts(through(asked, tracker, chosen), made)
                ended.callback(itself.close)
                named = hold_policy(audit, other)
                again, audit.asked_policy = (None, None) if policy is None else (itself, named)
            for (task, _, mode), group in groups(chosen).items():
                name = f"{task} {tracker} {mode}"
                cameras = stored_cameras(audit, name) if again is None else other.cameras
                lines = {episode.index: wanted[_key(episode)] for episode in group}
                media = {index: line.media or {} for index, line in lines.items()}
                recorded = {i: RecordedQueries.read(run.folder, files.get("actions")) for i, files in media.items()}
                seen = AskedAgain(recorded, again, latency=stored.latency_ticks, tolerance=tolerance)
                states = StatesAgain({i: run.folder / files.get(EPISODE, "") for i, files in media.items()})
                signals: list[SignalRecorder] = []

                def opened(
                    env: World, name: str = name, config: RunConfig = config, signals: list[SignalRecorder] = signals
                ) -> Sequence[Recorder]:
                    if by_tick:
                        return ()
                    hold_environment(audit, config, name, env)
                    signals += [SignalRecorder(env)] if stored.failures else []
                    return signals

                recorders = [states, seen] if by_tick else [seen]
                seeing = dataclasses.replace(config, cameras=cameras)
                for result in played(seeing, made, player, group, recorders, opened):
                    index = result.episode.index
                    if by_tick:
                        _compare_ticks(audit, lines[index], result, states.differences[index], tolerances)
                        totals.add(states.differences[index])
                    else:
                        _compare(audit, lines[index], result, seen.taken(index)[1], measured=measured)
                    for recorder in signals:
                        hold_signals(audit, lines[index], recorder)
                for index, answers in seen.answers.items():
                    _judge_answers(audit, lines[index], answers, totals)


def _without_window(made: Factories, where: str) -> Callable[[str, Path | None], Tracker]:
    """Constructor of trackers whose episodes recorded actions can give again."""

    def tracker(spec: str, checkpoint: Path | None) -> Tracker:
        one = made.tracker(spec, checkpoint)
        if getattr(one, "lookahead", 0):
            why = "reads the coming reference, which recorded actions do not hold"
            raise InputError(f"{where}: tracker {spec} {why}: no replay can contradict its episodes")
        return one

    return tracker


def through(plan: RunConfig, tracker: str, chosen: tuple[Episode, ...]) -> RunConfig:
    """The part of a plan that one tracker executes."""
    return dataclasses.replace(plan, flags=dataclasses.replace(plan.flags, tracker=(tracker,)), episodes=chosen)


def _judge_answers(audit: Audit, record: EpisodeRecord, answers: Answers, totals: _Totals) -> None:
    """Add a policy's answers at the queries of an episode to the sums, and what contradicts to the audit."""
    totals.compared, totals.equal = totals.compared + answers.asked, totals.equal + answers.equal
    totals.largest = max(totals.largest, answers.largest)
    where = f"{audit.run.folder / JOURNAL_FILE}: episode {record.index}"
    if answers.error is not None or not answers.asked:
        cause = answers.error or "its actions do not say when the policy was asked"
        audit.faults.append(f"{where}: the policy cannot be asked again: {cause}")
    elif answers.first is not None:
        differ = f"actions differ by up to {answers.largest:.3g}"
        audit.faults.append(f"{where}: at tick {answers.first} the policy decides otherwise; {differ}")
    elif answers.unasked is not None:
        audit.faults.append(f"{where}: no query of the policy gave the action at tick {answers.unasked}")


def _key(one: EpisodeRecord | Episode) -> tuple[object, ...]:
    return one.task, one.tracker, one.mode, one.group_seed, one.repeat


def played(
    config: RunConfig,
    made: Factories,
    policy: Policy,
    group: Sequence[Episode],
    recorders: Sequence[Recorder] = (),
    opened: Callable[[World], Sequence[Recorder]] = lambda env: (),
) -> Iterator[EpisodeResult]:
    """Episodes of one task, tracker and mode, played in an environment of their own.

    Args:
        config: The run, with the parts of `check_parts`.
        made: What the environment is made with.
        policy: The policy.
        group: The episodes.
        recorders: What records them.
        opened: Is given the environment before the first; gives recorders that need it.
    """
    env = make_env(config, made, group[0], min(config.flags.worlds, len(group)))
    try:
        recorders = [*recorders, *opened(env)]
        results: list[EpisodeResult] = []
        latency = config.flags.latency_ticks
        Rollout(
            env,
            policy,
            group,
            recorder=[*recorders, *made.measuring(env, config.flags.recorder)],
            max_steps=group[0].max_steps,
            latency=latency,
            on_finish=results.append,
        ).run()
    finally:
        env.close()
    yield from results


def stored_cameras(audit: Audit, group: str) -> dict[str, CameraConfig]:
    """Cameras of the policy of a run, by name, as the environment of a group kept them; none for one that did not see.

    Raises:
        InputError: One is unfit.
    """
    where = f"{audit.run.folder / CONFIG_FILE}: environments: {group}: {CAMERAS}"
    stored = audit.run.document.get("environments", {}).get(group, {}).get(CAMERAS, {})
    cameras = {}
    for name, facts in stored.items() if isinstance(stored, dict) else ():
        one = cameras[name] = loaded(where, facts if isinstance(facts, dict) else {}, CameraConfig)
        if max(one.width, one.height) > SIZE_LIMITS[1] or not 1 <= one.samples <= MOST_SAMPLES:
            raise InputError(f"{where}: {shown(facts)}: is larger than a camera of a policy")
    return cameras


def _note_differences(audit: Audit, config: RunConfig, keys: Sequence[str]) -> None:
    """Say where what is installed or asked here is not what the run names."""
    here, there = config.identity(), audit.run.config
    for key in keys:
        if differing_key({key: there.get(key)}, {key: here.get(key)}) is not None:
            note_difference(audit, key)


def _compare(
    audit: Audit, record: EpisodeRecord, result: EpisodeResult, evidence: dict[str, str], *, measured: bool
) -> None:
    """Hold an episode that was played again to its line; metrics too, where recorders are here (`measured`)."""
    margin = float(result.margin) if math.isfinite(result.margin) else None
    again = {name: getattr(result, name) for name in COMPARED} | {"margin": margin}
    again |= {"extra": result.extra} if measured or result.extra else {}
    again |= {name: evidence.get(name) for name in EVIDENCE if getattr(record, name) is not None}
    for name, value in again.items():
        was = getattr(record, name)
        if was != (tuple(value) if isinstance(was, tuple) else value):
            where = f"{audit.run.folder / JOURNAL_FILE}: episode {record.index}"
            audit.faults.append(f"{where}: {name} is {_short(was)}, its actions give {_short(value)}")


def _compare_ticks(
    audit: Audit, record: EpisodeRecord, result: EpisodeResult, found: TickDifferences, tolerances: tuple[float, float]
) -> None:
    """Hold an episode of another engine, whose ticks were checked one by one, to its line and recorded states."""
    where = f"{audit.run.folder / JOURNAL_FILE}: episode {record.index}"
    for name in DECIDED:
        if (was := getattr(record, name)) != (now := getattr(result, name)):
            audit.faults.append(f"{where}: {name} is {shown(was)}, its recorded states give {shown(now)}")
    if abs(record.steps - result.steps) > LATE:
        audit.faults.append(f"{where}: ended after {record.steps} steps, its recorded states end after {result.steps}")
    if found.first > START:
        audit.faults.append(f"{where}: its first state is {found.first:.2g} m from that of its seed")
    if found.first_speed > tolerances[1]:
        far = f"{found.first_speed:.2g} {UNITS['velocities']}"
        audit.faults.append(f"{where}: velocities of its first state are {far} from those that its seed gives")
    if found.states <= min(record.steps, result.steps):
        few = counted(max(found.states - 1, 0), "tick")
        audit.faults.append(f"{where}: states of its first {few} alone are recorded")
    worst, at = found.unmoved
    if worst > tolerances[1]:
        got = f"{worst * STILL:.2g} m/s or m that {ENGINE} does not give"
        audit.faults.append(f"{where}: until tick {at} a body that nothing moved got {got}")
    for ticks, factor, largest in ((1, 1.0, found.of_ticks()), (SECOND, DRIFT, found.of_seconds())):
        for name, differences, tolerance in zip(("positions", "velocities"), largest, tolerances, strict=True):
            if (worst := float(differences.max())) > factor * tolerance:
                at = int(differences.argmax())
                moment = f"after tick {at}" if ticks == 1 else f"added up over a second from tick {at} on"
                audit.faults.append(f"{where}: {name} {moment} are {worst:.2g} {UNITS[name]} from what {ENGINE} gives")


def _short(value: object) -> str:
    """A value of a line in a message."""
    if isinstance(value, tuple | list):
        return " ".join(f"{event.kind} at {event.tick}" for event in value) or "none"
    return shown(dict(value) if isinstance(value, dict) else value)
