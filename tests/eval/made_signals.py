"""Signals for tests: those of an episode that went well, with some changed."""

import dataclasses

from arena_newton import tasks
from arena_newton.eval.records.episode_signals import EpisodeSignals

WELL = {
    "looks": 9,
    "looks_seen": 8,
    "first_pixels": 40,
    "first_seen": 0,
    "start_distance": 1.9,
    "nearest_distance": 0.4,
    "engaged_ticks": 300,
    "stop_distance": 0.4,
    "stop_bearing": 0.7,
    "aligned_ticks": 150,
    "reach_distance": 0.05,
    "touches": 1,
    "first_touch": 360,
    "touch_distance": 0.42,
    "touch_bearing": 0.8,
    "moved": 0.0,
    "touches_moved": 0,
    "posture_margin": 0.8,
    "height_min": 0.6,
    "reference_tilt": 0.2,
    "reference_height": 0.6,
    "tracking_error": 0.05,
    "tracking_worst": 0.1,
    "tilt_error": 0.1,
    "drift": 0.2,
}
"""An episode whose hand came to its target."""
UNTOUCHED = {"touches": 0, "first_touch": None, "touch_distance": None, "touch_bearing": None, "reach_distance": 0.5}
"""Signals that differ when nothing was touched."""


def signals(**changes):
    """The signals of `WELL` with changes."""
    return EpisodeSignals(**(WELL | changes))


def without_signals(monkeypatch, task):
    """Take the interaction out of a task's record."""
    monkeypatch.setattr(f"arena_newton.tasks.{task}.TASK", dataclasses.replace(tasks.get(task), interaction=None))
