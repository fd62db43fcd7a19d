"""The pair `tracker_training`: mjlab in an interpreter of its own, by turns with our training."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from arena_newton.errors import ArenaError, InputError
from benchmarks import peer_tracker_training
from benchmarks.bench_options import PeerOptions
from benchmarks.peer_tracker_training import MjlabTraining, tracker_training_figures

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
    flags = PeerOptions(mjlab_python=fake(), training_worlds=(4,), iterations=2, history=str(history))
    (figure,) = tracker_training_figures(flags)
    assert figure.value is None and figure.verdict == "-" and figure.bar == 1.2
    assert "1.00 x, 384 / 384 samples/s" in figure.note and "mjlab 1.6.0, 5 ms x 4" in figure.note
    line = json.loads(history.read_text())
    assert line["peer"] == 2 * 4 * 24 / 0.5 and line["ratio"] == 1.0 and line["verdict"] == "information"
    assert line["peer_versions"] == {"mjlab": "1.6.0"} and line["versions"]["rsl-rl-lib"]


def test_without_an_interpreter_nothing_is_measured():
    """No figure has a value, and each says which flag is missing."""
    figures = list(tracker_training_figures(PeerOptions(training_worlds=(4096, 8192))))
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
    mjlab = MjlabTraining(fake("import time; time.sleep(600)"), motion, 4, "cpu", tmp_path)
    monkeypatch.setattr(peer_tracker_training, "ANSWER_S", 0.2)
    try:
        with pytest.raises(ArenaError, match="mjlab ended with code -9"):
            mjlab.speed(1)
    finally:
        mjlab.close()


STAND_INS = {
    "__init__.py": "",
    "tasks/__init__.py": "",
    "tasks/registry.py": """
import dataclasses
from types import SimpleNamespace as Bag

@dataclasses.dataclass
class Agent:
    num_steps_per_env: int = 24
    seed: int = 7
    clip_actions: float | None = None

class Runner:
    def __init__(self, env, agent, folder, device):
        assert folder is None and agent["num_steps_per_env"] == 24
        self.first = True
    def learn(self, num_learning_iterations, init_at_random_ep_len):
        print("iteration 1 of 1")
        assert init_at_random_ep_len == self.first
        self.first = False

def load_env_cfg(task):
    sim = Bag(mujoco=Bag(timestep=0.005))
    return Bag(commands={"motion": Bag()}, scene=Bag(), sim=sim, decimation=4, seed=None)

def load_rl_cfg(task):
    return Agent()

def load_runner_cls(task):
    return Runner
""",
    "asset_zoo/__init__.py": "",
    "asset_zoo/robots.py": """
import mujoco
from types import SimpleNamespace as Bag

def g1():
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="pelvis")
    body.add_freejoint()
    for number in range(30):
        body.add_geom(size=[0.1, 0, 0])
        if number < 29:
            body = body.add_body(name=f"link{number}", pos=[0, 0, 0.02])
            body.add_joint(axis=[0, 1, 0])
    return spec

def get_g1_robot_cfg():
    return Bag(spec_fn=g1)
""",
    "envs.py": """
import numpy as np

class ManagerBasedRlEnv:
    def __init__(self, cfg, device):
        assert cfg.scene.num_envs == 4 and cfg.seed == 7 and device == "cpu"
        with np.load(cfg.commands["motion"].motion_file) as motion:
            assert motion["fps"] == [50.0]
            position, velocity = motion["body_pos_w"], motion["body_lin_vel_w"]
            assert position.shape == velocity.shape == motion["body_ang_vel_w"].shape == (50, 30, 3)
            assert motion["body_quat_w"].shape == (50, 30, 4)
            assert motion["joint_pos"].shape == motion["joint_vel"].shape == (50, 29)
            np.testing.assert_allclose(position[:, 0, 0], 0.01 * np.arange(50), atol=1e-5)
            np.testing.assert_allclose(np.gradient(position, 0.02, axis=0)[1:-1], velocity[1:-1], atol=0.01)
            np.testing.assert_allclose(motion["body_ang_vel_w"][1:-1, 1, 1], 0.5, atol=1e-3)
    def close(self):
        pass
""",
    "rl.py": "def RslRlVecEnvWrapper(env, clip_actions):\n    return env\n",
    "utils/__init__.py": "",
    "utils/torch.py": "def configure_torch_backends():\n    pass\n",
    "../mjlab-1.6.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: mjlab\nVersion: 1.6.0\n",
}
"""Parts of mjlab that the script uses, which is not installed beside this product."""


def test_the_script_that_mjlab_is_handed(tmp_path):
    """It makes a motion whose velocities are those of its poses, trains as asked, and answers in whole lines."""
    for name, text in STAND_INS.items():
        file = tmp_path / "mjlab" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nPYTHONPATH="{tmp_path}" exec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    frames = np.arange(50.0)
    root = np.stack([0.01 * frames, 0 * frames, 0.8 + 0 * frames], axis=1)
    joints = np.zeros((50, 29))
    joints[:, 0] = 0.01 * frames  # 0.5 rad/s
    motion = tmp_path / "walk.npz"
    np.savez(motion, fps=50.0, root_pos=root, root_quat=np.tile([1.0, 0, 0, 0], (50, 1)), joint_pos=joints)
    mjlab = MjlabTraining(str(python), motion, 4, "cpu", tmp_path)
    try:
        assert mjlab.versions["mjlab"] == "1.6.0" and mjlab.versions["mujoco"] and mjlab.physics == "5 ms x 4"
        assert mjlab.speed(2) > 0.0 and mjlab.speed(1) > 0.0
    finally:
        mjlab.close()
