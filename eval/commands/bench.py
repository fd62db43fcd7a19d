"""``python -m arena_newton.eval bench``: this machine against the figures that the product must reach."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["BenchOptions", "run"]


@dataclass(frozen=True)
class BenchOptions:
    """Measure this machine against the figures to reach; ratios are taken side by side in one run."""

    what: tuple[str, ...] = ("all",)
    """Figures to measure: tick throughput learned gradients start, or `all`."""
    checkpoint: str | None = None
    """Weights of TWIST2; those that come with the package when none are named."""
    worlds: int = 20
    """Worlds of `tick`, on engine mujoco."""
    cuda_worlds: int = 4096
    """Worlds of `throughput`, on CUDA."""
    rounds: int = 20
    """Rounds of `tick`, `throughput` and `gradients`; their medians are compared."""
    learned_ticks: int = 300
    """Ticks of an episode of `learned`, and of the expert's next to it."""
    json: bool = False
    """Print one JSON array instead of the table."""


def run(options: BenchOptions) -> int:
    """Measure and print.

    Returns:
        Exit code: 0 when no measured figure misses its bar, 1 otherwise.

    Raises:
        InputError: An unknown item, or a checkpoint that cannot be read.
    """
    from arena_newton.cli.quiet import quiet_warp
    from arena_newton.eval.bench.bench_gradients import gradient_figures
    from arena_newton.eval.bench.bench_learned import learned_figures
    from arena_newton.eval.bench.bench_start import start_figures
    from arena_newton.eval.bench.bench_tick import throughput_figures, tick_figures
    from arena_newton.eval.bench.timing import chosen, print_figures

    quiet_warp()
    rounds, checkpoint = options.rounds, options.checkpoint
    items = {
        "tick": lambda: tick_figures(options.worlds, rounds, checkpoint),
        "throughput": lambda: throughput_figures(options.cuda_worlds, rounds, checkpoint),
        "learned": lambda: learned_figures(options.learned_ticks, checkpoint),
        "gradients": lambda: gradient_figures(rounds),
        "start": start_figures,
    }
    return print_figures(chosen(options.what, items), as_json=options.json)
