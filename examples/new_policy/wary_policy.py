"""A policy with three cameras as a package: it turns to what is yellow, and closes a hand on what its wrist sees near.

Shows: `cameras`, pictures and depths of several cameras, an entry point. More: docs/howto/bring/policies.md.

    uv pip install -e examples/new_policy
    python -m arena_newton doctor --policy wary
    python -m arena_newton.eval --task vis_navi --policy wary --tracker twist2 --seeds 0 --repeats 2
"""

import numpy as np
import torch

from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies import Chunk, Observation, Policy
from arena_newton.robot.canonical import ACTION, STAND_ACTION

WAIST = ACTION["joint_pos"].start + 2  # waist_yaw_joint in canonical order
HANDS = ("left_wrist", "right_wrist")


class WaryPolicy(Policy):
    """Half a second at a time: the waist follows yellow in the head's picture, hands close on what is within 0.15 m."""

    name = "wary"
    chunk_size = 25
    cameras = {"front": CameraConfig(160, 120, fit="native")} | dict.fromkeys(HANDS, CameraConfig(64, 64, depth=True))

    def __init__(self, argument: str | None = None):
        """Take nothing: what it does follows from what it sees now."""

    def act(self, observation: Observation) -> Chunk:
        """Answer all worlds; rows of those that do not ask are not read."""
        red, green, blue = observation.images["front"].float().unbind(dim=-1)
        yellow = ((red - blue > 80) & (green - blue > 60)).float().sum(dim=1)  # of each column of the picture
        columns = torch.linspace(0.5, -0.5, yellow.shape[1], device=yellow.device)
        actions = torch.tensor(np.tile(STAND_ACTION, (len(red), self.chunk_size, 1)), device=red.device)
        actions[:, :, WAIST] += ((yellow * columns).sum(dim=1) / yellow.sum(dim=1).clamp(min=1.0))[:, None]
        for slot, hand in zip((38, 39), HANDS, strict=True):
            depth = observation.depths[hand]
            near = ((depth > 0) & (depth < 0.15)).float().mean(dim=(1, 2)) > 0.2
            actions[:, :, slot] = near[:, None].float()
        return Chunk(actions)
