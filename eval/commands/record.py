"""`python -m arena_newton.eval record`: demonstrations, or more cameras of recorded ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

from arena_newton.eval.commands.run import run as evaluate
from arena_newton.eval.plan.options import RecordOptions

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["run"]


def run(options: RecordOptions, factories: Factories | None = None) -> int:
    """Record, or play recorded episodes again."""
    if options.source is not None:
        from arena_newton.eval.play import rerecord

        return rerecord.run(options, factories)
    from arena_newton.eval.plan.config import recording_run

    return evaluate(recording_run(options), factories)
