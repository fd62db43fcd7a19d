"""LeRobot's multi-task DiT, sampling from noise that is given, and built without fetching CLIP's weights."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.multi_task_dit import modeling_multi_task_dit
from lerobot.policies.multi_task_dit.modeling_multi_task_dit import (
    DiffusionObjective,
    FlowMatchingObjective,
    MultiTaskDiTPolicy,
)
from transformers import CLIPTextConfig, CLIPTextModel, CLIPVisionConfig, CLIPVisionModel, PretrainedConfig

from arena_newton.policies.lerobot.network_noise import normal

__all__ = ["build"]


class _SeededFlow(FlowMatchingObjective):
    """LeRobot's sampling of actions by flow matching, from noise that is given."""

    drawn: Sequence[torch.Generator] = ()

    def conditional_sample(
        self, model: torch.nn.Module, batch_size: int, conditioning_vec: torch.Tensor
    ) -> torch.Tensor:
        x = normal(self.drawn, (self.horizon, self.action_dim), conditioning_vec.device)
        # On the CPU: LeRobot takes each time as a number, for which the host would wait for the device.
        times = torch.linspace(0, 1, self.config.num_integration_steps + 1)
        integrate = self._rk4_integrate if self.config.integration_method == "rk4" else self._euler_integrate
        return integrate(model, x, times, conditioning_vec)


class _SeededDiffusion(DiffusionObjective):
    """LeRobot's sampling of actions by denoising, from generators that are given."""

    drawn: Sequence[torch.Generator] = ()

    def conditional_sample(
        self, model: torch.nn.Module, batch_size: int, conditioning_vec: torch.Tensor
    ) -> torch.Tensor:
        drawn, device = list(self.drawn), conditioning_vec.device
        sample = normal(drawn, (self.horizon, self.action_dim), device)
        self.noise_scheduler.set_timesteps(self.num_inference_steps)
        for t in self.noise_scheduler.timesteps:
            times = torch.full(sample.shape[:1], int(t), dtype=torch.long, device=device)
            answer = model(sample, times, conditioning_vec=conditioning_vec)
            sample = self.noise_scheduler.step(answer, t, sample, generator=drawn).prev_sample
        return sample


def build(config: PreTrainedConfig) -> MultiTaskDiTPolicy:
    """The network with random weights; it samples from the generators that are set as its objective's `drawn`.

    Raises:
        OSError: CLIP's configuration is neither in the named folder nor in the cache of the hub.
        ValueError: The configuration contradicts itself.
    """
    with _empty_encoders():
        policy = MultiTaskDiTPolicy(config)
    kind = _SeededFlow if config.is_flow_matching else _SeededDiffusion
    policy.objective = kind(config, action_dim=config.action_feature.shape[0], horizon=config.horizon)
    return policy


class _Untrained:
    """Stands for a model of transformers: builds it from its configuration alone."""

    def __init__(self, model: Callable[..., torch.nn.Module], config: type[PretrainedConfig]):
        self._model, self._config = model, config

    def from_pretrained(self, name: str) -> torch.nn.Module:
        """A network with random weights, which those of the checkpoint replace."""
        return self._model(self._config.from_pretrained(name))


@contextmanager
def _empty_encoders() -> Iterator[None]:
    """Lets LeRobot build CLIP without fetching weights: those of the checkpoint are loaded over them all."""
    kept = {name: getattr(modeling_multi_task_dit, name) for name in ("CLIPVisionModel", "CLIPTextModel")}
    for model, config in ((CLIPVisionModel, CLIPVisionConfig), (CLIPTextModel, CLIPTextConfig)):
        if kept[model.__name__] is model:  # else a checkpoint's own architecture stands for it already
            setattr(modeling_multi_task_dit, model.__name__, _Untrained(model, config))
    try:
        yield
    finally:
        for name, model in kept.items():
            setattr(modeling_multi_task_dit, name, model)
