"""Memory of a policy per world between two chunks: earlier glimpses, actions not yet given, and a mean.

A policy that looks at several ticks gives the last actions of a chunk one by one, so that it is asked at each of the
ticks that it will look at: the world has no other hook for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from arena_newton.robot.canonical import ACTION_WIDTH

__all__ = ["ChunkMemory"]

Glimpse = Mapping[str, torch.Tensor]
"""Name → what one world shows at one tick, without a dimension of worlds."""


class ChunkMemory:
    """Memory of all worlds; rows are worlds."""

    def __init__(
        self, worlds: int, device: torch.device, *, observations: int, predicted: int, executed: int, ensemble: bool
    ):
        """All worlds at the beginning of an episode.

        Args:
            observations: Ticks that the policy looks at.
            predicted: Actions of an answer of the network.
            executed: Actions of an answer that are executed before the next query.
            ensemble: Execute at each tick the mean, with equal weights, of all answers that cover it.
        """
        self.worlds, self.executed = worlds, executed
        self._observations = observations
        self._glimpses: list[list[Glimpse]] = [[] for _ in range(worlds)]
        self._waiting: list[list[torch.Tensor]] = [[] for _ in range(worlds)]
        self._sum = self._count = None
        if ensemble:
            self._sum = torch.zeros((worlds, predicted, ACTION_WIDTH), device=device)
            self._count = torch.zeros((worlds, predicted, 1), device=device)
        # Whole chunks where one tick is seen; else the last ones singly, so that every tick of a query is seen.
        singles = min(observations - 1, executed - 1)
        self._pieces = [executed - singles, *([1] * singles)]

    def reset(self, world: int) -> None:
        """Begin a new episode in a world."""
        self._glimpses[world], self._waiting[world] = [], []
        if self._sum is not None and self._count is not None:
            self._sum[world], self._count[world] = 0.0, 0.0

    def waits(self, world: int) -> bool:
        """True if actions of an earlier query have not been given yet."""
        return bool(self._waiting[world])

    def glimpse(self, world: int, seen: Glimpse) -> None:
        """Remember what a world shows at a tick at which it asks."""
        self._glimpses[world] = [*self._glimpses[world], seen][-self._observations :]

    def queried(self, world: int) -> list[Glimpse]:
        """The ticks of a query, oldest first; at an episode's beginning the first one stands for those before it."""
        kept = self._glimpses[world]
        return [kept[0]] * (self._observations - len(kept)) + kept

    def answer(self, worlds: Sequence[int], chunks: torch.Tensor) -> None:
        """Take the network's answers to a query of some worlds, shape [len(worlds), predicted, 40]."""
        if self._sum is not None and self._count is not None:
            rows, k = list(worlds), self.executed
            left = chunks.shape[1] - k
            total, count = torch.zeros_like(chunks), torch.zeros_like(self._count[rows])
            # What was executed since the last query has left; of a first query nothing is kept yet.
            total[:, :left], count[:, :left] = self._sum[rows, k:], self._count[rows, k:]
            self._sum[rows], self._count[rows] = total + chunks, count + 1.0
            chunks = self._sum[rows] / self._count[rows]
        for world, chunk in zip(worlds, chunks, strict=True):
            self._waiting[world] = list(chunk[: self.executed].split(self._pieces))

    def give(self, worlds: Sequence[int]) -> torch.Tensor:
        """The next actions of some worlds, as many as all of them have at once, shape [len(worlds), n, 40]."""
        n = min(len(self._waiting[world][0]) for world in worlds)
        given = []
        for world in worlds:
            piece, *rest = self._waiting[world]
            given.append(piece[:n])
            self._waiting[world] = [piece[n:], *rest] if len(piece) > n else rest
        return torch.stack(given)
