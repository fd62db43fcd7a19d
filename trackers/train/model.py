"""Actor and critic for rsl_rl; the actor is the tracker's own network, so that what was trained is what is shipped."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import HiddenState
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import nn

from arena_newton.trackers.inference import networks
from arena_newton.trackers.interface import get

__all__ = ["TrackerActor", "TrackerCritic", "UncheckedGaussian"]


class UncheckedGaussian(GaussianDistribution):
    """rsl_rl's, sampled without the check of the deviations, for which torch would wait for the device each tick."""

    def sample(self) -> torch.Tensor:
        """Sample, shape [rows, actions]."""
        with torch.no_grad():
            return self.mean + self.std * torch.randn_like(self.mean)


class TrackerActor(MLPModel):
    """rsl_rl's model interface around an interface's network."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        interface: str,
        network: Mapping[str, Any] | None,
        init_std: float,
        std_range: tuple[float, float] = (0.05, 2.0),
    ):
        """Make an interface's network of these widths and the action noise; the other arguments are rsl_rl's."""
        nn.Module.__init__(self)
        self.obs_groups, self.obs_dim = self._get_obs_dim(obs, obs_groups, obs_set)
        self.obs_normalization = True
        self.net = get(interface).make_network(network)
        if self.obs_dim != self.net.obs_width:
            raise ValueError(
                f"interface {interface}: {self.obs_dim} observations, its network takes {self.net.obs_width}"
            )
        self.distribution = UncheckedGaussian(output_dim, init_std=init_std, std_range=std_range, std_type="log")

    def forward(
        self,
        obs: TensorDict,
        masks: torch.Tensor | None = None,
        hidden_state: HiddenState = None,
        stochastic_output: bool = False,
    ) -> torch.Tensor:
        """Raw actions, sampled or the mean, shape [rows, actions]."""
        mean = self.net(self._pick(obs))
        if not stochastic_output:
            return mean
        self.distribution.update(mean)
        return self.distribution.sample()

    def update_normalization(self, obs: TensorDict) -> None:
        """Add a batch of observations to the network's input statistics."""
        self.net.update_norm(self._pick(obs))

    def counts(self) -> dict[str, torch.Tensor]:
        """Number of observations behind each input statistic, by module; not a part of the weights."""
        return {n: m.count for n, m in self.net.named_modules() if isinstance(m, networks.InputNorm)}

    def _pick(self, obs: TensorDict) -> torch.Tensor:
        groups = [obs[name] for name in self.obs_groups]
        return groups[0] if len(groups) == 1 else torch.cat(groups, -1)


class TrackerCritic(MLPModel):
    """rsl_rl's critic with the trackers' input statistics, whose addresses never change: a CUDA graph may use them."""

    def __init__(self, *args: Any, **kwargs: Any):
        """Take rsl_rl's arguments."""
        super().__init__(*args, **kwargs)
        if self.obs_normalization:
            self.obs_normalizer = networks.InputNorm(self.obs_dim)
