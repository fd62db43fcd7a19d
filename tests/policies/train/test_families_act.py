"""ACT: the loss, the vision encoder, checkpoints that a stock LeRobot loads."""

import json

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from safetensors.torch import load_file, save_file
from torchvision.models import resnet18

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.families import families
from tests.policies.train.made_stats import hold_loss, made_batch, made_stats, trained
from tests.policies.train.stock_lerobot import opened, raw_observation

SMALL = recipe("act", "small")


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return families.build(SMALL, made_stats(), "cpu")


def test_loss_is_lerobots(model):
    """Loss and gradients, with dropout and latent, are `ACTPolicy.forward`'s; it is the mean of its samples' losses."""
    batch = made_batch(model)
    hold_loss(model, lambda: model.loss(batch, model.noise(2)), lambda: model.policy.forward(batch)[0])
    loss, each = model.losses(batch)
    assert torch.allclose(each.mean(), loss) and each[0] != each[1]


def test_padding_does_not_count(model):
    """Actions after the episode's end do not change the loss."""
    model.policy.eval()
    batch = made_batch(model)
    before = model.loss(batch, {})
    batch["action"] = batch["action"].clone()
    batch["action"][-1, -3:] += 100.0
    assert torch.equal(model.loss(batch, {}), before)
    model.policy.train()


def test_checkpoint_in_a_stock_lerobot(model, tmp_path):
    """A trained checkpoint, BatchNorm inside, gives a stock ACT the same actions, from a raw observation."""
    trained(model, torch.optim.AdamW, {})
    model.save(tmp_path, CheckpointFacts(tasks=("boxing",), steps=2))
    policy, before, after = opened(tmp_path)
    observation = raw_observation()
    model.policy.eval()
    ours = model.postprocess(model.policy.predict_action_chunk(model.preprocess(dict(observation))))
    theirs = after(policy.predict_action_chunk(before(dict(observation))))
    assert ours.shape == (2, 20, 40)
    assert torch.allclose(ours, theirs, atol=1e-5)
    model.policy.train()
    assert not torch.allclose(model.policy.model.backbone.bn1.running_mean, torch.zeros(64)), "statistics were learned"
    facts = CheckpointFacts.read(tmp_path)
    assert (facts.labels, facts.realign, facts.family, facts.recipe) == ("v4", 0.002, "act", "small")
    assert (facts.width, facts.height, facts.tasks, facts.steps) == (64, 64, ("boxing",), 2)
    assert json.loads((tmp_path / "config.json").read_text())["pretrained_backbone_weights"] is None


def test_normalisation_is_lerobots(model):
    """Normalisation on the GPU is that of LeRobot's processors, constant numbers included."""
    observation = raw_observation()
    theirs = model.preprocess(dict(observation))
    for name in ("observation.images.front", "observation.state"):
        assert torch.allclose(model.normalise(name, observation[name]), theirs[name], atol=1e-5), name
    actions = torch.randn(5, 40) * 0.3
    ours = model.scalings["action"].restore(actions)
    assert torch.allclose(ours, model.postprocess(actions), atol=1e-5)
    assert model.stats["action"]["std"].min() == SMALL.action_std_floor


def test_half_precision(model, tmp_path):
    """A float16 file has half the size, computes in float32 and gives nearly the same actions."""
    model.policy.eval()
    model.save(tmp_path / "full", CheckpointFacts())
    model.save(tmp_path / "half", CheckpointFacts(), precision="float16")
    sizes = [(tmp_path / name / "model.safetensors").stat().st_size for name in ("full", "half")]
    assert sizes[1] < 0.51 * sizes[0]
    policy, before, after = opened(tmp_path / "half")
    assert {p.dtype for p in policy.parameters()} == {torch.float32}
    observation = raw_observation()
    ours = model.policy.predict_action_chunk(model.preprocess(dict(observation)))
    half = policy.predict_action_chunk(before(dict(observation)))
    assert 0.0 < (ours - half).abs().max() < 0.01
    model.policy.train()
    with pytest.raises(InputError, match="precision int8: unknown"):
        model.save(tmp_path / "int8", CheckpointFacts(), precision="int8")


def test_a_weight_beyond_half_precision_is_refused(tmp_path):
    """A weight that float16 cannot hold is named, not written as infinity."""
    model = families.build(SMALL, made_stats(), "cpu")
    with torch.no_grad():
        model.policy.model.action_head.weight[0, 0] = 1e6
    with pytest.raises(InputError, match=r"model\.action_head\.weight.*float16"):
        model.save(tmp_path, CheckpointFacts(), precision="float16")


def test_task_vector(tmp_path):
    """A recipe with a task vector acts by the task, and is refused without the vector's width."""
    wanted = recipe("act", "small", use_task_vector=True)
    with pytest.raises(InputError, match="environment_state: missing"):
        families.build(wanted, made_stats(), "cpu")
    model = families.build(wanted, made_stats(tasks=7), "cpu")
    model.policy.eval()
    batch = made_batch(model, tasks=7)
    same = {name: value[:1].repeat(2, *[1] * (value.dim() - 1)) for name, value in batch.items()}
    same["observation.environment_state"] = torch.eye(7)[:2]
    first, second = model.policy.predict_action_chunk(same)
    assert not torch.allclose(first, second)
    model.save(tmp_path, CheckpointFacts(task_vector=tuple("abcdefg")))
    policy, before, _ = opened(tmp_path)
    vector = before(raw_observation() | {"observation.environment_state": torch.eye(7)[:2]})
    assert torch.equal(vector["observation.environment_state"], torch.eye(7)[:2])
    assert torch.allclose(policy.predict_action_chunk(same)[0], first, atol=1e-6)


def test_compact_fits_in_32_mb(tmp_path):
    """A policy of seven tasks and two trackers: at most 32 MB in half precision with all its files."""
    model = families.build(recipe("act", "compact"), made_stats(tasks=7 + 3), "cpu")
    assert sum(p.numel() for p in model.policy.parameters()) < 16e6
    model.save(tmp_path, CheckpointFacts(), precision="float16")
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 32e6


def test_groups_hold_each_parameter_once(model):
    """Every parameter that learns is in one group, the encoder's with its own learning rate."""
    groups = model.groups()
    found = [id(p) for group in groups for p in group["params"]]
    assert sorted(found) == sorted(id(p) for p in model.policy.parameters() if p.requires_grad)
    assert len(groups[1]["params"]) == sum("backbone" in name for name, _ in model.policy.named_parameters())


@pytest.mark.parametrize(("ending", "batch_norm"), [("safetensors", True), ("pth", False)])
def test_pretrained_encoder_from_a_file(tmp_path, ending, batch_norm):
    """A file with torchvision's ResNet is loaded, frozen or with BatchNorm; another network's is refused."""
    torch.manual_seed(5)
    tensors = resnet18().state_dict()
    path = tmp_path / f"weights.{ending}"
    save_file(tensors, path) if ending == "safetensors" else torch.save(tensors, path)
    model = families.build(recipe("act", "small", batch_norm=batch_norm), made_stats(), "cpu", weights=path)
    assert torch.equal(model.policy.model.backbone.layer4[1].conv2.weight, tensors["layer4.1.conv2.weight"])
    del tensors["layer4.1.conv2.weight"]
    save_file(tensors, path) if ending == "safetensors" else torch.save(tensors, path)
    with pytest.raises(InputError, match=r"not those of a resnet18 \(layer4.1.conv2.weight"):
        families.build(SMALL, made_stats(), "cpu", weights=path)


def test_saved_tensors_are_finite_and_named_as_lerobots(model, tmp_path):
    """The file has exactly the tensors of a stock ACT."""
    model.save(tmp_path, CheckpointFacts())
    names = set(load_file(tmp_path / "model.safetensors"))
    policy = get_policy_class("act")(PreTrainedConfig.from_pretrained(tmp_path))
    assert names == set(policy.state_dict())
