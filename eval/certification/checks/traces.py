"""Every bit of an episode as text: what tells whether two episodes are the same, and from which tick they are not."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from arena_newton import policies
from arena_newton.interfaces import Recorder, World
from arena_newton.rollout import Rollout

if TYPE_CHECKING:
    from arena_newton.eval.certification.context import Context

__all__ = ["StateTrace", "first_difference", "play", "world_of"]


class StateTrace(Recorder):
    """Hashes positions, velocities, actuator targets and body poses of each episode at each tick, start-up included."""

    def __init__(self) -> None:
        """Know no episode yet."""
        self.traces: dict[str, list[str]] = {}
        """Episode seed → a hash for each tick."""
        self._running: dict[int, str] = {}

    def start(self, env: World, world: int, episode: SimpleNamespace) -> None:
        """See `Recorder.start`."""
        self._running[world] = str(episode.episode_seed)
        self.traces[self._running[world]] = []

    def tick(self, env: World) -> None:
        """See `Recorder.tick`."""
        p = env.physics
        # The poses of fixtures, which no joint moves, are in those of the bodies.
        arrays = [array.numpy() for array in (p.qpos, p.qvel, p.ctrl, p.xpos, p.xquat)]
        for world in np.flatnonzero(env.active).tolist():
            state = b"".join(array[world].tobytes() for array in arrays)
            self.traces[self._running[world]].append(hashlib.blake2b(state, digest_size=8).hexdigest())


def first_difference(one: Sequence[str], other: Sequence[str]) -> int | None:
    """Index from which two traces differ; None where they are equal."""
    for index, (a, b) in enumerate(zip(one, other, strict=False)):
        if a != b:
            return index
    return None if len(one) == len(other) else min(len(one), len(other))


def world_of(context: Context, task: str, tracker: str, *, worlds: int, **options: object) -> World:
    """Worlds of a task on the certification's engine.

    Args:
        tracker: Tracker with the weights it comes with.
        options: Further ones of `ArenaEnv`, such as `mode`, `rules` and `camera`.
    """
    made = context.factories.tracker(tracker, None)
    given = {"engine": context.options.engine, "device": context.options.device} | options
    return context.factories.env(task, tracker=made, worlds=worlds, **given)


def play(env: World, seeds: Sequence[int], ticks: int) -> dict[str, list[str]]:
    """Traces of episodes that the expert plays, in the order of the seeds, each for at most some ticks."""
    trace = StateTrace()
    episodes = [SimpleNamespace(episode_seed=seed) for seed in seeds]
    Rollout(env, policies.get("expert"), episodes, recorder=trace, max_steps=ticks).run()
    return trace.traces
