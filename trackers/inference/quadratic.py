"""Quantities that are quadratic in quaternions, in a handful of elementwise operations.

Products, sums in a fixed order and nothing else: each is exactly rounded, so a row's bits do not depend on the other
rows, which matrix products on a CPU do not promise.

Written out, a formula takes a tick of one world several times longer (twist2 30 us, sonic 115 us on one core): what
counts there is the number of operations. The bits are the same (the tests hold the formula of each table).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

__all__ = ["Quadratic"]


class Quadratic:
    """Sums of a few products a_i b_j of the numbers of two rows: `quadratic(a, b)`."""

    def __init__(
        self,
        table: Sequence[Sequence[tuple[int, float]]],
        constant: Sequence[float] | None = None,
        *,
        width: int = 4,
        device: torch.device | str = "cpu",
    ):
        """Put the table on the device.

        Args:
            table: For each result the products that it adds, as (i width + j, factor); equally many for each.
            constant: Added to each result.
            width: Width of `b`.
        """
        by_term = [term for terms in zip(*table, strict=True) for term in terms]
        self._left = torch.tensor([i // width for i, _ in by_term], device=device)
        self._right = torch.tensor([i % width for i, _ in by_term], device=device)
        self._factor = torch.tensor([float(f) for _, f in by_term], device=device)
        self._constant = None if constant is None else torch.tensor(constant, device=device)
        self._terms = len(table[0])

    def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        """Shapes [rows, (width of a)], [rows, width] → [rows, results]."""
        products = a.index_select(1, self._left).mul_(b.index_select(1, self._right)).mul_(self._factor)
        total, *rest = products.view(len(a), self._terms, -1).unbind(1)
        for term in rest:
            total = total + term
        return total if self._constant is None else total + self._constant
