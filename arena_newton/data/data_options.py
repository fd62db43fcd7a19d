"""Flags of `python -m arena_newton.data`, one dataclass per command."""

from __future__ import annotations

__all__: list[str] = []
