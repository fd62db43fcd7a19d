"""Recordings of what a policy decided: one file of canonical actions an episode."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arena_newton.eval.journal import StorageError
from arena_newton.foreign import create
from arena_newton.interfaces import Chunk, EpisodeResult, Observation
from arena_newton.policies.base import Policy, world_mask

__all__ = ["RecordingPolicy"]


class RecordingPolicy(Policy):
    """Another policy whose actions are kept until an episode ends, then written."""

    def __init__(self, policy: Policy, folder: Path):
        """Stand in front of a policy.

        Args:
            policy: What decides.
            folder: Where the files go: `<task>_<mode>_s<group seed>_r<repeat>.npz` with the arrays `action`
                [ticks, 40] and `episode_seed`, and the texts `task`, the task's Gym id, and `mode`.
        """
        self.policy, self.folder = policy, folder
        self.name, self.needs_image, self.camera = policy.name, policy.needs_image, policy.camera
        self.chunk_size = policy.chunk_size
        self._chunks: dict[int, list[np.ndarray]] = {}
        self._seeds = np.zeros(0, dtype=np.int64)

    def check(self) -> None:
        """As the policy behind."""
        self.policy.check()

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """As the policy behind."""
        self.policy.check_task(task, mode, seeds)

    def attach(self, env: Any) -> None:
        """As the policy behind."""
        self.policy.attach(env)

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Any = None) -> None:
        """As the policy behind; the episodes of the worlds in `mask` begin."""
        self.policy.reset(seeds, tasks, mask)
        if len(self._seeds) != len(seeds):
            self._seeds = np.zeros(len(seeds), dtype=np.int64)
        for world in np.flatnonzero(world_mask(mask, len(seeds))):
            self._seeds[world] = seeds[world]
            self._chunks[int(seeds[world])] = []

    def act(self, observation: Observation) -> Chunk:
        """As the policy behind; the answer is kept."""
        chunk = self.policy.act(observation)
        actions = np.asarray(chunk.actions.detach().cpu() if hasattr(chunk.actions, "detach") else chunk.actions)
        for world in np.flatnonzero(world_mask(observation.mask, len(observation.state))):
            self._chunks[int(self._seeds[world])].append(actions[world].astype(np.float32))
        return chunk

    def describe(self) -> dict[str, Any]:
        """As the policy behind: recording changes nothing."""
        return self.policy.describe()

    def close(self) -> None:
        """As the policy behind."""
        self.policy.close()

    def write(self, result: EpisodeResult, task: str) -> Path | None:
        """Write an episode that ended; None where it had no tick.

        Args:
            result: How it ended; `steps` of its actions were executed.
            task: Gym id of its task.

        Raises:
            StorageError: The file cannot be written.
        """
        episode = result.episode
        chunks = self._chunks.pop(episode.episode_seed, [])
        if not chunks or result.steps < 1:
            return None
        path = self.folder / f"{episode.key.replace('/', '_')}.npz"
        partial = path.with_name(path.name + ".partial")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with create(partial) as file:
                np.savez_compressed(
                    file,
                    action=np.concatenate(chunks)[: result.steps],
                    episode_seed=np.int64(episode.episode_seed),
                    task=np.str_(task),
                    mode=np.str_(episode.mode),
                )
            partial.replace(path)
        except OSError as error:
            raise StorageError(f"{path}: cannot be written ({error.strerror})") from error
        return path
