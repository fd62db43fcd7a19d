"""Where a policy lets go of the hammer: a metric that one class and one line add to an ordinary run.

Shows: a `Metric` of this process, which reads the policy's action and true poses. `release_depth` is how far beyond the
crate's middle line the hammer's centre of mass is when the left hand opens [m]; the near wall is at -0.20.

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

NEAR = 0.5
"""Distance from the crate's middle, seen from above, within which an opening hand lets go above it [m]."""


class ReleaseDepth(Metric):
    """The value of the last tick with a closed left hand near the crate."""

    name, fold = "release_depth", "last"

    def __init__(self, env: World):
        """Find hammer and crate."""
        super().__init__(env)
        self.sight = Sight(env)
        self.hammer, self.middle = self.sight.com(HAMMER), self.sight.frame(INSIDE)
        self.crate = env.scene.marker(INSIDE).body_id
        self.closed = torch.zeros(env.worlds, dtype=torch.bool, device=env.torch_device)

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Note which left hands the policy closes."""
        self.closed = action[:, ACTION["hands"]][:, 0] >= HAND_CLOSED

    def measure(self, env: World) -> np.ndarray:
        """Depth in the crate's frame, NaN where the hand is open or far, shape [worlds]."""
        offset = (self.hammer() - self.middle())[:, :2]
        local = rotate_xy(-heading(self.sight.body(self.crate)[1]), offset)
        near = torch.linalg.vector_norm(offset, dim=1) < NEAR
        return torch.where(self.closed & near, local[:, 1], torch.nan).cpu().numpy()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], Factories(recorders=lambda env: [ReleaseDepth(env)])))
