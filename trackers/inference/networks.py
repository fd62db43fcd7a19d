"""Modules of our own trackers' networks; training and deployment use the same modules.

A network takes the front end's observation as it is: it normalises its inputs itself.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

__all__ = ["InputNorm", "PartialNetwork", "Symmetric", "TrackerNetwork", "folded", "mlp", "shrink_last"]

_STD_FLOOR = 1e-2
"""Added to the measured deviation, so that an input that never moved does not explode when it first does."""
_LAST_LAYER_SCALE = 0.1


class InputNorm(nn.Module):
    """(x - mean) / std with statistics kept in buffers."""

    mean: torch.Tensor
    std: torch.Tensor
    count: torch.Tensor

    def __init__(self, width: int):
        """Start as the identity."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("std", torch.ones(width))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalised inputs, shape [rows, width]."""
        return (x - self.mean) / self.std

    @torch.no_grad()
    def update(self, x: torch.Tensor) -> None:
        """Take inputs, shape [rows, width], of all processes into the running statistics."""
        rows = torch.full((), x.shape[0], dtype=torch.float64, device=x.device)
        # Sums around the present mean keep their precision in float32.
        centred = x - self.mean
        sums = torch.stack([centred.mean(0), centred.square().mean(0)]).double() * rows
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(rows)
            torch.distributed.all_reduce(sums)
        total = self.count + rows
        shift = sums[0] / total
        old = torch.where(self.count > 0, (self.std - _STD_FLOOR).double().square(), 0.0) * self.count
        variance = ((old + sums[1]) / total - shift.square()).clamp_min(0.0)
        self.mean += shift.float()
        self.std.copy_(variance.sqrt().float() + _STD_FLOOR)
        self.count.copy_(total)


class TrackerNetwork(nn.Module, abc.ABC):
    """A network that is trained: observations [rows, obs_width] → raw actions [rows, 29], each row by itself."""

    obs_width: int
    """Width of the observation."""

    @abc.abstractmethod
    def config(self) -> dict[str, Any]:
        """Arguments that make this network again."""

    @abc.abstractmethod
    def deployed(self) -> nn.Module:
        """The same function with the normalisation inside the first layers."""

    @abc.abstractmethod
    def update_norm(self, obs: torch.Tensor) -> None:
        """Take a batch of observations, shape [rows, obs_width], into the input statistics."""


class PartialNetwork(nn.Module, abc.ABC):
    """A deployed network that reads some columns of the observation; it is mirrored in those alone."""

    @abc.abstractmethod
    def columns(self) -> torch.Tensor:
        """Columns that are read, in the order of `from_columns`."""

    @abc.abstractmethod
    def from_columns(self, used: torch.Tensor) -> torch.Tensor:
        """Raw actions of those columns, shape [rows, 29]."""


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """Linear layers of these widths with ELU between them."""
    layers: list[nn.Module] = []
    for a, b in zip(widths, widths[1:], strict=False):
        layers += [nn.Linear(a, b), nn.ELU()]
    return nn.Sequential(*layers[:-1])


def folded(layer: nn.Module, norm: InputNorm, start: int = 0) -> nn.Linear:
    """A linear layer that takes its inputs from `start` on as they were before `norm`."""
    assert isinstance(layer, nn.Linear)
    weight, bias = layer.weight.detach().double(), layer.bias.detach().double()
    scaled = weight.clone()
    scaled[:, start:] /= norm.std.double()
    folded = nn.Linear(layer.in_features, layer.out_features, device=layer.weight.device)
    with torch.no_grad():
        folded.weight.copy_(scaled)
        folded.bias.copy_(bias - scaled[:, start:] @ norm.mean.double())
    return folded


def shrink_last(layers: nn.Sequential) -> None:
    """Scale the last layer down: a new network starts near the reference or the default pose."""
    last = layers[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.mul_(_LAST_LAYER_SCALE)
        last.bias.zero_()


class Symmetric(nn.Module):
    """Average of the action and the mirrored action of the mirrored observation (left-right symmetric policy).

    A network has a preferred side that no training removes wholly; the average has none, whatever the network.
    """

    used: torch.Tensor
    obs_index: torch.Tensor
    obs_sign: torch.Tensor
    action_index: torch.Tensor
    action_sign: torch.Tensor

    def __init__(
        self, network: nn.Module, obs: tuple[torch.Tensor, torch.Tensor], action: tuple[torch.Tensor, torch.Tensor]
    ):
        """Join network and mirrors.

        Args:
            network: Maps [rows, obs_width] to [rows, action_width], each row by itself.
            obs: Index and sign of an observation's mirror image, each of shape [obs_width].
            action: Index and sign of a raw action's mirror image, each of shape [action_width].
        """
        super().__init__()
        self.network = network
        if isinstance(network, PartialNetwork):
            columns = network.columns()
            self.register_buffer("used", columns)
            obs = obs[0][columns], obs[1][columns]
        for name, tensor in zip(("obs_index", "obs_sign", "action_index", "action_sign"), (*obs, *action), strict=True):
            self.register_buffer(name, tensor)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Raw actions, shape [rows, 29]."""
        image = obs.index_select(1, self.obs_index) * self.obs_sign
        if isinstance(self.network, PartialNetwork):
            both = self.network.from_columns(torch.cat((obs.index_select(1, self.used), image)))
        else:
            both = self.network(torch.cat((obs, image)))
        straight, mirrored = both.chunk(2)
        return (straight + mirrored.index_select(1, self.action_index) * self.action_sign) * 0.5
