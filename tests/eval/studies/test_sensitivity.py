"""A grid of placements: its axes, what is played at each point, and the files and pictures that come of it."""

import csv
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from eval_fakes import PlacedEnv, factories

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.studies.adjoint_slopes import KINDS, Slope, groups, worth
from arena_newton.eval.studies.placement_axes import axes_of, chosen, moved
from arena_newton.interfaces import Verdict
from arena_newton.kernels import tick as codes

PAPER = rule_sets.get("paper")


class HalfEnv(PlacedEnv):
    """Football that succeeds where the ball's x is positive, falls where its y is above 1 and otherwise times out."""

    played: list = []

    def step(self, action, worlds=None):
        """End on the second tick, by the placement."""
        self.tick[self.active] += 1
        x, y = self.places.T
        ends = np.where(x > 0, codes.SUCCESS, np.where(y > 1, codes.FALL, codes.RUNNING))
        return np.where(self.active & (self.tick > 1), ends, codes.RUNNING).astype(np.int32)

    def verdict(self, world):
        """The margin is x."""
        return Verdict(margin=self.samples[world]["x"])


def call(out, *flags):
    """Exit code of the command over the stand-ins."""
    HalfEnv.played.clear()
    return main(["sensitivity", "--task", "football", "--out", str(out), *flags], factories(env=HalfEnv))


def rows(path):
    """Rows of a CSV."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("task", tasks.OWN)
@pytest.mark.parametrize("mode", ["base", "execution"])
def test_every_task_has_axes_and_its_draws_lie_on_them(task, mode):
    """Draws of the seeds are within the axes' ranges, and everything that differs between seeds is an axis."""
    spec, rules = tasks.get(task), PAPER.task(task)
    axes = axes_of(rules, mode)
    drawn = [spec.sample(seed, mode, rules) for seed in range(20)]
    for axis in axes:
        values = [sample[axis.record][axis.key] for sample in drawn]
        assert axis.low <= min(values) < max(values) <= axis.high, axis.name
        assert axis.grid(5)[0] == axis.low and len(set(axis.grid(5))) == (2 if axis.counts else 5)
    for sample in drawn:
        values = [sample[axis.record][axis.key] for axis in axes]
        again = moved(drawn[0], axes, values, rules, mode)
        assert again.keys() == sample.keys()
        for record in sample:
            assert again[record] == pytest.approx(sample[record])


def test_a_sample_on_a_cylinder_stays_on_it():
    """Boxing's target moves with bag and azimuth; the sample it was made from is left alone."""
    rules = PAPER.task("boxing")
    before = tasks.get("boxing").sample(3, "base", rules)
    kept = {record: dict(sample) for record, sample in before.items()}
    axes = chosen(axes_of(rules, "base"), ["boxing_target.bag", "boxing_target.azimuth"], "boxing")
    (target,) = moved(before, axes, (2.0, 0.0), rules, "base").values()
    assert (target["x"], target["y"]) == pytest.approx((-3.0 + 0.15, -3.7)) and target["bag"] == 2
    assert before == kept
    assert axes[0].grid(9) == (1.0, 2.0) and [axes[0].at(k) for k in (0.0, 0.49, 0.51, 1.0)] == [1, 1, 2, 2]
    circle = axes[1].grid(4)
    assert len(circle) == 4 and circle[-1] < np.pi - 1.0  # a full circle's end is its beginning


def test_the_grid_is_played_with_the_same_seeds_everywhere(tmp_path):
    """Every point gets each seed once; rates, falls and margins are those of its placement."""
    assert call(tmp_path / "out", "--grid", "3", "5", "--repeats", "2", "--worlds", "4", "--max-steps", "4") == 0
    seeds = {seed for seed, _ in HalfEnv.played}
    assert len(seeds) == 2 and len(HalfEnv.played) == 30
    points = rows(tmp_path / "out" / "sensitivity.csv")
    assert len(points) == 15
    for point in points:
        x, y = float(point["football.x"]), float(point["football.y"])
        assert (float(point["success_rate"]), int(point["falls"])) == (x > 0, 2 * (x <= 0 and y > 1))
        assert float(point["mean_margin"]) == float(point["least_margin"]) == pytest.approx(x)
        here = [seed for seed, sample in HalfEnv.played if (sample["x"], sample["y"]) == pytest.approx((x, y))]
        assert sorted(here) == sorted(seeds)
    told = json.loads((tmp_path / "out" / "sensitivity.json").read_text())
    assert (told["successes"], told["judged"]) == (10, 30) and told["points"][0]["success_s"] is None
    assert (tmp_path / "out" / "sensitivity.png").read_bytes().startswith(b"\x89PNG")


def test_files_do_not_depend_on_the_number_of_worlds(tmp_path):
    """Rows are in the plan's order whatever order the episodes end in: the same bytes."""
    for worlds in ("1", "7"):
        assert call(tmp_path / worlds, "--grid", "3", "--repeats", "2", "--worlds", worlds, "--max-steps", "4") == 0
    for name in ("episodes.csv", "sensitivity.csv", "sensitivity.json", "sensitivity.png"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "7" / name).read_bytes(), name


def test_an_interrupted_grid_goes_on(tmp_path, monkeypatch, capsys):
    """The same command plays what an interruption left: the same bytes, but for an episode with an error none twice."""
    flags = ("--grid", "3", "--worlds", "2", "--max-steps", "4")
    assert call(tmp_path / "whole", *flags) == 0
    plain = HalfEnv.step

    def stopped(self, action, worlds=None):
        if len(self.played) > 6:
            raise KeyboardInterrupt
        return plain(self, action, worlds)

    monkeypatch.setattr(HalfEnv, "step", stopped)
    assert call(tmp_path / "out", *flags) == 130
    monkeypatch.setattr(HalfEnv, "step", plain)
    path = tmp_path / "out" / "episodes.csv"
    left = path.read_text().splitlines()
    assert len(left) in (6, 7)
    broken = [line.replace(line.split(",")[-4], "error") for line in left[1:2]]
    path.write_text("\n".join([left[0], *broken, *left[2:]]) + "\n3,0.1")  # an error, and a line that a kill cut
    assert call(tmp_path / "out", *flags) == 0 and len(HalfEnv.played) == 9 - len(left[2:])
    for file in (tmp_path / "whole").iterdir():
        assert (tmp_path / "out" / file.name).read_bytes() == file.read_bytes(), file.name
    assert call(tmp_path / "out", *flags) == 0 and not HalfEnv.played
    capsys.readouterr()
    for other, words in ((("--grid", "2"), "grid was"), (("--seed", "1"), "seeds was 0, now 1")):
        assert call(tmp_path / "out", *flags, *other) == 2
        assert f"holds episodes of another study: {words}" in capsys.readouterr().err and not HalfEnv.played
    whole = path.read_text()
    damaged = ("point\n", "", whole.replace("timeout", "banana"), whole.replace(",4,", ",x,"), whole + "\udcff")
    for text in damaged:
        path.write_text(text, errors="surrogateescape")
        assert call(tmp_path / "out", *flags) == 2, text
        assert "episodes.csv: is not what a study of placements wrote" in capsys.readouterr().err
    path.with_suffix(".json").write_text('{"run": [1], "study": {}}')
    assert call(tmp_path / "out", *flags) == 2
    assert "episodes.json: is not what a study of placements wrote" in capsys.readouterr().err


def test_one_axis_is_a_map_of_one_row(tmp_path):
    """With one axis the seeds draw the other number, the same at every point."""
    assert call(tmp_path / "out", "--axes", "football.x", "--grid", "4", "--max-steps", "4") == 0
    assert [float(row["football.x"]) for row in rows(tmp_path / "out" / "sensitivity.csv")] == pytest.approx(
        [-1.2, -0.4, 0.4, 1.2]
    )
    assert len({sample["y"] for _, sample in HalfEnv.played}) == 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--axes", "ball.x"], "--axes ball.x: task football draws football.x, football.y"),
        (["--axes", "football.x", "football.x"], "--axes football.x: given twice"),
        (["--grid", "3", "3", "3"], "--grid 3 3 3: expected one number, or one for each of the 2 axes"),
        (["--grid", "0"], "--grid 0: expected at least 1"),
        (["--grid", "1000", "--repeats", "1"], "make 1,000,000 episodes, at most 200,000"),
        (["--repeats", "0"], "--repeats 0: expected at least 1"),
        (["--worlds", "0"], "--worlds 0: expected 1 to"),
        (["--task", "all"], "--task all: name one task"),
        (["--seed", "-1"], "--seed -1: expected at least 0"),
        (["--mode", "wild"], "wild"),
        (["--task", "chess"], "chess"),
    ],
)
def test_unfit_flags_are_one_line(tmp_path, capsys, flags, message):
    """Unfit flags are named before anything is played or written."""
    assert call(tmp_path / "out", *flags) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1
    assert not (tmp_path / "out").exists() and not HalfEnv.played


def test_a_folder_of_something_else_is_refused(tmp_path, capsys):
    """An existing folder without a study is left alone, whatever is in it."""
    (tmp_path / "out").mkdir()
    assert call(tmp_path / "out", "--grid", "2") == 2
    assert "exists and holds no study of placements; name another folder" in capsys.readouterr().err


def test_axes_are_refused_before_torch_is_loaded():
    """A wrong axis or scale costs no library of physics."""
    code = "import sys\nfrom arena_newton.eval.__main__ import main\nprint(main(sys.argv[1:]), 'torch' in sys.modules)"
    for flags in ("--axes ball.x", "--method adjoint --axes ball.x", "--method adjoint --reach 2 1"):
        command = [sys.executable, "-c", code, "sensitivity", "--task", "football", *flags.split()]
        assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == "2 False", flags


def test_samples_place_what_the_seed_would(tmp_path):
    """The real environment puts the ball where a sample says, and the other world's where its seed says."""
    from arena_newton import ArenaEnv, trackers

    env = ArenaEnv("football", tracker=trackers.get("pd"), worlds=2, engine="mujoco", device="cpu", fast_physics=True)
    drawn = env.spec.draw(5, "base", env.rules).sampled
    env.reset([5, 5], samples=[{"football": {"x": 0.25, "y": -0.5, "z": 0.11}}, drawn])
    address = env.scene.joint_qpos("/World/Ball")
    ball = env.physics.qpos.numpy()[:, address : address + 3].copy()
    assert ball[0] == pytest.approx((0.25, -0.5, 0.11))
    env.reset([5, 5])
    assert np.array_equal(env.physics.qpos.numpy()[1, address : address + 3], ball[1])
    with pytest.raises(InputError, match="1 samples for 2 worlds"):
        env.reset([5, 5], samples=[drawn])
    env.close()


def test_slopes_of_an_episode(tmp_path, capsys, request):
    """`--method adjoint` writes exact slopes beside differences; torch has as many threads afterwards as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    request.addfinalizer(lambda: torch.set_num_threads(before))
    flags = "--task football --policy stand --rules released --engine mujoco --fast-physics --max-steps 2"
    assert main(["sensitivity", "--method", "adjoint", *flags.split(), "--out", str(tmp_path / "out")]) == 0
    assert torch.get_num_threads() == 3
    found = {one["number"]: one for one in rows(tmp_path / "out" / "slopes.csv")}
    assert list(found)[:2] == ["football.x", "football.y"] and "mass:/World/Ball" in found
    ahead = found["football.y"]
    assert ahead["worth"] == "holds" and abs(float(ahead["slope"])) > 0.1
    for column in ("differences at 0.001", "differences at 0.01", "policy acts again"):
        assert float(ahead[column]) == pytest.approx(float(ahead["slope"]), abs=2e-3), column
    told = json.loads((tmp_path / "out" / "slopes.json").read_text())
    assert (told["outcome"], told["ticks"], told["policy_has_gradient"]) == ("timeout", 2, False)
    assert "actions are constants" in capsys.readouterr().out
    words = "<li>slopes that hold: football.y</li>\n<li>no influence: football.x, "
    page = (tmp_path / "out" / "sensitivity.html").read_text()
    assert words in page and 'badge pass">holds' in page and "sensitivity.png" not in page
    assert main(["sensitivity", *flags.split(), "--grid", "1", "--out", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "sensitivity.html").read_text()
    assert words in page and "sensitivity.png" in page and "success over 1 placement" in page
    assert main(["sensitivity", *flags.split(), "--seed", "1", "--grid", "1", "--out", str(tmp_path / "out")]) == 2
    assert "seeds was 0, now 1" in capsys.readouterr().err


def test_worth_of_a_slope_in_words():
    """Void slopes and numbers without influence are named; one that would lead out of every scene is chaotic."""
    assert worth(None, 0.1, 0.1, False, 0.001) == "no slope: a fixture"
    assert worth(-17.0, -17.0, -17.0, True, 0.001) == "holds"
    assert worth(-17.0, 2.0, 2.0, False, 0.001) == "means nothing at these scales"
    assert worth(0.0, 2.0, 2.0, False, 0.001) == "means nothing at these scales"
    assert worth(0.0, 0.0, 0.0, True, 0.001).startswith("no influence: ")
    assert worth(0.0, -math.inf, 0.0, False, 0.001) == "means nothing at these scales"
    assert worth(-5.99e12, 1.0, 1.0, False, 0.001).startswith("chaotic: ")
    assert worth(5.99e12, 1.0, 1.0, False, 1e-15) == "means nothing at these scales"
    slopes = [Slope(name, "m", 1.0, 1.0, 1.0, None, text) for name, text in zip("abcde", KINDS, strict=True)]
    assert groups(slopes) == [
        "slopes that hold: a",
        "void slopes, not to be followed: b, c",
        "no influence: d",
        "no slope, differences alone: e",
    ]


def test_unfit_flags_of_slopes(capsys):
    """Scales in the wrong order, repeats and latency are refused before anything is played."""
    for flags, words in (
        (["--reach", "0.01", "0.001"], "--reach 0.01 0.001: expected two scales, the smaller first"),
        (["--repeats", "2"], "--method adjoint: one episode without latency has slopes"),
    ):
        assert main(["sensitivity", "--method", "adjoint", "--task", "football", *flags]) == 2
        assert words in capsys.readouterr().err
