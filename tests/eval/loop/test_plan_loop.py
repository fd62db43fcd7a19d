"""A plan at toy size through all its commands: stages apart, a killed training, nothing finished is played again."""

import signal

import pytest

from arena_newton.eval.__main__ import main
from arena_newton.eval.loop import plan_run
from arena_newton.eval.loop.loop_requirements import SHIPPED
from arena_newton.eval.loop.plan_run import command_times
from arena_newton.eval.suites.suite_records import read_suite
from arena_newton.policies.learned.learned_card import read_card
from tests.children import Child

CHANGES = {
    'tracker = ["twist2", "sonic"]': 'tracker = ["pd"]',
    "vis_navi = 2\n": "",
    "[parts]\n": "",
    'trackers = ["twist2"]\n': "",
    "max_steps = 24": "max_steps = 12",
    "seeds = [0]\nrepeats = 2": "seeds = [0]\nrepeats = 1",
    "log_every = 1": "log_every = 1\nsave_every = 1",
}
"""Of the plan `tiny`, so that it takes seconds: one task, one tracker."""


class Forked(Child):
    """A command forked off a process that has imported the world, in place of one that imports it."""

    instead: dict[str, str] = {}
    """Module → module that is called instead of it."""

    def __init__(self, module, *arguments, variables, **_):
        super().__init__(self.instead.get(module, f"{module}.__main__"), [*map(str, arguments)], **variables)

    def terminate(self):
        """Tell it to end."""
        self.send_signal(signal.SIGTERM)


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """Folder of the plan's file, and of its stages."""
    text = (SHIPPED / "tiny.toml").read_text()
    for old, new in CHANGES.items():
        assert old in text
        text = text.replace(old, new)
    folder = tmp_path_factory.mktemp("plan")
    (folder / "small.toml").write_text(text)
    return folder


@pytest.mark.release
def test_a_plan_goes_on_from_stage_to_stage(plan, monkeypatch, capsys):
    """A training that was killed goes on at its last checkpoint; stages before it are not played again."""
    monkeypatch.setattr(plan_run, "start_module", Forked)
    out = plan / "out"
    flags = ["loop", "--plan", str(plan / "small.toml"), "--device", "cpu", "--seeds", "1", "--out", str(out)]
    assert main([*flags, "--only", "record", "build"]) == 0
    made = {path: path.stat().st_mtime_ns for path in (out / "datasets").rglob("*") if path.is_file()}
    assert made and not list((out / "trainings").iterdir())

    monkeypatch.setattr(Forked, "instead", {"arena_newton.policies.train": "tests.eval.loop.killed_training"})
    assert main(flags) == 1
    assert "failed: train all_1: SIGKILL" in capsys.readouterr().out and not (out / "packed" / "all").exists()
    assert (out / "trainings" / "all_1" / "checkpoints" / "last").resolve().name == "000002"

    monkeypatch.setattr(Forked, "instead", {})
    assert main(flags) == 0
    said = capsys.readouterr().out
    assert "record: finished before" in said and "all: base: " in said and "time: record" in said
    assert {path: path.stat().st_mtime_ns for path in made} == made
    cells = read_suite(out / "evaluation" / "all").cells
    assert {(cell.policy, cell.mode, cell.status) for cell in cells} == {
        ("all#1", "base", "done"),
        ("all#1", "visual", "done"),
    }
    card = read_card(out / "packed" / "all")
    assert (card.tasks, card.seed, card.steps, card.looks) == (("boxing",), 1, 4, ("0.5",))
    assert (out / "tables" / "cells.csv").is_file()
    assert "Failures of all trainings by stage" in (out / "plan.md").read_text()

    count = len(command_times(out))
    assert main(flags) == 0  # only what takes seconds is made again
    assert [one.stage for one in command_times(out)[count:]] == ["tables", "card"]
