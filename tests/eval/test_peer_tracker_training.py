"""bench --peers tracker_training: mjlab in an interpreter of its own, by turns with our training."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval import peer_tracker_training
from arena_newton.eval.options import BenchOptions
from arena_newton.eval.peer_tracker_training import MjlabTraining, tracker_training_figures

FAKE = """#!{python}
import json, os, sys
import numpy as np
safe, script, motion, worlds, device = sys.argv[1:]
assert safe == "-P" and script.endswith("mjlab_training.py") and device == "cpu"
assert "PYTHONPATH" not in os.environ and os.environ["WANDB_MODE"] == "disabled"
with np.load(motion) as file:
    assert file["fps"] == 50 and file["joint_pos"].shape == (len(file["root_pos"]), 29)
print("a library says hello", flush=True)
print(json.dumps(dict(versions=dict(mjlab="1.6.0"), steps=24, physics="5 ms x 4")), flush=True)
for line in sys.stdin:
    {body}
"""
ANSWERS = "print(json.dumps(dict(samples=int(line) * int(worlds) * 24, seconds=0.5)), flush=True)"


@pytest.fixture
def fake(tmp_path):
    """A program that answers as mjlab's interpreter does."""

    def make(body: str = ANSWERS) -> str:
        file = tmp_path / "python"
        file.write_text(FAKE.format(python=sys.executable, body=body))
        file.chmod(0o755)
        return str(file)

    return make


@pytest.fixture
def motion(tmp_path):
    """A motion of two frames."""
    file = tmp_path / "walk.npz"
    np.savez(file, fps=50.0, root_pos=np.zeros((2, 3)), root_quat=np.eye(4)[[0, 0]], joint_pos=np.zeros((2, 29)))
    return file


class _Ours:
    """Our training at known speeds; the first is of the warm-up."""

    def __init__(self, library: Path, worlds: int, device: str):
        assert library.is_file() and device == "cpu"
        self.speeds = [1.0, 96.0, 384.0, 576.0]

    def speed(self, iterations: int) -> float:
        return self.speeds.pop(0)


def test_rounds_are_taken_by_turns(fake, tmp_path, monkeypatch):
    """The median of the rounds' ratios, the warm-up left out; the history names both sides' versions; CPU: no bar."""
    monkeypatch.setattr(peer_tracker_training, "OwnTraining", _Ours)
    monkeypatch.setattr(peer_tracker_training.torch.cuda, "is_available", lambda: False)
    history = tmp_path / "history.jsonl"
    flags = BenchOptions(mjlab_python=fake(), peers_worlds=(4,), peers_iterations=2, peers_history=str(history))
    (figure,) = tracker_training_figures(flags)
    assert figure.value is None and figure.verdict == "-" and figure.bar == 1.2
    assert "1.00 x, 384 / 384 samples/s" in figure.note and "mjlab 1.6.0, 5 ms x 4" in figure.note
    line = json.loads(history.read_text())
    assert line["peer"] == 2 * 4 * 24 / 0.5 and line["ratio"] == 1.0 and line["verdict"] == "information"
    assert line["peer_versions"] == {"mjlab": "1.6.0"} and line["versions"]["rsl-rl-lib"]


def test_without_an_interpreter_nothing_is_measured():
    """No figure has a value, and each says which flag is missing."""
    figures = list(tracker_training_figures(BenchOptions(peers_worlds=(4096, 8192))))
    assert [figure.value for figure in figures] == [None, None]
    assert all("--mjlab-python" in figure.note for figure in figures)


def test_an_interpreter_without_mjlab(motion, tmp_path):
    """Ours has no mjlab: the error names flag and remedy."""
    with pytest.raises(InputError, match=r"--mjlab-python .*pip install mjlab"):
        MjlabTraining(sys.executable, motion, 4, "cpu", tmp_path)
    with pytest.raises(InputError, match="--mjlab-python no-such-python"):
        MjlabTraining("no-such-python", motion, 4, "cpu", tmp_path)


def test_a_training_that_breaks_says_its_last_words(fake, motion, tmp_path):
    """A process that ends in a round is an error with its exit code and last line, and none is left behind."""
    mjlab = MjlabTraining(fake("sys.exit('CUDA out of memory')"), motion, 4, "cpu", tmp_path)
    try:
        with pytest.raises(ArenaError, match="code 1: CUDA out of memory"):
            mjlab.speed(1)
    finally:
        mjlab.close()
    mjlab.close()  # again does no harm


def test_a_training_that_hangs_is_ended(fake, motion, tmp_path, monkeypatch):
    """No answer in time is an error."""
    mjlab = MjlabTraining(fake("import time; time.sleep(60)"), motion, 4, "cpu", tmp_path)
    monkeypatch.setattr(peer_tracker_training, "ANSWER_S", 0.2)
    try:
        with pytest.raises(ArenaError, match="mjlab ended with code -9"):
            mjlab.speed(1)
    finally:
        mjlab.close()
