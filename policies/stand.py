"""The policy that stands still: one constant action."""

from __future__ import annotations

import numpy as np

from arena_newton.canonical import ACTION, ACTION_WIDTH, IDENTITY_ROT6D
from arena_newton.errors import InputError
from arena_newton.policies.base import Chunk, Observation, Policy
from arena_newton.robot import CANONICAL_TO_MUJOCO, DEFAULT_POSE

__all__ = ["STAND_HEIGHT", "StandPolicy", "from_spec", "stand_action"]

STAND_HEIGHT = 0.8
"""Reference root height [m] of TWIST2's command when nobody steers it."""


def stand_action() -> np.ndarray:
    """The action that stands: no displacement, identity orientation, default pose, hands open; float32, shape [40]."""
    action = np.zeros(ACTION_WIDTH, dtype=np.float32)
    action[ACTION["root_z"]] = STAND_HEIGHT
    action[ACTION["root_rot6d"]] = IDENTITY_ROT6D
    action[ACTION["joint_pos"]] = np.asarray(DEFAULT_POSE)[list(CANONICAL_TO_MUJOCO)]
    return action


class StandPolicy(Policy):
    """Answers the standing action."""

    name = "stand"
    chunk_size = 50

    def act(self, observation: Observation) -> Chunk:
        """One second of standing for every world."""
        shape = (len(observation.state), self.chunk_size, ACTION_WIDTH)
        return Chunk(np.broadcast_to(stand_action(), shape).copy())


def from_spec(argument: str | None) -> StandPolicy:
    """Make the policy for `--policy stand`.

    Raises:
        InputError: There is text after a colon.
    """
    if argument is not None:
        raise InputError(f"--policy stand:{argument}: stand takes no argument")
    return StandPolicy()
