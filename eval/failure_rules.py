"""At which stage an episode failed: the taxonomy of the paper's appendix on failures as rules over recorded signals.

Pure and deterministic: an episode's line of the journal in, one stage out. The paper names six stages in words; what
they mean here is this file. A failure gets the first stage that broke down, from the robot outward: what the tracker
did, then contact and what came after it, then posture, approach, and last whether the object was found at all.
"""

from __future__ import annotations

from typing import Protocol

from arena_newton.eval.episode_signals import EpisodeSignals
from arena_newton.eval.failure_stage import FailureStage

__all__ = ["FALLING", "Judged", "sees_at_start", "stage_of"]


class Judged(Protocol):
    """What the rules read of an episode's line (`journal.EpisodeRecord`)."""

    @property
    def task(self) -> str:
        """Name of its task."""

    @property
    def outcome(self) -> str:
        """`success`, `fall`, `timeout` or `error`."""

    @property
    def reason(self) -> str | None:
        """Finer cause of the outcome, such as `ball_out`."""

    @property
    def steps(self) -> int:
        """Its length [ticks]."""

    @property
    def startup_fall(self) -> bool:
        """It fell before the policy acted."""

    @property
    def signals(self) -> EpisodeSignals | None:
        """None where they were not kept."""


TRACKING = 0.09
"""Mean error of the leg joints from which on the tracker does not follow [rad]. Experts' successes have 0.036 to 0.069
through `twist2` and `sonic`; with half the legs' excursions both have 0.10 to 0.13 (6 and 4 episodes each)."""
LEANING = 0.60
"""Tilt of a reference from which on no tracker can be blamed [rad]: the experts' is 0.05 to 0.08 here."""
SEEN = 10
"""Pixels of 224 x 168 from which on the first picture shows the object, as in the check `visible`."""
ENGAGED = 100
"""Ticks for which a robot must stay slow near the object to have come for it: two seconds. A searching robot slows
down for about one (up to 56 ticks measured), where its way turns; one that has arrived stays (300 and more)."""
ALIGNED = 100
"""The same where the object can be touched without a step."""
MOVED = 0.25
"""Distance from where it was touched first at which the object has moved away [m]."""
CARRIED = ("pp_box", "double_desk")
"""Tasks whose object moves with the hands; how far it has moved is measured from where they touched it last."""
LEFT = 1.0
"""Distance from there at which a carried object is left [m], seen from above: beyond `tasks.base.REACH`, 0.8 m. One
that is dropped or put down wrongly is nearer: a box that falls from walking hands rolls up to 0.8 m."""
REACHED_ONLY = ("vis_navi",)
"""Tasks in which the object is only to be reached. A touch has no effect that could fail to come: a robot that set a
foot on the area and does not stand in it with both has not come into the pose that is wanted."""
ENDING = ("ball_out",)
"""Causes that end an episode: after these there was nothing to recover."""
FALLING = 50
"""A touch within so many ticks before a fall is a part of the fall: it takes about a second."""


def stage_of(episode: Judged) -> FailureStage | None:
    """Stage at which an episode failed; None for a success, an error, and an episode without signals."""
    signals = episode.signals
    if signals is None or episode.outcome not in ("fall", "timeout"):
        return None
    if episode.startup_fall:
        return FailureStage.TRACKER
    fell = episode.outcome == "fall"
    if signals.tracking_error > TRACKING and signals.reference_tilt < LEANING:
        return FailureStage.TRACKER
    if signals.first_touch is not None and not (fell and episode.steps - signals.first_touch < FALLING):
        away = LEFT if episode.task in CARRIED else MOVED
        lost = signals.moved > away and not signals.touches_moved and episode.reason not in ENDING
        if fell or lost:
            return FailureStage.RECOVERY
        return FailureStage.APPROACH if episode.task in REACHED_ONLY else FailureStage.CONTACT
    if fell or signals.aligned_ticks >= ALIGNED:
        return FailureStage.POSTURE
    return FailureStage.APPROACH if signals.engaged_ticks >= ENGAGED else FailureStage.PERCEPTION


def sees_at_start(signals: EpisodeSignals) -> bool:
    """Whether the first picture shows the object."""
    return signals.first_pixels >= SEEN
