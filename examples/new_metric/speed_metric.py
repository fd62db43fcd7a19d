"""A metric as a package: the highest speed of each episode, in the journal and the tables of any run.

uv pip install -e examples/new_metric
python -m arena_newton.eval --task boxing --recorder speed --seeds 0 --repeats 4
"""

import numpy as np

from arena_newton.interfaces import World
from arena_newton.recorders import Metric


class HighestSpeed(Metric):
    """The root's highest horizontal speed [m/s]."""

    name = "highest_speed"

    def measure(self, env: World) -> np.ndarray:
        """Speed after a tick, shape [worlds]."""
        first = env.scene.robot.root_qvel
        return np.linalg.norm(env.physics.qvel.numpy()[:, first : first + 2], axis=1)
