"""Rows of a training step, a pure function of seed and step, and the batch that is made of them on the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from arena_newton.policies.lerobot.checkpoint_facts import vector_of
from arena_newton.policies.train.frames.augmentation import gathered_pictures
from arena_newton.policies.train.frames.demonstration_rows import ACTION_KEY, PICTURES, STATE_KEY, VECTOR_KEY
from arena_newton.policies.train.frames.frame_store import FrameStore

__all__ = ["BalancedOrder", "BatchMaker", "RowOrder", "step_seed"]

MIX = 0x9E3779B97F4A7C15
"""Odd number by which steps are spread over the seeds (the golden ratio of 2^64, as in splitmix64)."""
BLOCK_STEPS = 256
"""Steps whose balanced rows are drawn at once."""
UNKNOWN_FRACTION = 0.05
"""Fraction of the training samples whose tracker input is the entry for trackers that the vector lacks: for play
through one of which there are no demonstrations."""


def step_seed(seed: int, step: int, rank: int = 0) -> int:
    """Seed of everything random within a step of one process, in [0, 2^63)."""
    mixed = (seed * 0x2545F4914F6CDD1D + (step + 1) * MIX + (rank + 1) * 0xD1B54A32D192ED03) % 2**64
    mixed = ((mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) % 2**64
    return (mixed ^ (mixed >> 31)) >> 1


class RowOrder:
    """Rows in epochs, each a permutation: every row once before any a second time.

    The order is made on the CPU from seed and epoch alone, so that a resumed training goes on with the next batch, on
    any device, and processes take parts of one batch.
    """

    def __init__(self, samples: np.ndarray, seed: int, device: torch.device):
        """Rows at which samples may begin, int64, at least one."""
        self._samples = torch.from_numpy(np.ascontiguousarray(samples, np.int64))
        self._seed, self._device = seed, device
        self._epochs: dict[int, torch.Tensor] = {}

    def _epoch(self, number: int) -> torch.Tensor:
        """Order of an epoch on the device; the last few are remembered."""
        if number not in self._epochs:
            generator = torch.Generator().manual_seed(step_seed(self._seed, number, rank=-2))
            order = torch.randperm(len(self._samples), generator=generator)
            self._epochs[number] = self._samples[order].to(self._device)
            for old in [epoch for epoch in self._epochs if epoch < number - 1]:
                del self._epochs[old]
        return self._epochs[number]

    def rows(self, step: int, batch: int, *, rank: int = 0, ranks: int = 1) -> torch.Tensor:
        """Rows of a step of one process, int64, shape [batch]."""
        total = len(self._samples)
        begin = (step * ranks + rank) * batch
        parts, left = [], batch
        while left:
            epoch, at = divmod(begin, total)
            part = self._epoch(epoch)[at : at + left]
            parts.append(part)
            begin, left = begin + len(part), left - len(part)
        return parts[0] if len(parts) == 1 else torch.cat(parts)


class BalancedOrder:
    """Rows drawn independently: first a group of them, by its weight, then any of the group's rows.

    Drawn on the CPU from seed, step and process alone, as the order of `RowOrder` is, for many steps at once: a copy to
    a GPU waits for what it does.
    """

    def __init__(
        self, samples: np.ndarray, groups: np.ndarray, weights: Sequence[float], seed: int, device: torch.device
    ):
        """Sort the rows by their groups.

        Args:
            samples: Rows at which samples may begin, int64.
            groups: Group of each, int64.
            weights: Of each group, all of which have rows.
        """
        self._samples = torch.from_numpy(samples[np.argsort(groups, kind="stable")])
        self._counts = torch.from_numpy(np.bincount(groups, minlength=len(weights)))
        self._starts = self._counts.cumsum(0) - self._counts
        self._weights = torch.tensor(weights, dtype=torch.float64)
        self._seed, self._device = seed, device
        self._block: tuple[int, int, int] | None = None
        """Number of the block of steps that is drawn, samples of a step and process."""
        self._rows = torch.zeros(0)

    def rows(self, step: int, batch: int, *, rank: int = 0, ranks: int = 1) -> torch.Tensor:
        """Rows of a step of one process, int64, shape [batch]; `ranks` does not count."""
        number, at = divmod(step, BLOCK_STEPS)
        if self._block != (number, batch, rank):
            generator = torch.Generator().manual_seed(step_seed(self._seed, number, rank=-3 - rank))
            group = torch.multinomial(self._weights, BLOCK_STEPS * batch, replacement=True, generator=generator)
            within = torch.rand(len(group), dtype=torch.float64, generator=generator) * self._counts[group]
            self._rows = self._samples[self._starts[group] + within.long()].view(-1, batch).to(self._device)
            self._block = number, batch, rank
        return self._rows[at]


@dataclass
class BatchMaker:
    """Makes normalized batches of rows; nothing in it waits for the device."""

    store: FrameStore
    normalise: Callable[[str, torch.Tensor], torch.Tensor]
    """A feature as the network receives it; pictures are given on the scale 0 to 1."""
    offsets: Sequence[int]
    """Ticks of the actions of a sample, counted from its row."""
    task_vector: Sequence[str] = ()
    """Tasks in the order of the one-hot vector; none: no vector."""
    tracker_vector: Sequence[str] = ()
    """Trackers in the order of the numbers that follow in it, as of `CheckpointFacts`; none: it has no such numbers."""
    tall: int = 0
    """Height as in `gathered_pictures`."""
    tokens: Mapping[str, torch.Tensor] | None = None
    """Tokens of language of every instruction, or of every row: key → shape [instructions or rows, L]."""
    tokens_per_row: bool = False
    """True if the tokens are those of rows."""

    def __post_init__(self) -> None:
        """Make the constants."""
        device = self.store.device
        self._offsets = torch.tensor(list(self.offsets), device=device)
        pairs = [[(task, tracker), (task, "")] for task, tracker in self.store.pairs]
        vectors = [[vector_of(self.task_vector, self.tracker_vector, *one) for one in both] for both in pairs]
        self._vectors = torch.tensor(vectors, device=device)
        """Vector of each pair, and that of its task with an unknown tracker, shape [pairs, 2, width]."""

    def __call__(
        self,
        rows: torch.Tensor,
        *,
        looks: bool = False,
        shift: int = 0,
        colour: float = 0.0,
        transforms: bool = False,
        unknown: float = 0.0,
    ) -> dict[str, torch.Tensor]:
        """The batch of rows.

        Actions before or after an episode are those of its first or last row, and marked in `action_is_pad`.

        Args:
            rows: int64, shape [B].
            looks: Change the looks of a part of the samples, which may then begin a few rows earlier.
            shift: Most pixels by which a picture is shifted.
            colour: Most relative change of brightness and colours.
            transforms: Apply LeRobot's image transforms.
            unknown: Fraction of the samples whose tracker the vector does not name.

        Returns:
            `observation.images.front` [B, 3, H, W], and so on of each camera, `observation.state` [B, 64], `action` [B,
            n, 40], `action_is_pad` bool [B, n]; the task vector and tokens of language where the policy takes them.
        """
        store, changed = self.store, None
        if looks and store.looks is not None:
            rows, changed = store.looks.chosen(rows)
        wanted = rows[:, None] + self._offsets
        inside = torch.minimum(torch.maximum(wanted, store.first[rows][:, None]), store.last[rows][:, None])
        batch = {
            PICTURES + name: gathered_pictures(
                store,
                rows,
                camera=number,
                changed=changed,
                tall=self.tall,
                shift=shift,
                colour=colour,
                transforms=transforms,
            )
            for number, name in enumerate(store.cameras)
        }
        batch |= {
            STATE_KEY: store.states[rows],
            ACTION_KEY: store.actions[inside],
        }
        if self.task_vector:
            hidden = torch.zeros_like(rows)
            if self.tracker_vector and unknown:
                hidden = (torch.rand(len(rows), device=store.device) < unknown).long()
            batch[VECTOR_KEY] = self._vectors[store.pair[rows], hidden]
        batch = {key: self.normalise(key, value) for key, value in batch.items()}
        batch["action_is_pad"] = wanted != inside
        for key, tokens in (self.tokens or {}).items():
            batch[key] = tokens[rows if self.tokens_per_row else store.instruction[rows]]
        return batch
