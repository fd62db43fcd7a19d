"""A trainable tracker is a module with its `INTERFACE`, a line in `interface.MODULES` and a weights file."""

import dataclasses
import importlib.util
import sys
import types
from importlib.metadata import EntryPoint

import numpy as np
import pytest
import torch
import tyro
from torch import nn

from arena_newton.cli import registry
from arena_newton.errors import InputError
from arena_newton.robot.g1 import PhysicsRate
from arena_newton.trackers import interface, sonic, twist2
from arena_newton.trackers.evaluation.cells import suite
from arena_newton.trackers.evaluation.figures import Result, figures
from arena_newton.trackers.evaluation.suite_rollout import Outcome, make_plan
from arena_newton.trackers.front_end import NetworkTracker
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.inference.networks import InputNorm, TrackerNetwork, mlp
from arena_newton.trackers.train import train_options
from arena_newton.trackers.train.train_options import TrainOptions, check

NAMED = {"theirs": "make", "wrong": "wrong"}
RATE = PhysicsRate(dt=0.005, substeps=4)


class SmallNet(TrackerNetwork):
    """One hidden layer behind TWIST2's observation."""

    obs_width = twist2.OBSERVATION

    def __init__(self, hidden: int = 8):
        super().__init__()
        self.hidden = hidden
        self.norm, self.actor = InputNorm(self.obs_width), mlp((self.obs_width, hidden, 29))

    def config(self):
        return {"hidden": self.hidden}

    def deployed(self):
        return nn.Sequential(self.norm, self.actor)

    def update_norm(self, obs):
        self.norm.update(obs)

    def forward(self, obs):
        return self.actor(self.norm(obs))


class SmallFrontEnd(twist2.Twist2FrontEnd):
    """TWIST2's front end under another name."""


class SmallTracker(NetworkTracker):
    """The tracker of the third interface."""

    name = "small"


@pytest.fixture
def small(monkeypatch):
    """The third interface, in a module of its own and in the list."""
    module = types.ModuleType("small_tracker")
    module.INTERFACE = dataclasses.replace(
        twist2.INTERFACE, name="small", front_end=SmallFrontEnd, network=SmallNet, bars={"fall_rate": 0.5}
    )
    monkeypatch.setitem(sys.modules, "small_tracker", module)
    monkeypatch.setitem(interface.MODULES, "small", "small_tracker")
    return module.INTERFACE


def test_training_finds_it(small):
    """Training's front end, drive and physics rate are those of the record."""
    found = interface.get("small")
    front = found.front_end(found.action_form("residual"))
    assert isinstance(front, SmallFrontEnd) and (found.drive, found.rate) == (small.drive, RATE)
    assert "small" in interface.names() and front.obs_width == small.obs_width
    check(TrainOptions(tracker="small"))


def test_another_package_offers_one(monkeypatch):
    """An entry point of `arena_newton.interfaces` is listed and made; what makes no record is one line."""
    module = types.ModuleType("their_interfaces")
    module.make = lambda: dataclasses.replace(twist2.INTERFACE, name="theirs")
    module.wrong = lambda: "record"
    monkeypatch.setitem(sys.modules, "their_interfaces", module)
    points = [EntryPoint(n, f"their_interfaces:{f}", "arena_newton.interfaces") for n, f in NAMED.items()]
    monkeypatch.setattr(registry, "_installed", lambda group, path: points)
    assert interface.names() == ("sonic", "theirs", "twist2", "wrong")
    assert interface.get("theirs").name == "theirs" and interface.get("twist2") is twist2.INTERFACE
    with pytest.raises(InputError, match="--tracker wrong: its factory makes a str, not a Interface"):
        interface.get("wrong")


def test_the_command_line_offers_it(small, monkeypatch, capsys):
    """`--tracker` of a training takes the names of `interface.names()`, a third one included, and no other."""
    spec = importlib.util.spec_from_file_location("options_again", train_options.__file__)
    again = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "options_again", again)
    spec.loader.exec_module(again)  # as in a new process: the choices are those at the time of the import
    for name in interface.names():
        assert tyro.cli(again.TrainOptions, args=["--tracker", name]).tracker == name
    with pytest.raises(SystemExit):
        tyro.cli(again.TrainOptions, args=["--tracker", "nosuch"])
    shown = capsys.readouterr().err
    assert all(name in shown for name in ("small", "sonic", "twist2"))


def test_weights_round_trip(small, tmp_path):
    """Its weights are saved, loaded and run without another line."""
    network = small.make_network({"hidden": 6})
    network.update_norm(torch.randn(9, network.obs_width))
    form = small.action_form("residual")
    path = tmp_path / "small.safetensors"
    weights_file.save(path, weights_file.Weights("small", network, form, small.drive, RATE))
    loaded = weights_file.load(path, "small")
    x = torch.randn(3, network.obs_width)
    assert loaded.network.config() == {"hidden": 6} and torch.equal(loaded.network(x), network(x))
    tracker = SmallTracker.from_weights(path)
    assert tracker.drive == small.drive and tracker.front_end.action_form == form


def test_figures_apply_its_bars(small):
    """Its bar of the fall rate applies to it; bars that it does not name do not."""
    played = make_plan(suite("full"), 1, 0)
    worlds = len(played.cell)
    names = "leg_rmse drift_10s lowest speed_x ref_x goal_distance goal_turn seat_time end_z end_x support_x touch"
    measures = {name: np.full(worlds, 0.05) for name in [*names.split(), "ball_peak", "ball_end"]}
    measures["fell"] = np.arange(worlds) < 0.4 * worlds
    outcome = Outcome(measures, 0, 1, "mujoco", "cpu", RATE, 0.0, 0.0)
    shown = {f.name: f for f in figures(Result("s", "small", False, {}, played, outcome))}
    assert shown["fall rate, whole suite"].verdict == "pass" and shown["fall rate, whole suite"].bar == "≤ 50 %"
    assert shown["drift per 10 s, walk 0.3 m/s, open loop"].verdict == ""


def test_layouts():
    """Parts of an observation follow each other, and their widths add up to what the official networks take."""
    assert sum(twist2.LAYOUT.values()) == twist2.Twist2FrontEnd.obs_width == 1432
    assert (sonic.ENCODER_INPUT, sonic.PROPRIOCEPTION, sonic.SonicFrontEnd.obs_width) == (1762, 930, 2692)
    assert sonic.AT["anchors"] == slice(601, 661) and sonic.AT["gravity"] == slice(2662, 2692)


def test_unknown():
    """An interface that does not exist is named together with the known ones, and unfit widths are refused."""
    with pytest.raises(InputError, match="'falcon': unknown; trained here are sonic, twist2"):
        interface.get("falcon")
    for config in ({"hidden": [10**9]}, {"hidden": ["a"]}, {"depth": 3}):
        with pytest.raises(InputError, match="network of interface 'twist2'"):
            interface.get("twist2").make_network(config)
