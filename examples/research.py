"""Research on the runner: a push, and joint sensors with noise, in an ordinary run.

Shows: `main(arguments, Factories(...))`, with which a program puts its parts into the commands of `eval`. What is
random follows from an episode's seed; `describe` names it, so that no other program continues the run.

    python examples/research.py --task boxing --policy learned --out research
"""

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from arena_newton import ArenaEnv
from arena_newton.eval.__main__ import main
from arena_newton.eval.play.factories import Factories
from arena_newton.interfaces import Observation
from arena_newton.robot.canonical import STATE


class Lab(ArenaEnv):
    """Pushes each robot half a second after step 0; shows policies joint angles with noise."""

    def reset(self, seeds: Sequence[int], worlds: Any = None, **more: Any) -> None:
        """Keep the seed of each episode that begins."""
        self.seeds = getattr(self, "seeds", np.zeros(self.worlds, np.int64))
        self.seeds[slice(None) if worlds is None else worlds] = seeds
        super().reset(seeds, worlds, **more)

    def step(self, action: Any, worlds: np.ndarray | None = None) -> np.ndarray:
        """Push by up to 0.5 m/s at tick 25."""
        push = [np.random.default_rng(seed).uniform(-0.5, 0.5, 6) * [1, 1, 0, 0, 0, 0] for seed in self.seeds]
        self.physics.add_velocity(np.stack(push), self.active & (self.tick == 25))
        return super().step(action, worlds)

    def observe(self, mask: np.ndarray | None = None, *, image: bool = False) -> Observation:
        """Add noise [rad] to the joint angles."""
        seen = super().observe(mask, image=image)
        rows = zip(self.seeds, np.maximum(self.tick, 0), strict=True)
        noise = np.stack([np.random.default_rng(row).normal(0.0, 0.02, 29) for row in rows])
        seen.state[:, STATE["joint_pos"]] += torch.from_numpy(noise).to(seen.state)
        return seen

    def describe(self) -> dict[str, Any]:
        """Name both in every result."""
        return super().describe() | {"push": "up to 0.5 m/s at tick 25", "sensors": "0.02 rad on joint angles"}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], Factories(env=Lab)))
