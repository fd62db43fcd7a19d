"""ACT for inference, in torch alone.

The computation and the names of the weights are those of LeRobot 0.6.1 (`policies/act/modeling_act.py`, Zhao et al.
2023, https://huggingface.co/papers/2304.13705), so that the same file of weights is loaded by both; a test holds the
two together. What only training needs (dropout, the encoder of the latent) is absent. LeRobot itself takes several
times the start of the simulation to import, which a run of a packed policy does not wait for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional

from arena_newton.trackers.inference.blocks import OnnxProduct, compiled

__all__ = ["ACTIVATIONS", "BLOCKS", "ActNetwork", "ActSizes"]

BLOCKS = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3)}
"""Vision encoder → residual blocks of its four stages (He et al. 2015); the larger ones have blocks of another kind."""
WIDTHS = (64, 128, 256, 512)
"""Channels of the four stages."""
ACTIVATIONS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {"relu": functional.relu, "gelu": functional.gelu}
"""Names that a configuration may have."""
TEMPERATURE = 10_000.0
"""Ratio of the longest to the shortest wave of the positions' code (Vaswani et al. 2017)."""
POSITION_EPS = 1e-6
"""Keeps the positions of a picture below a whole turn, as LeRobot's do."""


@dataclass(frozen=True, kw_only=True)
class ActSizes:
    """Sizes that decide the network's shapes; names are those of LeRobot's configuration."""

    state: int
    """Numbers of the state."""
    tasks: int
    """Width of the vector of task and tracker; 0: none."""
    actions: int
    """Numbers of an action."""
    chunk_size: int
    """Actions of an answer."""
    vision_backbone: str = "resnet18"
    dim_model: int = 512
    n_heads: int = 8
    dim_feedforward: int = 3200
    feedforward_activation: str = "relu"
    n_encoder_layers: int = 4
    n_decoder_layers: int = 1
    latent_dim: int = 32
    pre_norm: bool = False


class FrozenNorm(nn.Module):
    """Normalisation of a picture's channels by stored statistics; goes into the convolution before it when folded."""

    eps = 1e-5

    def __init__(self, channels: int):
        """Identity until weights are loaded."""
        super().__init__()
        for name, value in (("weight", 1.0), ("bias", 0.0), ("running_mean", 0.0), ("running_var", 1.0)):
            self.register_buffer(name, torch.full((channels,), value))

    def factors(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Scale and shift, shape [channels] each."""
        stored = dict(self.named_buffers())
        scale = stored["weight"] * (stored["running_var"] + self.eps).rsqrt()
        return scale, stored["bias"] - stored["running_mean"] * scale

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalised pictures [B, channels, H, W]."""
        scale, shift = self.factors()
        return x * scale[:, None, None] + shift[:, None, None]


def _positions(count: int, width: int) -> nn.Embedding:
    """Learned positions; an embedding's own random numbers load seconds of torch on the device `meta`."""
    return nn.Embedding.from_pretrained(torch.rand(count, width), freeze=False)


def _convolution(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, size, stride=stride, padding=size // 2, bias=False)


class ResidualBlock(nn.Module):
    """Two convolutions beside a short cut."""

    def __init__(self, inputs: int, outputs: int, stride: int):
        """Make one with random weights."""
        super().__init__()
        self.conv1, self.bn1 = _convolution(inputs, outputs, 3, stride), FrozenNorm(outputs)
        self.conv2, self.bn2 = _convolution(outputs, outputs, 3), FrozenNorm(outputs)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(_convolution(inputs, outputs, 1, stride), FrozenNorm(outputs))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Features [B, outputs, H / stride, W / stride]."""
        short = x if self.downsample is None else self.downsample(x)
        x = functional.relu(self.bn1(self.conv1(x)), inplace=True)
        return functional.relu(self.bn2(self.conv2(x)) + short, inplace=True)


class VisionEncoder(nn.Module):
    """A residual network without its classifier."""

    def __init__(self, name: str):
        """Make one with random weights.

        Args:
            name: A key of `BLOCKS`.
        """
        super().__init__()
        self.conv1, self.bn1 = _convolution(3, WIDTHS[0], 7, 2), FrozenNorm(WIDTHS[0])
        before = WIDTHS[0]
        for stage, (width, count) in enumerate(zip(WIDTHS, BLOCKS[name], strict=True), start=1):
            strides = [1 if stage == 1 else 2, *[1] * (count - 1)]
            blocks = [ResidualBlock(before if i == 0 else width, width, stride) for i, stride in enumerate(strides)]
            self.add_module(f"layer{stage}", nn.Sequential(*blocks))
            before = width

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        """Features of pictures [B, 3, H, W], shape [B, 512, H / 32, W / 32]."""
        x = functional.relu(self.bn1(self.conv1(picture)), inplace=True)
        x = functional.max_pool2d(x, 3, stride=2, padding=1)
        for stage in range(1, 5):
            x = self.get_submodule(f"layer{stage}")(x)
        return x

    def fold(self) -> None:
        """Put every normalisation into the convolution before it; the weights' names are other ones afterwards."""
        for owner, conv, norm in list(_pairs(self)):
            convolution, frozen = owner.get_submodule(conv), owner.get_submodule(norm)
            assert isinstance(convolution, nn.Conv2d) and isinstance(frozen, FrozenNorm)
            scale, shift = frozen.factors()
            convolution.weight = nn.Parameter(convolution.weight * scale[:, None, None, None], requires_grad=False)
            convolution.bias = nn.Parameter(shift, requires_grad=False)
            setattr(owner, norm, nn.Identity())


def _pairs(module: nn.Module) -> Iterator[tuple[nn.Module, str, str]]:
    """Owner and names of each convolution and of the normalisation behind it."""
    for owner in module.modules():
        names = dict(owner.named_children())
        for conv, norm in (("conv1", "bn1"), ("conv2", "bn2"), ("0", "1")):
            if isinstance(names.get(conv), nn.Conv2d) and isinstance(names.get(norm), FrozenNorm):
                yield owner, conv, norm


class AttentionLayer(nn.Module):
    """A layer of the encoder, or of the decoder with `crossed` attention to what the encoder says."""

    def __init__(self, sizes: ActSizes, crossed: bool):
        """Make one with random weights."""
        super().__init__()
        width, self.pre_norm, self.crossed = sizes.dim_model, sizes.pre_norm, crossed
        self.activation = ACTIVATIONS[sizes.feedforward_activation]
        self.self_attn = nn.MultiheadAttention(width, sizes.n_heads)
        self.linear1, self.linear2 = nn.Linear(width, sizes.dim_feedforward), nn.Linear(sizes.dim_feedforward, width)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        if crossed:
            self.multihead_attn, self.norm3 = nn.MultiheadAttention(width, sizes.n_heads), nn.LayerNorm(width)

    def forward(
        self,
        x: torch.Tensor,
        position: torch.Tensor,
        seen: torch.Tensor | None = None,
        seen_position: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Tokens [tokens, B, width] after the layer; `seen` are those of the encoder."""

        def attend(x: torch.Tensor) -> torch.Tensor:
            asked = x + position
            return self.self_attn(asked, asked, x, need_weights=False)[0]

        def cross(x: torch.Tensor) -> torch.Tensor:
            assert seen is not None and seen_position is not None
            return self.multihead_attn(x + position, seen + seen_position, seen, need_weights=False)[0]

        def think(x: torch.Tensor) -> torch.Tensor:
            return self.linear2(self.activation(self.linear1(x)))

        steps = [(attend, self.norm1), *([(cross, self.norm2)] if self.crossed else [])]
        steps.append((think, self.norm3 if self.crossed else self.norm2))
        for work, norm in steps:
            x = x + work(norm(x)) if self.pre_norm else norm(x + work(x))
        return x


class LayerStack(nn.Module):
    """Layers and the normalisation behind them."""

    def __init__(self, sizes: ActSizes, crossed: bool):
        """Make one with random weights."""
        super().__init__()
        count = sizes.n_decoder_layers if crossed else sizes.n_encoder_layers
        self.layers = nn.ModuleList([AttentionLayer(sizes, crossed) for _ in range(count)])
        self.norm: nn.Module = nn.LayerNorm(sizes.dim_model) if crossed or sizes.pre_norm else nn.Identity()


class ActNetwork(nn.Module):
    """One picture, a state and a task in, a chunk of actions out; all of them normalised."""

    def __init__(self, sizes: ActSizes):
        """Make one with random weights; see `load`."""
        super().__init__()
        width = sizes.dim_model
        self.sizes = sizes
        self.backbone = VisionEncoder(sizes.vision_backbone)
        self.encoder, self.decoder = LayerStack(sizes, False), LayerStack(sizes, True)
        self.encoder_robot_state_input_proj = nn.Linear(sizes.state, width)
        if sizes.tasks:
            self.encoder_env_state_input_proj = nn.Linear(sizes.tasks, width)
        self.encoder_latent_input_proj = nn.Linear(sizes.latent_dim, width)
        self.encoder_img_feat_input_proj = nn.Conv2d(WIDTHS[-1], width, 1)
        self.encoder_1d_feature_pos_embed = _positions(3 if sizes.tasks else 2, width)
        self.decoder_pos_embed = _positions(sizes.chunk_size, width)
        self.action_head = nn.Linear(width, sizes.actions)
        self._on_host: OnnxProduct | None = None

    def on_host(self, height: int, width: int) -> None:
        """Have ONNX Runtime compute on the CPU, in half of torch's time.

        Args:
            height: Of the pictures [px].
            width: Of the pictures [px].

        Raises:
            InputError: It computes something else than torch.
        """
        if self._on_host is None:
            row = _Row(self, height, width)
            self._on_host = compiled(row, (1, 3 * height * width + row.rest), rtol=1e-3, atol=1e-3)

    def answer(
        self, picture: torch.Tensor, state: torch.Tensor, task: torch.Tensor | None, threads: int
    ) -> torch.Tensor:
        """Actions of a query as `forward` has them, on the CPU by ONNX Runtime on some threads once it is `on_host`.

        Numbers of threads do not change its bits.
        """
        if self._on_host is None or picture.device.type != "cpu":
            actions: torch.Tensor = self(picture, state, task)
            return actions
        given = [picture.flatten(1), state, *([] if task is None else [task])]
        return self._on_host.on(threads)(torch.cat(given, dim=1))

    def load(self, weights: dict[str, torch.Tensor]) -> None:
        """Take weights by their names in LeRobot's file, `model.` in front, widened to float32, ready to compute.

        Raises:
            KeyError: A name is missing or not of this network.
            RuntimeError: A shape is another one.
        """
        own = {name: weights[f"model.{name}"] for name in self.state_dict()}
        unknown = sorted(set(weights) - {f"model.{name}" for name in own})
        if unknown:
            raise KeyError(unknown[0])
        self.load_state_dict({name: value.to(torch.float32, copy=True) for name, value in own.items()}, assign=True)
        self.requires_grad_(False).eval()
        self.backbone.fold()

    def forward(self, picture: torch.Tensor, state: torch.Tensor, task: torch.Tensor | None) -> torch.Tensor:
        """Actions of a query.

        Args:
            picture: Shape [B, 3, H, W].
            state: Shape [B, state].
            task: Shape [B, tasks]; None for networks without a task vector.

        Returns:
            Shape [B, chunk_size, actions].
        """
        rows = len(state)
        tokens = [self.encoder_latent_input_proj(state.new_zeros(rows, self.sizes.latent_dim))]
        tokens.append(self.encoder_robot_state_input_proj(state))
        if task is not None:
            tokens.append(self.encoder_env_state_input_proj(task))
        features = self.backbone(picture)
        where = _picture_positions(features, self.sizes.dim_model // 2)
        features = self.encoder_img_feat_input_proj(features)
        seen = torch.cat([torch.stack(tokens), features.flatten(2).permute(2, 0, 1)])
        named = self.encoder_1d_feature_pos_embed.weight
        seen_position = torch.cat([named, where])[:, None]
        for layer in self.encoder.layers:
            seen = layer(seen, seen_position)
        seen = self.encoder.norm(seen)
        position = self.decoder_pos_embed.weight[:, None]
        chunk = state.new_zeros(self.sizes.chunk_size, rows, self.sizes.dim_model)
        for layer in self.decoder.layers:
            chunk = layer(chunk, position, seen, seen_position)
        return self.action_head(self.decoder.norm(chunk).transpose(0, 1))


class _Row(nn.Module):
    """The network of one tensor: picture, state and task of a query behind each other."""

    def __init__(self, network: ActNetwork, height: int, width: int):
        """Take the network and the size of its pictures [px]."""
        super().__init__()
        self.network, self.size = network, (3, height, width)
        self.rest = network.sizes.state + network.sizes.tasks

    def forward(self, row: torch.Tensor) -> torch.Tensor:
        """Actions [B, chunk_size, actions] of rows [B, 3 * height * width + state + tasks]."""
        sizes = self.network.sizes
        widths = [math.prod(self.size), sizes.state, *([sizes.tasks] if sizes.tasks else [])]
        picture, state, *task = row.split(widths, dim=1)
        actions: torch.Tensor = self.network(picture.unflatten(1, self.size), state, task[0] if task else None)
        return actions


def _picture_positions(features: torch.Tensor, half: int) -> torch.Tensor:
    """Code of each position of a feature map [B, C, H, W], row by row, shape [H * W, 2 * half].

    Waves of the row, then of the column, each a sine and a cosine in turn.
    """
    height, width = features.shape[2:]
    index = torch.arange(half, dtype=torch.float32, device=features.device)
    period = TEMPERATURE ** (2 * (index // 2) / half)

    def waves(count: int) -> torch.Tensor:
        at = torch.arange(1, count + 1, dtype=torch.float32, device=features.device)
        phase = (at / (count + POSITION_EPS) * 2 * math.pi)[:, None] / period
        return torch.stack([phase[:, 0::2].sin(), phase[:, 1::2].cos()], dim=-1).flatten(1)

    rows, columns = waves(height)[:, None].expand(-1, width, -1), waves(width)[None].expand(height, -1, -1)
    return torch.cat([rows, columns], dim=-1).flatten(0, 1)
