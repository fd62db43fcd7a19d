"""The policy that stands still: one constant action."""

from __future__ import annotations

import numpy as np

from arena_newton.errors import InputError
from arena_newton.policies.base import Chunk, Observation, Policy
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION

__all__ = ["StandPolicy", "from_spec"]


class StandPolicy(Policy):
    """Answers the standing action."""

    name = "stand"
    labels = "v3.1"
    chunk_size = 50

    def act(self, observation: Observation) -> Chunk:
        """One second of standing for every world."""
        shape = (len(observation.state), self.chunk_size, ACTION_WIDTH)
        return Chunk(np.broadcast_to(STAND_ACTION, shape).copy())


def from_spec(argument: str | None) -> StandPolicy:
    """Make the policy for `--policy stand`; text after a colon is refused."""
    if argument is not None:
        raise InputError(f"--policy stand:{argument}: stand takes no argument")
    return StandPolicy()
