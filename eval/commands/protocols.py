"""`python -m arena_newton.eval protocols`: one checkpoint through every protocol."""

from __future__ import annotations

from arena_newton.eval.adapters.protocol_options import ProtocolOptions

__all__ = ["run"]


def run(options: ProtocolOptions) -> int:
    """Play through each, and compare."""
    from arena_newton.eval.adapters import protocol_comparison

    return protocol_comparison.run(options)
