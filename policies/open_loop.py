"""Base of policies that play recordings of episodes, whatever the robot does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from arena_newton.policies.base import Chunk, Mask, Observation, Policy, world_mask
from arena_newton.robot.canonical import ACTION, ACTION_WIDTH

if TYPE_CHECKING:
    from arena_newton.interfaces import World

__all__ = ["RecordedEpisodes", "played"]

_XY = ACTION["root_xy_delta"]


def played(recording: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Actions at ticks of any shape; after the end the last one without displacement, shape [..., 40]."""
    actions = recording[np.minimum(ticks, len(recording) - 1)]
    actions[ticks >= len(recording), _XY] = 0.0
    return actions


class RecordedEpisodes(Policy):
    """Base of policies that play recordings of episodes, open loop."""

    labels = "v3.1"
    chunk_size = 20

    def __init__(self) -> None:
        """Play nothing yet."""
        self.path = Path()
        self.playing: list[np.ndarray | None] = []
        """Actions of each world, shape [ticks, 40]."""
        self._world: World | None = None
        self._asked: list[tuple[str, str, int]] = []
        self._steps = np.zeros(0, dtype=np.int64)

    def recording(self, task: str, mode: str, seed: int) -> np.ndarray | None:
        """Actions of an episode, by Gym id, mode and policy's seed, shape [ticks, 40]; None where there are none."""
        raise NotImplementedError

    def attach(self, env: World) -> None:
        """Take the worlds, in whose modes recordings are played."""
        self._world = env

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Take the recordings of the worlds in `mask`."""
        if len(self._steps) != len(seeds):
            self._steps = np.zeros(len(seeds), dtype=np.int64)
            self.playing, self._asked = [None] * len(seeds), [("", "", 0)] * len(seeds)
        modes = ["base"] * len(seeds) if self._world is None else self._world.modes
        for world in np.flatnonzero(world_mask(mask, len(seeds))):
            self._asked[world] = (tasks[world], modes[world], int(seeds[world]))
            self.playing[world] = self.recording(*self._asked[world])
            self._steps[world] = 0

    def act(self, observation: Observation) -> Chunk:
        """The next actions of the worlds that ask; a world without a recording gets an error."""
        worlds = len(observation.state)
        actions = np.zeros((worlds, self.chunk_size, ACTION_WIDTH), dtype=np.float32)
        errors = {}
        for world in np.flatnonzero(world_mask(observation.mask, worlds)):
            recording = self.playing[world]
            if recording is None:
                task, mode, _ = self._asked[world]
                errors[int(world)] = f"{self.path}: no recording of this episode of {task}, mode {mode}"
                continue
            ticks = self._steps[world] + np.arange(self.chunk_size)
            actions[world] = played(recording, ticks)
            self._steps[world] += self.chunk_size
        return Chunk(actions, errors)
