"""LeRobot's own evaluation plays our episodes: the same states at every tick and the same successes as our runner."""

import inspect
import json
import sys

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts import lerobot_eval
from lerobot.scripts.lerobot_eval import eval_main
from watched import WatchedEnv, watched_rollout

from arena_newton.errors import InputError
from arena_newton.eval.adapters import gym
from arena_newton.eval.adapters.gym import ArenaVectorEnv
from arena_newton.eval.adapters.lerobot_env import ArenaNewtonEnv
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies import Chunk, Policy
from arena_newton.robot.canonical import STAND_ACTION

PLUGIN = "--env.discover_packages_path=arena_newton.eval.adapters.lerobot_env"
SIDE = 64
"""Width and height of pictures [px]; the least that video encoders take."""
CHUNK = 5
"""Actions that the network's policy gives at once."""


@pytest.fixture(autouse=True)
def watched(monkeypatch, watched_worlds):
    """Every environment of these tests keeps the hashes of its ticks, and is built once."""
    monkeypatch.setattr(gym, "ArenaEnv", watched_worlds)
    WatchedEnv.history.clear()


@pytest.fixture(scope="module")
def checkpoint(narrow_resnet, tmp_path_factory):
    """A tiny ACT with random weights that sways about the standing action, saved as LeRobot saves policies."""
    torch.manual_seed(7)
    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (64,)),
            "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (40,))},
        normalization_mapping={kind: NormalizationMode.MEAN_STD for kind in ("VISUAL", "STATE", "ACTION")},
        pretrained_backbone_weights=None,
        device="cpu",
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        use_vae=False,
    )
    stats = {
        "observation.state": {"mean": torch.zeros(64), "std": torch.ones(64)},
        "observation.images.front": {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.25)},
        "action": {"mean": torch.from_numpy(STAND_ACTION), "std": torch.full((40,), 0.02)},
    }
    folder = tmp_path_factory.mktemp("act")
    ACTPolicy(config).save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


class NetworkPolicy(Policy):
    """The same network in our runner."""

    name, needs_image, camera = "act", True, CameraConfig(width=SIDE, height=SIDE)

    def __init__(self, folder):
        self.network = ACTPolicy.from_pretrained(folder)
        self.network.eval()
        self.before, self.after = make_pre_post_processors(self.network.config, pretrained_path=folder)

    def act(self, observation):
        seen = {"pixels": {"front": observation.image.numpy()}, "agent_pos": observation.state.numpy()}
        with torch.inference_mode():
            chunk = self.network.predict_action_chunk(self.before(preprocess_observation(seen)))
        return Chunk(torch.stack([self.after(chunk[:, tick]) for tick in range(CHUNK)], dim=1))


def as_it_is(batch):
    """No processing."""
    return batch


def evaluate(monkeypatch, checkpoint, out, task, *flags, episodes=2):
    """Results that LeRobot's command line wrote of the first episodes."""
    arguments = [PLUGIN, "--env.type=arena_newton", f"--env.task={task}", "--env.engine=mujoco", "--env.device=cpu"]
    arguments += [f"--env.image_width={SIDE}", f"--env.image_height={SIDE}", f"--policy.path={checkpoint}"]
    arguments += ["--policy.device=cpu", f"--eval.n_episodes={episodes}", f"--eval.batch_size={episodes}", "--seed=0"]
    arguments += [f"--output_dir={out}", *flags]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *arguments])
    eval_main()
    return json.loads((out / "eval_info.json").read_text())


def test_an_experts_actions_succeed_as_in_our_runner(monkeypatch, checkpoint, boxed, tmp_path):
    """A LeRobot policy that plays the expert's actions: LeRobot counts the same successes, every tick is the same."""
    table, hashes, results = boxed
    ticks = {"now": 0}

    def select_action(self, batch, **options):
        assert batch["observation.state"].shape == (2, 64) and batch["observation.images.front"].shape[1] == 3
        assert set(batch["task"]) == {"Strike the green markers on the punching bag."}
        rows = [table.at(result.episode.episode_seed, ticks["now"]) for result in results]
        ticks["now"] += 1
        return torch.from_numpy(np.stack(rows))

    monkeypatch.setattr(ACTPolicy, "select_action", select_action)
    monkeypatch.setattr(lerobot_eval, "make_pre_post_processors", lambda **_: (as_it_is, as_it_is))
    info = evaluate(monkeypatch, checkpoint, tmp_path, "boxing")
    assert WatchedEnv.history == hashes and ticks["now"] == max(result.steps for result in results)
    assert [result.outcome for result in results] == ["success"] * 2 and info["overall"]["pc_success"] == 100.0
    (task,) = info["per_task"]
    assert task["task_group"] == "boxing" and task["metrics"]["successes"] == [True, True]
    assert task["metrics"]["sum_rewards"] == [1.0, 1.0]
    assert len(list((tmp_path / "videos" / "boxing_0").glob("*.mp4"))) == 2


def test_a_network_decides_as_in_our_runner(monkeypatch, checkpoint, watched_worlds, tmp_path):
    """A random ACT, chunks and pictures included: every tick is the same; LeRobot's own recording has our columns."""
    hashes, results = watched_rollout(watched_worlds, "football", 2, 2, NetworkPolicy(checkpoint), max_steps=11)
    assert len({result.margin for result in results}) == 2
    flags = "--env.episode_length=11", "--eval.recording=true"
    info = evaluate(monkeypatch, checkpoint, tmp_path, "football", *flags)
    assert WatchedEnv.history == hashes and all(len(ticks) == 50 + 11 for ticks in hashes.values())
    assert info["overall"]["pc_success"] == 0.0
    recorded = LeRobotDataset("eval_recording_env_1", root=tmp_path / "recordings" / "football_0" / "env_1")
    assert recorded.num_frames == 11 and recorded.fps == 50
    assert {"observation.state", "observation.images.front", "action"} < set(recorded.features)
    assert recorded[0]["task"] == "Kick the soccer ball into the goal."


def test_falls_end_and_freeze(monkeypatch, checkpoint, watched_worlds, tmp_path):
    """Wild actions: worlds fall at different ticks as in our runner, and a fallen world moves no more."""
    wild = np.random.default_rng(1).normal(size=(2, 200, 40)).astype(np.float32)

    class Wild(Policy):
        name = "wild"

        def act(self, observation):
            return Chunk(wild)

    hashes, results = watched_rollout(watched_worlds, "football", 2, 2, Wild())
    assert [result.outcome for result in results] == ["fall"] * 2
    ticks = {"now": 0}

    def select_action(self, batch, **options):
        ticks["now"] += 1
        return torch.from_numpy(wild[:, ticks["now"] - 1])

    monkeypatch.setattr(ACTPolicy, "select_action", select_action)
    monkeypatch.setattr(lerobot_eval, "make_pre_post_processors", lambda **_: (as_it_is, as_it_is))
    info = evaluate(monkeypatch, checkpoint, tmp_path, "football")
    assert WatchedEnv.history == hashes and ticks["now"] == max(result.steps for result in results)
    assert info["per_task"][0]["metrics"]["sum_rewards"] == [0.0, 0.0]


def test_its_flags_are_ours():
    """Every option that LeRobot gives a batch is one of ours; features have the names of the original's datasets."""
    config = ArenaNewtonEnv(task="boxing, sit_sofa", cameras="front,left_wrist", image_width=64, image_height=48)
    assert set(config.gym_kwargs) <= set(inspect.signature(ArenaVectorEnv.__init__).parameters)
    assert config.tasks == ("boxing", "sit_sofa") and config.max_parallel_tasks == 1
    assert list(config.features) == [
        "action",
        "observation.state",
        "observation.images.front",
        "observation.images.left_wrist",
    ]
    assert config.features["observation.images.front"].shape == (48, 64, 3)
    assert len(ArenaNewtonEnv(task="all").tasks) == 7


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "golf"}, "golf"),
        ({"task": None}, "--env.task"),
        ({"cameras": "nose"}, "--env.cameras nose"),
        ({"image_width": 0}, "--env.image_width 0: expected at least 1"),
        ({"image_height": -5}, "--env.image_height -5: expected at least 1"),
        ({"fps": 30}, "--env.fps 30"),
        ({"max_parallel_tasks": 2}, "--env.max_parallel_tasks 2"),
    ],
)
def test_wrong_flags_are_refused(options, message):
    """A flag that does not fit is named before anything is built."""
    with pytest.raises(InputError, match=message):
        ArenaNewtonEnv(**options)


def test_what_a_rollout_asks():
    """Batches answer LeRobot's questions per world: task, instruction, step budget, pictures."""
    config = ArenaNewtonEnv(task="football", engine="mujoco", device="cpu", image_width=32, image_height=32)
    batch = config.create_envs(2, use_async_envs=True)["football"][0]
    assert batch.call("task") == ("football",) * 2 and batch.get_attr("task_description")[1].startswith("Kick")
    assert batch.call("_max_episode_steps")[0] == batch.env.budget and batch.unwrapped.metadata["render_fps"] == 50
    with pytest.raises(AttributeError):
        batch.get_attr("colour")
    observation, _ = batch.reset(seed=[5, 6], options={"lerobot_new_rollout": True})
    assert np.array_equal(observation["agent_pos"], observation["observation.state"])
    assert [picture.shape for picture in batch.call("render")] == [(32, 32, 3)] * 2
    batch.close()
