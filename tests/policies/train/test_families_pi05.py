"""pi0.5 at a size for tests: the loss, prompts that are not cut, base weights that are loaded or refused."""

import random

import pytest
import torch
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from lerobot.processor import TransitionKey
from safetensors.torch import load_file, save_file

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.lerobot.encoder_sources import GEMMA_FILE, checkpoint_encoders
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.families import families, pretrained_weights
from arena_newton.policies.train.families.pi05_family import PADDED, load_base, prompts
from tests.fuzz.mutants import damaged
from tests.policies.train.made_stats import hold_loss, made_batch, made_stats, trained
from tests.policies.train.stock_lerobot import opened, raw_observation

SMALL = recipe("pi05", "small")
TASKS = ["Open the door.", "Sit on the sofa."]


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return families.build(SMALL, made_stats(), "cpu")


@pytest.fixture
def base(tmp_path):
    """A folder with base weights for 32 actions, of another seed, with the names of openpi's export."""
    torch.manual_seed(4)
    tensors = {name: value.clone() for name, value in families.build(SMALL, made_stats(), "cpu").state_dict().items()}
    for name, dim in PADDED.items():
        tensors[name] = tensors[name].narrow(dim, 0, 32).clone()
    del tensors["model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"]  # tied to the head
    for name in list(tensors):
        old = name.replace("model.time_mlp", "model.action_time_mlp").removeprefix("model.")
        tensors[old] = tensors.pop(name)
    tensors["state_proj.weight"] = torch.zeros(3, 3)
    save_file(tensors, tmp_path / "model.safetensors")
    return tmp_path


def test_loss_is_lerobots(model, monkeypatch):
    """With equal noise loss and gradients are `PI05Policy.forward`'s; it is the mean of its samples' losses."""
    batch, noise = made_batch(model), model.noise(2)
    monkeypatch.setattr(model.policy.model, "sample_noise", lambda shape, device: noise["noise"])
    monkeypatch.setattr(model.policy.model, "sample_time", lambda rows, device: noise["time"])
    hold_loss(model, lambda: model.loss(batch, noise), lambda: model.policy.forward(batch)[0])
    loss, each = model.losses(batch, noise)
    assert torch.allclose(each.mean(), loss) and each[0] != each[1]
    assert noise["noise"].shape == (2, 20, 40)


def test_times_are_of_lerobots_distribution(model):
    """The times have the distribution of LeRobot's sampler."""
    torch.manual_seed(0)
    ours, theirs = model.noise(20_000)["time"], model.policy.model.sample_time(20_000, torch.device("cpu"))
    at = torch.linspace(0.05, 0.95, 19)
    assert (torch.quantile(ours, at) - torch.quantile(theirs, at)).abs().max() < 0.015


def test_prompts_are_lerobots(model):
    """Instruction and all 64 numbers of the state are in the prompt, as LeRobot's processors write and tokenize it."""
    state = torch.randn(2, 64, generator=torch.Generator().manual_seed(2))
    step = Pi05PrepareStateTokenizerProcessorStep(max_state_dim=64)
    transition = {
        TransitionKey.OBSERVATION: {"observation.state": state},
        TransitionKey.COMPLEMENTARY_DATA: {"task": list(TASKS)},
    }
    assert prompts(TASKS, state) == step(transition)[TransitionKey.COMPLEMENTARY_DATA]["task"]
    theirs = model.preprocess({"observation.state": state, "task": list(TASKS)})
    for name, value in model.tokens(TASKS, theirs["observation.state"]).items():
        assert torch.equal(theirs[name], value)


def test_a_prompt_that_would_be_cut_is_refused():
    """LeRobot's 200 tokens would lose the end of the state; that is reported, with the numbers."""
    model = families.build(recipe("pi05", "small", network={"tokenizer_max_length": 200}), made_stats(), "cpu")
    with pytest.raises(InputError, match=r"has 2\d\d tokens, the policy reads 200 \(tokenizer_max_length\)"):
        made_batch(model)
    with pytest.raises(InputError, match="the prompt holds the state"):
        model.tokens(TASKS)


def test_dims_that_do_not_fit_are_refused():
    """LeRobot's 32 numbers of action and state are refused before anything is built."""
    for name, size in (("max_action_dim", 40), ("max_state_dim", 64)):
        with pytest.raises(InputError, match=f"{name} is 32, expected {size} or more"):
            families.build(recipe("pi05", "small", network={name: 32}), made_stats(), "cpu")


def test_base_weights_are_all_there(base):
    """Every tensor of the file is in the policy, the wider projections are the file's and zeros."""
    model = families.build(SMALL, made_stats(), "cpu", weights=base)
    tensors, loaded = load_file(base / "model.safetensors"), model.policy.state_dict()
    for name, value in tensors.items():
        name = "model." + name.replace("action_time_mlp", "time_mlp")
        if name in PADDED:
            kept = loaded[name].narrow(PADDED[name], 0, 32)
            rest = loaded[name].narrow(PADDED[name], 32, 8)
            assert torch.equal(kept, value) and not rest.any()
        elif "state_proj" not in name:
            assert torch.equal(loaded[name], value), name
    head = loaded["model.paligemma_with_expert.paligemma.lm_head.weight"]
    assert torch.equal(loaded["model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"], head)
    assert len(model.weights_checksum) == 64
    model.loss(made_batch(model)).backward()
    assert model.policy.model.action_in_proj.weight.grad[:, 32:].any(), "what was zero learns"


def test_base_weights_that_do_not_fit_are_refused(base):
    """A missing, unknown or differently shaped tensor ends the training before it begins; LeRobot would go on."""
    path = base / "model.safetensors"
    whole = load_file(path)
    name = "paligemma_with_expert.gemma_expert.model.layers.0.mlp.up_proj.weight"

    def refused(tensors, match):
        save_file(tensors, path)
        with pytest.raises(InputError, match=match):
            families.build(SMALL, made_stats(), "cpu", weights=base)

    refused({key: value for key, value in whole.items() if key != name}, f"1 missing, model.{name}")
    refused(whole | {"extra.weight": torch.zeros(2)}, "1 unknown, model.extra.weight")
    refused(whole | {name: whole[name][:-1].clone()}, r"has shape \[63, 32\], the policy's \[64, 32\]")
    refused(whole | {"action_out_proj.bias": torch.zeros(48)}, r"action_out_proj.bias has shape \[48\]")
    path.unlink()
    with pytest.raises(InputError, match=r"holds no model\.safetensors"):
        families.build(SMALL, made_stats(), "cpu", weights=base)


def test_damaged_base_weights_are_one_clear_error(base, model, mutants):
    """Each of the mutated files is loaded completely or refused with one error that names the file."""
    path = base / "model.safetensors"
    refused = 0
    whole, rng = path.read_bytes(), random.Random(1)
    header = 8 + int.from_bytes(whole[:8], "little")
    for _ in range(mutants):
        path.write_bytes(damaged(whole[:header], rng) + whole[header:])
        try:
            assert len(load_base(model.policy, path)) == 64
        except InputError as error:
            assert "model.safetensors" in str(error)
            refused += 1
    assert refused > mutants // 2


def test_a_policy_that_lost_weights_is_noticed(base, monkeypatch):
    """The checksum fails where loading silently did nothing."""
    model = families.build(SMALL, made_stats(), "cpu")
    monkeypatch.setattr(model.policy, "load_state_dict", lambda *_, **__: None)
    with pytest.raises(InputError, match="does not hold the file's weights after loading"):
        load_base(model.policy, base / "model.safetensors")


def test_checkpoint_in_lerobot(model, tmp_path):
    """A trained checkpoint gives LeRobot's classes the same actions from the same noise."""
    trained(model, torch.optim.AdamW)
    model.save(tmp_path, CheckpointFacts())
    assert (tmp_path / GEMMA_FILE).is_file() and (tmp_path / "tokenizer" / "tokenizer.json").is_file()
    with checkpoint_encoders(tmp_path):
        policy, before, after = opened(tmp_path)
    noise = torch.randn(2, 20, 40)
    ours = model.postprocess(model.policy.predict_action_chunk(model.preprocess(raw_observation()), noise=noise))
    theirs = after(policy.predict_action_chunk(before(raw_observation()), noise=noise))
    assert ours.shape == (2, 20, 40)
    assert torch.allclose(ours, theirs, atol=1e-6)
    model.policy.train()
    assert (model.samples, model.drop_last, model.capturable) == (range(20), 0, False)


def test_a_frozen_vision_encoder_stays(base):
    """With the `released` recipe's `freeze_vision_encoder` training moves everything but the vision tower."""
    frozen = recipe("pi05", "released").network["freeze_vision_encoder"]
    model = families.build(
        recipe("pi05", "small", network={"freeze_vision_encoder": frozen}), made_stats(), "cpu", base
    )
    before = {name: value.clone() for name, value in model.state_dict().items()}
    optimizer = torch.optim.AdamW(model.groups(), lr=1e-3)
    model.loss(made_batch(model)).backward()
    optimizer.step()
    moved = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert moved and not any(model.is_backbone(name) for name in moved)


def test_absent_base_weights(monkeypatch, tmp_path):
    """The paper's recipe without base weights is one clear error, before 3.6 billion parameters are made."""
    monkeypatch.setattr(pretrained_weights.constants, "HF_HUB_OFFLINE", True)
    paper = recipe("pi05", "paper")
    with pytest.raises(InputError, match=r"lerobot/pi05_base.*--weights FOLDER"):
        families.build(paper, made_stats(), "cpu")
    with pytest.raises(InputError, match=r"holds no model\.safetensors"):
        families.build(paper, made_stats(), "cpu", weights=tmp_path)
