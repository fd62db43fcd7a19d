"""A metric of your own: each episode's highest speed, in the journal and the tables of an ordinary run.

Shows: a recorder, which sees every tick, and `Factories.recorders`, by which any command of `eval` takes it.

    python examples/own_metric.py --task boxing --tracker twist2 --seeds 0 --repeats 4 --out own_metric
"""

import sys
from typing import Any

import numpy as np

from arena_newton.eval.__main__ import main
from arena_newton.eval.play.factories import Factories
from arena_newton.interfaces import EpisodeResult, Recorder, World


class Speed(Recorder):
    """Measures each episode's highest speed of the root [m/s]."""

    def __init__(self, env: World):
        """Find the root's velocity."""
        self.most, self.first = np.zeros(env.worlds), env.scene.robot.root_qvel

    def start(self, env: World, world: int, episode: Any) -> None:
        """Begin at rest."""
        self.most[world] = 0.0

    def tick(self, env: World) -> None:
        """Look at all worlds after each tick."""
        speed = np.linalg.norm(env.physics.qvel.numpy()[:, self.first : self.first + 2], axis=1)
        self.most = np.maximum(self.most, speed)

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Give the journal its number."""
        result.extra["highest_speed"] = float(self.most[world])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], Factories(recorders=lambda env: [Speed(env)])))
