"""Recorders by name, of other packages and of this process; and a metric as the fold of one number per tick."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from arena_newton.cli.registry import Registry
from arena_newton.errors import InputError
from arena_newton.files.stored_json import is_name
from arena_newton.interfaces import EpisodeResult, Recorder, World

__all__ = ["Metric", "check_names", "finish", "get", "load", "names", "register", "unregister"]

Fold = Literal["highest", "lowest", "mean", "total", "last"]
FOLDS = get_args(Fold)
"""Ways in which values make a metric."""

RECORDERS: Registry[Recorder] = Registry("recorder", "arena_newton.recorders", lambda: Recorder, {})
"""Makers of recorders, such as their classes; each takes the environment."""
load = RECORDERS.load
names = RECORDERS.names
register = RECORDERS.register
unregister = RECORDERS.unregister


def get(name: str, env: World) -> Recorder:
    """Make a recorder of an environment.

    Raises:
        InputError: Unknown name, or a package that offers something else.
    """
    return RECORDERS.make(name, env)


def check_names(recorders: Sequence[Recorder]) -> None:
    """Refuse metrics of one name, of which the journal would hold the last.

    Raises:
        InputError: Two have the same; the message names their classes.
    """
    found: dict[str, Recorder] = {}
    for metric in (one for one in recorders if isinstance(one, Metric)):
        _claim(metric.name, metric, found)


def finish(recorders: Sequence[Recorder], env: World, world: int, result: EpisodeResult) -> None:
    """Tell recorders that an episode ended, each of which sees its own metrics alone in `result.extra`; then all are.

    Raises:
        InputError: Two give metrics of one name; the message names their classes.
    """
    found: dict[str, float] = {}
    owners: dict[str, Recorder] = {}
    for one in recorders:
        result.extra = {}
        one.finish(env, world, result)
        for name in result.extra:
            _claim(name, one, owners)
        found |= result.extra
    result.extra = found


def _claim(name: str, recorder: Recorder, owners: dict[str, Recorder]) -> None:
    """Note the recorder of a metric, or refuse a second one."""
    if (other := owners.setdefault(name, recorder)) is not recorder:
        kinds = [f"{kind.__module__}.{kind.__qualname__}" for kind in (type(other), type(recorder))]
        raise InputError(f"metric {name}: is the name of {kinds[0]} and of {kinds[1]}; rename one of them")


class Metric(Recorder):
    """A number per world and tick, of whose values an episode's metric is made; a subclass writes `measure`."""

    name: str
    """Name in journal and tables."""
    fold: Fold = "highest"
    """Way in which the values since step 0 make the metric; one that is NaN does not count."""

    def __init__(self, env: World):
        """Begin without values.

        Raises:
            InputError: The class has no name, or a fold that is not one.
        """
        kind = type(self).__name__
        if not is_name(getattr(self, "name", "")):
            raise InputError(f"metric {kind}: its `name` is {getattr(self, 'name', '')!r}, expected a name for tables")
        if self.fold not in FOLDS:
            raise InputError(f"metric {self.name} ({kind}): its `fold` is {self.fold!r}, expected {', '.join(FOLDS)}")
        self._values: list[list[float]] = [[] for _ in range(env.worlds)]

    def measure(self, env: World) -> np.ndarray:
        """Values after a tick, shape [worlds]."""
        raise TypeError(f"metric {self.name!r} defines no measure()")

    def start(self, env: World, world: int, episode: object) -> None:
        """See `Recorder.start`."""
        self._values[world] = []

    def tick(self, env: World) -> None:
        """See `Recorder.tick`."""
        found = np.asarray(self.measure(env))
        if found.shape != (env.worlds,):
            kind = f"metric {self.name} ({type(self).__name__})"
            raise InputError(
                f"{kind}: measure() gives shape {list(found.shape)}, expected [{env.worlds}], one per world"
            )
        measured = found.tolist()
        for world in range(env.worlds):
            if env.active[world] and env.tick[world] > 0 and not math.isnan(measured[world]):
                self._values[world].append(measured[world])

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """See `Recorder.finish`; an episode without a value has no metric."""
        if values := self._values[world]:
            total = math.fsum(values)
            folded = {"highest": max(values), "lowest": min(values), "total": total, "last": values[-1]}
            result.extra[self.name] = (folded | {"mean": total / len(values)})[self.fold]
