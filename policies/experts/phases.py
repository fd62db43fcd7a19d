"""The state machine of an expert: one phase per world, its time, and its longest time."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

__all__ = ["Phases", "select"]


def select(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Rows of `new` where the mask [worlds] is set, of `old` elsewhere; both of shape [worlds, ...]."""
    return torch.where(mask.reshape(-1, *([1] * (old.ndim - 1))), new, old)


class Phases:
    """Named phases, each bounded in time; one per world.

    An expert asks `at` for the worlds of a phase, `enter`s the next one, and looks at `late` so that none waits forever
    for what may never happen.
    """

    def __init__(self, longest: Mapping[str, float], worlds: int, device: torch.device | str = "cpu"):
        """Start in the first phase.

        Args:
            longest: Phase → longest time in it [s], in the usual order; `math.inf` for the last one.
        """
        self._names = list(longest)
        self._index = {name: i for i, name in enumerate(longest)}
        self._longest = torch.tensor(list(longest.values()), dtype=torch.float32, device=device)
        self.phase = torch.zeros(worlds, dtype=torch.long, device=device)
        """Number of each world's phase in the order of `longest`, shape [worlds]."""
        self.clock = torch.zeros(worlds, device=device)
        """Time since the phase was entered [s], shape [worlds]."""
        self._found: dict[tuple[str, ...], Tensor] = {}
        self._present: set[str] = set()

    def begin(self, mask: Tensor) -> None:
        """The worlds of `mask`, bool, shape [worlds], are in the first phase."""
        self.enter(self._names[0], mask)

    def advance(self, mask: Tensor, dt: float) -> None:
        """Time passes in the worlds of `mask`, bool, shape [worlds], by dt [s]."""
        self.clock = self.clock + dt * mask

    def at(self, *names: str) -> Tensor:
        """Worlds that are in one of these phases, bool, shape [worlds].

        Raises:
            KeyError: There is no such phase.
        """
        if names not in self._found:
            self._found[names] = torch.stack([self.phase == self._index[name] for name in names]).any(dim=0)
        return self._found[names]

    def present(self, *names: str) -> list[str]:
        """Those of these phases, or of all without names, that some world is in, in the order given."""
        if not self._present:
            self._present = set(self.names())
        return [name for name in names or self._names if name in self._present]

    def enter(self, name: str, mask: Tensor) -> None:
        """The worlds of `mask`, bool, shape [worlds], enter a phase, also when they are in it already.

        Raises:
            KeyError: There is no such phase.
        """
        number = self._index[name]
        if mask.any():
            self.phase, self.clock = self.phase.masked_fill(mask, number), self.clock.masked_fill(mask, 0.0)
            self._found, self._present = {}, set()

    def over(self, name: str, mask: Tensor, condition: Callable[[], Tensor]) -> Tensor:
        """Worlds of `mask`, bool, shape [worlds], that end this phase: by a condition, or late.

        The condition, bool, shape [worlds], is computed where some world is in the phase.
        """
        if not self.present(name):
            return torch.zeros_like(mask)
        return mask & self.at(name) & (condition() | self.late)

    @property
    def late(self) -> Tensor:
        """Worlds that have been in their phase for its longest time, bool, shape [worlds].

        An expert decides every 0.1 s and counts in single precision, so that a phase may last one decision longer.
        """
        return self.clock >= self._longest[self.phase]

    @property
    def fraction(self) -> Tensor:
        """Time in the phase over its longest time, 0 to 1, shape [worlds]; 0 in a phase without end."""
        return (self.clock / self._longest[self.phase]).clamp(0.0, 1.0)

    def names(self) -> list[str]:
        """Name of each world's phase."""
        return [self._names[phase] for phase in self.phase.tolist()]
