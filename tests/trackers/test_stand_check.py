"""Standing, turning and walking in the lab show mistakes that shapes cannot show."""

import dataclasses

import pytest
import torch

from arena_newton import trackers
from arena_newton.__main__ import main
from arena_newton.robot.g1 import MUJOCO_TO_CANONICAL
from arena_newton.trackers.evaluation import stand_check

CONJUGATE = torch.tensor([1.0, -1.0, -1.0, -1.0])


def with_wrong_pose(tracker):
    tracker.front_end.default_pose = tuple(-angle for angle in tracker.front_end.default_pose)


def with_wrong_turn(tracker):
    write = tracker.front_end.write
    tracker.front_end.write = lambda c, s: write(dataclasses.replace(c, quat=c.quat * CONJUGATE), s)


def with_wrong_scale(tracker):
    form = tracker.front_end.action_form
    tracker.front_end.action_form = dataclasses.replace(form, scale=tuple(-scale for scale in form.scale))


def with_wrong_order(tracker):
    write, order = tracker.front_end.write, list(MUJOCO_TO_CANONICAL)
    tracker.front_end.write = lambda c, s: write(dataclasses.replace(c, joints=c.joints[:, order]), s)


def with_half_the_command(tracker):
    write = tracker.front_end.write
    tracker.front_end.write = lambda c, s: write(
        dataclasses.replace(c, joints=0.5 * c.joints, joint_vel=0.5 * c.joint_vel), s
    )


@pytest.mark.parametrize(
    "spoil, broken",
    [
        (lambda tracker: None, set()),
        (with_wrong_pose, {"joints"}),
        (with_wrong_turn, {"turn"}),
        (with_wrong_order, {"walk"}),
        (with_half_the_command, {"walk"}),
        (with_wrong_scale, {"pelvis", "joints", "turn", "walk"}),
    ],
    ids=["right", "pose", "turn", "order", "half", "scale"],
)
def test_mistakes_show(monkeypatch, spoil, broken):
    """SONIC stands, turns and walks; a wrong pose, turn, order, size or scale breaks the measure that names it."""
    monkeypatch.setattr(stand_check, "ROLLOUTS", 1)
    tracker = trackers.get("sonic")
    spoil(tracker)
    results = {result.name: result for result in stand_check.stand(tracker, device="cpu")}
    assert {name for name, result in results.items() if not result.ok} == broken, results
    assert ("?" in results["turn"].message) == ("turn" in broken)
    if spoil is with_wrong_pose:
        assert "most waist_pitch_joint" in results["joints"].message


def test_doctor_prints_it(monkeypatch, capsys):
    """`doctor --tracker NAME --stand` adds the measures to the promises; one that fails makes the exit code 1."""
    monkeypatch.setattr(stand_check, "ROLLOUTS", 1)
    assert main(["doctor", "--tracker", "pd", "--stand"]) == 1
    shown = capsys.readouterr().out
    assert "keeps all 13 promises" in shown and "! pelvis" in shown and "0.6 m or more" in shown
    assert "declares that it follows no orientation" in shown
