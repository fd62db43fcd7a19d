"""Stand-ins for world, tracker and policy: outcomes follow from the episode seed, no physics runs.

As a script it is the command line with these stand-ins, so that a test can kill it: `eval_fakes.py run --out ...`.
"""

import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.eval.play.factories import Factories
from arena_newton.interfaces import Chunk, EpisodeEvent, Observation, Recorder, Verdict
from arena_newton.kernels import tick as codes
from arena_newton.policies.base import Policy

SLOW = 10
"""Every episode that ends by itself has ended after so many ticks; the others then leap from one leap to the next."""
LEAP = 50


class FakeEnv:
    """A world (`interfaces.World`) whose episodes end in another order than they start.

    Half of them succeed, three of ten fall, the others run until their budget: a multiple of `LEAP`, or at
    most `SLOW`.
    """

    startup_ticks = 0
    scene = None
    cameras = {}
    physics = SimpleNamespace(qpos=torch.zeros(1, 7).expand(4096, 7), qvel=torch.zeros(1, 6).expand(4096, 6))
    torch_device = torch.device("cpu")

    def __init__(self, task, *, worlds=1, mode="base", rules="paper", tracker=None, **options):
        self.task, self.worlds, self.mode, self.options, self.tracker = task, worlds, mode, options, tracker
        self.spec, self.rules = tasks.get(task), rule_sets.get(rules)
        self.budget = self.spec.max_steps(self.rules)
        self.tick, self.active = np.zeros(worlds, np.int64), np.zeros(worlds, bool)
        self.seeds, self.modes = np.zeros(worlds, np.int64), [mode] * worlds
        self.ended = 0
        """Episodes whose world got the next one."""

    def reset(self, seeds, worlds=None, *, spawn=None, samples=None, modes=None):
        worlds = range(self.worlds) if worlds is None else worlds
        for world, seed, mode in zip(worlds, seeds, modes or self.modes, strict=modes is not None):
            self.modes[world] = mode
            self.ended += bool(self.tick[world])
            self.seeds[world], self.tick[world], self.active[world] = seed, 0, True

    def release(self, worlds):
        self.active[worlds] = False

    def observe(self, mask=None, *, image=False):
        mask = self.active.copy() if mask is None else mask
        picture = torch.zeros(self.worlds, 48, 64, 3, dtype=torch.uint8) if image else None
        return Observation(
            torch.zeros(self.worlds, 64), picture, mask, self.task, self.spec.gym_id, self.spec.instruction
        )

    def step(self, action, worlds=None):
        poison = Path(os.environ.get("FAKE_POISON", "/nonexistent"))
        if poison.is_file():
            _suffer(poison.read_text(), self.seeds[self.active].tolist())
        if pause := float(os.environ.get("FAKE_TICK_S", "0")):
            time.sleep(pause)
        leapt = (self.tick // LEAP + 1) * LEAP
        self.tick[self.active] = np.where(self.tick < SLOW, self.tick + 1, leapt)[self.active]
        kind, ends = self.seeds % 10, self.tick > self.seeds % SLOW
        status = np.where(ends & (kind < 5), codes.SUCCESS, np.where(ends & (kind < 8), codes.FALL, codes.RUNNING))
        return np.where(self.active, status, codes.RUNNING).astype(np.int32)

    def render(self, camera, mask=None):
        raise NotImplementedError

    def verdict(self, world):
        far, kind = self.seeds[world] % 997 / 997, self.seeds[world] % 10
        ended = self.tick[world] > self.seeds[world] % SLOW
        fell = (EpisodeEvent("fall", int(self.tick[world])),) if ended and 5 <= kind < 8 else ()
        won = ended and kind < 5
        names = [predicate.name for predicate in self.spec.predicates]
        held = dict.fromkeys(names, int(self.tick[world]) if won else None)
        return Verdict(margin=far if won else -far, events=fell, predicates=held, progress=float(won))

    def describe(self):
        return {"engine": self.options["engine"], "device": "cpu", "physics_dt": 0.001, "startup_ticks": 0}

    def close(self):
        """Nothing to release."""


class PlacedEnv(FakeEnv):
    """Football whose ball is where a sample says; a subclass ends its episodes by that."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.samples = [{"x": 0.0, "y": 0.0} for _ in range(self.worlds)]

    def reset(self, seeds, worlds=None, *, spawn=None, samples=None):
        super().reset(seeds, worlds, spawn=spawn)
        for world, seed, sample in zip(worlds, seeds, samples, strict=True):
            self.samples[world] = sample["football"]
            self.played.append((seed, dict(sample["football"])))

    @property
    def places(self):
        """Position of the ball in each world, shape [worlds, 2]."""
        return np.array([(sample["x"], sample["y"]) for sample in self.samples])


def _suffer(poison, seeds):
    """End or stop this process while it plays an episode that a text names, such as `die 17 hang 19`."""
    words = poison.split()
    for what, seed in zip(words[::2], words[1::2], strict=True):
        if int(seed) in seeds:
            time.sleep(600) if what == "hang" else os.kill(os.getpid(), signal.SIGKILL)


class FakePolicy:
    """A policy that does not see and does nothing."""

    needs_image = depends_on_worlds = False
    camera = None
    chunk_size = 100

    def __init__(self, spec, **options):
        self.name, self.options, self.seeds = spec, options, []

    def check(self):
        """It can always work."""

    def check_task(self, task, mode=None, seeds=()):
        """It can do every task."""

    attach = Policy.attach
    """It does not look at the world."""

    def reset(self, seeds, tasks, mask=None):
        old = [*self.seeds, *seeds[len(self.seeds) :]]
        self.seeds = [new if mask is None or mask[world] else old[world] for world, new in enumerate(seeds)]

    def act(self, observation):
        if self.name in os.environ.get("FAKE_HANGS", "").split():
            time.sleep(600)
        return Chunk(torch.zeros(len(observation.mask), self.chunk_size, 40))

    def describe(self):
        return {"name": self.name}

    def close(self):
        """Nothing to release."""


class LastTick(Recorder):
    """Gives each episode that does not fall its last tick as a metric."""

    def finish(self, env, world, result):
        if result.outcome != "fall":
            result.extra["last_tick"] = float(env.tick[world])


def last_tick(env):
    """Recorders of an environment."""
    return [LastTick()]


def fake_tracker(spec, checkpoint):
    """Knows the three that come with the package."""
    if spec not in ("pd", "twist2", "sonic"):
        raise InputError(f"--tracker {spec}: unknown tracker; known are pd, twist2, sonic")
    return SimpleNamespace(name=spec, describe=lambda: {"name": spec, "drive": "none"})


def any_variant(path, task):
    """Every file is a scene."""


def factories(**changes):
    """Builders of the stand-ins."""
    parts = {"env": FakeEnv, "tracker": fake_tracker, "policy": FakePolicy, "check_variant": any_variant}
    return Factories(**(parts | changes))


def main(arguments):
    """The command line with these stand-ins."""
    from arena_newton.eval import __main__ as command_line

    return command_line.main(arguments, factories())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
