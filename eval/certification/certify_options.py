"""Flags of `eval certify`."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import Device, Engine, Several
from arena_newton.eval.plan.options import Jobs

__all__ = ["CertifyOptions"]


@dataclass(frozen=True)
class CertifyOptions(Jobs):
    """Measure what the benchmark claims of itself: solvable tasks that need legs, clean axes, engines that agree.

    The tasks' experts play in all checks but policy-inputs, execution, dynamics, modes, physics, camera and
    statistics. Exit code 0: no check fails; 1: one fails; 2: bad input. --jobs 0 only plays and writes no page, as each
    of several processes does.
    """

    out: str = "results/certify"
    """Folder of the certificate and of the evaluations behind it."""
    quick: bool = False
    """A few episodes of everything by two processes, or --jobs: minutes instead of hours, and wide intervals."""
    task: Several[str] = ()
    """Tasks; all that have an expert when none is named."""
    tracker: Several[str] = ("twist2", "sonic")
    """Trackers, with the weights they come with; the first one alone where one is enough."""
    checks: Several[str] = ()
    """Names of checks to run: journal recording solvable policy-inputs tracker-inputs frozen-legs gliding-base visual
    semantic execution dynamics modes physics camera rules engines batches official shards ray swap visible sill
    failures statistics gradients; all when none is named, modes only with --mode."""
    mode: Several[str] = ()
    """Modes whose records check `modes` compares with what they move, such as those of other packages."""
    episodes: int | None = None
    """Episodes of each cell: 60, the protocol's, or 2 under --quick."""
    worlds: int = 20
    """Episodes simulated at once."""
    engine: Engine = "mujoco"
    device: Device[str | None] = None
    twist2_checkpoint: str | None = None
    """Official TWIST2 checkpoint (.onnx), to compare our weights with."""
    resume: bool = False
    """Continue a certification in its folder; what was played is kept."""
