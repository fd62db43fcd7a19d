"""The bench of gradients: slopes of ticks and of closed loops are those of differences, and one that is off misses."""

import threading

import pytest
import torch

from arena_newton.robot.canonical import STAND_ACTION
from benchmarks import featherstone_bench, flight_bench, gradient_bench
from benchmarks.__main__ import main
from benchmarks.bench_options import GradientBenchOptions


def test_ticks_and_loops_are_compared(monkeypatch):
    """Each task and tracker gives a figure of its ticks; each task of loops one per length and one of factors."""
    for name, value in (("LOOKS", 2), ("EVERY", 4), ("LOOPS", {2: 1e-3}), ("FACTOR_TICKS", 3)):
        monkeypatch.setattr(gradient_bench, name, value)
    options = GradientBenchOptions(
        what=("ticks", "loops"), tasks=("football",), trackers=("pd",), states=6, loops=("vis_navi",)
    )
    tick, loop, factors = gradient_bench.slope_figures(options)
    assert [figure.verdict for figure in (tick, loop, factors)] == ["pass"] * 3
    assert tick.note.startswith("6 states; positions ") and loop.note.startswith("2 ticks; actions ")
    assert factors.note.startswith("3 ticks; friction ") and "kd" in factors.note
    honest = gradient_bench.closed_loop

    def off(env, actions, *given, **named):
        rolled = honest(env, actions, *given, **named)
        return rolled._replace(qpos=rolled.qpos + 0.01 * (rolled.qpos - rolled.qpos.detach()))

    monkeypatch.setattr(gradient_bench, "closed_loop", off)
    assert gradient_bench._loop("vis_navi", "pd", 2, 1e-3).value == pytest.approx(0.01, rel=0.01)


def test_the_nearer_side_of_a_kink_within_the_step_counts(monkeypatch):
    """A slope that jumps next to the actions is compared on the side that has it, and the note says so."""
    honest, at = gradient_bench.closed_loop, []

    def kinked(env, actions, *given, **named):
        rolled = honest(env, actions, *given, **named)
        if not isinstance(actions, torch.Tensor):
            return rolled
        at.append(actions.detach())
        return rolled._replace(qpos=rolled.qpos + 0.01 * ((actions - at[0]).sum() - 1e-9).clamp_min(0.0))

    monkeypatch.setattr(gradient_bench, "closed_loop", kinked)
    found = gradient_bench._loop("vis_navi", "pd", 2, 1e-3)
    assert found.verdict == "pass" and "; actions central " in found.note and ", one side " in found.note


def test_a_loop_is_compared_with_the_episode_that_it_replays(monkeypatch):
    """The distance is that of whole positions; a loop that starts elsewhere misses its bar."""
    monkeypatch.setattr(gradient_bench, "LONGEST", 5)
    found = gradient_bench._replay("vis_navi", "pd")
    assert found.verdict == "pass" and found.note.startswith("episode 0, 5 ticks; pelvis ")
    assert found.note.endswith("; the engine's own, nudged, 1e-12")
    honest = gradient_bench.closed_loop

    def off(*given):
        rolled = honest(*given)
        return rolled._replace(qpos=rolled.qpos + 2e-4)

    monkeypatch.setattr(gradient_bench, "closed_loop", off)
    assert gradient_bench._replay("vis_navi", "pd").verdict == "MISS"


def test_what_holds_through_a_kick_is_counted():
    """Of a ball that nobody touches all slopes hold, and no touch is found by name."""
    env = gradient_bench._world("football", "pd")
    stand = torch.tensor(STAND_ACTION).double().repeat(1, 4, 1)
    found = gradient_bench._reach(env, [5], stand, 3, soft=True)
    assert found.value == 3.0 and found.verdict == "pass" and "its start y +1.00 (+1.00, +1.00)" in found.note
    still = gradient_bench.closed_loop(env, stand, [5], 4)
    with pytest.raises(gradient_bench.InputError, match="football: the expert touches nothing within 4 ticks"):
        gradient_bench.touch_of(env, still)
    env.close()


def test_flights_and_mujocos_differences_are_figures(monkeypatch):
    """A short kick is a centimetre off at most; differences with the engine's solver are near a converged one's."""
    monkeypatch.setattr(gradient_bench, "LONGEST_KICK", 21)
    monkeypatch.setattr(flight_bench, "KICKS", ((2.0, 0.0, 0.0),))
    flight, transition = gradient_bench.slope_figures(GradientBenchOptions(what=("flights", "transition")))
    assert 0.0 < flight.value < 1.0 and flight.unit == "cm"
    assert 0.0 <= transition.value < 1.0 and "1 states" in transition.note


def test_a_solver_that_does_not_end_is_left(monkeypatch, capsys):
    """Stages are told as they begin; after the limit the last that ended is named, and an error is the bench's."""
    ends = threading.Event()

    def stages():
        seconds, _ = featherstone_bench._stage("robots", "cpu", lambda: None)
        yield featherstone_bench._duration("robots built", seconds)
        featherstone_bench._stage("kernels", "cpu", ends.wait)

    monkeypatch.setattr(featherstone_bench, "_figures", stages)
    built, left = featherstone_bench.featherstone_figures(0.5)
    assert built.name.endswith("robots built") and (left.verdict, left.bar) == ("MISS", 0.5)
    assert left.note == f"not ended, after {built.name}"
    assert capsys.readouterr().err == "featherstone: robots ...\nfeatherstone: kernels ...\n"
    ends.set()
    monkeypatch.setattr(featherstone_bench, "_figures", lambda: iter([1 / 0 for _ in "x"]))
    with pytest.raises(ZeroDivisionError):
        list(featherstone_bench.featherstone_figures(5.0))


@pytest.mark.parametrize(("flag", "least"), [("limit", 1), ("states", 2)])
def test_numbers_outside_their_bounds_are_refused(flag, least, capsys):
    """A limit of less than a second and a single state are refused before anything is measured."""
    assert main(["gradients", f"--{flag}", "-1"]) == 2
    assert f": expected a number from {least}" in capsys.readouterr().err
