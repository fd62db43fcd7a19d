"""Every family through the trainer at its smallest: two steps, one more after a resume, a checkpoint that opens."""

import contextlib
import csv
import json
from pathlib import Path

import pytest
import torch

from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts, checkpoint_folder
from arena_newton.policies.lerobot.checkpoint_policy import LeRobotPolicy
from arena_newton.policies.lerobot.encoder_sources import checkpoint_encoders
from arena_newton.policies.train.policy_options import PolicyTrainOptions
from arena_newton.policies.train.training import train
from tests.policies.train.small_dataset import make_dataset
from tests.policies.train.stock_lerobot import opened, raw_observation


@pytest.fixture(scope="module")
def seeing(tmp_path_factory):
    """A dataset with the pictures of the cameras of head and wrists."""
    return make_dataset(tmp_path_factory.mktemp("seeing"), cameras=("front", "left_wrist", "right_wrist"))


@pytest.mark.parametrize("family", ["diffusion", "flow", "pi05"])
def test_a_family_is_trained_and_opens(family, dataset, tmp_path, narrow_resnet):
    """Two steps with held-out losses and a resumed third; LeRobot opens it, and no file names where it grew."""
    out = tmp_path / "run"
    given = {"policy": family, "recipe": "small", "dataset": (dataset,), "out": out, "device": "cpu", "quiet": True}
    train(PolicyTrainOptions(**given, steps=2, hold_out=1, hold_out_every=1, log_every=1, save_every=0))
    with (out / "progress.csv").open() as file:
        assert [bool(row["held_out_loss"]) for row in csv.DictReader(file)] == [True, True]
    train(PolicyTrainOptions(resume=out, steps=3, device="cpu", quiet=True))
    folder = checkpoint_folder(out)
    facts = CheckpointFacts.read(folder)
    assert (facts.family, facts.recipe, facts.labels, facts.steps) == (family, "small", "v4", 3)
    assert not [file for file in folder.glob("*.json") if ".part" in file.read_text()]
    steps = json.loads((folder / "policy_preprocessor.json").read_text())["steps"]
    assert all(Path(name).is_dir() for step in steps if (name := step["config"].get("tokenizer_name")))
    # pi0.5 is of a size that LeRobot has not.
    with checkpoint_encoders(folder) if family == "pi05" else contextlib.nullcontext():
        policy, before, after = opened(folder)
    assert all(bool(torch.isfinite(value).all()) for value in policy.state_dict().values() if value.is_floating_point())
    seen = before({"observation.state": torch.zeros(1, 64), "task": ["Open the door."]})
    assert ("observation.language.tokens" in seen) == (family != "diffusion")
    assert after(torch.zeros(1, 40)).shape == (1, 40)


@pytest.mark.parametrize("family", ["act", "diffusion", "flow", "pi05"])
def test_a_policy_of_several_cameras(family, seeing, tmp_path, narrow_resnet):
    """Each picture decides what it answers, in a stock LeRobot too; resumed, it looks through the same cameras."""
    eyes = ("front", "left_wrist", "right_wrist")
    given = {"policy": family, "recipe": "small", "dataset": (seeing,), "device": "cpu", "quiet": True}
    train(PolicyTrainOptions(**given, out=tmp_path / "run", cameras=eyes, steps=1))
    folder = train(PolicyTrainOptions(resume=tmp_path / "run", steps=2, device="cpu", quiet=True))
    made = LeRobotPolicy(folder)
    wanted = {name: CameraConfig(64, 64, "ego" if name == "front" else name) for name in eyes}
    assert made.cameras == wanted and made.checkpoint.facts.fit == "pad"
    with checkpoint_encoders(folder) if family == "pi05" else contextlib.nullcontext():
        policy, before, _ = opened(folder)
    observation = raw_observation(rows=1) | {f"observation.images.{name}": torch.rand(1, 3, 64, 64) for name in eyes}
    assert [*policy.config.image_features] == [f"observation.images.{name}" for name in eyes]

    def answer(seen):
        torch.manual_seed(1)
        policy.reset()
        return policy.select_action(before(seen))

    whole = answer(observation)
    for name in eyes:
        assert not torch.equal(answer(observation | {f"observation.images.{name}": torch.rand(1, 3, 64, 64)}), whole)
