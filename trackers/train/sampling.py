"""Starts of training episodes: clips and their phases, more often where the tracker fails.

Clips are cut into bins of one second. A bin's weight is its family's weight, spread over the family's frames, times
a factor that grows with its failure rate. All statistics live on the device; the table is renewed once an iteration.
"""

from __future__ import annotations

import hashlib
from typing import Any

import torch

from arena_newton.trackers.train.references import ReferenceBank

__all__ = ["ClipSampler"]

BIN = 50
"""Frames of a bin."""
LEAD = 50
"""Largest number of frames by which an episode starts ahead of its bin: the cause of a fall precedes it."""
TAIL = 25
"""Smallest number of frames from the start of an episode to the end of its clip."""
PRIOR = 10.0
"""Weight of the family's failure rate against a bin's own evidence [s]."""
FORGET = 0.99
"""Fraction of the evidence that is kept per iteration."""
CEILING = 5.0
"""Largest factor of a bin over the mean: clips that no tracker can follow must not take all the time."""
_EVIDENCE = ("seconds", "failures", "cumulative")


class ClipSampler:
    """Adaptive sampling of start frames."""

    def __init__(self, bank: ReferenceBank, adaptive: float, family_weights: dict[str, float] | None = None):
        """Cut the clips into bins.

        Args:
            adaptive: Fraction of the starts that are sampled by failure rate, 0 to 1.
            family_weights: Weights of families by name relative to their seconds of motion; 1 where not named.
        """
        self.bank, self.adaptive = bank, adaptive
        first = bank.data.index_select(0, bank.start).cpu().numpy().tobytes()
        self.library = hashlib.sha256(bank.length.cpu().numpy().tobytes() + first).hexdigest()[:16]
        """Hash of the library: lengths and first frames of its clips."""
        device = bank.start.device
        bins = (bank.length + BIN - 1) // BIN
        clip = torch.repeat_interleave(torch.arange(len(bins), device=device), bins)
        first_bin = torch.cumsum(bins, 0) - bins
        self.start = bank.start[clip] + BIN * (torch.arange(len(clip), device=device) - first_bin[clip])
        self.earliest = bank.start[clip]
        self.latest = torch.maximum(bank.start[clip], bank.start[clip] + bank.length[clip] - 1 - TAIL)
        self.family = bank.family[clip]
        self.bin_of = (
            first_bin[bank.clip_of] + (torch.arange(bank.frames, device=device) - bank.start[bank.clip_of]) // BIN
        )
        """Bin of each frame, shape [frames]."""
        families = len(bank.family_names)
        weight = torch.tensor([(family_weights or {}).get(n, 1.0) for n in bank.family_names], device=device)
        frames = torch.minimum(torch.full_like(self.start, BIN), bank.start[clip] + bank.length[clip] - self.start)
        self.base = weight[self.family] * frames
        self.base /= self.base.sum()
        self.seconds = torch.zeros(len(clip), device=device)
        self.failures = torch.zeros(len(clip), device=device)
        self.family_seconds = torch.zeros(families, device=device)
        self.family_failures = torch.zeros(families, device=device)
        self.cumulative = torch.cumsum(self.base, 0)

    def record(self, frame: torch.Tensor, failed: torch.Tensor, tick: float) -> None:
        """Count one tick [s] of every world: its frame, and whether it lost its reference, shape [worlds] each."""
        bins = self.bin_of.index_select(0, frame)
        self.seconds.index_add_(0, bins, torch.full_like(failed, tick, dtype=torch.float32))
        self.failures.index_add_(0, bins, failed.float())

    def sample(self, count: int) -> torch.Tensor:
        """Start frames, shape [count]."""
        draw = torch.rand(2, count, device=self.base.device)
        bins = torch.searchsorted(self.cumulative, draw[0] * self.cumulative[-1]).clamp_max(len(self.base) - 1)
        frame = self.start[bins] + (draw[1] * (BIN + LEAD)).long() - LEAD
        return torch.minimum(torch.maximum(frame, self.earliest[bins]), self.latest[bins])

    def renew(self) -> None:
        """Recompute the weights from the evidence, and discount the evidence."""
        self.family_seconds.zero_().index_add_(0, self.family, self.seconds)
        self.family_failures.zero_().index_add_(0, self.family, self.failures)
        rate = (self.failures.sum() + 1.0) / (self.seconds.sum() + 10.0)
        by_family = (self.family_failures + PRIOR * rate) / (self.family_seconds + PRIOR)
        by_bin = (self.failures + PRIOR * by_family[self.family]) / (self.seconds + PRIOR)
        factor = (by_bin / (self.base * by_bin).sum()).clamp_max(CEILING)
        factor /= (self.base * factor).sum()
        torch.cumsum(self.base * (1.0 - self.adaptive + self.adaptive * factor), 0, out=self.cumulative)
        self.seconds *= FORGET
        self.failures *= FORGET

    def clear(self) -> None:
        """Forget the evidence."""
        self.seconds.zero_()
        self.failures.zero_()
        self.renew()

    def state_dict(self) -> dict[str, Any]:
        """State that a resumed training needs."""
        return {"library": self.library} | {name: getattr(self, name) for name in _EVIDENCE}

    def load_state_dict(self, state: dict[str, Any]) -> bool:
        """Load the evidence of a checkpoint; False, and nothing is loaded, where it is of another library."""
        if state.get("library") != self.library:
            return False
        for name in _EVIDENCE:
            getattr(self, name).copy_(state[name])
        return True
