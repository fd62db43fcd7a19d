"""Batches of worlds for LeRobot: they know a policy's task vector and labels, and write what LeRobot does not."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from arena_newton.data.readers.label_decoder import V4Decoder
from arena_newton.errors import InputError
from arena_newton.eval.adapters.gym import ArenaVectorEnv, Info, Observations
from arena_newton.eval.adapters.lerobot_env.policy_worlds import PolicyWorlds
from arena_newton.eval.folders.recordings import OUTCOMES_FILE, packed_actions
from arena_newton.eval.records.journal import StorageError, write_atomic
from arena_newton.policies.label_reader import measured_yaw
from arena_newton.policies.lerobot.checkpoint_facts import vector_of

__all__ = ["PolicyVectorEnv", "V4VectorEnv", "make_worlds"]

VECTOR_KEYS = ("environment_state", "observation.environment_state")
"""Names of the task vector in an observation: that of LeRobot's environments, and that of datasets for recordings."""


class PolicyVectorEnv(ArenaVectorEnv):
    """Worlds of one task for a policy of LeRobot, whose actions are of v3.1."""

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        policy: PolicyWorlds | None = None,
        episodes: Path | None = None,
        **options: object,
    ):
        """Build the worlds.

        Args:
            task: Task name.
            num_envs: Worlds in the batch.
            policy: What is known of the policy.
            episodes: Folder that gets a line per episode and its actions, where worlds wait for a reset after their
                end; None: nothing is written.
            options: Those of `ArenaVectorEnv`.

        Raises:
            InputError: The policy was not trained on the task, or as of `ArenaVectorEnv`.
        """
        self._policy, self._folder = policy or PolicyWorlds(), episodes
        known = self._policy.task_vector
        if known and task not in known:
            raise InputError(f"--env.task {task}: the policy was trained on {', '.join(known)}")
        super().__init__(task, num_envs, **cast("dict[str, Any]", options))
        trackers = self._policy.tracker_vector if known else ()
        vector = np.array(vector_of(known, trackers, task, self.env.tracker.name), np.float32)
        self._vectors = {name: np.tile(vector, (num_envs, 1)) for name in VECTOR_KEYS} if known else {}
        if self._vectors:
            box = spaces.Box(0.0, 1.0, vector.shape, np.float32)
            parts = cast("spaces.Dict", self.single_observation_space).spaces
            self.single_observation_space = spaces.Dict(parts | dict.fromkeys(VECTOR_KEYS, box))
            self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._executed: list[list[np.ndarray]] = [[] for _ in range(num_envs)]
        self._kept = np.zeros(num_envs, dtype=bool)

    def step(self, actions: np.ndarray | torch.Tensor) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Advance by one tick; see `ArenaVectorEnv.step`."""
        if self._folder is None:
            return super().step(actions)
        rows = self._checked(actions).cpu().numpy()
        for world in np.flatnonzero(self._acting()).tolist():
            self._executed[world].append(rows[world].copy())
        answer = super().step(actions)
        for world in np.flatnonzero(self._over & ~self._kept).tolist():
            self._keep(self._folder, world)
        return answer

    def _acting(self) -> np.ndarray:
        """Worlds whose next action is executed, bool, shape [num_envs]."""
        return ~self._over & (self.env.tick >= 0)

    def _begin(self, mask: np.ndarray, numbers: Sequence[int | None]) -> None:
        """Begin episodes, of which nothing is known yet."""
        for world in np.flatnonzero(mask).tolist():
            self._executed[world] = []
        self._kept[mask] = False
        super()._begin(mask, numbers)

    def _observation(self) -> Observations:
        """Observation and task."""
        return super()._observation() | {name: value.copy() for name, value in self._vectors.items()}

    def _keep(self, folder: Path, world: int) -> None:
        """Write what became of a world's episode."""
        group, repeat = divmod(int(self._seed[world]), self.repeats)
        margin = float(self._margin[world])
        line = {
            "task": self.task,
            "mode": self.env.mode,
            "tracker": self.env.tracker.name,
            "group_seed": group,
            "repeat": repeat,
            "episode_seed": int(self._episode_seed[world]),
            "outcome": str(self._outcome[world]),
            "reason": str(self._reason[world]),
            "steps": max(int(self.env.tick[world]), 0),
            "margin": margin if np.isfinite(margin) else None,
        }
        try:
            (folder / "actions").mkdir(parents=True, exist_ok=True)
            with (folder / OUTCOMES_FILE).open("a") as file:
                file.write(json.dumps(line) + "\n")
        except OSError as error:
            raise StorageError(f"--env.episodes {folder}: cannot be written ({error.strerror})") from error
        if self._executed[world]:
            path = folder / "actions" / f"{self.task}_{self.env.mode}_s{group}_r{repeat}.npz"
            seed, gym_id = int(self._episode_seed[world]), self.env.spec.gym_id
            content, _ = packed_actions(self._executed[world], episode_seed=seed, gym_id=gym_id, mode=self.env.mode)
            write_atomic(path, content, "the episodes before are kept")
        self._kept[world] = True


class V4VectorEnv(PolicyVectorEnv):
    """Worlds of one task whose actions are of v4; an episode's heading is that of its own start."""

    def __init__(self, task: str, num_envs: int = 1, *, policy: PolicyWorlds | None = None, **options: object):
        """Build the worlds; arguments as of `PolicyVectorEnv`.

        Raises:
            InputError: A number is out of range, or as of `PolicyVectorEnv`.
        """
        policy = policy or PolicyWorlds(labels="v4")
        if not 0.0 <= policy.realign <= 1.0:
            raise InputError(f"realign {policy.realign}: expected 0 to 1")
        if policy.query_ticks < 1:
            raise InputError(f"query_ticks {policy.query_ticks}: expected at least 1")
        super().__init__(task, num_envs, policy=policy, **cast("dict[str, Any]", options))
        self._decoder = V4Decoder(num_envs, realign=policy.realign)

    def step(self, actions: np.ndarray | torch.Tensor) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Decode a tick's actions and advance; see `ArenaVectorEnv.step`."""
        acting = self._acting()
        self._decoder.measure(
            measured_yaw(torch.from_numpy(self._state)), acting & (self.env.tick % self._policy.query_ticks == 0)
        )
        decoded = self._decoder.decode(self._checked(actions).cpu()[:, None], acting)[:, 0]
        return super().step(decoded)

    def _begin(self, mask: np.ndarray, numbers: Sequence[int | None]) -> None:
        """Begin episodes at their own heading."""
        self._decoder.reset(mask)
        super()._begin(mask, numbers)


def make_worlds(
    task: str, num_envs: int, policy: PolicyWorlds, episodes: Path | None, options: Mapping[str, object]
) -> PolicyVectorEnv:
    """A batch of worlds for a policy; arguments as of `PolicyVectorEnv`, whose worlds take what it decides."""
    kind = V4VectorEnv if policy.labels == "v4" else PolicyVectorEnv
    return kind(task, num_envs, policy=policy, episodes=episodes, **options)
