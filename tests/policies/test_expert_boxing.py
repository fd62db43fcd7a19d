"""Boxing's expert: it acts on what the head camera has seen, searches in a fixed order, and strikes."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arena_newton import policies, trackers
from arena_newton.env import ArenaEnv
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.experts.base import ExpertPolicy, Sight
from arena_newton.policies.experts.eyes import Eyes, hidden, silhouette
from arena_newton.robot.g1 import DEFAULT_POSE
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding
from arena_newton.tasks.boxing import BOUNDS
from tests.policies.test_experts import pose

BAGS = torch.tensor([[-0.97, -3.7], [-3.0, -3.7]])
CYLINDERS = torch.tensor([[-0.97, -3.7, 0.155], [-3.0, -3.7, 0.155], [-0.97, -4.2, 0.03], [-3.0, -4.2, 0.03]])
"""Bags and posts of the scene: x, y, radius [m]."""
ORDER = ["beside 1", "behind 1", "behind 2", "beside 2"]
"""Places to look from, in their order."""


def protocol(count):
    """Seeds of the first episodes of the protocol."""
    gym_id = "Isaac-Move-Boxing-Bag-G129-Dex3-Wholebody"
    return [seeding.episode_seed(gym_id, i // 20, i % 20) for i in range(count)]


def robots(env, x, y, yaw):
    """Upright robots in the default pose."""
    zero = np.zeros_like(x)
    roots = np.stack([x, y, zero + 0.78, np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)
    pose(env, roots, np.tile(DEFAULT_POSE, (len(x), 1)))


def put_target(env, world, bag, azimuth, z=0.8):
    """Move one world's target to an azimuth [rad] of a bag (0 or 1)."""
    data = env.physics._data[world]
    x, y = BAGS[bag].tolist()
    data.mocap_pos[env.scene.mocap_id("/World/Target")] = (
        x + 0.15 * math.cos(azimuth),
        y + 0.15 * math.sin(azimuth),
        z,
    )
    env.physics._publish(world, data)


@pytest.fixture(scope="module")
def env():
    """Sixty worlds with a head camera; robots are put, not simulated."""
    pd = trackers.get("pd")
    return ArenaEnv("boxing", tracker=pd, worlds=60, engine="mujoco", device="cpu", threads=1, camera=CameraConfig())


def test_a_cylinder_hides_what_is_behind_it():
    """Points behind a cylinder are hidden; beside it, before it and beyond its shadow they are not."""
    points = torch.tensor([[[3.0, 0.0], [3.0, 0.4], [3.0, 0.7], [1.0, 0.0], [-3.0, 0.0], [2.1, 0.9]]])
    found = hidden(torch.zeros(1, 2), points, torch.tensor([[[2.0, 0.0, 0.3]]]))
    assert found.tolist() == [[True, True, False, False, False, False]]


def test_a_silhouette_is_the_near_side_of_a_ball():
    """Its points lie on the ball, on the side of the eye, symmetric about the line of sight."""
    eye, centre = torch.tensor([[0.0, 0.0, 1.2]]), torch.tensor([[2.0, 0.0, 0.8]])
    points = silhouette(eye, centre, 0.05, 8)
    assert torch.linalg.vector_norm(points - centre[:, None], dim=2).allclose(torch.tensor(0.05))
    assert (points[..., 0] < 2.0).all() and points[0, :, 1].sum().abs() < 1e-6
    assert points[0, 0, 1] > points[0, -1, 1]


def test_eyes_agree_with_pictures(env):
    """Eyes and rendered pictures agree about the target, at the 60 starts and at 60 places all around."""
    env.reset(protocol(60))
    sight = Sight(env)
    eyes, target = Eyes(sight), sight.frame(BOUNDS)
    rng = np.random.default_rng(3)
    at = target()[:, :2].numpy()
    bag = BAGS.numpy()[np.linalg.norm(at[:, None] - BAGS.numpy(), axis=2).argmin(axis=1)]
    bearing, distance = rng.uniform(-np.pi, np.pi, 60), rng.uniform(0.7, 1.5, 60)
    x, y = bag[:, 0] + distance * np.cos(bearing), bag[:, 1] + distance * np.sin(bearing)
    yaw = np.arctan2(at[:, 1] - y, at[:, 0] - x) + rng.uniform(-1.1, 1.1, 60)
    starts = np.full(60, -1.6), np.full(60, -2.0), np.full(60, -math.pi / 2)
    for where, exact in ((starts, True), ((x, y, yaw), False)):
        robots(env, *where)
        image = env.render(env.camera).int()
        green = (image[..., 1] > image[..., 0] + 40) & (image[..., 1] > image[..., 2] + 40)
        pixels = green.sum(dim=(1, 2))
        stripes = eyes.sees(silhouette(eyes.position, target(), 0.05, 8), CYLINDERS.expand(60, -1, 3)).sum(dim=1)
        if exact:
            assert ((pixels > 0) == (stripes > 0)).all() and (pixels == 0).sum() == 23
        agree = ((pixels > 0) == (stripes > 0)).float().mean()
        assert agree >= 0.93  # the rest is cut by the picture's border, or the robot is in a wall
        assert (pixels[stripes >= 3] >= 5).float().mean() > 0.96


def follow(env, frames):
    """Put the robots where their references are."""
    roots = np.concatenate([frames.root_pos, frames.root_quat], axis=1)
    pose(env, roots, frames.joint_pos.numpy())


@pytest.fixture(scope="module")
def search():
    """Five episodes of one seed by robots that obey their references; they differ in the target alone.

    Their actions, phases and `seen` at each tick, and the decisions at which the last robot, which never sees a target,
    would have seen one, for 60 azimuths of each bag.
    """
    env = ArenaEnv("boxing", tracker=trackers.get("pd"), worlds=5, engine="mujoco", device="cpu", threads=1)
    env.reset(protocol(1) * 5)
    robots(env, np.full(5, -1.6), np.full(5, -2.0), np.full(5, -math.pi / 2))
    put_target(env, 0, 0, 1.9)  # in the first picture
    put_target(env, 1, 0, 5.2)  # behind bag 1
    put_target(env, 2, 1, 4.4)  # behind bag 2
    put_target(env, 3, 1, 2.8)  # on the far side of bag 2
    put_target(env, 4, 0, 0.0, z=60.0)  # nowhere
    azimuth = torch.arange(60) / 60 * 2.0 * math.pi
    out = 0.15 * torch.stack([torch.cos(azimuth), torch.sin(azimuth)], dim=1)
    balls = torch.cat([(BAGS[:, None] + out).reshape(120, 2), torch.full((120, 1), 0.8)], dim=1)
    policy = policies.get("expert")
    policy.attach(env)
    policy.reset([7] * 5, ["boxing"] * 5)
    eyes, every = Eyes(policy.sight), np.ones(5, bool)
    actions, phases, seen, glances = [], [[] for _ in range(5)], [], torch.zeros(120)
    for tick in range(640):
        chunk = policy.act(env.observe(every))
        actions.append(chunk.actions[:, 0].clone())
        seen.append(policy.expert.seen.clone())
        for world in range(5):
            if chunk.phases[world] not in phases[world][-1:]:
                phases[world].append(chunk.phases[world])
        if tick % 5 == 0:
            eye = eyes.position[4]
            points = silhouette(eye.expand(120, 3), balls, 0.05, 8).reshape(1, -1, 3)
            found = eyes.sees(points.expand(5, -1, -1), CYLINDERS.expand(5, -1, 3))[4]
            glances += found.reshape(120, 8).sum(dim=1) >= 3
        follow(env, policy.generator.frames)
    return SimpleNamespace(actions=torch.stack(actions), phases=phases, seen=torch.stack(seen), glances=glances)


def test_it_acts_on_nothing_that_it_has_not_seen(search):
    """Until one of them sees its target, episodes of one seed are the same wherever their targets are hidden."""
    first = [int(column.int().argmax()) for column in search.seen.T[:4]]
    assert first[0] == 5 and first[0] < first[1] < first[2] < first[3]
    assert not search.seen[:, 4].any()
    for world, until in enumerate(first):
        mine, blind = search.actions[:, world], search.actions[:, 4]
        assert (mine[:until] == blind[:until]).all()
        assert (mine[until:] != blind[until:]).any()


def test_it_looks_from_place_to_place(search):
    """The search leads through the places in their order, and ends at the first that shows the target."""
    assert search.phases[4][:5] == ["look", *ORDER]
    for world, least in enumerate((0, 1, 2, 3)):
        named = search.phases[world]
        places = named[1 : named.index("approach")]
        assert named[0] == "look" and places == ORDER[: len(places)]
        assert len(places) >= least and (world > 0 or not places)


def test_every_azimuth_comes_into_view(search):
    """On the way around both bags targets at all of 60 azimuths of each bag would have been seen within 13 s."""
    assert (search.glances >= 2).all()


class Kept(ExpertPolicy):
    """The expert, which keeps the actions of every tick."""

    def __init__(self):
        super().__init__()
        self.kept = []

    def act(self, observation):
        chunk = super().act(observation)
        self.kept.append(chunk.actions[:, 0].clone())
        return chunk


def played(seeds, ticks):
    """Results and actions of episodes through the package's own TWIST2 weights, all at once."""
    tracker = trackers.get("twist2")
    env = ArenaEnv("boxing", tracker=tracker, worlds=len(seeds), engine="mujoco", device="cpu", threads=1)
    policy = Kept()
    results = Rollout(env, policy, [SimpleNamespace(episode_seed=seed) for seed in seeds], max_steps=ticks).run()
    return results, policy.kept


def test_through_twist2():
    """The target is struck when it is in the first picture and when it is hidden, alone as among others."""
    results, among = played([1102966727, 2062305377], 650)
    assert [r.outcome for r in results] == ["success", "success"]
    named = [[name for name, _ in r.phases] for r in results]
    assert named[0] == ["look", "approach", "go round", "step up", "strike"]
    assert named[1] == ["look", "beside 1", "behind 1", "approach", "go round", "step up", "strike"]
    _, alone = played([2062305377], 250)
    assert all((one[0] == two[1]).all() for one, two in zip(alone, among[: len(alone)], strict=True))
