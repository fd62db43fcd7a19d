"""The bench `training`: processes that begin together, real steps, refused flags."""

import dataclasses
import io
import json
import sys
from pathlib import Path

import pytest

from arena_newton.errors import ArenaError, InputError
from arena_newton.physics.devices import torch_threads
from benchmarks import measured_training, training_bench
from benchmarks.__main__ import main
from benchmarks.bench_options import TrainingBenchOptions
from tests.policies.train import narrow_network
from tests.policies.train.small_dataset import make_dataset

SMALL = TrainingBenchOptions(recipe="small", device="cpu", frames=100, seconds=0.2)


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    """A vision encoder that trains in milliseconds, in one thread."""
    narrow_network.install(monkeypatch.setattr)
    with torch_threads(1):
        yield


def test_trainings_are_measured_side_by_side(monkeypatch):
    """Each training is a process that begins when all are ready and answers a figure; a failed one is an error."""
    program = Path(__file__).with_name("made_measurement.py")
    monkeypatch.setattr(training_bench, "_command", lambda flags, lerobot: [sys.executable, str(program), flags])
    given = dataclasses.replace(SMALL, trainings=(1, 3))
    alone, three = training_bench.training_figures(given)
    assert alone.value == 5.0 and three.value == 15.0 and three.note.startswith("5.0 + 5.0 + 5.0; no graph")
    assert alone.bar is None and alone.verdict == "-"
    for frames, words in ((666, "2 at once: no memory"), (667, "2 at once: a training ended with code 3")):
        with pytest.raises(ArenaError, match=words):
            training_bench.measure(dataclasses.replace(given, frames=frames), 2)


@pytest.mark.parametrize(("lerobot", "looks"), [(False, 0.0), (False, 0.6), (True, 0.0)])
def test_a_measured_training_counts_its_steps(lerobot, looks, tmp_path, monkeypatch, capsys):
    """Ours and LeRobot's loop say that they are ready, wait for a line, and answer the speed of real steps."""
    monkeypatch.setattr(sys, "stdin", io.StringIO("go\n"))
    flags = dataclasses.asdict(dataclasses.replace(SMALL, workers=0, looks=looks))
    if lerobot:
        flags["dataset"] = [str(make_dataset(tmp_path / "data"))]
    assert measured_training.main(json.dumps(flags), *(["lerobot"] if lerobot else [])) == 0
    ready, answer = capsys.readouterr().out.splitlines()
    assert ready == "ready" and json.loads(answer)["steps_per_s"] > 0 and not json.loads(answer)["graphed"]


def test_no_pictures_are_made_first(tmp_path, monkeypatch):
    """A measured training looks for its weights before it makes up pictures."""
    monkeypatch.setattr(measured_training, "made_frames", lambda *a, **k: pytest.fail("pictures were made"))
    with pytest.raises(InputError, match="no such folder"):
        measured_training.measured(dataclasses.replace(SMALL, weights=str(tmp_path / "absent")))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--policy", "pi05", "--compile"], "--compile: pi05 cannot be compiled"),
        (["--policy", "cat"], "--policy cat: unknown, choose from act, diffusion, flow, pi05"),
        (["--trainings", "0"], "--trainings: expected numbers from 1 to 16"),
        (["--frames", "1"], "--frames 1: expected a number from 100"),
        (["--against-lerobot"], "--against-lerobot: LeRobot's loop reads a dataset"),
    ],
)
def test_flags_are_refused_first(flags, message, capsys):
    """A wrong flag is one line before anything is measured."""
    assert main(["training", *flags]) == 2
    assert message in capsys.readouterr().err
