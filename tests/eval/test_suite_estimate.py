"""How long a suite takes: the estimate from made times is right, its interval holds what it says, nothing is hidden."""

import random
import re
from pathlib import Path

import numpy as np
import pytest
from eval_fakes import FakeEnv, factories
from test_matrix import SUITE

from arena_newton.eval.__main__ import main
from arena_newton.eval.bench import suite_timing
from arena_newton.eval.bench.suite_estimate import CellSize, MeasuredCell, Slowdown, drawn, suite_time

KINDS = (("act", "base"), ("act", "visual"), ("dp", "base"))
COST = {("act", "base"): 0.01, ("act", "visual"): 0.02, ("dp", "base"): 0.05}
"""Seconds per tick."""


def cells(number=30):
    """Cells of three kinds whose sizes differ, four of an environment after each other."""
    groups = [(f"task{n // 4}", "twist2", "base") for n in range(number)]
    return [CellSize(f"cell{n}", KINDS[n % 3], groups[n], 500 + 100 * (n % 7)) for n in range(number)]


def measured(sample, noise=0.0, seed=0):
    """What they take, each by chance more or less by a fraction."""
    dice = random.Random(seed)
    return [MeasuredCell(c, COST[c.kind] * c.ticks * (1 + dice.gauss(0, noise)), 2.0) for c in sample]


def test_without_chance_the_estimate_is_exact():
    """Times in proportion to ticks give the sum of all cells, and an interval of no width."""
    found = suite_time(cells(), measured(drawn(cells(), 2)), (1,))
    assert found.seconds == pytest.approx(sum(COST[c.kind] * c.ticks for c in cells()))
    assert found.building == pytest.approx(2.0 * 8) and found.degrees == 3
    assert found.on[0].seconds == pytest.approx(found.seconds + found.building)
    assert found.on[0].low == pytest.approx(found.on[0].high)


def test_the_interval_holds_the_truth():
    """Of 400 plans whose cells differ by chance at least about 95 % of the intervals hold their time, and not all."""
    held = 0
    for seed in range(400):
        every = measured(cells(60), 0.2, seed)
        chosen = {c.name for c in random.Random(-1 - seed).sample(cells(60), 60)[:18]}
        sample = [one for one in every if one.size.name in chosen]
        if {one.size.kind for one in sample} != set(KINDS):
            held += 1
            continue
        found = suite_time(cells(60), sample, (1,))
        build = found.on[0].seconds - found.seconds
        truth = sum(one.seconds for one in every) + build
        held += found.on[0].low <= truth <= found.on[0].high
    assert 0.93 <= held / 400 < 1


def test_drawn_cells_are_of_each_kind():
    """So many of each kind, the same ones every time, whatever the order."""
    sample = drawn(cells(), 2)
    assert [sum(c.kind == kind for c in sample) for kind in KINDS] == [2, 2, 2]
    assert {c.name for c in drawn(cells()[::-1], 2)} == {c.name for c in sample}
    assert drawn(cells(), 99) == cells()


def test_more_devices_share_the_cells():
    """Without a slowdown eight take about an eighth; never less than the longest cell, nor more than one alone."""
    one, two, eight, many = suite_time(cells(400), measured(drawn(cells(400), 3)), (1, 2, 8, 1000)).on
    assert one.seconds / two.seconds == pytest.approx(2, rel=0.1)
    assert 6 < one.seconds / eight.seconds <= 8
    assert many.seconds == pytest.approx(max(COST[c.kind] * c.ticks for c in cells()) + 2.0)


def test_a_slowdown_is_carried_on():
    """A second device that costs 10 % makes eight of them 70 % slower, with the range of the rounds."""
    slow = Slowdown((10.0, 10.0, 10.0), (10.5, 11.0, 12.0))
    assert slow.ratio == pytest.approx(1.1) and slow.range == pytest.approx((1.05, 1.2))
    free = suite_time(cells(), measured(drawn(cells(), 2)), (1, 2, 8)).on
    held = suite_time(cells(), measured(drawn(cells(), 2)), (1, 2, 8), slow).on
    assert [b.seconds / a.seconds for a, b in zip(free, held, strict=True)] == pytest.approx([1.0, 1.1, 1.7])
    assert held[2].low == pytest.approx(free[2].seconds * 1.35) and held[2].high == pytest.approx(free[2].seconds * 2.4)
    assert Slowdown((10.0,), (9.0,)).ratio == 1.0


@pytest.fixture
def suite(tmp_path):
    """Path of a suite with a policy whose checkpoint is absent."""
    path = tmp_path / "small.toml"
    absent = '[[policies]]\nname = "pi"\nfamily = "pi05"\nspec = "lerobot:absent"\nmodes = "base"\n'
    path.write_text(SUITE + absent)
    return path


class Clock:
    """A clock that goes on by what is simulated: 10 ms per world-tick."""

    now = 0.0

    def perf_counter(self):
        return Clock.now


class TimedEnv(FakeEnv):
    """A world whose ticks take time on the clock."""

    def step(self, action, worlds=None):
        Clock.now += 0.01 * self.worlds
        self.tick[self.active] += 1
        return np.zeros(self.worlds, np.int32)


@pytest.mark.parametrize("cuda", [False, True])
def test_random_weights_stand_in_for_absent_ones(cuda, monkeypatch):
    """All four families with CUDA; pi0.5, of 7 GB, not without."""
    made = []
    monkeypatch.setattr(suite_timing, "random_checkpoint", lambda folder, family: made.append(family) or folder)
    timing = suite_timing._Timing.__new__(suite_timing._Timing)
    timing.cuda, timing.folder = cuda, Path("made")
    specs = {family: timing._made(family) for family in ("act", "diffusion", "flow", "pi05", "other")}
    kept = ["act", "diffusion", "flow", *(["pi05"] if cuda else [])]
    assert made == kept and [name for name, spec in specs.items() if spec] == kept
    assert specs["act"] == "lerobot:made/act"


def test_the_command_says_what_it_measured(suite, tmp_path, capsys, monkeypatch):
    """Cells of each kind are played for some ticks; times, how they are known and what is left out are printed."""
    monkeypatch.setattr(suite_timing, "time", Clock())
    monkeypatch.chdir(tmp_path)
    command = ["matrix", str(suite), "--out", str(tmp_path / "out"), "--estimate", "1", "4", "4"]
    assert main(command, factories(env=TimedEnv)) == 0
    said = capsys.readouterr().out
    assert "measured on cpu: 6 cells with 2 worlds, 20 and 60 ticks" in said
    # 20 ms per tick of two worlds.
    assert re.search(r"\| expert \| base +\| +2 \| +2 \| +50\.0 \|", said)
    assert "not in it: 2 cells of pi05: " in said and "absent" in said
    assert len(re.findall(r"\| 4 +\| assumes that processes do not slow each other", said)) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("number", "expected"), [("0", "at least 1"), ("10000", "at most 9,999")])
def test_a_number_of_devices_is_checked(suite, tmp_path, capsys, number, expected):
    """No devices are refused, and more than memory has room for, before a cell is measured."""
    assert main(["matrix", str(suite), "--out", str(tmp_path / "out"), "--estimate", "1", number], factories()) == 2
    assert capsys.readouterr().err == f"error: --estimate {number}: expected {expected}\n"
