"""Episodes of a plan over a batch of worlds: each world takes the next one as soon as it is free.

Chunks, budgets, endings and a policy's errors are handled here; how a world moves and is judged is the `World`'s.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from arena_newton import recorders
from arena_newton.errors import InputError
from arena_newton.files.text import counted
from arena_newton.interfaces import (
    Chunk,
    Disturbance,
    EpisodeResult,
    Observation,
    Planned,
    Policy,
    Recorder,
    Spawn,
    World,
)
from arena_newton.kernels import tick as codes
from arena_newton.physics.policy_view import PolicyView
from arena_newton.pictures.settings import policy_cameras
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION
from arena_newton.robot.g1 import TICK
from arena_newton.rules import seeding

__all__ = ["Rollout", "ending"]


@dataclass
class _Running:
    """The episode that a world runs."""

    index: int
    """Its position in the plan."""
    episode: Planned
    began: float
    """Wall-clock time of its reset [s]."""
    phases: list[tuple[str, int]] = field(default_factory=list)
    """The policy's phases and their first ticks so far."""


def ending(env: World, code: int, tick: int, budget: int) -> tuple[str, str, str | None] | None:
    """Outcome, reason and message of an episode; None while it goes on.

    Args:
        env: The worlds.
        code: Code of `env.step` for the episode's world.
        tick: Ticks since its step 0, the one that ended now included; negative in the start-up.
        budget: Its step budget [ticks].
    """
    if code == codes.ERROR_STATE:
        return "error", "nonfinite_state", "the simulation state of this world became non-finite"
    if code == codes.ERROR_TARGETS:
        return "error", "tracker", f"tracker {env.tracker.name}: a joint target is not finite"
    if code == codes.ERROR_ACTION:
        return "error", "bad_action", "the policy's action is non-finite or its rot6d is degenerate"
    if code == codes.SUCCESS:
        return "success", "success", None
    if code == codes.FALL:
        return "fall", "startup_fall" if tick <= 0 else "fall", None
    if code > codes.EVENT:
        return "timeout", env.spec.events[code - codes.EVENT], None
    return ("timeout", "timeout", None) if tick >= budget else None


class Rollout:
    """A policy plays episodes in a batch of worlds; `run` returns when all have ended."""

    def __init__(
        self,
        env: World,
        policy: Policy,
        episodes: Sequence[Planned],
        *,
        recorder: Recorder | Sequence[Recorder] = (),
        disturbance: Disturbance | None = None,
        max_steps: int | None = None,
        latency: int = 0,
        spawn: Spawn | None = None,
        samples: Callable[[Planned], Mapping[str, dict[str, float]]] | None = None,
        modes: Callable[[Planned], str] | None = None,
        on_finish: Callable[[EpisodeResult], None] | None = None,
        on_tick: Callable[[int], None] | None = None,
    ):
        """Prepare the run.

        Args:
            env: The worlds.
            policy: A policy (`arena_newton.policies`).
            episodes: Objects with `episode_seed` and whatever the caller needs back; they start in this order.
            recorder: One recorder or several, which are called in their order.
            disturbance: Makes the executed actions of a tick from the policy's; recorders see the policy's.
            max_steps: Step budget instead of the rule set's [ticks].
            latency: Ticks from a policy's query to the first action of its chunk. Meanwhile the chunk before goes on:
                the policy is queried again when so many actions of it are left; in an episode's first ticks the robot
                stands.
            spawn: The robot's pose at a reset instead of the task's spawn pose.
            samples: Samples of the objects' poses of an episode instead of those that its seed draws.
            modes: Mode of an episode instead of the environment's; both have one scene.
            on_finish: Called with each result, in the order of ending.
            on_tick: Called each tick with the number of active worlds.
        """
        if planning := getattr(env, "planning", ""):
            raise InputError(f"these worlds are a planning model ({planning}): no episode is played or judged in them")
        self.env, self.policy = env, policy
        self._view = PolicyView(env)
        self.recorders: Sequence[Recorder] = [recorder] if isinstance(recorder, Recorder) else recorder
        self.disturbance, self.spawn = disturbance, spawn
        self._drawn = {name: draw for name, draw in (("samples", samples), ("modes", modes)) if draw is not None}
        self.budget = max_steps or env.budget
        self.on_finish, self.on_tick = on_finish, on_tick
        self.latency = latency
        self._observing = any(one.wants_observation for one in self.recorders)
        self._waiting = deque(enumerate(episodes))
        self._running: dict[int, _Running] = {}
        self._results: dict[int, EpisodeResult] = {}
        self._chunk = torch.zeros((env.worlds, 1, ACTION_WIDTH), device=env.torch_device)
        self._next, self._length = np.zeros(env.worlds, np.int64), np.zeros(env.worlds, np.int64)
        """Next action of each world's chunk, and its length; it begins with what is left of the chunk before."""
        self._stand = torch.tensor(STAND_ACTION, device=env.torch_device).expand(env.worlds, latency, ACTION_WIDTH)
        """Actions before an episode's first chunk begins, shape [worlds, latency, 40]."""
        self._rows = torch.arange(env.worlds, device=env.torch_device)
        self._lookahead = getattr(env.tracker, "lookahead", 0)

    def run(self) -> list[EpisodeResult]:
        """Play all episodes.

        Returns:
            Results in the order of the plan.

        Raises:
            InputError: A chunk of the policy or targets of the tracker have another shape than the interface says.
        """
        env = self.env
        self.policy.attach(self._view)
        sees = bool(policy_cameras(self.policy))
        self._assign(range(env.worlds))
        while env.active.any():
            asks = env.active & (env.tick >= 0) & (self._next + self.latency >= self._length)
            observation = None
            if asks.any():
                observation = env.observe(asks, image=sees)
                failed = self._ask(observation)
                if failed:
                    self._assign(failed)
                    continue  # without a start-up the new episodes ask before this tick
            self._assign(self._endings(self._tick(observation)))
            if self.on_tick is not None:
                self.on_tick(int(env.active.sum()))
        return [self._results[index] for index in sorted(self._results)]

    def _assign(self, free: Iterable[int]) -> None:
        """Give free worlds the next episodes; those for which none is left are released."""
        env, free = self.env, list(free)
        if not free:
            return
        taken = {world: self._waiting.popleft() for world in free[: len(self._waiting)]}
        env.release(free)
        if not taken:
            return
        episodes = [episode for _, episode in taken.values()]
        seeds_of = [episode.episode_seed for episode in episodes]
        drawn: dict[str, Any] = {name: [draw(one) for one in episodes] for name, draw in self._drawn.items()}
        env.reset(seeds_of, list(taken), spawn=self.spawn, **drawn)
        mask, seeds = np.zeros(env.worlds, dtype=bool), [0] * env.worlds
        for world, (index, episode) in taken.items():
            self._running[world] = _Running(index, episode, time.perf_counter())
            mask[world], seeds[world] = True, seeding.policy_seed(episode.episode_seed)
            self._length[world] = self._next[world] = 0
            for one in self.recorders:
                one.start(env, world, episode)
        self._view.refresh()
        self.policy.reset(seeds, [env.spec.gym_id] * env.worlds, mask)

    def _ask(self, observation: Observation) -> list[int]:
        """Take new chunks from the policy; ends the episodes for which it has none, and returns their worlds."""
        self._view.refresh()
        for one in self.recorders:
            one.query(self.env, observation)
        answer, asks = self.policy.act(observation), observation.mask
        self._take(answer, asks)
        failed = {world: message for world, message in answer.errors.items() if asks[world]}
        for world in np.flatnonzero(asks).tolist():
            phase = None if answer.phases is None else answer.phases[world]
            phases = self._running[world].phases
            if phase is not None and (not phases or phases[-1][0] != phase):
                phases.append((phase, int(self.env.tick[world]) + self.latency))
        for world, message in failed.items():
            self._finish(world, "error", "policy", message)
        return list(failed)

    def _take(self, answer: Chunk, asks: np.ndarray) -> None:
        """Keep the rows of a chunk that were asked for."""
        worlds = self.env.worlds
        actions = torch.as_tensor(answer.actions, dtype=torch.float32, device=self.env.torch_device)
        if actions.ndim != 3 or actions.shape[::2] != (worlds, ACTION_WIDTH) or not actions.shape[1]:
            raise InputError(
                f"policy {self.policy.name}: a chunk of shape {list(actions.shape)}, expected "
                f"[{worlds}, n, {ACTION_WIDTH}] with n of at least 1"
            )
        if self.latency:
            actions = torch.cat([self._left(actions.shape[1]), actions], dim=1)
        longer = actions.shape[1] - self._chunk.shape[1]
        if longer > 0:
            self._chunk = torch.nn.functional.pad(self._chunk, (0, 0, 0, longer))
        rows = torch.from_numpy(asks).to(self.env.torch_device)
        self._chunk[rows, : actions.shape[1]] = actions[rows]
        self._next[asks], self._length[asks] = 0, actions.shape[1]

    def _left(self, length: int) -> torch.Tensor:
        """Actions of every world until a chunk of a length begins, shape [worlds, latency, 40].

        Whoever is asked again before its answer has begun would have to decide twice at once; only one that gives a
        longer chunk in pieces does not.
        """
        whole = getattr(self.policy, "chunk_size", 1) if getattr(self.policy, "in_pieces", False) else length
        if whole <= self.latency:
            late = f"--latency-ticks {self.latency}: policy {self.policy.name} gives chunks of"
            raise InputError(f"{late} {counted(whole, 'action')}; expected fewer ticks than that")
        ticks = np.clip(self._next[:, None] + np.arange(self.latency), 0, self._chunk.shape[1] - 1)
        left = self._chunk[self._rows[:, None], torch.from_numpy(ticks).to(self.env.torch_device)]
        first = torch.from_numpy(self._length == 0).to(self.env.torch_device)
        return torch.where(first[:, None, None], self._stand, left)

    def _tick(self, observation: Observation | None) -> np.ndarray:
        """Play the next action of every chunk; `observation` is what the policy saw at this tick, if it was asked."""
        env = self.env
        acting = env.active & (env.tick >= 0)
        index = np.where(acting, np.minimum(self._next, self._chunk.shape[1] - 1), 0)
        action = self._chunk[self._rows, torch.from_numpy(index).to(env.torch_device)]
        if self._observing and observation is None:
            observation = env.observe()
        for one in self.recorders:
            one.before_physics(env, observation if self._observing else None, action)
        if self._lookahead:
            env.loop.announce(self._coming(acting))
        status = env.step(action if self.disturbance is None else self.disturbance(env, action))
        self._next[acting] += 1
        for one in self.recorders:
            one.tick(env)
        return status

    def _coming(self, acting: np.ndarray) -> torch.Tensor:
        """Actions of every chunk behind the next one, NaN after its end, shape [worlds, lookahead, 40]."""
        index = self._next[:, None] + np.arange(1, self._lookahead + 1)
        real = torch.from_numpy(acting[:, None] & (index < self._length[:, None])).to(self.env.torch_device)
        ticks = torch.from_numpy(np.minimum(index, self._chunk.shape[1] - 1)).to(self.env.torch_device)
        return torch.where(real[..., None], self._chunk[self._rows[:, None], ticks], torch.nan)

    def _endings(self, status: np.ndarray) -> list[int]:
        """Finish the episodes that a tick ended; returns their worlds."""
        ended = []
        for world in np.flatnonzero(self.env.active).tolist():
            found = ending(self.env, int(status[world]), int(self.env.tick[world]), self.budget)
            if found is not None:
                self._finish(world, *found)
                ended.append(world)
        return ended

    def _finish(self, world: int, outcome: str, reason: str, error: str | None) -> None:
        """Report how a world's episode ended."""
        env, running = self.env, self._running.pop(world)
        tick, verdict = int(env.tick[world]), env.verdict(world)
        result = EpisodeResult(
            episode=running.episode,
            outcome=outcome,
            reason=reason,
            steps=max(tick, 0),
            margin=verdict.margin,
            startup_fall=reason == "startup_fall",
            overflow=verdict.overflow,
            sim_s=float((tick + env.startup_ticks) * TICK),
            wall_s=time.perf_counter() - running.began,
            error=error,
            phases=tuple((name, first) for name, first in running.phases if not self.latency or first < tick),
            predicates=verdict.predicates,
            progress=1.0 if outcome == "success" else verdict.progress,
            events=verdict.events,
        )
        self._results[running.index] = result
        recorders.finish(self.recorders, env, world, result)
        if self.on_finish is not None:
            self.on_finish(result)
