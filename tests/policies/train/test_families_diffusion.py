"""Diffusion Policy: the loss, checkpoints that a stock LeRobot loads."""

import pytest
import torch
from safetensors.torch import save_file
from torchvision import models

from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.families import families
from tests.policies.train.made_stats import hold_loss, made_batch, made_stats, observed, trained
from tests.policies.train.stock_lerobot import opened, raw_observation

SMALL = recipe("diffusion", "small")


@pytest.fixture(scope="module")
def model(narrow_resnet):
    torch.manual_seed(0)
    return families.build(SMALL, made_stats(), "cpu")


@pytest.mark.parametrize(("prediction", "mask"), [("epsilon", False), ("sample", True)])
def test_loss_is_lerobots(model, monkeypatch, mask, prediction):
    """With equal noise loss and gradients are `DiffusionPolicy.forward`'s; it is the mean of its samples' losses."""
    monkeypatch.setattr(model.policy.config, "do_mask_loss_for_padding", mask)
    monkeypatch.setattr(model.policy.config, "prediction_type", prediction)
    batch = made_batch(model)
    ours, theirs = lambda: model.loss(batch), lambda: model.policy.forward(observed(batch))[0]
    hold_loss(model, ours, theirs, rtol=1e-3, atol=1e-6)
    loss, each = model.losses(batch)
    assert torch.allclose(each.mean(), loss) and each[0] != each[1]


def test_noise_decides_the_loss(model):
    """Equal noise gives an equal loss, a generator of another seed another one; a time axis changes nothing."""
    model.policy.eval()
    batch = made_batch(model)
    drawn = [model.noise(2, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    losses = [model.loss(batch, noise) for noise in drawn]
    assert torch.equal(losses[0], losses[1]) and not torch.equal(losses[0], losses[2])
    assert torch.equal(model.loss(observed(batch), drawn[0]), losses[0])
    model.policy.train()


def test_checkpoint_in_a_stock_lerobot(model, tmp_path):
    """A trained checkpoint gives a stock LeRobot the same actions from the same noise."""
    trained(model, torch.optim.Adam)
    model.save(tmp_path, CheckpointFacts())
    policy, before, after = opened(tmp_path)
    observation, noise = raw_observation(), torch.randn(2, 24, 40)
    model.policy.eval()

    def act(policy, before, after):
        seen = before(dict(observation))
        seen["observation.state"] = seen["observation.state"].unsqueeze(1)
        return after(policy.predict_action_chunk(seen, noise=noise))

    ours, theirs = act(model.policy, model.preprocess, model.postprocess), act(policy, before, after)
    assert ours.shape == (2, 20, 40)
    assert torch.allclose(ours, theirs, atol=1e-6)
    model.policy.train()
    assert CheckpointFacts.read(tmp_path).family == "diffusion"
    assert (model.samples, model.drop_last) == (range(24), 4)


def test_normalisation_is_lerobots(model):
    """Ranges of constant numbers do not blow up what leaves them, and both normalisations are the same."""
    observation = raw_observation()
    theirs = model.preprocess(dict(observation))
    ours = model.normalise("observation.state", observation["observation.state"])
    assert torch.allclose(ours, theirs["observation.state"], rtol=1e-4, atol=1e-4)
    span = model.stats["observation.state"]["max"] - model.stats["observation.state"]["min"]
    assert span.min() >= 2 * SMALL.state_std_floor * 0.999


def test_pretrained_encoder_and_groups(narrow_resnet, tmp_path):
    """A local ResNet is put into the encoder, whose parameters have their own learning rate."""
    torch.manual_seed(5)
    tensors = models.resnet18().state_dict()
    save_file(tensors, tmp_path / "model.safetensors")
    model = families.build(recipe("diffusion", "small", lr_backbone=1e-5), made_stats(), "cpu", weights=tmp_path)
    encoder = model.policy.diffusion.rgb_encoder[0].backbone
    assert torch.equal(encoder[7][1].conv2.weight, tensors["layer4.1.conv2.weight"])
    rest, backbone = model.groups()
    assert backbone["lr"] == 1e-5 and len(backbone["params"]) == len(list(encoder.parameters()))
    assert len(rest["params"]) + len(backbone["params"]) == len(list(model.policy.parameters()))


def test_task_vector(narrow_resnet):
    """The task vector reaches the network."""
    model = families.build(recipe("diffusion", "small", use_task_vector=True), made_stats(tasks=3), "cpu")
    model.policy.eval()
    batch, noise = made_batch(model, tasks=3), model.noise(2)
    other = {**batch, "observation.environment_state": batch["observation.environment_state"].flip(0)}
    assert not torch.equal(model.loss(batch, noise), model.loss(other, noise))
