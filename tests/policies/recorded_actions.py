"""Rollouts of an expert with its actions by episode, for tests that compare two runs bit for bit."""

from types import SimpleNamespace

import torch

from arena_newton import policies
from arena_newton.interfaces import Recorder
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding


class Actions(Recorder):
    """Keeps the actions of every episode, by its seed."""

    def __init__(self, startup=True):
        """With those of the start-up, or from step 0 on."""
        self.startup, self.worlds, self.rows = startup, {}, {}

    def start(self, env, world, episode):
        self.worlds[world] = self.rows.setdefault(episode.episode_seed, [])

    def before_physics(self, env, observation, action):
        for world, rows in self.worlds.items():
            if self.startup or (env.active[world] and env.tick[world] >= 0):
                rows.append(action[world].clone())

    def finish(self, env, world, result):
        del self.worlds[world]


def episodes(env, *repeats, group=900):
    """Episodes of a group seed for a rollout."""
    return [SimpleNamespace(episode_seed=seeding.episode_seed(env.spec.gym_id, group, i)) for i in repeats]


def expert_rollout(env, played, ticks=None, recorders=(), **more):
    """Results of the expert in the plan's order, and its actions by seed, one row per tick."""
    actions = Actions()
    results = Rollout(
        env, policies.get("expert"), played, recorder=[actions, *recorders], max_steps=ticks, **more
    ).run()
    return results, actions.rows


def assert_same_elsewhere(env, first, played, ticks=100):
    """Play episodes of which one was played before: in another world or company it gets the same actions."""
    _, rows = expert_rollout(env, played, ticks)
    (seed,) = first.keys() & rows.keys()
    again = torch.stack(rows[seed])
    assert len(again) > ticks and torch.equal(torch.stack(first[seed])[: len(again)], again)
