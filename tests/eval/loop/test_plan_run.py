"""Commands of a plan: in their order, side by side, on GPUs in turn; what failed or was killed is played again."""

import dataclasses
import functools
import os
import signal
import sys
import threading
from pathlib import Path

import pytest

from arena_newton.errors import InputError
from arena_newton.eval.loop.plan_commands import ALL_GPUS, PlanCommand
from arena_newton.eval.loop.plan_run import CommandPlayer, CommandTime, command_times, stage_seconds
from arena_newton.files.new_folder import held_folder
from tests.children import Child
from tests.patience import wait_for

PROGRAM = "planned_program"


@pytest.fixture(autouse=True)
def beside(monkeypatch):
    """Commands find the program beside this file."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


def command(stage, name, what, mark, after=(), **more):
    """A command that leaves a mark."""
    given = [PROGRAM, what, str(mark)]
    return PlanCommand(stage=stage, name=name, words=lambda: given, done=lambda: False, after=after, **more)


def played(out, commands, gpus=(), **most):
    """Play commands in a folder; the player."""
    with held_folder(out, "works in it") as held:
        player = CommandPlayer(out, gpus, most, held)
        player.play(commands)
        return player


def test_what_needs_a_failed_command_waits_for_the_next_call(tmp_path, capsys):
    """The others are played; the next call plays the failed one and what needs it, and nothing that is done."""

    def plan():
        first = command("record", "a", "go", tmp_path / "a"), command("record", "b", "fail", tmp_path / "b")
        then = command("build", "a", "go", tmp_path / "c", ("record a",))
        last = command("train", "b", "go", tmp_path / "d", ("record b", "build a"))
        done = {f"{one.stage} {one.name}" for one in command_times(tmp_path / "out") if one.code == 0}
        found = (*first, then, last)
        return [dataclasses.replace(one, done=functools.partial(done.__contains__, str(one))) for one in found]

    out = tmp_path / "out"
    player = played(out, plan(), record=2)
    assert list(player.failed) == ["record b"] and not (tmp_path / "d").exists()
    assert "exit code 1: a reason of its own" in player.failed["record b"]
    assert [(one.stage, one.name) for one in command_times(out)][-1] == ("build", "a")
    assert not played(out, plan(), record=2).failed
    assert [(one.stage, one.name) for one in command_times(out)][-2:] == [("record", "b"), ("train", "b")]
    assert len(command_times(out)) == 5 and "record: finished before" not in capsys.readouterr().out
    assert {path.name for path in (out / "logs").iterdir()} == {
        f"{n}.log" for n in ("record_a", "record_b", "build_a", "train_b")
    }


def test_what_some_failed_trainings_leave_is_played(tmp_path):
    """A suite is played once all its trainings have ended, if one of them is whole; what needs all is not."""
    marks = {name: tmp_path / name for name in "abcd"}
    trainings = command("train", "a", "go", marks["a"], size=1), command("train", "b", "fail", marks["b"])
    suite = command("evaluate", "", "go", marks["c"], ("train a", "train b"), needs_all=False)
    alone = command("card", "", "go", marks["d"], ("train a", "train b"))
    player = played(tmp_path / "out", [*trainings, suite, alone])
    assert list(player.failed) == ["train b"] and marks["c"].exists() and not marks["d"].exists()
    assert [one.name for one in command_times(tmp_path / "out")] == ["a", "b", ""]
    none = command("train", "c", "fail", tmp_path / "e"), command("evaluate", "e", "go", tmp_path / "f", ("train c",))
    played(tmp_path / "other", [none[0], dataclasses.replace(none[1], needs_all=False)])
    assert not (tmp_path / "f").exists()


def test_a_failed_command_is_begun_again(tmp_path, capsys):
    """So often as the plan says; what needs it waits, and bad input is not tried twice."""
    marks = {name: tmp_path / name for name in "abc"}
    first = command("record", "a", "fail", marks["a"])
    then = command("build", "a", "go", marks["b"], ("record a",))
    wrong = command("record", "b", "refuse", marks["c"])
    with held_folder(tmp_path / "out", "works in it") as held:
        player = CommandPlayer(tmp_path / "out", (), {}, held, again=1)
        assert not player.play([first, then, wrong])
    assert list(player.failed) == ["record b"] and "exit code 2" in player.failed["record b"]
    assert [(str(one.stage), one.code) for one in command_times(tmp_path / "out") if one.name == "a"] == [
        ("record", 1),
        ("record", 0),
        ("build", 0),
    ]
    assert marks["b"].exists() and marks["c"].read_text() == "x"


def test_gpus_are_taken_in_turn(tmp_path):
    """A command of one GPU has one that few others have, one of all has all, and one of none sees none."""
    marks = {name: tmp_path / name for name in "abcde"}
    alone = [command("record", name, "go", marks[name], gpus=1, size=n) for n, name in enumerate("abc")]
    last = command("evaluate", "d", "go", marks["d"], ("record a", "record b", "record c"), gpus=ALL_GPUS)
    none = command("tables", "", "go", marks["e"], ("evaluate d",))
    assert not played(tmp_path / "out", [*alone, last, none], ("4", "7"), record=3).failed
    seen = {name: mark.read_text().strip() for name, mark in marks.items()}
    assert (seen["c"], seen["b"], seen["a"]) == ("4", "7", "4")  # the largest first
    assert (seen["d"], seen["e"]) == ("4,7", "")


def test_ctrl_c_tells_all_commands_to_end(tmp_path):
    """They end by SIGTERM, as a training that saves its state, and their time counts."""
    mark = tmp_path / "mark"
    stop = threading.Thread(target=lambda: (wait_for(mark.exists, "command"), os.kill(os.getpid(), signal.SIGINT)))
    stop.start()
    with pytest.raises(KeyboardInterrupt):
        played(tmp_path / "out", [command("train", "a", "wait", mark)])
    stop.join()
    assert (tmp_path / "mark.told").exists()
    assert [(one.name, one.code) for one in command_times(tmp_path / "out")] == [("a", 3)]


def hang(arguments):
    """Play a command that does not end."""
    folder = Path(arguments[0])
    sys.path.insert(0, str(Path(__file__).parent))
    played(folder / "out", [command("train", "a", "wait", folder / "mark")])


def test_commands_do_not_outlive_a_kill(tmp_path):
    """After kill -9 of the loop its commands are told to end, and until then the folder is refused."""
    process = Child("tests.eval.loop.test_plan_run:hang", [str(tmp_path)])
    wait_for((tmp_path / "mark").exists, "command")
    process.kill()
    assert process.wait() == -signal.SIGKILL
    wait_for((tmp_path / "mark.told").exists, "end of the command")

    def free():
        try:
            with held_folder(tmp_path / "out", "works in it"):
                return True
        except Exception:
            return False

    wait_for(free, "free folder")
    assert command_times(tmp_path / "out") == []  # its time is lost with the loop


def test_seconds_of_a_stage_are_those_in_which_it_worked():
    """Commands side by side count once, pauses between calls are none, and all stages together neither."""
    spans = [("record", 0, 10), ("record", 5, 12), ("build", 10, 20), ("record", 100, 103)]
    times = [CommandTime(stage, str(n), began, ended, 0) for n, (stage, began, ended) in enumerate(spans)]
    assert stage_seconds(times) == {"record": 15.0, "build": 10.0, "all": 23.0}


def test_a_line_that_a_kill_cut_is_left_out(tmp_path):
    """The others count."""
    line = '{"stage": "record", "name": "a", "began": 1.0, "ended": 2.0, "code": 0}\n'
    (tmp_path / "commands.jsonl").write_text(line + '{"stage": "rec\n[1]\n{"stage": "x"}\n' + line)
    assert [one.name for one in command_times(tmp_path)] == ["a", "a"]


def test_a_command_that_cannot_begin_ends_no_other(tmp_path):
    """A command that needs one of several trainings is played although the time of another is over."""

    def over():
        raise InputError("nothing is left to train in")

    late = dataclasses.replace(command("train", "b", "go", tmp_path / "b"), words=over)
    plays = command("evaluate", "all", "go", tmp_path / "c", ("train a", "train b"), needs_all=False)
    player = played(tmp_path / "out", [command("train", "a", "go", tmp_path / "a"), late, plays], train=2)
    assert player.failed == {"train b": "nothing is left to train in"} and (tmp_path / "c").exists()
