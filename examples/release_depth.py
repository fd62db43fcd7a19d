"""Measure where a policy lets go of the hammer: a metric that one class and one line add to an ordinary run.

Shows: a `Metric` of this process, which reads the policy's action and true poses. `release_depth` is how far beyond the
crate's middle line the hammer's centre of mass is when the left hand opens above the crate [m]. Negative is towards the
robot; the near wall is at -0.20.

    python examples/release_depth.py --task double_desk --policy learned --tracker sonic --seeds 203 --repeats 20
"""

import sys

import numpy as np
import torch

from arena_newton.eval.__main__ import main
from arena_newton.eval.play.factories import Factories
from arena_newton.interfaces import Observation, World
from arena_newton.policies.experts.base import Sight
from arena_newton.recorders import Metric
from arena_newton.robot.canonical import ACTION, HAND_CLOSED
from arena_newton.robot.rotations import heading, rotate_xy
from arena_newton.tasks.double_desk import HAMMER, INSIDE

NEAR, ABOVE = 0.5, 0.085
"""Distances from the crate's middle within which, seen from above, and over which a hand lets go above it [m]."""


class ReleaseDepth(Metric):
    """The value of the last tick in which the left hand opens above the crate."""

    name, fold = "release_depth", "last"

    def __init__(self, env: World):
        """Find hammer and crate."""
        super().__init__(env)
        self.sight = Sight(env)
        self.hammer, self.middle = self.sight.com(HAMMER), self.sight.frame(INSIDE)
        self.crate = env.scene.marker(INSIDE).body_id
        self.opens = self.closed = torch.zeros(env.worlds, dtype=torch.bool, device=env.torch_device)

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Note which left hands the policy opens."""
        closed = action[:, ACTION["hands"]][:, 0] >= HAND_CLOSED
        self.opens, self.closed = self.closed & ~closed, closed

    def measure(self, env: World) -> np.ndarray:
        """Depth in the crate's frame, NaN where no hand opens above the crate, shape [worlds]."""
        offset = self.hammer() - self.middle()
        local = rotate_xy(-heading(self.sight.body(self.crate)[1]), offset[:, :2])
        above = (torch.linalg.vector_norm(offset[:, :2], dim=1) < NEAR) & (offset[:, 2] > ABOVE)
        return torch.where(self.opens & above, local[:, 1], torch.nan).cpu().numpy()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], Factories(recorders=lambda env: [ReleaseDepth(env)])))
