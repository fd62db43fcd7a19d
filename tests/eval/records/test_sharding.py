"""Shards of a plan: every episode in one of them, the same on every machine, named by a flag or by Slurm."""

import collections
import json
import os
import subprocess
from pathlib import Path

import pytest
from eval_fakes import factories

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records.sharding import Shard, dealt, parse_shard
from arena_newton.eval.suites.suite_call import plan_call
from arena_newton.eval.suites.suite_options import MatrixOptions

ROOT = Path(__file__).parents[3]
FLAGS = ["--task", "football", "boxing", "--engine", "mujoco", "--mode", "base", "visual", "--repeats", "4"]
OPTIONS = RunOptions(task=("football", "boxing"), mode=("base", "visual"), repeats=4, engine="mujoco")


def plan(shard=None):
    """Episodes of the run of these options, or of one shard of it."""
    return resolve(RunOptions(**{**OPTIONS.__dict__, "shard": shard})).episodes


@pytest.mark.parametrize("count", [1, 2, 3, 7, 48])
def test_shards_are_the_plan(count):
    """Shards have every episode once, in the plan's order, differ by one episode at most and mix all cells."""
    whole = plan()
    parts = [plan(f"{number}/{count}") for number in range(1, count + 1)]
    assert sorted((e for part in parts for e in part), key=lambda e: e.index) == list(whole)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    for number, part in enumerate(parts, start=1):
        assert len(part) == Shard(number, count).size(len(whole))
        assert [e.index for e in part] == sorted(e.index for e in part), "tasks are not together"
        cells = collections.Counter((e.task, e.mode) for e in whole)
        own = collections.Counter((e.task, e.mode) for e in part)
        assert all(size // count <= own[cell] <= size // count + 1 for cell, size in cells.items())


def test_the_deal_is_shuffled_and_fixed():
    """A deal follows neither the order of episodes nor this machine's chance: it is the same in every version."""
    keys = [("boxing", "twist2", "base", seed, repeat) for seed in range(2) for repeat in range(6)]
    assert dealt(keys, Shard(1, 3)) == [0, 5, 8, 11]
    assert dealt([*keys, ("football", "twist2", "base", 0, 0)], Shard(1, 3)) == [0, 5, 8, 11, 12]


def test_shards_are_no_part_of_the_identity():
    """Runs of one plan have one hash, whatever part of it they play."""
    hashes = {resolve(RunOptions(**{**OPTIONS.__dict__, "shard": s})).hash for s in (None, "1/2", "2/2", "3/16")}
    assert len(hashes) == 1


BAD = ["0/4", "5/4", "x", "1/0", "-1/4", "1/-4", "", "1", "/", "1/2/3", "1.0/2", "1/10000", "¹/4", "1 / 4"]


@pytest.mark.parametrize(("command", "value"), [*(("run", v) for v in BAD), ("list", "5/4"), ("record", "5/4")])
def test_bad_shards(command, value, capsys, tmp_path, monkeypatch):
    """A value that is not a shard ends with exit code 2 and one line that names flag and value; nothing is written."""
    monkeypatch.chdir(tmp_path)
    assert main([command, "--task", "boxing", f"--shard={value}"], factories()) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: --shard ") and "\n" not in error and value in error, error
    assert not list(tmp_path.iterdir())


def test_refused_combinations(capsys, tmp_path, monkeypatch):
    """More shards than episodes, a plan that is not named, and recordings of successes alone have one line each."""
    monkeypatch.chdir(tmp_path)
    cases = {
        ("run", "--task", "boxing", "--repeats", "1", "--shard", "1/4"): "the plan has 3 episodes",
        ("run", "--shard", "1/4"): "--task all",
        ("record", "--task", "boxing", "--only-success", "--shard", "1/4"): "--only-success",
        ("record", "--from", "x", "--out", "y", "--shard", "1/4"): "drop it beside --from",
        ("loop", "--shard", "1/4"): "--shard: unknown argument",
    }
    for arguments, expected in cases.items():
        assert main(list(arguments), factories()) == 2, arguments
        error = capsys.readouterr().err.strip()
        assert expected in error and "\n" not in error, error


def slurm(task, count=None, first=None, last=None):
    """Variables of a task of an array."""
    given = {"ID": task, "COUNT": count, "MIN": first, "MAX": last}
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in given.items() if value is not None}


@pytest.mark.parametrize(
    ("text", "environ", "shard"),
    [
        ("slurm", slurm(3, 16, 1, 16), "3/16"),
        ("slurm", slurm(0, 16, 0, 15), "1/16"),
        ("slurm", slurm(15, 16, 0, 15), "16/16"),
        ("slurm", slurm(3, 16), "3/16"),
        ("slurm/16", slurm(3, 1, 3, 3), "3/16"),
        ("slurm/16", slurm(7, 2, 3, 7), "7/16"),
        ("3/16", slurm(9, 9, 1, 9), "3/16"),
    ],
)
def test_slurm_arrays(text, environ, shard):
    """An array counts from 0 or 1 and has all numbers; with the count in the flag it may have any of them."""
    assert str(parse_shard(text, environ)) == shard


@pytest.mark.parametrize(
    ("text", "environ", "expected"),
    [
        ("slurm", {}, "SLURM_ARRAY_TASK_ID is not set"),
        ("slurm", slurm(1), "SLURM_ARRAY_TASK_COUNT is not set"),
        ("slurm", slurm("x", 4), "SLURM_ARRAY_TASK_ID is x"),
        ("slurm", slurm("-1", 4), "SLURM_ARRAY_TASK_ID is -1"),
        ("slurm", slurm("", 4), "SLURM_ARRAY_TASK_ID is empty"),
        ("slurm", slurm(3, 1, 3, 3), "one task"),
        ("slurm", slurm(12, 4, 10, 13), "from 10 to 13"),
        ("slurm", slurm(2, 4, 0, 6), "from 0 to 6"),
        ("slurm", slurm(0, 4), "this one 0"),
        ("slurm", slurm(5, 4, 1, 4), "this one 5"),
        ("slurm", slurm(1, 10**6, 1, 10**6), "at most"),
        ("slurm/16", slurm(0, 16, 0, 15), "is 0, expected 1 to 16"),
        ("slurm/16", slurm(17, 2, 16, 17), "is 17, expected 1 to 16"),
        ("slurm/0", slurm(1, 1, 1, 1), "slurm/N"),
        ("slurm/x", slurm(1, 1, 1, 1), "slurm/N"),
        ("SLURM", slurm(1, 4, 1, 4), "expected n/N"),
    ],
)
def test_other_arrays_are_refused(text, environ, expected):
    """Arrays that leave a part of the plan out, or that are none, have one line that says what is expected."""
    with pytest.raises(InputError, match="^--shard ") as caught:
        parse_shard(text, environ)
    assert expected in str(caught.value)


def test_suites_take_arrays_too(monkeypatch):
    """`matrix --shard slurm` plays the part of the array's task, and the command that continues names it."""
    monkeypatch.setattr(os, "environ", os.environ | slurm(1, 2, 0, 1))
    call = plan_call("tiny", MatrixOptions(shard="slurm"))
    assert call.shard == (2, 2) and "--shard 2/2" in call.again
    assert call.chosen == plan_call("tiny", MatrixOptions(shard="2/2")).chosen


def test_suites_have_a_cell_for_each_shard(tmp_path):
    """More shards than cells are refused, as a run refuses more shards than episodes."""
    cells = len(plan_call("tiny", MatrixOptions()).cells)
    assert len(plan_call("tiny", MatrixOptions(shard=f"{cells}/{cells}")).chosen) == 1
    with pytest.raises(InputError, match=f"^--shard 1/{cells + 1}: the suite has {cells} cells, expected no more"):
        plan_call("tiny", MatrixOptions(shard=f"1/{cells + 1}"))


def test_list_shows_a_shard(capsys):
    """`list` prints the episodes of a shard with their numbers in the plan."""
    assert main(["list", *FLAGS, "--shard", "2/3"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("16 episodes, ") and "smallest difference" in lines[1]
    assert [int(line.split()[0]) for line in lines[2:]] == [e.index for e in plan("2/3")]


def test_a_folder_belongs_to_one_shard(tmp_path, capsys):
    """A shard's folder refuses another shard and the whole plan, the plan's refuses a shard; `resume` goes on."""
    out = str(tmp_path / "a")
    assert main(["run", *FLAGS, "--shard", "1/3", "--out", out], factories()) == 0
    before = (tmp_path / "a" / "episodes.jsonl").read_bytes()
    for flags in (["--shard", "2/3"], ["--shard", "1/2"], []):
        capsys.readouterr()
        assert main(["run", *FLAGS, *flags, "--out", out], factories()) == 2
        error = capsys.readouterr().err
        assert "was begun with shard 1/3" in error and error.count("\n") == 1
    assert main(["resume", out, "--shard", "2/3"], factories()) == 2
    lines = before.splitlines(keepends=True)
    (tmp_path / "a" / "episodes.jsonl").write_bytes(b"".join(lines[:9]) + lines[9][:40])
    assert main(["resume", out], factories()) == 0
    numbers, played = (
        sorted(json.loads(line)["index"] for line in text.splitlines())
        for text in (before, (tmp_path / "a" / "episodes.jsonl").read_bytes())
    )
    assert played == numbers
    results = json.loads((tmp_path / "a" / "results.json").read_text())
    assert (results["shard"], results["planned"], results["finished"], results["complete"]) == ("1/3", 16, 16, True)
    assert main(["run", *FLAGS, "--repeats", "1", "--out", str(tmp_path / "b")], factories()) == 0
    assert main(["run", *FLAGS, "--repeats", "1", "--shard", "1/3", "--out", str(tmp_path / "b")], factories()) == 2
    assert "was begun with the whole plan" in capsys.readouterr().err


def test_shards_are_no_results(tmp_path, capsys):
    """Tables and comparisons refuse a finished shard and name merge; a joint table of all shards says what they are."""
    flags = ["run", "--task", "boxing", "--repeats", "2", "--engine", "mujoco", "--shard"]
    folders = [str(tmp_path / name) for name in ("a", "b")]
    for number, folder in enumerate(folders, start=1):
        assert main([*flags, f"{number}/2", "--out", folder], factories()) == 0
    for command in (["tables", *folders], ["compare", *folders], ["tables", folders[1]]):
        capsys.readouterr()
        assert main([*command, "--out", str(tmp_path / "out")]) == 2
        error = capsys.readouterr().err
        assert "of a run; name the folder into which eval merge joins all" in error and error.count("\n") == 1
    assert main(["report", *folders]) == 0
    printed = capsys.readouterr().out
    assert f"{folders[0]} is shard 1/2 of a plan of 6 episodes: 3 of 3 episodes." in printed
    assert "incomplete" not in printed


def test_shards_without_out_have_folders_of_their_own(tmp_path, monkeypatch):
    """Tasks of an array that start in the same second do not meet in one folder."""
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        monkeypatch.setattr(os, "environ", os.environ | slurm(number, 2, 1, 2))
        assert main(["run", "--task", "boxing", "--repeats", "1", "--shard", "slurm"], factories()) == 0
    names = sorted(path.name.partition("_shard_")[2] for path in (tmp_path / "results").iterdir())
    assert names == ["1_of_2", "2_of_2"]
    options = [json.loads((path / "config.json").read_text())["options"] for path in (tmp_path / "results").iterdir()]
    assert sorted(one["shard"] for one in options) == ["1/2", "2/2"], "resume must not depend on the array"


def submit(folder, monkeypatch, *arguments, **variables):
    """Plays what the example's batch file calls, with stand-ins for the world; the scheduler only sets variables."""
    python = folder / "bin" / "python"
    python.parent.mkdir(exist_ok=True)
    given = " ".join(f'"$SLURM_ARRAY_TASK_{name}"' for name in ("ID", "COUNT", "MIN", "MAX"))
    python.write_text(f'#!/bin/bash\nprintf "%s\\n" {given} "$@" "" >> calls\n')
    python.chmod(0o755)
    environment = os.environ | {"PATH": f"{python.parent}:{os.environ['PATH']}"} | variables
    command = ["bash", str(Path(__file__).with_name("fake_sbatch.sh")), *arguments]
    subprocess.run(command, env=environment, cwd=folder, check=True)
    for call in (folder / "calls").read_text().split("\n\n")[:-1]:
        *array, flag, module = call.split("\n")[:6]
        assert (flag, module) == ("-m", "arena_newton.eval")
        with monkeypatch.context() as patch:
            patch.chdir(folder)
            patch.setattr(os, "environ", os.environ | slurm(*array))
            assert main(call.split("\n")[6:], factories()) == 0
    (folder / "calls").unlink()


def test_the_batch_file(tmp_path, monkeypatch):
    """The batch file plays a shard per task of an array, again on demand, and merge joins what it wrote."""
    file = ROOT / "examples" / "shards.sbatch"
    run = [str(file), "out", *"--task boxing football --seeds 0 --repeats 2 --engine mujoco --policy expert".split()]
    submit(tmp_path, monkeypatch, "--array=1-2", *run)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["shard_1", "shard_2"]
    (tmp_path / "out" / "shard_2" / "episodes.jsonl").write_bytes(b"")
    submit(tmp_path, monkeypatch, "--array=2", *run, SHARDS="2")
    folders = [str(path) for path in sorted((tmp_path / "out").iterdir())]
    assert main(["merge", *folders, "--out", str(tmp_path / "out" / "all")]) == 0
    assert len((tmp_path / "out" / "all" / "episodes.jsonl").read_text().splitlines()) == 4
