"""Pretrained weights of a ResNet: torchvision's by name, or a local file."""

from __future__ import annotations

import pickle
import urllib.error
import urllib.request
from pathlib import Path

import torch
import torchvision
from torch import nn

from arena_newton.errors import InputError
from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.families.pretrained_weights import (
    PATIENCE,
    check_safetensors,
    read_safetensors,
    weights_folder,
)

__all__ = ["check_resnet", "find_resnet", "load_resnet"]

_SEQUENTIAL = {"0": "conv1", "1": "bn1", "4": "layer1", "5": "layer2", "6": "layer3", "7": "layer4"}
"""Children of LeRobot's diffusion encoder → names of torchvision."""
_FILES = ("*.safetensors", "*.pth", "*.bin", "*.json")
DEFAULT_BACKBONE = "resnet18"
"""LeRobot's, where a recipe names none."""
_HEAD = "fc."
"""The layer that names ImageNet's classes; no policy has it."""


def load_resnet(backbone: nn.Module, kind: str, wanted: object) -> None:
    """Put pretrained weights into a policy's vision encoder.

    Args:
        backbone: ACT's `IntermediateLayerGetter` or the `Sequential` of Diffusion Policy.
        kind: torchvision's name, such as `resnet18`.
        wanted: torchvision's weights (`ResNet18_Weights.IMAGENET1K_V1`), a file or folder with a state dict of
            torchvision's names (safetensors or pth), or a name on the Hugging Face hub.

    Raises:
        InputError: They are not there, or are those of another network.
    """
    path = find_resnet(kind, wanted)
    found = _read(path) if isinstance(path, Path) else path.get_state_dict(progress=False, check_hash=True)
    tensors = {name: value for name, value in found.items() if not name.startswith(_HEAD)}
    if isinstance(backbone, nn.Sequential):
        numbers = {name: number for number, name in _SEQUENTIAL.items()}
        tensors = {
            ".".join([numbers.get(first, first), *rest]): value
            for (first, *rest), value in ((name.split("."), value) for name, value in tensors.items())
        }
    own = backbone.state_dict()
    counters = {name for name in {*own, *tensors} if name.endswith("num_batches_tracked")}
    wrong = sorted((set(own) ^ set(tensors)) - counters)
    wrong += sorted(name for name in set(own) & set(tensors) - counters if own[name].shape != tensors[name].shape)
    if wrong:
        raise InputError(f"weights {wanted}: not those of a {kind} ({wrong[0]} and {len(wrong) - 1} others do not fit)")
    backbone.load_state_dict({name: value for name, value in tensors.items() if name in own}, strict=False)


def check_resnet(recipe: TrainingRecipe, weights: str | Path | None) -> None:
    """Make sure that the weights of a recipe's vision encoder are there.

    Raises:
        InputError: They are not.
    """
    wanted = weights if weights is not None else recipe.network.get("pretrained_backbone_weights")
    if wanted is not None:
        find_resnet(str(recipe.network.get("vision_backbone", DEFAULT_BACKBONE)), wanted)


def find_resnet(kind: str, wanted: object) -> Path | torchvision.models.WeightsEnum:
    """Location of pretrained weights; nothing is loaded.

    Args:
        kind: As of `load_resnet`.
        wanted: As of `load_resnet`.

    Returns:
        A file, or torchvision's weights, which are in its cache or at their address.

    Raises:
        InputError: They are not there.
    """
    text = str(wanted)
    if text.endswith("_V1") or "_Weights." in text:
        return _torchvision(kind, text)
    path = Path(text).expanduser()
    if not path.is_file():
        folder = weights_folder(text, f"{kind} weights", _FILES)
        files = sorted(one for pattern in _FILES[:3] for one in folder.glob(pattern))
        if not files:
            raise InputError(f"--weights {folder}: holds no weights of a {kind} ({', '.join(_FILES[:3])})")
        path = files[0]
    if path.suffix == ".safetensors":
        check_safetensors(path)
    return path


def _read(path: Path) -> dict[str, torch.Tensor]:
    if path.suffix == ".safetensors":
        return read_safetensors(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(f"{path}: not readable as a state dict ({error})") from None
    if not isinstance(content, dict) or not all(isinstance(one, torch.Tensor) for one in content.values()):
        raise InputError(f"{path}: expected a state dict of tensors")
    return content


def _torchvision(kind: str, name: str) -> torchvision.models.WeightsEnum:
    """Torchvision's weights, which are in its cache or at their address."""
    enum = torchvision.models.get_model_weights(kind)
    short = name.rpartition(".")[2]
    if short not in enum.__members__:
        raise InputError(f"weights {name}: unknown, torchvision has {', '.join(enum.__members__)} of {kind}")
    weights: torchvision.models.WeightsEnum = enum[short]
    cached = Path(torch.hub.get_dir()) / "checkpoints" / weights.url.rpartition("/")[2]
    if not cached.is_file():
        try:
            request = urllib.request.Request(weights.url, method="HEAD")
            urllib.request.urlopen(request, timeout=PATIENCE).close()
        except (OSError, urllib.error.URLError) as error:
            raise InputError(
                f"ResNet weights {name}: not in {cached}, and {weights.url} does not give them ({error}); "
                f"--weights FILE takes a local copy"
            ) from None
    return weights
