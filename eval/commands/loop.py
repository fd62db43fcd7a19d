"""`python -m arena_newton.eval loop`: from demonstrations to the report of a trained policy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from arena_newton.errors import InputError
from arena_newton.eval.loop.loop_options import LoopOptions

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["run"]


def run(options: LoopOptions, factories: Factories | None = None) -> int:
    """Run the loop; missing libraries are named before those that are there load."""
    from arena_newton.eval.loop.loop_requirements import check_libraries, plan_path

    check_libraries(options.policy)
    if options.plan is not None:
        plan_path(options.plan)  # a wrong name is refused before torch is loaded
        from arena_newton.eval.loop import plan_loop

        return plan_loop.run(options)
    for name in ("rows", "seeds", "only"):
        if getattr(options, name):
            raise InputError(f"--{name}: belongs to --plan, which is not given")
    from arena_newton.eval.loop import learning_loop

    return learning_loop.run(options, factories)
