"""Flow matching: the loss, CLIP from a folder or from new weights, checkpoints that a stock LeRobot loads."""

import socket

import pytest
import torch
from safetensors.torch import load_file, save_file

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.lerobot.encoder_sources import checkpoint_encoders, made_clip, made_tokenizer, write_clip
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.families import families, pretrained_weights
from arena_newton.policies.train.families.policy_model import with_time_axis
from tests.policies.train.made_stats import hold_loss, made_batch, made_stats, observed, trained
from tests.policies.train.stock_lerobot import opened, raw_observation

SMALL = recipe("flow", "small")
NAME = "openai/clip-vit-base-patch16"


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return families.build(SMALL, made_stats(), "cpu")


@pytest.fixture(scope="module")
def clip_folder(model, tmp_path_factory):
    """A tiny CLIP as transformers writes one."""
    folder = tmp_path_factory.mktemp("clip_tiny")
    torch.manual_seed(9)
    encoder = families.build(SMALL, made_stats(), "cpu").policy.observation_encoder
    write_clip(folder, model.clip, encoder.vision_encoder.model, encoder.text_encoder.text_encoder)
    model.tokenizer.save_pretrained(folder)
    return folder


@pytest.mark.parametrize("mask", [False, True])
def test_loss_is_lerobots(model, monkeypatch, mask):
    """With equal noise loss and gradients are `MultiTaskDiTPolicy.forward`'s; it is the mean of its samples' losses."""
    model.policy.eval()
    monkeypatch.setattr(model.policy.config, "do_mask_loss_for_padding", mask)
    monkeypatch.setattr(model.policy.objective, "do_mask_loss_for_padding", mask)
    batch, noise = made_batch(model), model.noise(2)
    monkeypatch.setattr(model.policy.objective, "_sample_timesteps", lambda rows, device: noise["time"])
    monkeypatch.setattr(torch, "randn_like", lambda value: noise["noise"])
    ours, theirs = lambda: model.loss(batch, noise), lambda: model.policy.forward(observed(batch))[0]
    hold_loss(model, ours, theirs, rtol=1e-4, atol=1e-7)
    loss, each = model.losses(batch, noise)
    assert torch.allclose(each.mean(), loss) and each[0] != each[1]
    model.policy.train()


def test_times_are_of_lerobots_distribution(model):
    """The times without a wait for the host have the distribution of LeRobot's sampler."""
    torch.manual_seed(0)
    ours = model.noise(20_000)["time"]
    theirs = model.policy.objective._sample_timesteps(20_000, torch.device("cpu"))
    at = torch.linspace(0.05, 0.95, 19)
    assert (torch.quantile(ours, at) - torch.quantile(theirs, at)).abs().max() < 0.015


def test_task_strings_and_tokens(model):
    """A batch with strings gives the loss of one with their tokens; instructions matter; a long one is refused."""
    model.policy.eval()
    batch, noise = made_batch(model), model.noise(2)
    strings = {name: value for name, value in batch.items() if "language" not in name}
    tasks = ["Open the door.", "Sit on the sofa."]
    assert torch.equal(model.loss(strings | {"task": tasks}, noise), model.loss(batch, noise))
    encoder = model.policy.observation_encoder  # the network itself begins blind to what it is conditioned on
    seen = with_time_axis(model.policy.config, batch)
    assert not torch.equal(encoder.encode(seen | model.tokens(tasks[::-1])), encoder.encode(seen))
    theirs = model.preprocess({"observation.state": torch.zeros(2, 64), "task": tasks})
    for name, value in model.tokens(tasks).items():
        assert torch.equal(theirs[name], value)
    with pytest.raises(InputError, match="has .* tokens, the policy reads 32"):
        model.tokens(["Zyx " * 40])
    with pytest.raises(InputError, match="neither tokens nor a task"):
        model.loss(strings, noise)
    model.policy.train()


def chunk(policy, before, after, seed=11):
    """Actions of a raw observation; the noise is that of torch's generator."""
    torch.manual_seed(seed)
    seen = before(raw_observation())
    pictures = seen.pop("observation.images.front")
    seen["observation.images"] = pictures[:, None, None]
    seen["observation.state"] = seen["observation.state"].unsqueeze(1)
    with torch.no_grad():
        return after(policy._generate_actions(seen))


def test_checkpoint_in_a_stock_lerobot(model, tmp_path, capsys):
    """A trained checkpoint, saved silently, gives a stock LeRobot the same actions, with its encoders and tokenizer."""
    trained(model, torch.optim.Adam)
    folder = tmp_path / "first"
    capsys.readouterr()
    model.save(folder, CheckpointFacts())
    assert not capsys.readouterr().err, "no progress bar of transformers"
    model.policy.eval()
    ours = chunk(model.policy, model.preprocess, model.postprocess)
    assert ours.shape == (2, 20, 40)
    assert torch.allclose(ours, chunk(*opened(folder)), atol=1e-6)
    moved = folder.rename(tmp_path / "second")
    with checkpoint_encoders(moved):
        assert torch.allclose(ours, chunk(*opened(moved)), atol=1e-6), "and where the folder has moved"
    model.policy.train()
    assert (model.samples, model.drop_last) == (range(40), 20)


def test_clip_from_a_folder(clip_folder, tmp_path):
    """CLIP and tokenizer are those of the folder, which a checkpoint names; the encoder has its learning rate."""
    model = families.build(recipe("flow", "small", lr_backbone=1e-6), made_stats(), "cpu", weights=clip_folder)
    tensors = load_file(clip_folder / "model.safetensors")
    loaded = model.policy.observation_encoder.vision_encoder.model.state_dict()
    assert all(torch.equal(loaded[name], tensors[name]) for name in loaded if name in tensors)
    assert len(set(loaded) & set(tensors)) > 10
    rest, vision = model.groups()
    assert vision["lr"] == 1e-6 and len(vision["params"]) == len(loaded) - sum(
        "position_ids" in name for name in loaded
    )
    assert not any(
        p is q for q in rest["params"] for p in model.policy.observation_encoder.text_encoder.text_encoder.parameters()
    )
    model.save(tmp_path, CheckpointFacts())
    model.policy.eval()
    ours = chunk(model.policy, model.preprocess, model.postprocess)
    assert torch.allclose(ours, chunk(*opened(tmp_path)), atol=1e-6)
    assert not (tmp_path / "clip" / "model.safetensors").exists(), "its weights are in the checkpoint's own file"
    with checkpoint_encoders(tmp_path):
        assert torch.allclose(ours, chunk(*opened(tmp_path)), atol=1e-6)


def test_an_incomplete_clip_is_refused(clip_folder, tmp_path):
    """Weights that are missing are not drawn at random, as transformers would; other faults are named."""
    folder = tmp_path / "clip_broken"
    folder.mkdir()
    for path in clip_folder.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    tensors = load_file(folder / "model.safetensors")
    del tensors["vision_model.post_layernorm.weight"]
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InputError, match=r"incomplete, post_layernorm|incomplete, vision_model\.post_layernorm"):
        families.build(SMALL, made_stats(), "cpu", weights=folder)
    (folder / "model.safetensors").unlink()
    with pytest.raises(InputError, match="holds no weights of CLIP"):
        families.build(SMALL, made_stats(), "cpu", weights=folder)
    with pytest.raises(InputError, match="sees pictures of 64 pixels"):
        families.build(recipe("flow", "small", picture=80), made_stats(), "cpu", weights=clip_folder)
    empty = tmp_path / "clip_empty"
    empty.mkdir()
    with pytest.raises(InputError, match="holds no CLIP"):
        families.build(SMALL, made_stats(), "cpu", weights=empty)


def test_an_absent_hub_is_one_clear_error(monkeypatch, tmp_path):
    """Offline, unreachable or misspelt: one message with the name, the cache and `--weights FOLDER`, at once."""
    monkeypatch.setattr(pretrained_weights.constants, "HF_HUB_OFFLINE", True)
    paper = recipe("flow", "paper", picture=64)
    with pytest.raises(InputError, match=f"{NAME}.*cache.*HF_HUB_OFFLINE.*--weights FOLDER"):
        families.build(paper, made_stats(), "cpu")
    with pytest.raises(InputError, match="no such folder"):
        families.build(paper, made_stats(), "cpu", weights=tmp_path / "absent")
    monkeypatch.setattr(pretrained_weights.constants, "HF_HUB_OFFLINE", False)
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        monkeypatch.setattr(pretrained_weights.constants, "ENDPOINT", f"http://127.0.0.1:{closed.getsockname()[1]}")
        with pytest.raises(InputError, match=r"api/models/openai.*refused.*--weights FOLDER"):
            families.build(paper, made_stats(), "cpu")


def test_made_clip_sizes():
    """Sizes that cannot be are refused with their names."""
    with pytest.raises(InputError, match="expected heads, hidden, layers, patch"):
        made_clip({"hidden": 30, "layers": 1, "heads": 4, "patch": 16}, 64, 32, made_tokenizer())
