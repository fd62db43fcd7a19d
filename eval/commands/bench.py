"""`python -m arena_newton.eval bench`: this machine against the figures to reach."""

from __future__ import annotations

from arena_newton.eval.bench.bench_options import BenchOptions

__all__ = ["run"]


def run(options: BenchOptions) -> int:
    """Measure."""
    from arena_newton.eval.bench import bench

    return bench.run(options)
