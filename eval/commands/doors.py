"""`python -m arena_newton.eval doors`: one checkpoint through every protocol."""

from __future__ import annotations

from arena_newton.eval.adapters.door_options import DoorOptions

__all__ = ["run"]


def run(options: DoorOptions) -> int:
    """Play through each, and compare."""
    from arena_newton.eval.adapters import door_comparison

    return door_comparison.run(options)
