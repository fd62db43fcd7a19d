"""The networks of our own trackers; training and deployment use the same modules.

Input normalisation lives inside: a network takes the front end's observation as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn

from arena_newton.errors import InputError

__all__ = ["InputNorm", "SonicNet", "Symmetric", "Twist2Net", "make"]

TWIST2_WIDTH = 1432
"""Width of TWIST2's observation."""
SONIC_ENCODER_WIDTH = 1762
"""Width of the input of SONIC's encoder."""
SONIC_PROPRIO_WIDTH = 930
"""Width of what SONIC's decoder sees besides the latent."""
SONIC_WIDTH = SONIC_ENCODER_WIDTH + SONIC_PROPRIO_WIDTH
"""Width of SONIC's observation: encoder input, then proprioception."""
SONIC_USED = (slice(4, 584), slice(595, 661))
"""Encoder inputs of mode 0: joint positions and velocities of ten frames, the anchor, the anchor of ten frames."""
_SONIC_FRAME = (slice(4, 33), slice(294, 323), slice(595, 601))
"""One frame of them: joint positions and velocities, and the anchor."""
JOINTS = 29

_STD_FLOOR = 1e-2
"""Added to the measured deviation, so that an input that never moved does not explode when it first does."""
_WIDEST = 8192
"""Widest layer that a file may ask for."""
_LAST_LAYER_SCALE = 0.1
"""A network starts near zero, that is near the reference or the default pose."""


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
        """Take a batch into the running statistics, together with those of the other processes, if there are any.

        Args:
            x: Inputs, shape [rows, width].
        """
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


def _mlp(widths: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for a, b in zip(widths, widths[1:], strict=False):
        layers += [nn.Linear(a, b), nn.ELU()]
    return nn.Sequential(*layers[:-1])


def _folded(layer: nn.Module, norm: InputNorm, start: int = 0) -> nn.Linear:
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


def _shrink_last(layers: nn.Sequential) -> None:
    last = layers[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.mul_(_LAST_LAYER_SCALE)
        last.bias.zero_()


class Twist2Net(nn.Module):
    """1432 observations → 29 raw actions."""

    interface = "twist2"
    obs_width = TWIST2_WIDTH

    def __init__(self, hidden: Sequence[int] = (512, 512, 256)):
        """Make the layers.

        Args:
            hidden: Widths of the hidden layers.
        """
        super().__init__()
        self.hidden = tuple(hidden)
        self.norm = InputNorm(self.obs_width)
        self.actor = _mlp((self.obs_width, *self.hidden, JOINTS))
        _shrink_last(self.actor)

    def config(self) -> dict[str, Any]:
        """Arguments that make this network again."""
        return {"hidden": list(self.hidden)}

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Raw actions, shape [rows, 29]."""
        return self.actor(self.norm(obs))

    def deployed(self) -> nn.Module:
        """The same function with the normalisation inside the first layer."""
        return nn.Sequential(_folded(self.actor[0], self.norm), *list(self.actor)[1:]).eval().requires_grad_(False)

    def update_norm(self, obs: torch.Tensor) -> None:
        """Take a batch of observations into the input statistics."""
        self.norm.update(obs)


class SonicNet(nn.Module):
    """Encoder of the reference → bounded latent; latent and proprioception → decoder → 29 raw actions."""

    interface = "sonic"
    obs_width = SONIC_WIDTH

    used: torch.Tensor
    """Indices of the encoder inputs that the encoder reads, shape [646]."""

    def __init__(
        self,
        encoder: Sequence[int] = (512, 256),
        decoder: Sequence[int] = (512, 512, 256),
        latent: int = 64,
    ):
        """Make the layers.

        Args:
            encoder: Widths of the encoder's hidden layers.
            decoder: Widths of the decoder's hidden layers.
            latent: Width of the latent.
        """
        super().__init__()
        self.widths = tuple(encoder), tuple(decoder), latent
        used = torch.cat([torch.arange(s.start, s.stop) for s in SONIC_USED])
        self.register_buffer("used", used, persistent=False)
        self.encoder_norm = InputNorm(len(used))
        self.decoder_norm = InputNorm(SONIC_PROPRIO_WIDTH)
        self.encoder = nn.Sequential(*_mlp((len(used), *encoder, latent)), nn.Tanh())
        self.decoder = _mlp((latent + SONIC_PROPRIO_WIDTH, *decoder, JOINTS))
        _shrink_last(self.decoder)

    def config(self) -> dict[str, Any]:
        """Arguments that make this network again."""
        encoder, decoder, latent = self.widths
        return {"encoder": list(encoder), "decoder": list(decoder), "latent": latent}

    def encode(self, reference: torch.Tensor) -> torch.Tensor:
        """Latent in (-1, 1) of encoder inputs [rows, 1762], shape [rows, latent]."""
        return self.encoder(self.encoder_norm(reference.index_select(1, self.used)))

    def decode(self, latent: torch.Tensor, proprio: torch.Tensor) -> torch.Tensor:
        """Raw actions of latents [rows, latent] and proprioception [rows, 930], shape [rows, 29]."""
        return self.decoder(torch.cat((latent, self.decoder_norm(proprio)), 1))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Raw actions of observations [rows, 2692], shape [rows, 29]."""
        return self.decode(self.encode(obs), obs[:, SONIC_ENCODER_WIDTH:])

    def update_norm(self, obs: torch.Tensor) -> None:
        """Take a batch of observations into the input statistics."""
        self.encoder_norm.update(obs.index_select(1, self.used))
        self.decoder_norm.update(obs[:, SONIC_ENCODER_WIDTH:])

    def deployed(self) -> nn.Module:
        """The same function with normalisation inside the first layers and one frame of the reference instead of ten.

        It needs what `SonicFrontEnd` gives: ten equal frames.
        """
        return _DeployedSonic(self).eval().requires_grad_(False)


class _DeployedSonic(nn.Module):
    def __init__(self, network: SonicNet):
        super().__init__()
        assert isinstance(network.encoder, nn.Sequential)
        first = _folded(network.encoder[0], network.encoder_norm)
        # Of the used inputs: 10 x 29 positions, 10 x 29 velocities, the anchor, 10 x 6 anchors.
        weight = first.weight.detach().double()
        pos, vel, anchor, anchors = weight.split([290, 290, 6, 60], 1)
        frames = [part.unflatten(1, (10, -1)).sum(1) for part in (pos, vel)]
        merged = torch.cat([*frames, anchor + anchors.unflatten(1, (10, 6)).sum(1)], 1)
        layer = nn.Linear(merged.shape[1], first.out_features, device=merged.device)
        with torch.no_grad():
            layer.weight.copy_(merged)
            layer.bias.copy_(first.bias)
        self.encoder = nn.Sequential(layer, *list(network.encoder)[1:])
        self.decoder = nn.Sequential(
            _folded(network.decoder[0], network.decoder_norm, network.widths[2]), *list(network.decoder)[1:]
        )

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self._act(torch.cat([obs[:, part] for part in _SONIC_FRAME], 1), obs[:, SONIC_ENCODER_WIDTH:])

    def columns(self) -> torch.Tensor:
        """Columns of the observation that are read, in the order of `from_columns`, shape [994]."""
        read = (*_SONIC_FRAME, slice(SONIC_ENCODER_WIDTH, SONIC_WIDTH))
        return torch.cat([torch.arange(part.start, part.stop) for part in read])

    def from_columns(self, used: torch.Tensor) -> torch.Tensor:
        """Raw actions of those columns, shape [rows, 29]."""
        reference = used.shape[1] - SONIC_PROPRIO_WIDTH
        return self._act(used[:, :reference], used[:, reference:])

    def _act(self, reference: torch.Tensor, proprio: torch.Tensor) -> torch.Tensor:
        return self.decoder(torch.cat((self.encoder(reference), proprio), 1))


class Symmetric(nn.Module):
    """The mean of a network's two ways to an action: straight, and mirrored there and back.

    A network has a preferred side that no training takes away wholly; the mean has none, whatever the network.
    """

    used: torch.Tensor
    obs_index: torch.Tensor
    obs_sign: torch.Tensor
    action_index: torch.Tensor
    action_sign: torch.Tensor

    def __init__(
        self,
        network: nn.Module,
        obs: tuple[torch.Tensor, torch.Tensor],
        action: tuple[torch.Tensor, torch.Tensor],
    ):
        """Join network and mirrors.

        Args:
            network: Maps [rows, obs_width] to [rows, action_width], each row by itself.
            obs: Index and sign of an observation's mirror image, each of shape [obs_width].
            action: Index and sign of a raw action's mirror image, each of shape [action_width].
        """
        super().__init__()
        self.network = network
        if isinstance(network, _DeployedSonic):  # it reads some of its columns and is mirrored in those alone
            columns = network.columns()
            self.register_buffer("used", columns)
            obs = obs[0][columns], obs[1][columns]
        for name, tensor in zip(("obs_index", "obs_sign", "action_index", "action_sign"), (*obs, *action), strict=True):
            self.register_buffer(name, tensor)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Raw actions, shape [rows, 29]."""
        image = obs.index_select(1, self.obs_index) * self.obs_sign
        if isinstance(self.network, _DeployedSonic):
            both = self.network.from_columns(torch.cat((obs.index_select(1, self.used), image)))
        else:
            both = self.network(torch.cat((obs, image)))
        straight, mirrored = both.chunk(2)
        return (straight + mirrored.index_select(1, self.action_index) * self.action_sign) * 0.5


_NETWORKS: dict[str, type[Twist2Net] | type[SonicNet]] = {"twist2": Twist2Net, "sonic": SonicNet}


def make(interface: str, config: Mapping[str, Any] | None = None) -> Twist2Net | SonicNet:
    """A fresh network of an interface.

    Args:
        interface: `twist2` or `sonic`.
        config: What `config()` of such a network gave; default widths without it.

    Raises:
        InputError: Unknown interface, or arguments that do not fit it.
    """
    if interface not in _NETWORKS:
        raise InputError(f"network interface {interface!r}: known are {', '.join(_NETWORKS)}")
    config = dict(config or {})
    widths = [w for value in config.values() for w in (value if isinstance(value, list | tuple) else [value])]
    if not all(isinstance(w, int) and 0 < w <= _WIDEST for w in widths):
        raise InputError(f"network of interface {interface!r}: widths must be whole numbers up to {_WIDEST}: {config}")
    try:
        return _NETWORKS[interface](**config)
    except TypeError as error:
        raise InputError(f"network of interface {interface!r}: unfit arguments {config}: {error}") from error
