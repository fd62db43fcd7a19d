"""The search of a policy's worst placement: it finds a known one, its numbers are what was played, nothing is lost."""

import csv
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from eval_fakes import PlacedEnv, factories

from arena_newton.eval.__main__ import main
from arena_newton.eval.studies.placement_axes import Axis
from arena_newton.eval.studies.worst_placement import score_of, search, worst_of
from arena_newton.interfaces import EpisodeResult, Verdict
from arena_newton.kernels import tick as codes

AXES = (Axis("football", "x", -1.2, 1.2), Axis("football", "y", -1.2, 1.2), Axis("target", "bag", 1.0, 3.0))
HOLE = (0.9, -0.7)
"""Placements at which the stand-in's robot fails."""


def result(outcome, steps=10, margin=0.0):
    """An episode's result."""
    return EpisodeResult(SimpleNamespace(), outcome, outcome, steps, margin)


class HoleEnv(PlacedEnv):
    """Football that fails within 0.3 m of a hole, the nearer the worse, and succeeds everywhere else."""

    played: list = []

    def step(self, action, worlds=None):
        """End on the second tick with a success, or never."""
        self.tick[self.active] += 1
        far = np.linalg.norm(self.places - HOLE, axis=1) > 0.3
        return np.where(self.active & (self.tick > 1) & far, codes.SUCCESS, codes.RUNNING).astype(np.int32)

    def verdict(self, world):
        """Distance from the hole's rim."""
        return Verdict(margin=float(np.linalg.norm(self.places[world] - HOLE)) - 0.3)


def call(out, *flags):
    """Exit code of the command over the stand-ins."""
    HoleEnv.played.clear()
    common = ["--task", "football", "--out", str(out), "--max-steps", "4"]
    return main(["adversary", *common, *flags], factories(env=HoleEnv))


def test_scores_order_failures_and_successes():
    """Far failures are below near ones, these below slow successes, and those below fast ones; errors say nothing."""
    order = [
        [result("fall", margin=-2.0)],
        [result("timeout", margin=-0.1)],
        [result("fall", margin=0.4), result("timeout", margin=0.2)],
        [result("success", steps=90)],
        [result("success", steps=20), result("error", margin=math.nan)],
    ]
    scores = [score_of(one, 100) for one in order]
    assert scores == sorted(scores) and scores == pytest.approx([-2.0, -0.1, 0.0, 0.1, 0.8], abs=1e-6)
    assert scores[2] < 0.0 == score_of([result("success", steps=100)], 100)
    assert math.isnan(score_of([result("error", margin=math.nan)], 100))


@pytest.mark.parametrize("seed", range(4))
def test_the_search_finds_a_known_minimum(seed):
    """On a bowl whose lowest point is one of three numbers, the worst of five batches is near it."""

    def bowl(points):
        return [math.hypot(x - HOLE[0], y - HOLE[1]) + (bag != 2.0) for x, y, bag in points]

    points, scores = search(AXES, bowl, batches=5, size=40, seed=seed)
    assert len(points) == len(scores) == 200
    assert min(scores) < 0.06
    assert min(scores[160:]) < min(scores[:40])
    for x, y, bag in points:
        assert abs(x) <= 1.2 and abs(y) <= 1.2 and bag in (1.0, 2.0, 3.0)


def test_placements_without_a_score_are_left_out():
    """A batch of errors moves nothing, and the search goes on."""
    points, scores = search(AXES, lambda points: [math.nan] * len(points), batches=3, size=10, seed=1)
    assert len(points) == 30 and all(math.isnan(score) for score in scores)


def test_one_unlucky_placement_is_not_the_worst():
    """The corner of 1,000 where all fail is named, not the one failure among successes, however far it failed."""
    rng = np.random.default_rng(0)
    points = [(float(x), float(y), 1.0) for x, y in rng.uniform(-1.2, 1.2, (1000, 2))]
    scores = [-0.5 - x if x > 0.8 and y > 0.8 else 0.5 for x, y, _ in points]
    unlucky = min(range(1000), key=lambda k: math.hypot(points[k][0] + 0.5, points[k][1]))
    scores[unlucky] = -9.0
    x, y, _ = points[worst_of(AXES, points, scores)]
    assert x > 0.8 and y > 0.8
    few = [unlucky, *(k for k in range(90) if k != unlucky)]
    assert worst_of(AXES, [points[k] for k in few], [scores[k] for k in few]) == 0


def test_a_circle_has_no_ends():
    """A place where all fail and which lies across the end of a full circle is found, though each half is small."""
    rng = np.random.default_rng(1)
    angles = rng.uniform(-math.pi, math.pi, 2000)
    points = [(float(angle),) for angle in angles]
    scores = [-1.0 if abs(angle) > 3.1 or (abs(angle) < 0.02 and k % 2) else 0.5 for k, angle in enumerate(angles)]
    worst = worst_of([Axis("target", "azimuth", -math.pi, math.pi)], points, scores)
    assert abs(points[worst][0]) > 3.1


def test_one_placement_that_was_played_often_counts_whole():
    """The one of two bags at which more failed is named, though ten of the other failed in a row."""
    points = [(float(1 + k % 2),) for k in range(1000)]
    scores = [-1.0 if (k % 2 and k % 10 < 3) or (not k % 2 and k < 200) else 0.5 for k in range(1000)]
    shares = [
        np.mean([score < 0.0 for (bag,), score in zip(points, scores, strict=True) if bag == one]) for one in (1, 2)
    ]
    assert points[worst_of([Axis("target", "bag", 1.0, 2.0)], points, scores)][0] == 1.0 + int(np.argmax(shares))


def test_the_worst_of_errors_is_none():
    """Placements that ended with errors are nobody's neighbours."""
    points = [(0.1 * k, 0.0, 1.0) for k in range(-5, 6)]
    assert worst_of(AXES, points, [math.nan] * 11) is None
    assert worst_of(AXES, points, [math.nan, 0.2, 0.1, *[math.nan] * 8]) == 2


def test_the_command_finds_the_hole(tmp_path, capsys):
    """The worst placement is in the hole, fails with new seeds too, and stands beside the mean of the whole range."""
    assert call(tmp_path / "out", "--batch", "40", "--batches", "4", "--confirm", "6", "--worlds", "8") == 0
    told = json.loads((tmp_path / "out" / "adversary.json").read_text())
    assert np.linalg.norm(np.array(told["worst"]["values"]) - HOLE) < 0.15
    assert (told["worst"]["success_rate"], told["confirmed"]["successes"], told["confirmed"]["episodes"]) == (0, 0, 6)
    inside = [np.linalg.norm((where["x"] - HOLE[0], where["y"] - HOLE[1])) <= 0.3 for _, where in HoleEnv.played[:40]]
    assert told["mean"]["successes"] == 40 - sum(inside) and told["mean"]["judged"] == 40
    assert len({seed for seed, _ in HoleEnv.played[:160]}) == 1
    assert len({seed for seed, _ in HoleEnv.played[160:]}) == 6
    assert {(where["x"], where["y"]) for _, where in HoleEnv.played[160:]} == {tuple(told["worst"]["values"])}
    said = capsys.readouterr().out
    assert "mean over the range: " in said and "with new seeds: 0/6" in said
    with (tmp_path / "out" / "episodes.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 166
    with (tmp_path / "out" / "placements.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 160


def test_the_search_does_not_depend_on_the_number_of_worlds(tmp_path):
    """The same bytes for one world and for many."""
    for worlds in ("1", "9"):
        assert call(tmp_path / worlds, "--batch", "12", "--batches", "2", "--confirm", "2", "--worlds", worlds) == 0
    for name in ("episodes.csv", "placements.csv", "adversary.json"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "9" / name).read_bytes(), name


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--batch", "5"], "--batch 5: expected at least 10"),
        (["--batches", "0"], "--batches 0: expected at least 1"),
        (["--confirm", "0"], "--confirm 0: expected at least 1"),
        (["--search-seed", "-1"], "--search-seed -1"),
        (["--batch", "100000", "--batches", "3"], "make 300,010 episodes, at most 200,000"),
        (["--axes", "ball.x"], "--axes ball.x: task football draws football.x, football.y"),
        (["--task", "all"], "--task all: name one task"),
        (["--seed", "-1"], "--seed -1: expected at least 0"),
    ],
)
def test_unfit_flags_are_one_line(tmp_path, capsys, flags, message):
    """Unfit flags are named before anything is played or written."""
    assert call(tmp_path / "out", *flags) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1
    assert not (tmp_path / "out").exists() and not HoleEnv.played
