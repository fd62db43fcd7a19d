"""Worlds whose episodes succeed after 10 to 19 ticks, whatever the robot does, and the command line in them."""

import dataclasses

import numpy as np

from arena_newton.eval.play.env_cache import CachedEnv
from arena_newton.eval.play.factories import Factories
from arena_newton.kernels.tick import SUCCESS


class QuickEnv(CachedEnv):
    """A real world but for its verdict and its short start-up; how long an episode takes follows from its seed."""

    def __init__(self, task, **options):
        super().__init__(task, **options)
        self.startup_ticks = 5

    def reset(self, seeds, worlds=None, **options):
        super().reset(seeds, worlds, **options)
        self.ends = getattr(self, "ends", np.zeros(self.worlds, int))
        self.ends[slice(None) if worlds is None else list(worlds)] = 10 + np.array(seeds) % 10

    def step(self, action, worlds=None):
        status = super().step(action, worlds)
        return np.where(self.active & (self.tick >= self.ends), SUCCESS, status).astype(np.int32)

    def verdict(self, world):
        found = super().verdict(world)
        won = self.tick[world] >= self.ends[world]
        held = dict.fromkeys(found.predicates, int(self.tick[world]))
        return dataclasses.replace(found, margin=0.0, predicates=held) if won else found


def main(arguments):
    """The command line in such worlds."""
    from arena_newton.eval import __main__ as command_line

    return command_line.main(arguments, Factories(env=QuickEnv))
