"""One checkpoint through its protocols: what is compared and refused, and that a stock lerobot-eval plays ours."""

import contextlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts.lerobot_eval import eval_main

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.adapters import protocol_comparison
from arena_newton.eval.adapters.lerobot_env import ArenaNewtonEnv
from arena_newton.eval.adapters.lerobot_env.labelled_worlds import V4VectorEnv
from arena_newton.eval.adapters.protocol_comparison import (
    ProtocolEpisode,
    ProtocolRun,
    compare_protocols,
    protocol_table,
)
from arena_newton.eval.adapters.protocol_options import PROTOCOLS, ProtocolOptions
from arena_newton.eval.play.factories import Factories
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.replay import ReplayEpisodes

sys.path.insert(0, str(Path(__file__).parents[2] / "policies" / "checkpoints"))
from made_checkpoints import SIDE, facts, save

TASKS = ("boxing", "vis_navi")
TICKS = 8
"""Step budget of an episode: more than a chunk."""
PLUGIN = ["--env.discover_packages_path=arena_newton.eval.adapters.lerobot_env", "--env.type=arena_newton"]


@pytest.fixture(scope="module")
def checkpoint(narrow_resnet, tmp_path_factory):
    """A tiny ACT like the one that ships: v4 with realignment, a task vector, pictures without bars."""
    about = facts(labels="v4", realign=0.05, family="act", task_vector=TASKS, tasks=TASKS, fit="native")
    return save(tmp_path_factory.mktemp("act"), "act", facts=about, spread=0.1)


def play(protocol, *episodes, seconds=1.0):
    """Episodes played through a protocol, as outcome and actions."""
    made = [
        ProtocolEpisode(f"s0/r{number}", outcome, outcome, len(actions), 0.5, np.asarray(actions, np.float32))
        for number, (outcome, actions) in enumerate(episodes)
    ]
    return ProtocolRun(protocol, tuple(made), seconds)


def test_any_bit_counts():
    """The same episodes keep the promise; one bit of one action, another ending or another margin breaks it."""
    actions = np.linspace(0.0, 1.0, 5 * 40, dtype=np.float32).reshape(5, 40)
    other = actions.copy()
    other[3, 7] = np.nextafter(other[3, 7], np.float32(2.0))
    first = play("lerobot", ("success", actions), ("timeout", actions[:4]))
    same = play("openpi", ("success", actions), ("timeout", actions[:4]))
    bit = play("arena", ("success", other), ("timeout", actions[:4]))
    ended = play("vla-eval", ("fall", actions[:2]), ("timeout", actions[:4]))
    free = play("learned", ("success", other), ("timeout", actions[:4]))
    rows = compare_protocols([first, same, bit, ended, free], 2, ("lerobot", "openpi", "arena", "vla-eval"))
    assert [row.kept for row in rows] == [True, True, False, False, True]
    assert [row.parts_at for row in rows] == [None, None, 3, 2, 3]
    assert [row.same_actions for row in rows] == [True] * 5 and not rows[3].same_endings
    (late,) = compare_protocols([first, bit], 4, ())[1:]
    assert not late.same_actions and 0.0 < late.largest < 1e-6
    moved = ProtocolRun(
        "openpi", (ProtocolEpisode("s0/r0", "success", "success", 5, 0.6, actions), same.episodes[1]), 1.0
    )
    assert not compare_protocols([first, moved], 2, ("lerobot", "openpi"))[1].kept
    table = protocol_table(rows, 2)
    assert table.count("\n") == 2 + 5 and "| `arena` | 1 of 2 | 5 4 | same bits |" in table
    with pytest.raises(InputError, match="protocol openpi: played s0/r0, protocol lerobot s0/r0 s0/r1"):
        compare_protocols([first, play("openpi", ("success", actions))], 2, ())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"protocols": ("openpi", "grpc")}, "--protocols grpc: unknown"),
        ({"protocols": ("openpi", "openpi")}, "each once"),
        ({"episodes": 21}, "--episodes 21"),
        ({"first": 0}, "--first 0"),
        ({"max_steps": 0}, "--max-steps 0"),
        ({"task": "golf"}, "golf"),
        ({"checkpoint": "/nowhere"}, "--checkpoint /nowhere: no such folder"),
        ({"protocols": ("learned",)}, "none is left"),
    ],
)
def test_wrong_protocols_are_refused_first(checkpoint, tmp_path, changes, message):
    """A flag that does not fit is named before a program starts, and nothing is written."""
    with pytest.raises(InputError, match=re.escape(message)):
        protocol_comparison.run(
            ProtocolOptions(**{"checkpoint": str(checkpoint), "out": str(tmp_path / "new")} | changes)
        )
    assert not (tmp_path / "new").exists()


def test_a_folder_that_holds_something_is_left_alone(checkpoint, tmp_path):
    """A folder that is not empty is refused, and keeps what it has."""
    (tmp_path / "mine").write_text("kept")
    with pytest.raises(InputError, match="is not an empty folder"):
        protocol_comparison.run(ProtocolOptions(checkpoint=str(checkpoint), out=str(tmp_path)))
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.fixture
def here(monkeypatch, kept_worlds):
    """The programs of protocols run in this process, by their command lines; gives their exit codes."""
    codes = []

    def start(module, *arguments, output, **_):
        assert module == "arena_newton.eval"
        with os.fdopen(os.dup(output), "w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
            codes.append(main(arguments, Factories(env=kept_worlds)))
        return subprocess.Popen(["sh", "-c", f"exit {codes[-1]}"])

    monkeypatch.setattr(protocol_comparison, "start_module", start)
    return codes


def test_a_protocol_that_fails_names_the_last_line_of_its_program(checkpoint, tmp_path, here):
    """The last line of the program that failed, and where the rest is; a policy that does not know the task."""
    options = ProtocolOptions(
        checkpoint=str(checkpoint), out=str(tmp_path / "out"), protocols=("lerobot",), task="football", max_steps=2
    )
    with pytest.raises(
        InputError, match="protocol lerobot: exit code 2, .*was trained on boxing, vis_navi, not on football"
    ):
        protocol_comparison.run(options)
    assert here == [2]


def test_our_runner_alone(checkpoint, tmp_path, here):
    """One protocol alone: what its program did is read from its files."""
    flags = ["--checkpoint", str(checkpoint), "--task", "boxing", "--episodes", "1", "--max-steps", str(TICKS)]
    assert main(["protocols", *flags, "--protocols", "lerobot", "--out", str(tmp_path / "out")]) == 0
    (row,) = json.loads((tmp_path / "out" / "protocols.json").read_text())["protocols"]
    assert row["steps"] == [TICKS] and row["episodes"] == len(here) == 1 and row["promised"]


def program(folder, monkeypatch, text):
    """Name of a module with this text, and the file of what it prints."""
    (folder / "made_program.py").write_text(f"import os, signal, sys, time\n{text}")
    monkeypatch.syspath_prepend(folder)
    return ["made_program"], folder / "log"


def test_a_protocol_is_a_program(tmp_path, monkeypatch):
    """It runs with one thread, what it prints goes into a file, and its exit code counts."""
    command, log = program(
        tmp_path, monkeypatch, "print('said', os.environ['MKL_NUM_THREADS'], flush=True)\nexit('lost')"
    )
    protocol_comparison._call("openpi", command, log, (0, 1))
    assert log.read_text() == "said 1\nlost\n"
    with pytest.raises(InputError, match=f"protocol openpi: exit code 1, lost; all of it is in {log}"):
        protocol_comparison._call("openpi", command, log, (0,))


@pytest.mark.parametrize("deaf", [False, True])
def test_a_server_ends_with_its_protocol(tmp_path, monkeypatch, deaf):
    """It is asked by the address that it prints, and ended by Ctrl-C, or killed where it does not hear."""
    monkeypatch.setattr(protocol_comparison, "END_S", 0.3 if deaf else 30.0)
    hears = "signal.signal(signal.SIGINT, signal.SIG_IGN if deaf else lambda *_: (print('bye', flush=True), exit()))"
    text = f"deaf = {deaf}\n{hears}\nprint('{protocol_comparison.ADDRESS}openpi:here', flush=True)\ntime.sleep(600)"
    command, log = program(tmp_path, monkeypatch, text)
    with protocol_comparison._server("openpi", command, log) as spec:
        assert spec == "openpi:here"
    assert log.read_text().splitlines()[1:] == ([] if deaf else ["bye"])


def test_a_server_that_does_not_listen_is_named(tmp_path, monkeypatch):
    """Its last line is in the error, as soon as it has ended."""
    command, log = program(tmp_path, monkeypatch, "exit('no room')")
    with pytest.raises(InputError, match="protocol openpi: its server does not listen, no room; all of it"):
        with protocol_comparison._server("openpi", command, log):
            pass


def argv(monkeypatch, checkpoint, *flags):
    """The command line of lerobot-eval, without what the checkpoint says itself."""
    given = [*PLUGIN, "--env.task=boxing", "--env.engine=mujoco", "--env.device=cpu", f"--policy.path={checkpoint}"]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *given, "--policy.device=cpu", *flags])


def test_the_checkpoint_says_how_it_is_played(checkpoint, monkeypatch, tmp_path):
    """Labels, picture, task vector and queries are those of `--policy.path`; flags that are given count more."""
    argv(monkeypatch, checkpoint)
    said = ArenaNewtonEnv(task="boxing").policy_worlds
    assert (said.labels, said.realign, said.query_ticks, said.task_vector) == ("v4", 0.05, 6, TASKS)
    assert said.cameras == {"front": CameraConfig(width=SIDE, height=SIDE, fit="native")}
    own = ArenaNewtonEnv(task="boxing", fit="pad", realign=0.0, image_width=96, labels="v3.1", task_vector="boxing")
    assert own.policy_worlds.realign == 0.0 and own.policy_worlds.labels == "v3.1"
    assert own.policy_worlds.cameras == {"front": CameraConfig(width=96, height=SIDE)}
    assert own.features["observation.images.front"].shape == (SIDE, 96, 3)
    assert own.features["observation.environment_state"].shape == (1,)
    argv(monkeypatch, checkpoint, "--policy.n_action_steps=3")
    assert ArenaNewtonEnv(task="boxing").policy_worlds.query_ticks == 3
    argv(monkeypatch, checkpoint, "--policy.temporal_ensemble_coeff=0.01", "--policy.n_action_steps=1")
    assert ArenaNewtonEnv(task="boxing").policy_worlds.query_ticks == 1
    with pytest.raises(InputError, match="--env.task football: the policy was trained on boxing, vis_navi"):
        ArenaNewtonEnv(task="football")
    argv(monkeypatch, tmp_path)  # none of ours
    other = ArenaNewtonEnv(task="football").policy_worlds
    assert (other.labels, other.cameras, other.task_vector) == ("v3.1", {"front": CameraConfig()}, ())
    features = {"observation.images.front": {"type": "VISUAL", "shape": [3, 480, 640]}}
    features["observation.images.right_wrist"] = {"type": "VISUAL", "shape": [3, 96, 96]}
    (tmp_path / "config.json").write_text(json.dumps({"n_action_steps": 8, "input_features": features}))
    trained = ArenaNewtonEnv(task="football").policy_worlds  # by lerobot-train, on pictures of the sensor's own shape
    front, wrist = CameraConfig(width=640, height=480, fit="native"), CameraConfig(96, 96, "right_wrist")
    assert trained.cameras == {"front": front, "right_wrist": wrist} and trained.labels == "v3.1"
    with pytest.raises(InputError, match="--env.fit wide"):
        ArenaNewtonEnv(task="boxing", fit="wide")


@pytest.mark.parametrize("content", ["[]", "{", '{"n_action_steps": "many"}'])
def test_a_damaged_checkpoint_is_named(tmp_path, monkeypatch, content):
    """A configuration that cannot be read is one error with its path."""
    facts(labels="v4", family="act").write(tmp_path)
    (tmp_path / "config.json").write_text(content)
    argv(monkeypatch, tmp_path)
    with pytest.raises(InputError, match="config.json"):
        ArenaNewtonEnv(task="boxing")


def test_a_picture_of_no_size_is_named(tmp_path, monkeypatch):
    """A foreign checkpoint whose picture cannot be rendered is one error with its path."""
    features = {"observation.images.front": {"type": "VISUAL", "shape": [3, "wide"]}}
    (tmp_path / "config.json").write_text(json.dumps({"n_action_steps": 8, "input_features": features}))
    argv(monkeypatch, tmp_path)
    with pytest.raises(InputError, match="config.json: input observation.images.front has shape"):
        ArenaNewtonEnv(task="boxing")


def test_lerobot_eval_plays_a_policy_with_a_task_vector(checkpoint, monkeypatch, tmp_path, kept_worlds):
    """No flag but the checkpoint's path: the episodes of our runner, bit for bit, and files that `replay:` plays."""
    flags = ["--eval.n_episodes=2", "--eval.batch_size=1", "--seed=0", f"--env.episode_length={TICKS}"]
    flags += [f"--env.episodes={tmp_path / 'kept'}", f"--output_dir={tmp_path / 'out'}"]
    argv(monkeypatch, checkpoint, *flags)
    eval_main()
    lines = [json.loads(line) for line in (tmp_path / "kept" / "outcomes.jsonl").read_text().splitlines()]
    run = ["--task", "boxing", "--policy", f"lerobot:{checkpoint}", "--seeds", "0", "--repeats", "2", "--worlds", "1"]
    run += ["--engine", "mujoco", "--device", "cpu", "--max-steps", str(TICKS), "--actions"]
    assert main(["run", *run, "--out", str(tmp_path / "run")], Factories(env=kept_worlds)) == 0
    ours = [json.loads(line) for line in (tmp_path / "run" / "episodes.jsonl").read_text().splitlines()]
    ours = {line["episode_seed"]: line for line in ours if "margin" in line}
    assert len(lines) == len(ours) == 2 and {line["tracker"] for line in lines} == {"twist2"}
    for line in lines:
        wanted = ours[line["episode_seed"]]
        for name in ("outcome", "reason", "steps", "margin", "group_seed", "repeat", "mode", "task"):
            assert line[name] == wanted[name], name
        name = f"boxing_base_s0_r{line['repeat']}.npz"
        first, second = (np.load(tmp_path / folder / "actions" / name) for folder in ("kept", "run"))
        same = set(first) - {"queries"}  # LeRobot asks where our environment does not see it
        assert set(first) == set(second) and all(np.array_equal(first[key], second[key]) for key in same)
        assert first["action"].shape == (TICKS, 40)
    policy = policies.get(f"replay:{tmp_path / 'kept' / 'actions'}")
    assert isinstance(policy, ReplayEpisodes)
    policy.close()


def test_lerobots_recording_has_the_task_vector(checkpoint, monkeypatch, tmp_path):
    """LeRobot's recording of a policy with a task vector has it as a column."""
    flags = ["--eval.n_episodes=1", "--eval.batch_size=1", "--seed=0", "--env.episode_length=3"]
    argv(monkeypatch, checkpoint, *flags, f"--output_dir={tmp_path / 'out'}", "--eval.recording=true")
    eval_main()
    recorded = LeRobotDataset("eval_recording", root=tmp_path / "out" / "recordings" / "boxing_0")
    assert recorded.num_frames == 3 and recorded[2]["observation.environment_state"].tolist() == [1.0, 0.0]


def test_the_vector_names_the_task():
    """Every world gets task and tracker, under LeRobot's name and under that of datasets; the spaces say so."""
    vectors = {"task_vector": "boxing,vis_navi", "tracker_vector": "sonic,twist2"}
    config = ArenaNewtonEnv(task="vis_navi", engine="mujoco", device="cpu", labels="v4", **vectors)
    assert config.features["observation.environment_state"].shape == (5,)
    batch = config.create_envs(2)["vis_navi"][0]
    assert isinstance(batch, V4VectorEnv)
    seen, _ = batch.reset(seed=[0, 1])
    for name in ("environment_state", "observation.environment_state"):
        assert torch.equal(torch.from_numpy(seen[name]), torch.tensor([[0.0, 1.0, 0.0, 1.0, 0.0]] * 2))
    assert batch.observation_space.contains(seen)
    batch.close()


@pytest.mark.slow
def test_every_protocol_gives_the_same_episodes(checkpoint, tmp_path, capsys):
    """The command itself, each protocol a program: equal bits, exit code 0, and a table with every command."""
    protocols = [protocol for protocol in PROTOCOLS if protocol != "learned"]
    flags = ["--checkpoint", str(checkpoint), "--task", "boxing", "--episodes", "2", "--max-steps", str(TICKS)]
    assert main(["protocols", *flags, "--protocols", *protocols, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert said.count("| `") == len(protocols) and "what is promised holds" in said and "differ |" not in said
    written = json.loads((tmp_path / "out" / "protocols.json").read_text())
    assert [row["protocol"] for row in written["protocols"]] == protocols
    assert all(row["same_everything"] and row["steps"] == [TICKS, TICKS] for row in written["protocols"])
    text = (tmp_path / "out" / "protocols.md").read_text()
    assert "lerobot.scripts.lerobot_eval" in text and text.count("policies.serve") == 4
