"""Pretrained weights that are absent or damaged are refused before anything that takes time."""

import dataclasses

import pytest
import torch
from safetensors.torch import save_file
from torchvision.models import resnet18

from arena_newton.errors import InputError
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train import training
from arena_newton.policies.train.families import families, pretrained_weights
from arena_newton.policies.train.policy_options import PolicyTrainOptions
from tests.policies.train.small_dataset import info

FAMILIES = ("act", "diffusion", "flow", "pi05")
NAMES = {"act": "resnet18", "diffusion": "resnet18", "flow": "CLIP", "pi05": "pi0.5"}


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """No hub."""
    monkeypatch.setattr(pretrained_weights.constants, "HF_HUB_OFFLINE", True)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("wanted", ["absent/{family}", "somebody/absent-{family}", "empty", "damaged"])
def test_no_picture_is_decoded_for_a_training_that_cannot_begin(dataset, tmp_path, monkeypatch, family, wanted):
    """A folder or name that is not there, an empty folder and a damaged file give one error, and nothing is decoded."""
    for folder in ("empty_clip", "damaged_clip"):
        (tmp_path / folder).mkdir()
    (tmp_path / "damaged_clip" / "model.safetensors").write_bytes(b"\xff" * 100)
    given = {
        "empty": str(tmp_path / "empty_clip"),
        "damaged": str(tmp_path / "damaged_clip"),
        "absent/{family}": str(tmp_path / "absent" / family),
    }.get(wanted, wanted.format(family=family))
    monkeypatch.setattr(training, "load_frames", lambda *a, **k: pytest.fail("pictures were decoded"))
    flags = PolicyTrainOptions(
        policy=family, recipe="small", dataset=(dataset,), out=tmp_path / "out", device="cpu", weights=given, quiet=True
    )
    with pytest.raises(InputError, match=rf"{given}") as error:
        training.train(flags)
    assert NAMES[family] in str(error.value) or "safetensors" in str(error.value)
    assert not (tmp_path / "out").exists() and info(dataset)


@pytest.mark.parametrize("family", ["act", "diffusion"])
def test_weights_that_are_there_are_not_read(tmp_path, monkeypatch, family):
    """Looking for weights reads no tensor and makes no network; without `--weights` a small recipe needs none."""
    torch.manual_seed(0)
    save_file(resnet18().state_dict(), tmp_path / "weights.safetensors")
    monkeypatch.setattr(torch.nn.Module, "__init__", lambda self, *a, **k: pytest.fail("a network was made"))
    families.check_weights(recipe(family, "small"), tmp_path)
    families.check_weights(recipe(family, "small"), tmp_path / "weights.safetensors")
    for name in FAMILIES:
        families.check_weights(recipe(name, "small"))


@pytest.mark.parametrize("family", FAMILIES)
def test_weights_of_the_papers_recipe(family, monkeypatch, tmp_path):
    """Without `--weights` those that the paper's recipe names are looked for."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    paper = recipe(family, "paper")
    if family in ("act", "diffusion"):
        paper = dataclasses.replace(paper, network={**paper.network, "pretrained_backbone_weights": "a/b"})
    with pytest.raises(InputError, match="HF_HUB_OFFLINE forbids"):
        families.check_weights(paper)
