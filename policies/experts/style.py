"""Differences between two episodes of one expert: numbers drawn from the seed that a policy is given of it."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

__all__ = ["Style"]

_STEP, _MIX_A, _MIX_B = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
"""Constants of the generator splitmix64 (Steele, Lea, Flood 2014)."""


class Style:
    """Draws of the running episodes, by name: the same seed and name always give the same number."""

    def __init__(self, worlds: int, device: torch.device | str = "cpu"):
        """All seeds are 0 until `begin`."""
        self._device = device
        self._seeds = np.zeros(worlds, np.uint64)

    def begin(self, mask: np.ndarray, seeds: Sequence[int]) -> None:
        """Episodes with these seeds (one per world) begin in the worlds of `mask`, bool, shape [worlds]."""
        self._seeds[mask] = np.asarray(seeds, np.uint64)[mask]

    def uniform(self, name: str, low: float, high: float) -> Tensor:
        """A number from low to high for each world's episode, float32, shape [worlds]."""
        with np.errstate(over="ignore"):
            z = self._seeds + np.uint64(zlib.crc32(name.encode()) + 1) * _STEP
            z = (z ^ (z >> np.uint64(30))) * _MIX_A
            z = (z ^ (z >> np.uint64(27))) * _MIX_B
            z = z ^ (z >> np.uint64(31))
        unit = (z >> np.uint64(40)).astype(np.float32) / np.float32(1 << 24)
        return torch.from_numpy(low + (high - low) * unit).to(self._device, torch.float32)

    def coin(self, name: str) -> Tensor:
        """True in every other episode, bool, shape [worlds]."""
        return self.uniform(name, 0.0, 1.0) < 0.5
