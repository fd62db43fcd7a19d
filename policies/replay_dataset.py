"""The policy that plays a LeRobot dataset: one of its episodes, or to each of our episodes its own recording."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from arena_newton import tasks as task_registry
from arena_newton.data.readers.dataset_files import PARQUET_BYTES
from arena_newton.data.readers.lerobot_reader import DatasetActions
from arena_newton.errors import InputError
from arena_newton.files.untrusted_files import read_bytes
from arena_newton.policies.base import Json, Mask
from arena_newton.policies.open_loop import RecordedEpisodes
from arena_newton.rules import seeding

if TYPE_CHECKING:
    from arena_newton.interfaces import World

__all__ = ["ALL", "ReplayDataset"]

ALL = "all"
"""Instead of an episode's number: each of our episodes plays the recording of its own seed."""


class ReplayDataset(RecordedEpisodes):
    """Plays actions of a LeRobot dataset, open loop."""

    def __init__(self, root: str | Path, episode: str | None = None):
        """Read the actions.

        Args:
            root: Folder of the dataset.
            episode: Number of the episode that every world plays, or `all`: to each its own, by task, mode and seed.

        Raises:
            InputError: The dataset or the episode is unfit; see `data.readers.lerobot_reader`.
        """
        super().__init__()
        self.where = f"--policy replay:{root}"
        try:
            self.dataset = DatasetActions(root)
            self.path = self.dataset.files.root
            self.name = f"replay-{self.path.name}"
            self._one: np.ndarray | None = None
            self._seeded: dict[tuple[str, str, int], list[tuple[str, int]]] = {}
            if episode == ALL:
                self._all()
            else:
                self._single(episode)
        except InputError as error:
            raise InputError(f"{self.where}: {error}" if self.where not in str(error) else str(error)) from None
        self._tracker, self._read = "", dict[int, np.ndarray]()

    def _all(self) -> None:
        """Find the recorded ones among our episodes."""
        for number, seed in enumerate(self.dataset.seeds()):
            if seed.task not in task_registry.names():
                raise InputError(f"{self.dataset.where}: arena: episode {number}: no task {seed.task[:80]!r}")
            key = task_registry.get(seed.task).gym_id, seed.mode, seeding.policy_seed(seed.episode_seed)
            self._seeded.setdefault(key, []).append((seed.tracker, number))
        if not self._seeded:
            raise InputError(
                f"{self.dataset.where}: does not say which seeds its episodes have; name one, as in #0 of "
                f"0 to {self.dataset.episodes - 1}"
            )

    def _single(self, episode: str | None) -> None:
        """Read the one episode."""
        if episode is None or not episode.isascii() or not episode.isdigit():
            given = f"#{episode[:40]}: is no episode" if episode is not None else "name an episode"
            last = self.dataset.episodes - 1
            raise InputError(f"{given}: {self.where}#0 to #{last}, or #{ALL} where the dataset knows our seeds")
        self.number = int(episode)
        self._one = self.dataset.actions(self.number)
        self.name = f"{self.name}-{self.number}"

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """Refuse a task or seeds that are not recorded.

        Raises:
            InputError: The message says what is.
        """
        if self._one is not None:
            recorded = self.dataset.task(self.number)
            if recorded is not None and recorded != task:
                raise InputError(f"{self.where}#{self.number}: is an episode of {recorded}, not of {task}")
            return
        gym_id = task_registry.get(task).gym_id
        here = {(recorded, seed) for name, recorded, seed in self._seeded if name == gym_id}
        if not here:
            raise InputError(f"{self.where}: no recording of task {task}")
        modes = sorted({recorded for recorded, _ in here})
        if mode is not None and mode not in modes:
            raise InputError(f"{self.where}: no recording of task {task} in mode {mode}, only {', '.join(modes)}")
        if seeds and not any((mode, seed) in here for seed in seeds):
            kinds = sorted({seeding.seed_range(one.episode_seed) for one in self.dataset.seeds() if one.task == task})
            raise InputError(f"{self.where}: recordings of task {task}, but of other seeds (of {', '.join(kinds)})")

    def attach(self, env: World) -> None:
        """Take mode and tracker of the worlds."""
        super().attach(env)
        self._tracker = env.tracker.name

    def recording(self, task: str, mode: str, seed: int) -> np.ndarray | None:
        """The one episode; or that of a seed, the one through the same tracker where several were recorded."""
        if self._one is not None:
            return self._one
        found = self._seeded.get((task, mode, seed), [])
        same = [number for tracker, number in found if tracker == self._tracker] or [number for _, number in found]
        if len(same) != 1:
            return None
        if same[0] not in self._read:
            self._read[same[0]] = self.dataset.actions(same[0])
        return self._read[same[0]]

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Take the recordings of the worlds in `mask`; those that are no longer played are forgotten."""
        super().reset(seeds, tasks, mask)
        self._read = {number: rows for number, rows in self._read.items() if any(rows is p for p in self.playing)}

    def describe(self) -> Json:
        """Folder, protocol, and the episode with a hash of its actions."""
        facts = {"name": self.name, "folder": self.path.name, "labels": self.dataset.labels}
        if self._one is None:
            digest = hashlib.sha256()
            for file in sorted(self.path.glob("data/chunk-*/file-*.parquet")):
                digest.update(read_bytes(file, PARQUET_BYTES))
            return facts | {"episodes": self.dataset.episodes, "hash": digest.hexdigest()[:12]}
        hashed = hashlib.sha256(np.ascontiguousarray(self._one).tobytes()).hexdigest()[:12]
        return facts | {"episode": self.number, "ticks": len(self._one), "hash": hashed}
