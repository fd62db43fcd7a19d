"""A policy of your own: squat to a depth that follows from the episode's seed, up and down.

Shows: memory per world, masks, noise from the seed, the conformance checks, episodes in three worlds at once, and the
name under which the command line knows it. Other programs find it by an entry point; see docs/howto/bring/policies.md.

    python examples/own_policy.py
"""

import argparse
from collections.abc import Sequence

import numpy as np

from arena_newton import ArenaEnv, Rollout, policies, trackers
from arena_newton.eval.plan.episode_plan import expand
from arena_newton.policies.base import Mask
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.testing import check_policy


class Squat(policies.Policy):
    """Ten actions at a time; `observation.mask` says which worlds ask."""

    name = "squat"
    chunk_size = 10

    ticks = depth = np.zeros(0)

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Begin episodes: draw a depth from the seed, and forget the time."""
        if len(self.ticks) != len(seeds):
            self.ticks, self.depth = np.zeros(len(seeds)), np.zeros(len(seeds))
        for world in np.flatnonzero(policies.world_mask(mask, len(seeds))):
            self.ticks[world] = 0
            self.depth[world] = np.random.default_rng(seeds[world]).uniform(0.05, 0.15)

    def act(self, observation: policies.Observation) -> policies.Chunk:
        """Lower the reference root as one second of a cosine; the tracker bends the knees."""
        time = 0.02 * (self.ticks[:, None] + np.arange(self.chunk_size))
        actions = np.tile(STAND_ACTION, (len(time), self.chunk_size, 1))
        actions[:, :, ACTION["root_z"]] -= (0.5 * self.depth[:, None] * (1.0 - np.cos(6.28 * time)))[:, :, None]
        self.ticks[observation.mask] += self.chunk_size
        return policies.Chunk(actions)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-steps", type=int, default=150, help="ticks of 0.02 s")
    steps = parser.parse_args().max_steps
    print(f"{len(check_policy(Squat()))} promises kept")
    policies.register("squat", lambda argument: Squat())  # --policy squat, in this process
    env = ArenaEnv("boxing", tracker=trackers.get("twist2"), worlds=3, engine="mujoco")
    episodes = expand(["boxing"], trackers=["twist2"], policy="squat", seeds=[0, 1], repeats=3)
    for result in Rollout(env, policies.get("squat"), episodes, max_steps=steps).run():
        print(f"{result.episode.key}: {result.outcome} after {result.steps} ticks")
    env.close()
