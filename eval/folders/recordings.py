"""Recordings of what a policy decided: one file of canonical actions per episode."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.records.journal import StorageError
from arena_newton.files.own_files import replace_atomically
from arena_newton.interfaces import EpisodeResult, Observation, Recorder, World

__all__ = ["OUTCOMES_FILE", "ActionRecorder", "write_actions"]

OUTCOMES_FILE = "outcomes.jsonl"
"""File of the episodes that LeRobot's command line played: a line with outcome, reason, steps and margin of each."""


def write_actions(path: Path, actions: Sequence[np.ndarray], *, episode_seed: int, gym_id: str, mode: str) -> str:
    """Write the actions that an episode executed, as `--policy replay:` reads them.

    Args:
        path: The file, `<task>_<mode>_s<group seed>_r<repeat>.npz`.
        actions: Canonical actions, one per tick, each of shape [40].
        episode_seed: The episode's seed.
        gym_id: The task's Gym id.
        mode: One of `rule_types.MODES`.

    Returns:
        SHA-256 of the file.

    Raises:
        StorageError: The file cannot be written.
    """
    try:
        # A process that was given up for dead may still play the episode.
        with replace_atomically(path, shared=True) as file:
            np.savez_compressed(
                file,
                action=np.stack(actions),
                episode_seed=np.int64(episode_seed),
                task=np.str_(gym_id),
                mode=np.str_(mode),
            )
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror})") from error
    return hashlib.sha256(path.read_bytes()).hexdigest()


class ActionRecorder(Recorder):
    """Keeps a policy's actions until their episode ends, then writes them."""

    def __init__(self, folder: Path, inside: str = "actions"):
        """Write into a folder inside a results folder: `<task>_<mode>_s<group seed>_r<repeat>.npz`.

        The files hold the arrays `action` [ticks, 40] and `episode_seed`, and the texts `task`, the task's Gym id, and
        `mode`.
        """
        self.folder, self.inside = folder, inside
        self._actions: dict[int, list[np.ndarray]] = {}
        self._written: dict[int, tuple[str, str]] = {}
        """Path below the results folder, and SHA-256, by the episode's number."""

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
        episode, gym_id = result.episode, env.spec.gym_id
        name = f"{self.inside}/{episode.key.replace('/', '_')}.npz"
        seed, mode = episode.episode_seed, episode.mode
        digest = write_actions(self.folder / name, actions, episode_seed=seed, gym_id=gym_id, mode=mode)
        self._written[episode.index] = name, digest

    def taken(self, index: int) -> tuple[dict[str, str], str | None]:
        """Path of an episode's actions below the results folder, by `actions`, and its SHA-256; once.

        Args:
            index: The episode's number. Of one without actions there is neither.
        """
        path, digest = self._written.pop(index, (None, None))
        return ({} if path is None else {"actions": path}), digest
