"""The random numbers of policies that sample their actions: drawn per episode and query, never from a common one.

An episode's noise follows from its seed and from the number of its queries, so that it depends neither on other worlds
nor on what else drew numbers. It is drawn on the CPU, whatever the device is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch

__all__ = ["NOISE_RULE", "Draw", "generators", "normal"]

NOISE_RULE = "sha256(policy seed|look)"
"""Rule for the seed of a query's generator; results record it."""


@dataclass(frozen=True)
class Draw:
    """Seed and query of one world, from which its noise is drawn."""

    seed: int
    """Seed that the policy was given of the episode."""
    query: int
    """Queries of the episode before this one."""


def generators(draws: Sequence[Draw]) -> list[torch.Generator]:
    """A new generator per row; its seed is the first 63 bits of `NOISE_RULE`."""
    found = []
    for draw in draws:
        digest = hashlib.sha256(f"{draw.seed}|{draw.query}".encode()).digest()
        found.append(torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1))
    return found


def normal(drawn: Sequence[torch.Generator], shape: tuple[int, ...], device: torch.device) -> torch.Tensor:
    """Standard normal numbers, each row from its own generator, float32, shape [rows, *shape]."""
    return torch.stack([torch.randn(shape, generator=one) for one in drawn]).to(device)
