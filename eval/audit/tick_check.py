"""Recorded states of episodes checked tick by tick on engine mujoco: a state and its action give the next state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.interfaces import Observation, Recorder, World
from arena_newton.physics.mujoco_engine import MujocoPhysics

__all__ = ["EPISODE", "START", "StatesAgain", "TickDifferences"]

EPISODE = "episode"
"""Name of the recording of an episode among its media."""
START = 0.05
"""Largest difference of the first recorded state from that of the seed, after the start-up [m or rad]."""


@dataclass
class TickDifferences:
    """Differences of recorded positions from those that engine mujoco gives [m or rad]."""

    start: float = 0.0
    """At step 0, after the start-up."""
    ticks: list[float] = field(default_factory=list)
    """Largest after each tick, from the recorded state before it."""


@dataclass
class _Recorded:
    """Recorded states of an episode."""

    index: int
    positions: np.ndarray
    """Before each tick and at the end, shape [ticks + 1, nq]."""
    velocities: np.ndarray
    """Before each tick, shape [ticks, nv]."""


class StatesAgain(Recorder):
    """Puts the worlds into the recorded state before each tick, and measures how far off the next one is."""

    def __init__(self, files: Mapping[int, Path]):
        """Take the recordings of `eval run --record` by the episode's number."""
        self.files = files
        self.differences: dict[int, TickDifferences] = {}
        """By the episode's number."""
        self._states: dict[int, _Recorded] = {}

    def start(self, env: World, world: int, episode: Episode) -> None:
        """Read an episode's states.

        Raises:
            InputError: The recording is absent, damaged, or of another scene.
        """
        model, file = env.scene.mj_model, EpisodeFile(self.files[episode.index])
        positions, last = file.array("arena_qpos", -1, model.nq), file.array("arena_final_qpos", model.nq)
        velocities = file.array("arena_qvel", len(positions), model.nv)
        self._states[world] = _Recorded(episode.index, np.vstack([positions, last]), velocities)
        self.differences[episode.index] = TickDifferences()

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Take up the recorded state."""
        qpos = env.physics.qpos.numpy()
        for world in np.flatnonzero(env.active & (env.tick >= 0)).tolist():
            mine, tick = self._states[world], int(env.tick[world])
            if tick >= len(mine.velocities):
                continue
            if tick == 0:
                self.differences[mine.index].start = float(np.abs(qpos[world] - mine.positions[0]).max())
            assert isinstance(env.physics, MujocoPhysics), "the audit plays on engine mujoco"
            env.physics.put(world, mine.positions[tick], mine.velocities[tick])

    def tick(self, env: World) -> None:
        """Measure the state after the tick."""
        qpos = env.physics.qpos.numpy()
        for world in np.flatnonzero(env.active & (env.tick > 0)).tolist():
            mine, tick = self._states[world], int(env.tick[world])
            if tick < len(mine.positions):
                self.differences[mine.index].ticks.append(float(np.abs(qpos[world] - mine.positions[tick]).max()))
