"""A small network that is given the true poses: what it sees, what it learns, what it refuses, and that it plays."""

import json
import math

import numpy as np
import pytest
import torch

from arena_newton.errors import InputError
from arena_newton.policies.train import teachable_network
from arena_newton.policies.train.__main__ import main
from arena_newton.policies.train.teachable_network import Demonstrations, fitted, pose_features, read_demonstrations
from tests.arena_newton.data.made_episodes import make_episode

ROWS = 40
BALL = {f"env_obj_ball_{name}": None for name in ("position", "orientation", "linear_velocity", "angular_velocity")}


def football(folder, repeat=0, **more):
    """A made-up recording of Football with its ball."""
    there = np.tile(np.float32([1.0, 2.0, 0.1]), (ROWS, 1))
    turned = np.tile(np.float32([1.0, 0.0, 0.0, 0.0]), (ROWS, 1))
    given = BALL | {"env_obj_football_position": there, "env_obj_football_orientation": turned}
    return make_episode(folder, ROWS, task="football", repeat=repeat, **(given | more))


@pytest.fixture(autouse=True)
def _narrow(monkeypatch):
    """Layers of 64."""
    monkeypatch.setattr(teachable_network, "WIDTH", 64)


@pytest.fixture
def recording(tmp_path):
    """Two successes and a failure of Football, and one of Boxing."""
    for repeat in (0, 1):
        football(tmp_path, repeat)
    football(tmp_path, 2, outcome="fall")
    make_episode(tmp_path, ROWS, task="boxing")
    return tmp_path


def quat(yaw):
    """About z, wxyz."""
    return torch.tensor([[math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]])


def test_an_object_is_seen_from_the_robot():
    """A whole scene that is moved and turned changes only the robot's own pose in the network's input."""
    state = torch.zeros(1, 64)
    for yaw, away in ((0.7, (3.0, -2.0)), (3.0, (0.0, 9.0))):
        turn = torch.tensor([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        seen = []
        for moved in (False, True):
            robot, ball = torch.tensor([[0.2, 0.1, 0.8]]), torch.tensor([[1.2, 0.1, 0.3]])
            quats = [quat(0.0 + yaw * moved), quat(0.4 + yaw * moved)]
            for place in (robot, ball) if moved else ():
                place[:, :2] = place[:, :2] @ turn.T + torch.tensor([away])
            seen.append(pose_features(state, robot, quats[0], [(ball, quats[1])]))
        torch.testing.assert_close(seen[0][:, 68:], seen[1][:, 68:], atol=1e-5, rtol=0)
        assert not torch.allclose(seen[0][:, 64:68], seen[1][:, 64:68])
    torch.testing.assert_close(seen[0][0, 68:71], torch.tensor([1.0, 0.0, 0.3]), atol=1e-6, rtol=0)
    turned = [math.sin(0.4), math.cos(0.4), math.sin(0.8), math.cos(0.8), 1.0]
    torch.testing.assert_close(seen[0][0, 71:], torch.tensor(turned), atol=1e-6, rtol=0)


def made(rule, episodes=6, rows=50):
    """Demonstrations whose actions follow from what is seen by a rule."""
    seen = torch.randn(episodes * rows, 72, generator=torch.Generator().manual_seed(1))
    seen[:, :66] = 0.0
    return Demonstrations(("ball",), seen, rule(seen), (rows,) * episodes)


def test_what_can_be_seen_is_learned_and_a_coin_is_not():
    """Actions that follow from a pose are predicted; those that a hidden coin decides are not."""
    coin = torch.rand(300, 1, generator=torch.Generator().manual_seed(2)).round() * 2 - 1
    rules = {"seen": lambda seen: seen[:, 68:69].expand(-1, 40), "coin": lambda seen: coin.expand(-1, 40)}
    ends = {}
    for name, rule in rules.items():
        losses = []
        options = {"chunk": 1, "steps": 100, "batch_size": 32, "seed": 0}
        network = fitted(made(rule), **options, on_step=lambda step, loss, losses=losses: losses.append(loss))
        fresh = torch.randn(200, 72, generator=torch.Generator().manual_seed(3))
        fresh[:, :66] = 0.0
        with torch.no_grad():
            answer = network(fresh)[:, 0, 0]
        ends[name] = float(torch.corrcoef(torch.stack([answer, fresh[:, 68]]))[0, 1]), losses
    assert ends["seen"][0] > 0.9 and abs(ends["coin"][0]) < 0.4
    assert ends["seen"][1][-1] < 0.6 * ends["seen"][1][0]


def test_the_same_seed_trains_the_same_network():
    """Weights, rows and noise follow from the seed; no other generator has a say."""
    data = made(lambda seen: seen[:, :40])
    options = {"chunk": 3, "steps": 4, "batch_size": 8}
    one = fitted(data, seed=1, **options)
    torch.manual_seed(99)
    same, other = fitted(data, seed=1, **options), fitted(data, seed=2, **options)
    inputs = data.features[:5]
    assert torch.equal(one(inputs), same(inputs)) and not torch.equal(one(inputs), other(inputs))
    assert one(inputs).shape == (5, 3, 40)


def test_only_successes_of_the_task_are_read(recording):
    """Two of four recordings, with the objects that they name; others are refused with what there is."""
    data = read_demonstrations(recording, "football", "twist2")
    assert data.lengths == (ROWS, ROWS) and data.objects == ("football",)
    assert data.features.shape == (2 * ROWS, 64 + 4 + 8) and data.actions.shape == (2 * ROWS, 40)
    with pytest.raises(InputError, match="no success of football through sonic, but boxing through twist2, success"):
        read_demonstrations(recording, "football", "sonic")
    football(recording, 3, env_obj_box_position=np.zeros((ROWS, 3), np.float32))
    with pytest.raises(InputError, match="others have football"):
        read_demonstrations(recording, "football", "twist2")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env_obj_football_position": np.full((ROWS, 3), np.nan, np.float32)}, "holds a number that is not finite"),
        ({"robot_root_orientation": np.zeros((3, 4), np.float32)}, "robot_root_orientation has shape"),
        ({"env_obj_football_orientation": None}, "env_obj_football_orientation is missing"),
    ],
)
def test_damaged_recordings_are_named(tmp_path, changes, message):
    """File and field are named."""
    football(tmp_path, **changes)
    with pytest.raises(InputError, match=message):
        read_demonstrations(tmp_path, "football", "twist2")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "--recording"),
        (["--recording", "/nowhere", "--task", "football"], "--recording /nowhere"),
        (["--recording", "RECORDING"], "--task: name the task"),
        (["--recording", "RECORDING", "--task", "golf"], "golf"),
        (["--recording", "RECORDING", "--task", "football", "--steps", "0"], "--steps 0"),
        (["--recording", "RECORDING", "--task", "football", "--tracker", "pd"], "no success of football through pd"),
    ],
)
def test_wrong_flags_are_one_line(recording, capsys, flags, message):
    """Exit code 2 and what is wrong."""
    given = [str(recording) if flag == "RECORDING" else flag for flag in flags]
    assert main(["teachable", *given]) == 2
    assert message in capsys.readouterr().err


def test_it_trains_and_plays(recording, tmp_path, capsys):
    """The command, end to end at its smallest: the objects are found in the world, and any number of worlds agrees."""
    written = []
    for worlds in ("1", "3"):
        flags = ["--recording", str(recording), "--task", "football", "--steps", "2", "--episodes", "3"]
        flags += ["--max-steps", "25", "--worlds", worlds, "--out", str(tmp_path / f"{worlds}.json")]
        assert main(["teachable", *flags]) == 0
        written.append(json.loads((tmp_path / f"{worlds}.json").read_text()))
    said = capsys.readouterr().out
    assert "2 demonstrations of football through twist2, 80 ticks" in said and "0 of 3 succeed" in said
    assert written[0]["objects"] == ["football"] and written[0]["episodes"] == written[1]["episodes"]
    assert [episode["group_seed"] for episode in written[0]["episodes"]] == [0, 1, 2]


def test_an_object_that_the_world_lacks_is_refused(tmp_path, capsys):
    """A recording of another scene ends before anything is played."""
    make_episode(tmp_path, ROWS, task="boxing")
    flags = ["--recording", str(tmp_path), "--task", "boxing", "--steps", "1", "--episodes", "1", "--max-steps", "2"]
    assert main(["teachable", *flags]) == 2
    assert "boxing: has no object ball, which was recorded" in capsys.readouterr().err
