"""A task, tracker and mode ends by the width of its interval alone, fixed before the first episode."""

import json
import math
import random

import pytest
from eval_fakes import factories

from arena_newton.cli.intervals import wilson
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.results import load_run, results_json
from arena_newton.eval.plan.rounds import LOOK_EVERY, WidthRule, due
from arena_newton.eval.reports.report import notes
from arena_newton.eval.workers.shard_merge import merge

RUN = ["run", "--engine", "mujoco", "--task", "football", "boxing"]


def played(rule, group, succeeds, order=lambda batch: batch):
    """Outcomes in the order of playing."""
    ended = {}
    while batch := due(group, ended, None, rule):
        for index in order(batch):
            ended[index] = "success" if succeeds(index) else "fall"
    return ended


def test_it_ends_where_the_interval_is_narrow():
    """All succeed: after 20 episodes the interval is 16 points wide, after 40 it is 9; half succeed: all are played."""
    group = range(1000, 1201)
    assert len(played(WidthRule(0.14, 200, 3), group, lambda index: True)) == 2 * LOOK_EVERY
    assert len(played(WidthRule(0.2, 200, 3), group, lambda index: True)) == LOOK_EVERY
    assert len(played(WidthRule(0.05, 200, 3), group, lambda index: index % 2)) == 200
    assert len(played(WidthRule(0.5, 7, 1), range(7), lambda index: True)) == 7


def test_group_seeds_take_turns():
    """The first episodes are as many of each group seed, whenever playing ends."""
    rule, group = WidthRule(0.14, 200, 3), list(range(201))
    counts = [sum(index // 67 == seed for index in rule.order(group)[:40]) for seed in range(3)]
    assert counts == [14, 13, 13] and len(rule.order(group)) == 200


def test_the_width_decides_and_nothing_else():
    """Rounds follow from outcomes alone, whatever ends first or was interrupted; the last look is the first narrow."""
    rule, group = WidthRule(0.25, 120, 2), range(120)
    for seed in range(40):
        draw = random.Random(seed)
        good = {index for index in group if draw.random() < draw.random()}
        ended = played(rule, group, good.__contains__)
        assert played(rule, group, good.__contains__, lambda batch: batch[::-1][:1]) == ended
        first = rule.order(group)
        narrow = [
            count
            for count in range(LOOK_EVERY, 121, LOOK_EVERY)
            if (bounds := wilson(sum(index in good for index in first[:count]), count))[1] - bounds[0] <= 0.25
        ]
        assert set(ended) == set(first[: narrow[0] if narrow else 120])


def test_a_run_stops_each_row_by_itself(tmp_path, capsys):
    """The rule is stored with the plan, does not depend on worlds, and a resumed run ends where the other one did."""
    flags = [*RUN, "--until-width", "0.34", "--max", "90"]
    assert main([*flags, "--worlds", "7", "--out", str(tmp_path / "a")], factories()) == 0
    said = capsys.readouterr().out
    assert "at most 90 episodes, until the 95 % interval of its success rate is at most 34 points wide" in said
    run = load_run(tmp_path / "a")
    results = results_json(run)
    assert (run.config["until_width"], run.config["max"], run.config["repeats"]) == (0.34, 90, 30)
    assert results["complete"] and results["finished"] < 180
    for cell in results["cells"]:
        low, high = cell["ci95"]
        assert high - low <= 0.34 and cell["episodes"] % LOOK_EVERY == 0
    assert any(note.startswith("Said before the first episode: a row ends when") for note in notes(run, results))
    journal = tmp_path / "a" / "episodes.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "config.json").write_text((tmp_path / "a" / "config.json").read_text())
    (tmp_path / "b" / "episodes.jsonl").write_text("".join(lines[:9]))
    assert main(["resume", str(tmp_path / "b"), "--worlds", "2"], factories()) == 0
    again = (tmp_path / "b" / "episodes.jsonl").read_text().splitlines()
    assert {json.loads(line)["index"] for line in again} == {json.loads(line)["index"] for line in lines}
    assert merge([tmp_path / "a"], tmp_path / "m").results["complete"]
    half = tmp_path / "half"
    half.mkdir()
    (half / "config.json").write_text((tmp_path / "a" / "config.json").read_text())
    (half / "episodes.jsonl").write_text("".join(lines[:9]))
    compare, out = ["compare", str(tmp_path / "a")], ["--out", str(tmp_path / "c")]
    assert (
        main([*compare, str(half), *out]) == 2 and "half: is unfinished (9 of 180 episodes)" in capsys.readouterr().err
    )
    assert main([*compare, str(tmp_path / "b"), *out]) == 0
    compared = json.loads((tmp_path / "c" / "compare.json").read_text())
    assert (
        sum(
            "rows ended when their interval was at most 34 points wide, or at 90 episodes" in note
            for note in compared["notes"]
        )
        == 2
    )
    with_out = ["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "m")]
    assert main(with_out) == 2 and "m: holds a run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--max", "9"], "--max: belongs to --until-width, which is not given"),
        (["--until-width", "0"], "--until-width 0: expected more than 0 and less than 1"),
        (["--until-width", "nan"], "--until-width nan: expected more than 0 and less than 1"),
        (["--until-width", "0.1", "--max", "0"], "--max 0: expected at least 1"),
        (["--until-width", "0.1", "--max", "300000"], "--max 300000: makes "),
        (["--until-width", "0.1", "--repeats", "5"], "--repeats 5: --until-width decides it, up to --max"),
        (["--until-width", "0.1", "--shard", "1/2"], "--shard: does not go with --until-width"),
    ],
)
def test_what_does_not_fit_is_refused(flags, said, tmp_path, capsys):
    """Each is one line with exit code 2, before anything is written."""
    assert main([*RUN, *flags, "--out", str(tmp_path / "r")], factories()) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {said}") and not (tmp_path / "r").exists()


def test_another_rule_is_refused_in_the_same_folder(tmp_path, capsys):
    """A rule that was fixed is kept: neither dropped nor changed after episodes were seen."""
    flags = [*RUN, "--until-width", "0.5", "--max", "6", "--out", str(tmp_path / "a")]
    assert main(flags, factories()) == 0
    assert main([*flags, "--max", "9"], factories()) == 2
    capsys.readouterr()
    assert main(["resume", str(tmp_path / "a"), "--max", "9"], factories()) == 2
    assert capsys.readouterr().err.startswith("error: --max was 6, now 9: it was fixed before the first episode")
    assert main([*RUN, "--seeds", "0", "--out", str(tmp_path / "a"), "--repeats", "2"], factories()) == 2
    assert "another configuration" in capsys.readouterr().err


def stopped(rate, width):
    """Exactly, for a true rate: mean error of the measured one, how often its interval covers, episodes on average."""
    alive, played, error, covers, mean = {0: 1.0}, 0, 0.0, 0.0, 0.0
    for count in range(LOOK_EVERY, 201, LOOK_EVERY):
        more = count - played
        chances = [math.comb(more, k) * rate**k * (1 - rate) ** (more - k) for k in range(more + 1)]
        after, alive, played = {}, dict(alive), count
        for successes, weight in alive.items():
            for k, chance in enumerate(chances):
                after[successes + k] = after.get(successes + k, 0.0) + weight * chance
        alive = {}
        for successes, weight in after.items():
            low, high = wilson(successes, count)
            if high - low <= width or count == 200:
                error += weight * (successes / count - rate)
                covers += weight * (low <= rate <= high)
                mean += weight * count
            else:
                alive[successes] = weight
    return error, covers, mean


def test_what_stopping_by_width_costs():
    """Stopping by width moves the mean by less than a point, as documented, and intervals cover as without it."""
    found = {rate: stopped(rate, 0.14) for rate in (0.02, 0.05, 0.1, 0.2, 0.3, 0.5)}
    assert [round(mean) for _, _, mean in found.values()] == [44, 56, 79, 130, 170, 200]
    assert [round(100 * error, 1) for error, _, _ in found.values()] == [-0.2, -0.6, -0.8, -0.5, -0.2, 0.0]
    assert [round(100 * covers, 1) for _, covers, _ in found.values()] == [97.1, 95.7, 96.3, 94.3, 95.4, 94.4]
