"""Checkpoints as our own trainer saves them, of every family at its smallest: they run without a hub."""

import gc
import sys
import weakref
from pathlib import Path

import pytest
import torch
from made_checkpoints import follow

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.lerobot.checkpoint_policy import LeRobotPolicy
from arena_newton.policies.lerobot.checkpoint_reader import FAMILY_TYPES
from arena_newton.policies.lerobot.checkpoint_tensors import check_family
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.families.families import build

sys.path.insert(0, str(Path(__file__).parents[1] / "train"))
from made_stats import made_stats


@pytest.mark.parametrize("family", ["act", "diffusion", "flow", "pi05"])
def test_what_is_trained_is_run(family, tmp_path):
    """Saved, opened and asked: the recipe's facts, and the same actions for 1, 3 and 8 worlds, bit for bit.

    What LeRobot saves of a family is taken for no other one.
    """
    torch.manual_seed(3)
    model = build(recipe(family, "small"), made_stats(), "cpu")
    model.save(tmp_path, CheckpointFacts(tasks=("boxing",), steps=1))
    weights = tmp_path / "model.safetensors"
    for kind in {kind for kind, name in FAMILY_TYPES.items() if name != family}:
        with pytest.raises(InputError, match=f"{weights}: holds the tensor .*, but config.json says type {kind}"):
            check_family(weights, kind)
    policy = LeRobotPolicy(tmp_path)
    about = policy.describe()
    assert (about["family"], about["recipe"], about["tasks"]) == (family, "small", ["boxing"])
    side = (policy.camera.height, policy.camera.width)
    seeds = (11, 12, 13)
    few = follow(policy, seeds, 2, asks=(0, 3, 5), side=side)
    many = follow(policy, [*range(100, 105), *seeds], 1, side=side)
    assert all(torch.equal(few[seed][: len(many[seed])], many[seed]) for seed in seeds)
    assert torch.equal(follow(policy, [12], 2, side=side)[12], few[12])
    assert not torch.equal(few[11], few[12])
    assert torch.isfinite(few[11]).all()
    # A suite opens one policy after the other: what is closed frees its memory at once, not when garbage is collected.
    weights_held = [weakref.ref(one) for one in policy._on(torch.device("cpu")).policy.parameters()]
    gc.disable()
    try:
        policy.close()
        assert weights_held and not any(one() is not None for one in weights_held)
    finally:
        gc.enable()
