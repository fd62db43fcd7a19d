"""Stage at which an episode failed: the taxonomy of the paper's appendix on failures as rules over recorded signals.

Pure and deterministic: an episode's line of the journal in, one stage out. The paper names six stages in words; what
they mean here is this file. A failure gets the first stage that broke down, from the robot outward: what the tracker
did, then contact and what came after it, then posture, approach, and last whether the object was found at all.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from arena_newton import tasks
from arena_newton.eval.folders.failure_stage import FailureStage
from arena_newton.eval.records.episode_signals import EpisodeSignals
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.tasks.interaction import Interaction

__all__ = ["BARS", "BAND", "Bars", "near_bars", "sees_at_start", "stage_of", "waits_in_view"]


@dataclass(frozen=True)
class Bars:
    """Bars of the rules, each named as the signal that it is for."""

    tracking_error: float = 0.09
    """Mean error of the leg joints from which on the tracker does not follow [rad]. Experts' successes have 0.036 to
    0.069 through `twist2` and `sonic`; with half the legs' excursions both have 0.10 to 0.13 (6, 4 episodes each)."""
    reference_tilt: float = 0.60
    """Tilt of a reference from which on no tracker can be blamed [rad]: the experts' is 0.05 to 0.08 here."""
    engaged_ticks: float = 100
    """Ticks for which a robot must stay slow near the object to have come for it: two seconds. A searching robot slows
    down for about one (up to 56 ticks measured), where its way turns; one that has arrived stays (300 and more)."""
    aligned_ticks: float = 60
    """The same where the object can be touched without a step: longer than a searching robot slows down for, and long
    enough to reach for it. In proportion longer where a faster walk is slow: Football's robots that aim badly walk past
    the ball in up to 68. (The two seconds of readers include when it is at the side, beyond an `Interaction`'s
    bearing.)"""
    moved: float = 0.25
    """Distance from where it was touched first at which the object has moved away [m]."""
    left: float = 1.1
    """The same of a carried object, from where it was touched last, seen from above [m]: beyond `tasks.base.REACH`,
    0.8 m. One that is dropped or put down wrongly is nearer: a box that falls from walking hands rolls up to 0.8 m."""
    effect: float = 0.05
    """Distance that a loose object moves at least by a touch that has an effect [m]: a fist that comes to rest at a box
    shifts it by up to 0.02, one that squeezes it and loses it by 0.09 and more."""
    first_touch: float = 50
    """A touch within so many ticks before a fall is a part of the fall: it takes about a second."""
    stop_distance: float = 1.1
    """A robot that stays near the object for half of its episode, once it is within the `Interaction`'s stance times
    this, stands where it can touch it: who has arrived and sways about the border has not left the pose."""
    stop_bearing: float = 1.1
    """The same of the bearing."""


BARS = Bars()
BAND = 0.1
"""A signal within this fraction of its bar is near it."""
SEEN = 10
"""Pixels of 224 x 168 from which on the first picture shows the object, as in the check `visible`."""
ENDING = ("ball_out",)
"""Causes that end an episode: after these there was nothing to recover."""
_OTHER = Interaction("", (), touch=0.0, stance=0.0)
"""A task that this installation has no entry of; its folders are read all the same."""
WAITS = 0.5
"""Fraction of an episode for which a robot that waits stays slow near the object without a break, and of the looks that
show it. Those that were seen to wait stayed 0.6 to 0.9 of it."""


def stage_of(episode: EpisodeRecord, bars: Bars = BARS) -> FailureStage | None:
    """Stage at which an episode failed; None for a success, an error, and an episode without signals."""
    signals = episode.signals
    if signals is None or episode.outcome not in ("fall", "timeout"):
        return None
    if episode.startup_fall:
        return FailureStage.TRACKING
    fell = episode.outcome == "fall"
    if signals.tracking_error > bars.tracking_error and signals.reference_tilt < bars.reference_tilt:
        return FailureStage.TRACKING
    task = _interaction(episode.task)
    touched = _touched(episode, signals, task)
    if touched is not None and not (fell and episode.steps - touched < bars.first_touch):
        if _without_effect(episode, signals, task, bars):
            return FailureStage.POSTURE
        away = bars.left if task.carried else bars.moved
        lost = signals.moved > away and not signals.touches_moved and episode.reason not in ENDING
        if fell or lost:
            return FailureStage.RECOVERY
        return FailureStage.APPROACH if task.reached_only else FailureStage.CONTACT
    engaged = signals.engaged_ticks >= bars.engaged_ticks
    stays = engaged and signals.engaged_ticks >= WAITS * episode.steps
    aligned = signals.aligned_ticks >= bars.aligned_ticks * task.slow / _OTHER.slow
    if fell or aligned or (stays and _in_pose(signals, task, bars)):
        return FailureStage.POSTURE
    return FailureStage.APPROACH if engaged else FailureStage.PERCEPTION


def _interaction(task: str) -> Interaction:
    return (tasks.get(task).interaction if task in tasks.names() else None) or _OTHER


def _touched(episode: EpisodeRecord, signals: EpisodeSignals, task: Interaction) -> int | None:
    """Tick of the first touch; None where there was none, or the task's own predicate says that there was none."""
    declared = episode.predicates.get(task.predicate, signals.first_touch)
    return None if declared is None or signals.first_touch is None else max(declared, signals.first_touch)


def _without_effect(episode: EpisodeRecord, signals: EpisodeSignals, task: Interaction, bars: Bars) -> bool:
    """A loose object stayed where it was when it was touched, and no later predicate of its task held.

    Of a carried object that is still touched at the end how far it was pushed is not known: `moved` is 0.
    """
    held = task.carried and signals.moved == 0.0
    if held or not task.loose or task.predicate not in episode.predicates or signals.moved >= bars.effect:
        return False
    names = list(episode.predicates)
    return all(episode.predicates[name] is None for name in names[names.index(task.predicate) + 1 :])


def _in_pose(signals: EpisodeSignals, task: Interaction, bars: Bars) -> bool:
    """It stayed, by a bar that is a little wider, where the object can be touched without a step."""
    distance, bearing = signals.stop_distance, signals.stop_bearing
    if distance is None or bearing is None:
        return False
    return distance <= bars.stop_distance * task.stance and bearing <= bars.stop_bearing * task.bearing


def near_bars(episode: EpisodeRecord) -> tuple[str, ...]:
    """Signals within a tenth of a bar beyond which the stage would be another."""
    stage, signals = stage_of(episode), episode.signals
    if stage is None or signals is None:
        return ()
    found = []
    for name in (field.name for field in dataclasses.fields(Bars)):
        others = (dataclasses.replace(BARS, **{name: getattr(BARS, name) * (1.0 + by)}) for by in (-BAND, BAND))
        if any(stage_of(episode, bars) != stage for bars in others):
            found.append(name)
    touch = _interaction(episode.task).touch
    if stage is not FailureStage.TRACKING and abs(signals.reach_distance - touch) < BAND * touch:
        found.append("reach_distance")
    return tuple(found)


def waits_in_view(episode: EpisodeRecord) -> bool:
    """A robot that failed stayed slow near the object, which it had in view, for most of its episode."""
    signals = episode.signals
    if signals is None or episode.outcome != "timeout":
        return False
    return signals.engaged_ticks >= WAITS * episode.steps and signals.looks_seen >= WAITS * max(signals.looks, 1)


def sees_at_start(signals: EpisodeSignals) -> bool:
    """True if the first picture shows the object."""
    return signals.first_pixels >= SEEN
