"""Diffusion Policy: LeRobot's policy with a loss whose random numbers are given."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import nn

from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.families.policy_model import (
    ACTION,
    Losses,
    TrainableModel,
    new_policy,
    prepared,
    with_time_axis,
)
from arena_newton.policies.train.families.resnet_weights import check_resnet, load_resnet
from arena_newton.policies.train.frames.feature_scaling import Stats

__all__ = ["DiffusionModel", "build", "check_weights"]


class DiffusionModel(TrainableModel):
    """Diffusion Policy and its loss."""

    def __init__(self, recipe: TrainingRecipe, stats: Stats, device: torch.device, policy: PreTrainedPolicy):
        """Make one with the noise schedule on the device: LeRobot's copies it there in every step."""
        super().__init__(recipe, stats, device, policy)
        kept = policy.diffusion.noise_scheduler.alphas_cumprod.to(device)
        self._signal, self._noise = kept**0.5, (1.0 - kept) ** 0.5

    def noise(self, rows: int, generator: torch.Generator | None = None) -> dict[str, torch.Tensor]:
        """`noise` [rows, horizon, 40], standard normal, and `time` [rows], steps of the diffusion."""
        config = self.policy.config
        shape = (rows, config.horizon, config.action_feature.shape[0])
        noise = torch.randn(shape, device=self.device, generator=generator)
        time = torch.randint(0, len(self._signal), (rows,), device=self.device, generator=generator)
        return {"noise": noise, "time": time}

    def losses(self, batch: Mapping[str, object], noise: Mapping[str, torch.Tensor] | None = None) -> Losses:
        """Squared error of the predicted noise or actions (`DiffusionModel.compute_loss` of LeRobot)."""
        actions = batch[ACTION]
        assert isinstance(actions, torch.Tensor)
        drawn = self.noise(len(actions)) if noise is None else noise
        seen = self.policy.diffusion._prepare_global_conditioning(with_time_axis(self.policy.config, batch))
        time = drawn["time"]
        noisy = self._signal[time][:, None, None] * actions + self._noise[time][:, None, None] * drawn["noise"]
        predicted = self.policy.diffusion.unet(noisy, time, global_cond=seen)
        wanted = drawn["noise"] if self.policy.config.prediction_type == "epsilon" else actions
        return self.mean_error((predicted - wanted) ** 2, batch)

    def compiled_parts(self) -> list[nn.Module]:
        """The vision encoders and the U-Net."""
        encoders = self.policy.diffusion.rgb_encoder
        each = list(encoders) if self.policy.config.use_separate_rgb_encoder_per_camera else [encoders]
        return [*each, self.policy.diffusion.unet]

    def is_backbone(self, parameter: str) -> bool:
        """Those of the ResNet."""
        return parameter.startswith("diffusion.rgb_encoder") and ".backbone." in parameter


def check_weights(recipe: TrainingRecipe, weights: str | Path | None) -> None:
    """Check weights as `families.check_weights` does."""
    check_resnet(recipe, weights)


def build(recipe: TrainingRecipe, stats: Stats, device: torch.device, weights: str | Path | None) -> DiffusionModel:
    """Diffusion Policy of a recipe; see `families.build`."""
    config, usable = prepared(recipe, stats, device)
    policy = new_policy(config)
    wanted = weights if weights is not None else recipe.network.get("pretrained_backbone_weights")
    if wanted is not None:
        encoders = policy.diffusion.rgb_encoder
        for encoder in encoders if config.use_separate_rgb_encoder_per_camera else [encoders]:
            load_resnet(encoder.backbone, str(config.vision_backbone), wanted)
    policy.to(device).train()
    return DiffusionModel(recipe, usable, device, policy)
