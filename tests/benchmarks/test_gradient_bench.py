"""The bench of gradients: slopes of ticks and of closed loops are those of differences, and one that is off misses."""

import pytest

from benchmarks import gradient_bench
from benchmarks.bench_options import GradientBenchOptions


def test_ticks_and_loops_are_compared(monkeypatch):
    """Each task and tracker gives a figure of its ticks; each task of loops one per length and one of factors."""
    for name, value in (("LOOKS", 2), ("EVERY", 4), ("LOOPS", {2: 1e-3}), ("FACTOR_TICKS", 3)):
        monkeypatch.setattr(gradient_bench, name, value)
    options = GradientBenchOptions(tasks=("football",), trackers=("pd",), states=6, loops=("vis_navi",))
    tick, loop, factors = gradient_bench.slope_figures(options)
    assert [figure.verdict for figure in (tick, loop, factors)] == ["pass"] * 3
    assert tick.note.startswith("6 states; positions ") and loop.note.startswith("actions ")
    assert factors.note.startswith("friction ") and "kd" in factors.note
    honest = gradient_bench.closed_loop

    def off(env, actions, *given, **named):
        rolled = honest(env, actions, *given, **named)
        return rolled._replace(qpos=rolled.qpos + 0.01 * (rolled.qpos - rolled.qpos.detach()))

    monkeypatch.setattr(gradient_bench, "closed_loop", off)
    assert gradient_bench._loop("vis_navi", "pd", 2, 1e-3).value == pytest.approx(0.01, rel=0.01)
