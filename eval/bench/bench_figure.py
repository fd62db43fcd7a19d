"""A line of the bench."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["BenchFigure"]


@dataclass(frozen=True)
class BenchFigure:
    """One line of the bench."""

    name: str
    bar: float
    unit: str
    at_most: bool
    """True when smaller is better."""
    value: float | None = None
    """None when it was not measured."""
    note: str = ""

    @property
    def verdict(self) -> str:
        """``pass``, ``MISS`` or ``-``."""
        if self.value is None:
            return "-"
        return "pass" if (self.value <= self.bar if self.at_most else self.value >= self.bar) else "MISS"
