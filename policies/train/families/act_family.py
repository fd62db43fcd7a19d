"""ACT: LeRobot's policy, a loss that does not wait for the GPU, a vision encoder that learns without weights."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import nn
from torchvision.ops.misc import FrozenBatchNorm2d

from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.families.policy_model import (
    ACTION,
    Losses,
    TrainableModel,
    new_policy,
    prepared,
    valid_mean,
)
from arena_newton.policies.train.families.resnet_weights import check_resnet, load_resnet
from arena_newton.policies.train.frames.feature_scaling import Stats

__all__ = ["ActModel", "build", "check_weights", "with_batch_norm"]

_COUNTER = "num_batches_tracked"
"""A number of `BatchNorm2d` that `FrozenBatchNorm2d` has not."""


class ActModel(TrainableModel):
    """ACT and its loss."""

    def losses(self, batch: Mapping[str, object], noise: Mapping[str, torch.Tensor] | None = None) -> Losses:
        """L1 of the actions that are not padding, and the weighted divergence of the latent (`ACTPolicy.forward`)."""
        actions = batch[ACTION]
        assert isinstance(actions, torch.Tensor)
        config = self.policy.config
        inputs = {**batch, "observation.images": [batch[name] for name in config.image_features]}
        predicted, (mean, log_variance) = self.policy.model(inputs)
        loss, each = valid_mean((actions - predicted).abs(), batch)
        if mean is not None:
            divergence = (-0.5 * (1 + log_variance - mean.pow(2) - log_variance.exp())).sum(-1)
            loss = loss + divergence.mean() * config.kl_weight
            each = each + divergence.detach() * config.kl_weight
        return loss, each

    def compiled_parts(self) -> list[nn.Module]:
        """The whole network."""
        return [self.policy.model]

    def is_backbone(self, parameter: str) -> bool:
        """Those of the ResNet."""
        return parameter.startswith("model.backbone")

    def state_dict(self) -> dict[str, torch.Tensor]:
        """State without what a stock ACT, whose encoder is frozen, has no name for."""
        return {name: value for name, value in super().state_dict().items() if not name.endswith(_COUNTER)}


def with_batch_norm(network: nn.Module) -> None:
    """Replace every `FrozenBatchNorm2d` by a `BatchNorm2d` with its statistics; both compute the same in eval mode."""
    for name, module in network.named_children():
        if isinstance(module, FrozenBatchNorm2d):
            batch_norm = nn.BatchNorm2d(module.weight.shape[0], eps=module.eps).to(module.weight.device)
            batch_norm.load_state_dict(module.state_dict(), strict=False)
            setattr(network, name, batch_norm)
        else:
            with_batch_norm(module)


def check_weights(recipe: TrainingRecipe, weights: str | Path | None) -> None:
    """Check weights as `families.check_weights` does."""
    check_resnet(recipe, weights)


def build(recipe: TrainingRecipe, stats: Stats, device: torch.device, weights: str | Path | None) -> ActModel:
    """ACT of a recipe; see `families.build`."""
    config, usable = prepared(recipe, stats, device)
    policy = new_policy(config)
    wanted = weights if weights is not None else recipe.network.get("pretrained_backbone_weights")
    if wanted is not None and config.image_features:
        load_resnet(policy.model.backbone, str(config.vision_backbone), wanted)
    if recipe.batch_norm:
        with_batch_norm(policy.model.backbone)
    policy.to(device).train()
    return ActModel(recipe, usable, device, policy)
