"""Size of a network's parameters: memory of a GPU in training, and the disk for a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from arena_newton.policies.recipes.training_recipe import TrainingRecipe

__all__ = ["checkpoint_bytes", "network_bytes"]

CONTEXT_BYTES = 2 * 2**30
"""CUDA's own, workspaces of cuDNN and cuBLAS, and what torch's allocator keeps unused."""


@dataclass(frozen=True)
class NetworkSize:
    """Memory of a family's largest network during training."""

    parameters: int
    parameter_bytes: int
    """Bytes of a parameter: itself, its gradient, AdamW's two moments, and their copies while a graph is captured."""
    sample_bytes: int
    """Activations of a sample that the backward pass needs."""
    stored_bytes: int
    """Bytes of a parameter in a checkpoint: itself, and AdamW's two moments where it is trained."""


SIZES = {
    # float32: 16, a copy of weights and moments for the capture 12, the weights in bfloat16 2. Activations: ACT with
    # batch 64 in bfloat16 was measured at 2.6 GB in all; ResNet-18 in float32 has twice as much.
    "act": NetworkSize(52_000_000, 30, 30_000_000, 12),
    "diffusion": NetworkSize(263_000_000, 30, 60_000_000, 12),
    # ViT-B/16 and CLIP's text encoder (150 million), the transformer (50 million). In float32 each of the vision
    # encoder's 12 layers keeps about 15 vectors of 768 for each of 197 tokens. The text encoder has no moments.
    "flow": NetworkSize(200_000_000, 30, 130_000_000, 9),
    # 3.2 billion parameters in bfloat16 (8 bytes with gradient and moments), 0.4 billion of the vision tower in float32
    # (16 bytes): 9 on average; no graph. Layers are computed again in the backward pass: 18 inputs of 600 tokens of
    # 2048 numbers are kept, and one layer's activations (0.2 MB a token) exist at a time.
    "pi05": NetworkSize(3_620_000_000, 9, 250_000_000, 6),
}
"""Memory of `paper`, which no other recipe exceeds; counted, and computed where nothing was measured."""

SMALLER = {
    ("act", "fast"): 34_200_000,
    ("diffusion", "fast"): 76_000_000,
    ("flow", "fast"): 64_000_000,
    ("act", "compact"): 15_600_000,
}
"""Parameters of networks that are smaller than their family's largest, with new weights; counted."""


def network_bytes(recipe: TrainingRecipe, device: torch.device, cameras: int = 1) -> int:
    """Memory that a training must find beside its pictures [bytes].

    Args:
        recipe: Family and batch size count; the networks of `small` are too small to.
        device: On a host 0: its memory is not divided into a network's and pictures' here.
        cameras: Pictures of a sample, each of which is encoded.
    """
    if device.type != "cuda":
        return 0
    if recipe.name == "small":
        return CONTEXT_BYTES
    size = SIZES[recipe.family]
    return CONTEXT_BYTES + size.parameters * size.parameter_bytes + recipe.batch_size * size.sample_bytes * cameras


def checkpoint_bytes(recipe: TrainingRecipe, *, pretrained: bool) -> int:
    """Disk that a checkpoint with its training state takes [bytes]; 0 for `small`: its networks are too small to count.

    Args:
        recipe: Family and name count.
        pretrained: Whether `--weights` gives the vision encoder, which then has the size of the paper's.
    """
    if recipe.name == "small":
        return 0
    size = SIZES[recipe.family]
    smaller = SMALLER.get((recipe.family, recipe.name), size.parameters)
    parameters = size.parameters if pretrained and recipe.family == "flow" else smaller
    return parameters * size.stored_bytes
