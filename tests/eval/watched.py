"""Worlds that keep a hash of every tick, and a recorder of actions: to compare two ways to play episodes."""

import hashlib

import numpy as np

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.eval.plan import episode_plan
from arena_newton.eval.play.env_cache import CachedEnv
from arena_newton.interfaces import Recorder
from arena_newton.rollout import Rollout


class WatchedEnv(ArenaEnv):
    """Keeps, by episode seed, a hash of the physical state and the observed 64 numbers after every tick."""

    history: dict[int, list[str]] = {}
    """Hashes of all watched worlds since it was last cleared."""

    def reset(self, seeds, worlds=None, *, spawn=None):
        super().reset(seeds, worlds, spawn=spawn)
        self.playing = getattr(self, "playing", {})
        for seed, world in zip(seeds, range(self.worlds) if worlds is None else worlds, strict=True):
            self.playing[int(world)] = int(seed)
            self.history[int(seed)] = []

    def step(self, action, worlds=None):
        stepping = self.active.copy() if worlds is None else self.active & worlds
        status = super().step(action, worlds)
        qpos, qvel = self.physics.qpos.numpy(), self.physics.qvel.numpy()
        state = self.observe().state.cpu().numpy()
        for world in np.flatnonzero(stepping).tolist():
            words = qpos[world].tobytes() + qvel[world].tobytes() + state[world].tobytes()
            self.history[self.playing[world]].append(hashlib.sha256(words).hexdigest()[:16])
        return status


class LastingWatchedEnv(CachedEnv, WatchedEnv):
    """A watched environment that is handed out again."""


class Table(Recorder):
    """Keeps the actions of every episode, by its seed: float32, shape [ticks, 40]."""

    def __init__(self):
        self.rows, self.playing = {}, {}

    def start(self, env, world, episode):
        self.playing[world] = episode.episode_seed
        self.rows[episode.episode_seed] = []

    def before_physics(self, env, observation, action):
        for world in np.flatnonzero(env.active & (env.tick >= 0)).tolist():
            self.rows[self.playing[world]].append(action[world].cpu().numpy().copy())

    def at(self, seed, tick):
        """The action of a tick; the last one after the end."""
        rows = self.rows[int(seed)]
        return rows[min(int(tick), len(rows) - 1)]


def watched_rollout(made, task, count, worlds, policy, *, recorder=(), max_steps=None):
    """Play the first episodes of the plan in watched worlds; hashes by episode seed, and results in the plan's order.

    Args:
        made: Builder of the worlds, such as the fixture `watched_worlds`.
    """
    camera = policy.camera if policy.needs_image else None
    given = {"worlds": worlds, "engine": "mujoco", "device": "cpu", "camera": camera}
    env = made(task, tracker=trackers.get("twist2"), **given)
    episodes = episode_plan.expand([task], trackers=["twist2"], policy="test", seeds=[0], repeats=count)
    WatchedEnv.history.clear()
    results = Rollout(env, policy, episodes, recorder=recorder, max_steps=max_steps).run()
    hashes = {seed: list(ticks) for seed, ticks in WatchedEnv.history.items()}
    WatchedEnv.history.clear()
    env.close()
    return hashes, results
