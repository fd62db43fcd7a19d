"""Recorded states of episodes checked tick by tick on engine mujoco: a state and its action give the next state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.errors import InputError
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.interfaces import EpisodeResult, Observation, Recorder, World
from arena_newton.physics.mujoco_engine import MujocoPhysics

__all__ = ["EPISODE", "START", "StatesAgain"]

EPISODE = "episode"
"""Name of the recording of an episode among its media."""
START = 0.01
"""Largest distance of a body in the first recorded state from where the seed puts it, after the start-up [m]."""


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
        self.differences: dict[int, list[float]] = {}
        """Largest distance along an axis of a body from its recorded position, before each tick and at the end [m], by
        the episode's number; the first is after the start-up from the seed, the others after one tick each."""
        self._states: dict[int, _Recorded] = {}

    def start(self, env: World, world: int, episode: Episode) -> None:
        """Read an episode's states.

        Raises:
            InputError: The recording is absent, damaged, or of another scene.
        """
        model, file = env.scene.mj_model, EpisodeFile(self.files[episode.index])
        positions, last = file.array("arena_qpos", -1, model.nq), file.array("arena_final_qpos", model.nq)
        velocities = file.array("arena_qvel", len(positions), model.nv)
        if not len(velocities):
            raise InputError(f"{file.path}: arena_qvel holds no tick")
        self._states[world] = _Recorded(episode.index, np.vstack([positions, last]), velocities)
        self.differences[episode.index] = []

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Measure how far off the recorded state is, and take it up."""
        for world in np.flatnonzero(env.active & (env.tick >= 0)).tolist():
            self._take_up(env, world, int(env.tick[world]))

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Measure how far off the recorded last state is."""
        self._take_up(env, world, result.steps)
        del self._states[world]

    def _take_up(self, env: World, world: int, tick: int) -> None:
        """Put a world into the recorded state at a tick; one that goes on after its recording stays as it is."""
        assert isinstance(env.physics, MujocoPhysics), "the audit plays on engine mujoco"
        mine, places = self._states[world], env.physics.xpos.numpy()[world]
        if tick >= len(mine.positions):
            return
        given = places.copy()
        env.physics.put(world, mine.positions[tick], mine.velocities[min(tick, len(mine.velocities) - 1)])
        self.differences[mine.index].append(float(np.abs(places - given).max()))
