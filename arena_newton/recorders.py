"""Recorders by name, of other packages and of this process; and a metric as the fold of one number per tick."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

from arena_newton.cli.registry import Registry
from arena_newton.interfaces import EpisodeResult, Recorder, World

if TYPE_CHECKING:
    import numpy as np

__all__ = ["Metric", "check", "get", "names", "register", "unregister"]

RECORDERS: Registry[Recorder] = Registry("recorder", "arena_newton.recorders", lambda: Recorder, {})
"""Makers of recorders, such as their classes; each takes the environment."""
check = RECORDERS.check
names = RECORDERS.names
register = RECORDERS.register
unregister = RECORDERS.unregister


def get(name: str, env: World) -> Recorder:
    """Make a recorder of an environment.

    Raises:
        InputError: Unknown name, or a package that offers something else.
    """
    return RECORDERS.make(name, env)


class Metric(Recorder):
    """A number per world and tick, of whose values an episode's metric is made; a subclass writes `measure`."""

    name: str
    """Name in journal and tables."""
    fold: Literal["highest", "lowest", "mean", "total", "last"] = "highest"
    """Way in which the values since step 0 make the metric; one that is NaN does not count."""

    def __init__(self, env: World):
        """Begin without values."""
        self._values: list[list[float]] = [[] for _ in range(env.worlds)]

    def measure(self, env: World) -> np.ndarray:
        """Values after a tick, shape [worlds]."""
        raise TypeError(f"metric {self.name!r} defines no measure()")

    def start(self, env: World, world: int, episode: object) -> None:
        """See `Recorder.start`."""
        self._values[world] = []

    def tick(self, env: World) -> None:
        """See `Recorder.tick`."""
        measured = self.measure(env).tolist()
        for world in range(env.worlds):
            if env.active[world] and env.tick[world] > 0 and not math.isnan(measured[world]):
                self._values[world].append(measured[world])

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """See `Recorder.finish`; an episode without a value has no metric."""
        if values := self._values[world]:
            total = math.fsum(values)
            folded = {"highest": max(values), "lowest": min(values), "total": total, "last": values[-1]}
            result.extra[self.name] = (folded | {"mean": total / len(values)})[self.fold]
