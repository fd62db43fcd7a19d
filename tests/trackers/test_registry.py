"""Trackers are found by name and bad input is answered with one clear line."""

import importlib
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import torch

from arena_newton import trackers
from arena_newton.cli import registry
from arena_newton.errors import InputError
from arena_newton.robot.g1 import MUJOCO_JOINTS, TWIST2_DRIVE
from arena_newton.trackers import base


def message(spec: str, checkpoint=None) -> str:
    with pytest.raises(InputError) as caught:
        trackers.get(spec, checkpoint)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_names():
    """The built-in trackers are listed."""
    assert {"pd", "twist2", "sonic"} <= set(trackers.names())


def test_unknown_name():
    """An unknown tracker is named together with the known ones."""
    assert "--tracker sonick" in message("sonick") and "pd" in message("sonick")


@pytest.mark.parametrize("spec", ["sonic:", "sonic:v1+1", "sonic:v1 1"])
def test_arguments_that_tables_cannot_name_are_refused(spec):
    """No argument behind the colon, a plus sign and a space are refused: tables join names of trackers by them."""
    assert message(spec) == f"--tracker {spec}: expected sonic:<argument>, without + and spaces"


@pytest.mark.parametrize("name", ["twist2", "sonic"])
def test_needs_weights(name, monkeypatch, tmp_path):
    """A tracker whose weights are not installed says what to do."""
    monkeypatch.setattr(base, "weights_path", lambda interface: tmp_path / f"{interface}.safetensors")
    text = message(name)
    assert "--checkpoint" in text and "--tracker pd" in text and str(tmp_path) in text


def test_missing_checkpoint(tmp_path):
    """A checkpoint that does not exist is named with its flag."""
    path = tmp_path / "none.onnx"
    assert message("twist2", path) == f"--checkpoint {path}: no such file"


def test_folder_as_checkpoint(tmp_path):
    """TWIST2 reads files: a folder is refused by its name."""
    assert str(tmp_path) in message("twist2", tmp_path) and ".onnx" in message("twist2", tmp_path)


def test_damaged_checkpoint(tmp_path):
    """A file that is no ONNX is refused."""
    path = tmp_path / "noise.onnx"
    path.write_bytes(np.random.default_rng(0).bytes(5000))
    assert str(path) in message("twist2", path)
    path.write_bytes(b"")
    assert str(path) in message("twist2", path)


def test_wrong_suffix(tmp_path):
    """A file of another kind is refused by its name."""
    path = tmp_path / "weights.pt"
    path.write_bytes(b"x")
    assert ".onnx" in message("twist2", path)


def test_pd_takes_no_checkpoint(tmp_path):
    """The PD tracker does not swallow a checkpoint silently."""
    path = tmp_path / "a.onnx"
    path.write_bytes(b"x")
    assert "pd" in message("pd", path)


def test_pd_passes_reference():
    """The PD tracker hands the reference joints on without a copy."""
    tracker = trackers.get("pd")
    tracker.bind(3)
    joints = torch.randn(3, 29)
    command = trackers.TrackerCommand(torch.zeros(3, 35), joints, torch.zeros(3, 29), torch.zeros(3, 4))
    state = trackers.RobotState(torch.zeros(3, 4), torch.zeros(3, 3), torch.zeros(3, 29), torch.zeros(3, 29))
    tracker.reset(torch.ones(3, dtype=torch.bool))
    tracker.prefill(command, state)
    assert tracker.step(command, state) is joints
    assert tracker.joints == MUJOCO_JOINTS and tracker.drive.effort == TWIST2_DRIVE.effort
    assert len(tracker.drive.kp) == len(tracker.drive.kd) == 29


def test_registration():
    """A third party's tracker is found under its name and described."""

    class Mine(trackers.Tracker):
        name = "mine"

    trackers.register("mine", lambda checkpoint: Mine())
    tracker = trackers.get("mine")
    assert "mine" in trackers.names() and tracker.describe()["name"] == "mine"
    assert tracker.rate(fast=True) == tracker.fast_physics_rate
    with pytest.raises(TypeError, match="mine"):
        tracker.step(None, None)


def test_argument():
    """What follows a colon reaches the tracker's factory; one that takes none refuses it in one line."""

    class Mine(trackers.Tracker):
        def __init__(self, variant):
            self.name = f"mine {variant}"

    trackers.register("varied", lambda checkpoint, variant="a": Mine(variant))
    assert [trackers.get(spec).name for spec in ("varied", "varied:b:c")] == ["mine a", "mine b:c"]
    assert "--tracker pd: its factory does not take what it is given" in message("pd:stiff")
    assert "--tracker nobody: unknown" in message("nobody:b")


def test_entry_point(monkeypatch):
    """A tracker offered by another package's entry point is listed and loaded; a broken one is one line."""
    points = [
        EntryPoint("theirs", "arena_newton.trackers.pd:from_checkpoint", base.ENTRY_POINT_GROUP),
        EntryPoint("broken", "no_such_package:make", base.ENTRY_POINT_GROUP),
    ]
    monkeypatch.setattr(registry, "_installed", lambda group, path: points)
    assert {"theirs", "broken"} <= set(trackers.names())
    assert trackers.get("theirs").name == "pd"
    assert "no_such_package" in message("broken")


def test_built_in_names_are_taken(monkeypatch):
    """A package that offers a tracker under a built-in name is refused: neither of the two is taken silently."""
    points = [EntryPoint("twist2", "theirs:make", base.ENTRY_POINT_GROUP)]
    monkeypatch.setattr(registry, "_installed", lambda group, path: points)
    assert "offered by this package and by another package" in message("twist2")
    assert trackers.get("pd").name == "pd"
    with pytest.raises(InputError, match="'sonic': is built in"):
        trackers.register("sonic", lambda checkpoint: trackers.get("pd"))


def test_the_page_about_trackers():
    """Every Python block of docs/howto/bring/trackers.md runs, one after the other, and gives what the page says."""
    page = (Path(__file__).parents[2] / "docs" / "howto" / "bring" / "trackers.md").read_text()
    world: dict = {"__name__": "docs_trackers"}
    for block in re.findall(r"^```python\n(.*?)^```$", page, flags=re.DOTALL | re.MULTILINE):
        exec(compile(block, "docs/howto/bring/trackers.md", "exec"), world)
    assert world["targets"].shape == (20, 29)
    for name in re.findall(r"`(arena_newton\.trackers\.[\w.]+)`", page):
        importlib.import_module(name)
