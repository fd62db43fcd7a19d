"""Every family through the trainer at its smallest: two steps, one more after a resume, a checkpoint that opens."""

import pytest
import torch

from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts, checkpoint_folder
from arena_newton.policies.lerobot.encoder_sources import checkpoint_encoders
from arena_newton.policies.train.policy_options import PolicyTrainOptions
from arena_newton.policies.train.training import train
from tests.policies.train.stock_lerobot import opened


@pytest.mark.parametrize("family", ["diffusion", "flow", "pi05"])
def test_a_family_is_trained_and_opens(family, dataset, tmp_path):
    """The trainer takes each family as it is, goes on after an interruption, and LeRobot opens what it wrote."""
    out = tmp_path / "run"
    given = {"device": "cpu", "quiet": True}
    train(PolicyTrainOptions(policy=family, recipe="small", dataset=(dataset,), out=out, steps=2, **given))
    train(PolicyTrainOptions(resume=out, steps=3, **given))
    folder = checkpoint_folder(out)
    facts = CheckpointFacts.read(folder)
    assert (facts.family, facts.recipe, facts.labels, facts.steps) == (family, "small", "v4", 3)
    if family == "pi05":  # of a size that LeRobot has not
        with checkpoint_encoders(folder):
            policy, before, after = opened(folder)
    else:
        policy, before, after = opened(folder)
    assert all(bool(torch.isfinite(value).all()) for value in policy.state_dict().values() if value.is_floating_point())
    seen = before({"observation.state": torch.zeros(1, 64), "task": ["Open the door."]})
    assert ("observation.language.tokens" in seen) == (family != "diffusion")
    assert after(torch.zeros(1, 40)).shape == (1, 40)
