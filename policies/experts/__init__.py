"""Scripted experts: closed loops on the true state of the world, built from the reference generator alone."""

from __future__ import annotations

from arena_newton.errors import InputError
from arena_newton.policies.experts.base import Expert, ExpertPolicy, Sight

__all__ = ["EXPERTS", "Expert", "ExpertPolicy", "Sight", "from_spec"]


def _boxing(sight: Sight) -> Expert:
    from arena_newton.policies.experts.boxing import BoxingExpert

    return BoxingExpert(sight)


def _vis_navi(sight: Sight) -> Expert:
    from arena_newton.policies.experts.vis_navi import VisNaviExpert

    return VisNaviExpert(sight)


EXPERTS = {"boxing": _boxing, "vis_navi": _vis_navi}
"""Task name to maker of its expert."""


def from_spec(argument: str | None) -> ExpertPolicy:
    """Make the policy for `--policy expert`.

    Raises:
        InputError: There is text after a colon.
    """
    if argument is not None:
        raise InputError(f"--policy expert:{argument}: expert takes no argument; it picks by the task")
    return ExpertPolicy(EXPERTS)
