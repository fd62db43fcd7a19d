"""Queries of a run made again while its episodes are replayed: what the policy was shown, and its answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from arena_newton.eval.folders.recordings import ActionRecorder
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.files.untrusted_files import numbers, read_arrays
from arena_newton.interfaces import Observation, Policy, World
from arena_newton.physics.policy_view import PolicyView
from arena_newton.rules import seeding

__all__ = ["AskedAgain", "Answers", "RecordedQueries"]


@dataclass(frozen=True)
class RecordedQueries:
    """Actions of an episode, and when its policy was asked for them."""

    actions: np.ndarray
    """Canonical actions, shape [ticks, 40]."""
    queries: frozenset[float]
    """Ticks; none of an episode of a version that did not keep them."""

    @classmethod
    def read(cls, folder: Path, name: str | None) -> RecordedQueries:
        """Read a file of actions, by its path in a results folder; without one there are none.

        Raises:
            InputError: It is absent or damaged.
        """
        if name is None:
            return cls(np.zeros((0, 40), np.float32), frozenset())
        path = folder / name
        arrays = read_arrays(path, ("action", "queries"))
        queries = numbers(arrays.get("queries", np.zeros(0)), f"{path}: queries", np.float64)
        return cls(arrays["action"], frozenset(np.ravel(queries).tolist()))


@dataclass
class Answers:
    """A policy's answers at the queries of one episode, against its recorded actions."""

    asked: int = 0
    """Actions that were compared."""
    equal: int = 0
    """Actions with the same bits."""
    largest: float = 0.0
    """Largest difference of a number of an action."""
    error: str | None = None
    """Message of the policy's first error."""
    first: int | None = None
    """First tick at which an action differs by more than the tolerance."""
    until: int = 0
    """Tick before which every action is of a query, or of the stand before the first."""
    unasked: int | None = None
    """First tick whose action no query gave."""


class AskedAgain(ActionRecorder):
    """Records a replay as its run was recorded: queries at the recorded ticks, not at those of the replay.

    Answers of a policy that is asked again are compared; recorded actions are played.
    """

    def __init__(
        self,
        recorded: Mapping[int, RecordedQueries],
        policy: Policy | None = None,
        *,
        latency: int = 0,
        tolerance: float = 0.0,
    ):
        """Ask nothing yet.

        Args:
            recorded: Recordings by the episode's number.
            policy: The policy to ask; none: only what it was shown is drawn again.
            latency: Ticks from a query to the first action of its chunk.
            tolerance: Largest difference of an action that is still the policy's.
        """
        super().__init__(lambda name, content: None)
        self.recorded, self.policy, self.latency, self.tolerance = recorded, policy, latency, tolerance
        self.answers: dict[int, Answers] = {}
        """Answers by the episode's number."""
        self._episodes: dict[int, int] = {}
        self._view: PolicyView | None = None
        self._seeds: list[int] = []

    def start(self, env: World, world: int, episode: Episode) -> None:
        """An episode begins, for the policy too."""
        super().start(env, world, episode)
        self._episodes[world] = episode.index
        if self.policy is None:
            return
        if self._view is None:
            self._view, self._seeds = PolicyView(env), [0] * env.worlds
            self.policy.attach(self._view)
        self._view.refresh()
        self._seeds[world] = seeding.policy_seed(episode.episode_seed)
        self.answers[episode.index] = Answers(until=self.latency)
        self.policy.reset(self._seeds, [env.spec.gym_id] * env.worlds, np.arange(env.worlds) == world)

    def query(self, env: World, observation: Observation) -> None:
        """The replay's own query, which the run did not make."""

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Ask where the run asked; keep the actions."""
        asks = np.zeros(env.worlds, dtype=bool)
        for world in np.flatnonzero(env.active & (env.tick >= 0)).tolist():
            asks[world] = int(env.tick[world]) in self.recorded[self._episodes[world]].queries
        if asks.any():
            seen = env.observe(asks, image=bool(env.cameras))
            super().query(env, seen)
            if self.policy is not None and self._view is not None:
                self._view.refresh()
                self._compare(env, self.policy, seen)
        for world in np.flatnonzero(env.active & (env.tick >= 0)).tolist() if self.policy is not None else ():
            found, tick = self.answers[self._episodes[world]], int(env.tick[world])
            if found.until <= tick < len(self.recorded[self._episodes[world]].actions) and found.unasked is None:
                found.unasked = tick
        super().before_physics(env, observation, action)

    def _compare(self, env: World, policy: Policy, seen: Observation) -> None:
        """Hold the policy's answers to the recorded actions."""
        answer = policy.act(seen)
        chunks = torch.as_tensor(answer.actions, dtype=torch.float32).detach().cpu().numpy()
        for world in np.flatnonzero(seen.mask).tolist():
            index = self._episodes[world]
            found, begins = self.answers[index], int(env.tick[world]) + self.latency
            if world in answer.errors:
                found.error = found.error or answer.errors[world]
                continue
            found.until = max(found.until, begins + chunks.shape[1] if begins <= found.until else 0)
            recorded = self.recorded[index].actions[begins : begins + chunks.shape[1]]
            difference = np.abs(chunks[world, : len(recorded)] - recorded).max(axis=1, initial=0.0)
            found.asked += len(recorded)
            found.equal += int((difference == 0.0).sum())
            found.largest = max(found.largest, float(difference.max(initial=0.0)))
            late = np.flatnonzero(~(difference <= self.tolerance))
            if len(late) and found.first is None:
                found.first = begins + int(late[0])
