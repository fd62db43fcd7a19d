"""Recordings of what a policy decided: one file of canonical actions per episode."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from arena_newton.eval.journal import StorageError
from arena_newton.eval.plan import Episode
from arena_newton.files import replace_atomically
from arena_newton.interfaces import EpisodeResult, Observation, Recorder, World

__all__ = ["ActionRecorder"]


class ActionRecorder(Recorder):
    """Keeps a policy's actions until their episode ends, then writes them."""

    def __init__(self, folder: Path):
        """Write into a folder: `<task>_<mode>_s<group seed>_r<repeat>.npz`.

        The files hold the arrays `action` [ticks, 40] and `episode_seed`, and the texts `task`, the task's Gym id, and
        `mode`.
        """
        self.folder = folder
        self._actions: dict[int, list[np.ndarray]] = {}

    def start(self, env: World, world: int, episode: Episode) -> None:
        """An episode without actions yet."""
        self._actions[world] = []

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Keep the actions of the worlds that act."""
        rows = action.detach().cpu().numpy()
        for world in np.flatnonzero(env.active & (env.tick >= 0)).tolist():
            self._actions[world].append(rows[world].copy())

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Write the actions that were executed, if any were.

        Raises:
            StorageError: The file cannot be written.
        """
        actions = self._actions.pop(world)
        if result.steps < 1:
            return
        path = self.folder / f"{result.episode.key.replace('/', '_')}.npz"
        try:
            with replace_atomically(path) as file:
                np.savez_compressed(
                    file,
                    action=np.stack(actions),
                    episode_seed=np.int64(result.episode.episode_seed),
                    task=np.str_(env.spec.gym_id),
                    mode=np.str_(result.episode.mode),
                )
        except OSError as error:
            raise StorageError(f"{path}: cannot be written ({error.strerror})") from error
