"""Cache of environments for runs that follow each other: the same one again, or its scene, is not built again.

Building an environment takes seconds, for runs of a minute. An episode begins from its seed alone, so what ran before
in the same environment does not change it; a test compares them bit for bit.
"""

from __future__ import annotations

import gc
import json

from arena_newton import rule_sets, tasks
from arena_newton.env import ArenaEnv
from arena_newton.trackers.base import Tracker

__all__ = ["EnvCache", "CachedEnv"]


class CachedEnv(ArenaEnv):
    """An environment that its run does not release."""

    def close(self) -> None:
        """End the episodes; the physics stays for the next run."""
        self.active[:] = False

    def end(self) -> None:
        """Release the physics' threads; the environment steps no more."""
        super().close()


class EnvCache:
    """Makes environments (`Factories.env`) and keeps the last one."""

    def __init__(self, kind: type[CachedEnv] = CachedEnv) -> None:
        """Begin without any."""
        self._kind = kind
        self._key: object = None
        self._env: CachedEnv | None = None
        self.built = 0
        """Environments built so far."""

    def __call__(
        self, task: str, *, tracker: Tracker, mode: str = "base", rules: str = "paper", **options: object
    ) -> CachedEnv:
        """Environment of a run, whose arguments are those of `ArenaEnv`.

        A tracker whose description equals the last one's is taken to be the same; modes that share a scene share the
        environment.
        """
        description = json.dumps(tracker.describe(), sort_keys=True, default=str)
        scene = tasks.get(task).scene_name(mode, rule_sets.get(rules))
        key = (task, type(tracker), description, rules, scene, sorted(options.items(), key=lambda item: item[0]))
        if self._env is None or self._key != key:
            self.drop()
            self._env = self._kind(task, tracker=tracker, mode=mode, rules=rules, **options)  # type: ignore[arg-type]
            self._key, self.built = key, self.built + 1
        self._env.mode = mode
        return self._env

    def drop(self) -> None:
        """Release the last environment: it is not needed any more, or what ran in it broke down."""
        if self._env is not None:
            self._env.end()
            self._key = self._env = None
            gc.collect()
