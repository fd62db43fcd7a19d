"""Evidence of what a policy decided and was shown: a file of canonical actions per episode, and hashes."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.files.untrusted_files import array_digest
from arena_newton.interfaces import EpisodeResult, Observation, Recorder, World

__all__ = ["OUTCOMES_FILE", "ActionRecorder", "packed_actions"]

OUTCOMES_FILE = "outcomes.jsonl"
"""File of the episodes that LeRobot's command line played: a line with outcome, reason, steps and margin of each."""


def packed_actions(
    actions: Sequence[np.ndarray], *, episode_seed: int, gym_id: str, mode: str, queries: Sequence[int] = ()
) -> tuple[bytes, str]:
    """File of the actions that an episode executed, `<task>_<mode>_s<group seed>_r<repeat>.npz`, for a replay.

    Args:
        actions: Canonical actions, one per tick, each of shape [40].
        mode: One of `modes.names()`.
        queries: Ticks at which the policy was asked, where they are known.

    Returns:
        The file, and the hash of its arrays.
    """
    arrays: dict[str, np.ndarray] = {
        "action": np.stack(actions),
        "episode_seed": np.asarray(np.int64(episode_seed)),
        "task": np.asarray(np.str_(gym_id)),
        "mode": np.asarray(np.str_(mode)),
        "queries": np.asarray(queries, np.int32),
    }
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # its flags are named alike
    return file.getvalue(), array_digest(arrays)


@dataclass
class _Running:
    """Evidence of the episode that a world runs."""

    actions: list[np.ndarray] = field(default_factory=list)
    queries: list[int] = field(default_factory=list)
    shown: hashlib._Hash = field(default_factory=hashlib.sha256)


class ActionRecorder(Recorder):
    """Keeps a policy's actions, and hashes of what it was shown and of the last state, until their episode ends."""

    def __init__(self, keep: Callable[[str, bytes], None], inside: str = "actions"):
        """Record without an episode yet.

        Args:
            keep: Takes path below the results folder, and content, of the file of an episode's actions.
            inside: Folder of the files: `<task>_<mode>_s<group seed>_r<repeat>.npz`, with the arrays `action`
                [ticks, 40], `episode_seed` and `queries`, and the texts `task`, the task's Gym id, and `mode`.
        """
        self._keep_file, self.inside = keep, inside
        self._running: dict[int, _Running] = {}
        self._ended: dict[int, tuple[dict[str, str], dict[str, str]]] = {}
        """File and hashes by the episode's number."""

    def start(self, env: World, world: int, episode: Episode) -> None:
        """An episode without actions yet."""
        self._running[world] = _Running()

    def query(self, env: World, observation: Observation) -> None:
        """Add what the worlds that ask are shown."""
        asking = np.flatnonzero(observation.mask).tolist()
        parts = {"state": observation.state} | {f"picture {name}": one for name, one in observation.images.items()}
        parts |= {f"depth {name}": one for name, one in observation.depths.items()}
        rows = [(name, parts[name][asking].detach().cpu().numpy()) for name in sorted(parts)]
        for row, world in enumerate(asking):
            tick, mine = int(env.tick[world]), self._running[world]
            mine.queries.append(tick)
            for name, values in rows:
                mine.shown.update(f"{tick} {name} {values.dtype.str} {values.shape[1:]}\n".encode())
                mine.shown.update(values[row].tobytes())

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Keep the actions of the worlds that act."""
        rows = action.detach().cpu().numpy()
        for world in np.flatnonzero(env.active & (env.tick >= 0)).tolist():
            self._running[world].actions.append(rows[world].copy())

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Hand over the actions that were executed, if any were.

        Raises:
            StorageError: The file cannot be written.
        """
        mine = self._running.pop(world)
        if result.steps < 1:
            return
        episode, gym_id = result.episode, env.spec.gym_id
        name = f"{self.inside}/{episode.key.replace('/', '_')}.npz"
        file, digest = packed_actions(
            mine.actions, episode_seed=episode.episode_seed, gym_id=gym_id, mode=episode.mode, queries=mine.queries
        )
        self._keep_file(name, file)
        state = {key: getattr(env.physics, key).numpy()[world] for key in ("qpos", "qvel")}
        hashes = {"actions": digest, "final_state": array_digest(state), "shown": mine.shown.hexdigest()}
        self._ended[episode.index] = {"actions": name}, hashes

    def taken(self, index: int) -> tuple[dict[str, str], dict[str, str]]:
        """Path of an episode's actions below the results folder, by `actions`, and `journal.EVIDENCE` by key; once.

        Args:
            index: The episode's number. Of one without actions there is neither.
        """
        return self._ended.pop(index, ({}, {}))
