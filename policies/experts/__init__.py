"""Scripted experts: closed loops on the true state of the world, built from the reference generator alone."""

from arena_newton.errors import InputError
from arena_newton.policies.experts.base import Expert, ExpertPolicy, Sight

__all__ = ["Expert", "ExpertPolicy", "Sight", "from_spec"]


def from_spec(argument: str | None) -> ExpertPolicy:
    """Make the policy for `--policy expert`; text after a colon is refused."""
    if argument is not None:
        raise InputError(f"--policy expert:{argument}: expert takes no argument; it picks by the task")
    return ExpertPolicy()
