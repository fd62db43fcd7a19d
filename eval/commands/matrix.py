"""`python -m arena_newton.eval matrix`: cells of a suite."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.eval.suites.suite_options import MatrixOptions

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["run"]


def run(files: Sequence[Path], options: MatrixOptions, factories: Factories | None = None) -> int:
    """Play the cells, or print them."""
    from arena_newton.eval.suites.suite_call import plan_call

    call = plan_call(str(files[0]), options)
    if options.dry_run:
        print(call.table(), flush=True)
        if call.problem is not None:
            raise call.problem
        return 0
    if options.dealt:
        from arena_newton.eval.suites import dealt_suite

        return dealt_suite.run(call, factories)
    from arena_newton.eval.suites import suite_run

    return suite_run.run(call, factories)
