"""VisNavi's expert: what it decides from is in the first picture, episodes differ by style, no phase lasts for ever."""

import numpy as np
import pytest
import torch

from arena_newton import policies, trackers
from arena_newton.env import ArenaEnv
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.experts.vis_navi import FEET, HELD
from arena_newton.robot.g1 import DEFAULT_POSE, TICK
from arena_newton.rules import seeding
from tests.policies.test_experts import pose

WORLDS = 6
LAYOUT = 2
"""An episode of the protocol whose sign is behind an obstacle at the start."""


@pytest.fixture(scope="module")
def env():
    """Worlds of one layout after its obstacles were dropped, the robots where they spawn; and a head camera."""
    pd = trackers.get("pd")
    config = CameraConfig()
    env = ArenaEnv("vis_navi", tracker=pd, worlds=WORLDS, engine="mujoco", device="cpu", threads=1, camera=config)
    env.reset([seeding.episode_seed(env.spec.gym_id, 0, LAYOUT)] * WORLDS)
    for _ in range(env.startup_ticks):
        env.physics.step()
    pose(env, np.tile([*env.spec.spawn_position, *env.spec.spawn_quat], (WORLDS, 1)), default())
    return env


def default():
    """The default joint angles of every robot."""
    return np.tile(DEFAULT_POSE, (WORLDS, 1))


def asked(env, seeds):
    """The policy after its first decision in every world, in episodes of the same layout with these style seeds."""
    policy = policies.get("expert")
    policy.attach(env)
    policy.reset(seeds, ["vis_navi"] * WORLDS)
    policy.act(env.observe(np.ones(WORLDS, bool)))
    return policy


def test_the_area_is_in_the_first_picture(env):
    """Yellow of the area is in the first picture even where an obstacle hides the sign."""
    red, green, blue = env.render(env.camera)[0].int().unbind(2)
    yellow = (red > 0.9 * green) & (red - blue > 60) & (green - blue > 50)
    assert yellow.sum() >= 4


def test_episodes_differ_by_their_seed_alone(env):
    """One seed gives one goal; other seeds stand elsewhere in the area, with room for both feet."""
    expert = asked(env, [5, 5, 6, 7, 8, 9]).expert
    goal = expert.goal
    assert (goal[0] == goal[1]).all()
    assert len({tuple(g) for g in goal[1:, :2].tolist()}) >= 4
    zone = env.scene.marker("/World/TargetSign/Frame/Zone")
    pos, _ = expert.sight.body(zone.body_id)
    away = torch.linalg.vector_norm(goal[:, :2] - pos[:, :2], dim=1)
    assert (away < (zone.half[0] - FEET) * 2.0**0.5 + 1e-3).all()


def test_standing_without_success_does_not_last(env):
    """A robot that stands at its goal without success for `HELD` seconds goes to the area's best place.

    That is another one than the style had favoured, but for a world where obstacles leave no choice.
    """
    policy = asked(env, [5, 5, 6, 7, 8, 9])
    every = np.ones(WORLDS, bool)
    for _ in range(2):  # put so far from its path, a robot plans once more, with another heading at the goal
        x, y, yaw = policy.expert.goal.numpy().T
        zero = np.zeros(WORLDS)
        pose(env, np.stack([x, y, zero + 0.78, np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1), default())
        for _ in range(10):
            policy.act(env.observe(every))
    first, held, moved = policy.expert.goal.clone(), np.zeros(WORLDS), torch.zeros(WORLDS, dtype=torch.bool)
    for _ in range(int((HELD + 3.0) / TICK)):
        phases = policy.act(env.observe(every)).phases
        moved |= (policy.expert.goal != first).any(dim=1)
        held += TICK * np.array([phase == "hold" for phase in phases]) * ~moved.numpy()
    assert moved.sum() >= WORLDS - 1
    assert (np.abs(held[moved.numpy()] - HELD) < 0.2).all()
