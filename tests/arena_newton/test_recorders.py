"""Metrics as folds of one number per tick, and recorders by name."""

from types import SimpleNamespace

import numpy as np
import pytest

from arena_newton import recorders
from arena_newton.errors import InputError
from arena_newton.interfaces import EpisodeResult
from arena_newton.recorders import Metric

VALUES = [[9.0, 9.0], [1.0, np.nan], [4.0, np.nan], [3.0, np.nan]]
"""Values of two worlds in the start-up, and after three ticks of an episode; the second has none."""


@pytest.mark.parametrize(
    ("fold", "found"), [("highest", 4.0), ("lowest", 1.0), ("mean", 8.0 / 3.0), ("total", 8.0), ("last", 3.0)]
)
def test_a_metric_folds_the_values_of_an_episode(fold, found):
    """Ticks before step 0 and of other episodes do not count; an episode without a value has no metric."""

    class Pace(Metric):
        name = "pace"

        def measure(self, env):
            return np.array(VALUES[env.tick[0]])

    Pace.fold = fold
    env = SimpleNamespace(worlds=2, active=np.array([True, True]), tick=np.array([0, 0]))
    metric = Pace(env)
    for _ in range(2):
        metric.start(env, 0, None)
        for tick in range(len(VALUES)):
            env.tick[:] = tick
            metric.tick(env)
        results = [EpisodeResult(None, "timeout", "", 3, 0.0) for _ in range(2)]
        for world, result in enumerate(results):
            metric.finish(env, world, result)
        assert [result.extra for result in results] == [{"pace": found}, {}]


def test_recorders_are_known_by_name():
    """A class that was registered makes recorders; a metric that measures nothing and an unknown name are named."""

    class Blind(Metric):
        name = "blind"

    recorders.register("blind", Blind)
    try:
        made = recorders.get("blind", SimpleNamespace(worlds=1))
        assert isinstance(made, Metric) and "blind" in recorders.names()
    finally:
        recorders.unregister("blind")
    with pytest.raises(InputError, match="--recorder blind: unknown recorder"):
        recorders.load("blind")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "metric Odd: its `name` is '', expected a name"),
        ({"name": "odd", "fold": "median"}, r"metric odd \(Odd\): its `fold` is 'median', expected highest, "),
        (
            {"name": "odd", "measure": lambda self, env: 1.0},
            r"metric odd \(Odd\): measure\(\) gives shape \[\], expected",
        ),
    ],
)
def test_a_metric_that_is_not_whole_is_named(given, said):
    """A metric without a name, with an unknown fold or with values that are not one per world is an error by name."""
    env = SimpleNamespace(worlds=2, active=np.array([True, True]), tick=np.array([1, 1]))
    with pytest.raises(InputError, match=said):
        type("Odd", (Metric,), given)(env).tick(env)
