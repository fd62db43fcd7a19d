"""Successes by what a mode drew about the dynamics."""

import json
import re

import pytest
from eval_fakes import factories

from arena_newton.eval.__main__ import main
from arena_newton.rules import modes

RUN = ["--task", "football", "boxing", "--engine", "mujoco", "--seeds", "0", "--repeats", "20", "--mode", "dynamics"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run in which other dynamics were drawn."""
    out = tmp_path_factory.mktemp("run") / "a"
    assert main([*RUN, "--out", str(out)], factories()) == 0
    return out


def test_rows_are_the_values_that_were_drawn(folder, capsys):
    """Each episode is in the row of its draws, whole numbers by value and others by halves of their range."""
    lines = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    drawn = [(line, modes.get("dynamics").draw(line["episode_seed"])) for line in lines]
    capsys.readouterr()
    assert main(["report", str(folder), "--table", "--by", "task", "state_latency", "friction"]) == 0
    rows = re.findall(
        r"^\| (\w+) +\| ([01]) +\| (\S+) to \S+ \| +(\d+)/(\d+)(?:, (\d+) fell)? \|", capsys.readouterr().out, re.M
    )
    assert len(rows) == 8 and sum(int(row[4]) for row in rows) == len(lines)
    for task, late, low, successes, number, fell in rows:
        found = [
            line["outcome"]
            for line, values in drawn
            if line["task"] == task
            and values["state_latency"] == int(late)
            and (values["friction"] >= 0.75) == (float(low) == 0.75)
        ]
        assert (found.count("success"), len(found), found.count("fall")) == (
            int(successes),
            int(number),
            int(fell or 0),
        )


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ("--table --by colour", "error: --by colour: unknown, choose from task, friction, "),
        ("--by friction", "error: --by friction: belongs to --table"),
    ],
)
def test_what_was_not_drawn_is_refused(folder, capsys, flags, says):
    """An unknown quantity, and one without --table, is an error that names it."""
    assert main(["report", str(folder), *flags.split()]) == 2
    assert says in capsys.readouterr().err


def test_a_run_of_base_mode_has_no_such_table(tmp_path, capsys):
    """A run whose modes draw nothing is refused."""
    out = tmp_path / "a"
    assert main([*RUN[:-1], "base", "--repeats", "1", "--out", str(out)], factories()) == 0
    assert main(["report", str(out), "--table", "--by", "friction"]) == 2
    assert "error: --by friction: no episode is of a mode that draws it" in capsys.readouterr().err
