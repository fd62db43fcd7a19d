"""Base of every family of policies: features, processors, groups of parameters, saving."""

from __future__ import annotations

import abc
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from safetensors.torch import save_file
from torch import nn

from arena_newton.errors import InputError
from arena_newton.files.own_files import PARTIAL
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.frames.feature_scaling import Scaling, Stats, scalings, usable_stats

__all__ = [
    "ACTION",
    "IMAGES",
    "PAD",
    "STATE",
    "TASK_VECTOR",
    "WEIGHTS_FILE",
    "TrainableModel",
    "Losses",
    "configuration",
    "finished",
    "new_policy",
    "prepared",
    "valid_mean",
    "with_time_axis",
]

type Losses = tuple[torch.Tensor, torch.Tensor]
"""Loss of a batch, a scalar, and each sample's part of it without a gradient, shape [B], whose mean it is."""

IMAGES = "observation.images."
"""Beginning of the key of a camera's picture, float32 [B, 3, H, W], before the camera's name."""
STATE = "observation.state"
"""Key of the canonical state."""
TASK_VECTOR = "observation.environment_state"
"""Key of the one-hot vector of the task."""
ACTION = "action"
PAD = "action_is_pad"
"""Key of the mask of actions that lie after the episode's end."""
WEIGHTS_FILE = "model.safetensors"
"""LeRobot's file of the weights."""
MIN_HALF_DIMS = 2
"""Tensors with fewer dimensions stay in float32 when a policy is saved in half precision: variances of batches can
exceed float16's range, and all vectors together are less than a hundredth of a network."""
_TORCH = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
_OURS = ("clip", "gemma")
"""Fields of a recipe's `network` that are ours and not of LeRobot's configuration."""


def configuration(recipe: TrainingRecipe, stats: Stats, device: torch.device) -> PreTrainedConfig:
    """LeRobot's configuration of a recipe's policy; nothing in it makes LeRobot download.

    Raises:
        InputError: A field of `network` is not one of LeRobot's, or the task vector's width is not known.
    """
    network = {name: value for name, value in recipe.network.items() if name not in _OURS}
    # Optimizer and schedule are the recipe's; LeRobot's fields of them would contradict it in the saved file.
    network |= {"pretrained_path": None, "optimizer_lr": recipe.lr, "optimizer_weight_decay": recipe.weight_decay}
    if "pretrained_backbone_weights" in network:
        network["pretrained_backbone_weights"] = None  # loaded by us, and a checkpoint needs no second copy
    modes = network.get("normalization_mapping", {})
    assert isinstance(modes, Mapping)
    if "dtype" in network:
        network["dtype"] = recipe.precision
    network = {name: tuple(value) if isinstance(value, list) else value for name, value in network.items()}
    network["normalization_mapping"] = {kind: NormalizationMode(mode) for kind, mode in modes.items()}
    picture = PolicyFeature(FeatureType.VISUAL, (3, recipe.height, recipe.picture))
    inputs = {name: picture for name in stats if name.startswith(IMAGES)}
    inputs[STATE] = PolicyFeature(FeatureType.STATE, tuple(stats[STATE]["mean"].shape))
    if recipe.use_task_vector:
        if "mean" not in stats.get(TASK_VECTOR, {}):
            raise InputError(f"statistics of {TASK_VECTOR}: missing, which a recipe with a task vector needs")
        inputs[TASK_VECTOR] = PolicyFeature(FeatureType.ENV, tuple(stats[TASK_VECTOR]["mean"].shape))
    outputs = {ACTION: PolicyFeature(FeatureType.ACTION, tuple(stats[ACTION]["mean"].shape))}
    quiet = logging.getLogger("lerobot.configs.policies")
    level = quiet.level
    quiet.setLevel(logging.ERROR)
    try:
        return make_policy_config(
            recipe.type, **network, input_features=inputs, output_features=outputs, device=str(device)
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"recipe {recipe.family}/{recipe.name}: {error}") from None
    finally:
        quiet.setLevel(level)


class TrainableModel(abc.ABC):
    """A policy of LeRobot with what training it needs."""

    capturable: ClassVar[bool] = True
    """True if `loss` and its backward pass can be captured in a CUDA graph."""
    compilable: ClassVar[bool] = True
    """True if `compiled_parts` can be compiled."""
    reads_task: ClassVar[bool] = False
    """True if the policy reads the task's instruction."""

    def __init__(self, recipe: TrainingRecipe, stats: Stats, device: torch.device, policy: PreTrainedPolicy):
        """Make one with processors of the statistics.

        Args:
            stats: As `usable_stats` returns them.
            policy: With the features of `configuration`.
        """
        self.recipe = recipe
        self.device = device
        self.policy = policy
        self.stats = {name: dict(values) for name, values in stats.items()}
        self.preprocess, self.postprocess = self._processors()
        config = policy.config
        modes = {
            name: config.normalization_mapping.get(one.type.value, NormalizationMode.IDENTITY).value
            for name, one in {**config.input_features, **config.output_features}.items()
        }
        self.scalings: dict[str, Scaling] = scalings(modes, self.stats, device)
        """Feature → how it is normalised; pictures from 0 to 1."""

    @property
    def samples(self) -> range:
        """Offsets of the actions of a training sample from its observation [ticks]."""
        offsets = self.policy.config.action_delta_indices
        return range(offsets[0], offsets[-1] + 1)

    @property
    def drop_last(self) -> int:
        """Ticks at the end of each episode at which no training sample begins."""
        return int(getattr(self.policy.config, "drop_n_last_frames", None) or 0)

    def normalise(self, feature: str, value: torch.Tensor) -> torch.Tensor:
        """A feature as the network receives it; pictures are uint8, or floats from 0 to 1. Safe in a CUDA graph."""
        if value.dtype == torch.uint8:
            value = value.float() / 255.0
        return self.scalings[feature].normalise(value)

    @abc.abstractmethod
    def losses(self, batch: Mapping[str, object], noise: Mapping[str, torch.Tensor] | None = None) -> Losses:
        """Loss of a normalised batch and of its samples, on the device; the host does not wait.

        Args:
            batch: As the module's `families` says.
            noise: What `noise` returns; drawn here where it is not given. Dropout, and ACT's latent, draw from torch's
                own generator, which a CUDA graph advances.
        """

    def loss(self, batch: Mapping[str, object], noise: Mapping[str, torch.Tensor] | None = None) -> torch.Tensor:
        """Loss of a normalised batch, a scalar; see `losses`."""
        return self.losses(batch, noise)[0]

    @abc.abstractmethod
    def compiled_parts(self) -> list[nn.Module]:
        """Networks of the policy that `loss` calls, for `torch.compile`; together nearly all of its work."""

    def noise(self, rows: int, generator: torch.Generator | None = None) -> dict[str, torch.Tensor]:
        """Random numbers of a batch's loss, on the device; safe in a CUDA graph that knows the generator."""
        return {}

    def tokens(self, tasks: Sequence[str], state: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Inputs of a batch in place of `task`; empty for families that read no instruction.

        Args:
            tasks: An instruction per row.
            state: Normalised states [B, 64], of families whose prompt holds the state.
        """
        return {}

    def groups(self) -> list[dict[str, object]]:
        """Groups of parameters for an optimizer, each with its highest learning rate."""
        backbone = [p for name, p in self.policy.named_parameters() if self.is_backbone(name) and p.requires_grad]
        rest = [p for name, p in self.policy.named_parameters() if not self.is_backbone(name) and p.requires_grad]
        groups = [{"params": rest, "lr": self.recipe.lr}, {"params": backbone, "lr": self.recipe.lr_backbone}]
        return [group for group in groups if group["params"]]

    def mean_error(self, errors: torch.Tensor, batch: Mapping[str, object]) -> Losses:
        """Mean of errors [B, n, 40]; where LeRobot's configuration says so, of those that are not padding."""
        if not self.policy.config.do_mask_loss_for_padding:
            return errors.mean(), errors.detach().mean(dim=(1, 2))
        return valid_mean(errors, batch)

    def is_backbone(self, parameter: str) -> bool:
        """True if a parameter, by name, belongs to the vision encoder and has the recipe's `lr_backbone`."""
        return False

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Tensors by the names that LeRobot's policy has."""
        return dict(self.policy.state_dict())

    def save(self, folder: Path, facts: CheckpointFacts, precision: str = "float32") -> None:
        """Write a checkpoint that a stock LeRobot loads.

        Args:
            folder: Made where there is none.
            facts: Of the training; what the recipe decides (family, protocol, picture) is put in here.
            precision: `float32`, or `float16` and `bfloat16` for a file of half the size, which computes in float32.

        Raises:
            InputError: The precision is not known, or a weight does not fit into it.
        """
        if precision not in _TORCH:
            raise InputError(f"precision {precision}: unknown, choose from {', '.join(_TORCH)}")
        folder.mkdir(parents=True, exist_ok=True)
        self.policy.config.save_pretrained(folder)
        self._save_weights(folder, precision)
        self.preprocess.save_pretrained(folder)
        self.postprocess.save_pretrained(folder)
        recipe = self.recipe
        replace(
            facts,
            labels=recipe.labels,
            realign=recipe.realign,
            width=recipe.picture,
            height=recipe.height,
            fit="native" if recipe.cut_pad else facts.fit,
            family=recipe.family,
            recipe=recipe.name,
        ).write(folder)

    def _save_weights(self, folder: Path, precision: str) -> None:
        tensors: dict[str, torch.Tensor] = {}
        seen: set[int] = set()
        for name, tensor in self.state_dict().items():
            if tensor.numel() and tensor.data_ptr() in seen:
                continue  # one tensor under two names: safetensors holds it once, and LeRobot ties it when loading
            seen.add(tensor.data_ptr())
            value = tensor.detach()
            if value.is_floating_point() and value.dim() >= MIN_HALF_DIMS and precision != "float32":
                value = value.to(_TORCH[precision])
                if not bool(torch.isfinite(value).all()):
                    raise InputError(f"{name}: has a weight that does not fit into {precision}")
            tensors[name] = value.cpu().contiguous()
        save_file(tensors, folder / WEIGHTS_FILE, metadata={"format": "pt"})

    def _processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        return make_pre_post_processors(self.policy.config, dataset_stats=self.stats)


def valid_mean(errors: torch.Tensor, batch: Mapping[str, object]) -> Losses:
    """Mean of errors [B, n, 40] that are not padding."""
    pad = batch[PAD]
    assert isinstance(pad, torch.Tensor)
    valid = ~pad.unsqueeze(-1)
    kept, count = errors * valid, (valid.sum() * errors.shape[-1]).clamp_min(1)
    return kept.sum() / count, kept.detach().sum(dim=(1, 2)) * (len(errors) / count)


def new_policy(config: PreTrainedConfig) -> PreTrainedPolicy:
    """A policy of LeRobot with new weights."""
    return get_policy_class(config.type)(config)


def finished(path: Path) -> Path:
    """The absolute path that something will have when it is complete, without the endings of what is being written."""
    return Path(*(part.removesuffix(PARTIAL) for part in path.resolve().parts))


def with_time_axis(config: PreTrainedConfig, batch: Mapping[str, object]) -> dict[str, object]:
    """A batch as families with an axis of observed ticks take it, pictures of all cameras stacked.

    Returns:
        `observation.state` [B, 1, 64], `observation.images` [B, 1, 1, 3, H, W] and so on; with the axis in the batch,
        its own number of ticks.
    """
    found = dict(batch)
    for name, dims in ((STATE, 2), (TASK_VECTOR, 2), *((name, 4) for name in config.image_features)):
        value = found.get(name)
        if isinstance(value, torch.Tensor) and value.dim() == dims:
            found[name] = value.unsqueeze(1)
    if config.image_features:
        pictures = [value for name in config.image_features if isinstance(value := found[name], torch.Tensor)]
        found["observation.images"] = torch.stack(pictures, dim=-4)
    return found


def prepared(recipe: TrainingRecipe, stats: Stats, device: torch.device) -> tuple[PreTrainedConfig, Stats]:
    """Configuration and usable statistics of a recipe."""
    usable = usable_stats(recipe, stats)
    return configuration(recipe, usable, device), usable
