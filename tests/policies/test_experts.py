"""Experts: ways keep their distance from boxes, and the references they make solve their tasks."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arena_newton import policies, tasks, trackers
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.interfaces import Observation
from arena_newton.policies.experts.planning import BLOCKED, Floor, footprint, plan, signed_distance
from arena_newton.robot.canonical import validate_action
from arena_newton.robot.g1 import DEFAULT_POSE
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding

EPISODES = {"boxing": (0, 21), "vis_navi": (4, 15)}
"""Short episodes of the protocol: both bags, both hands; a way to each side of the beams."""


def rotation(quat):
    w, x, y, z = quat
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


def along(points, steps=200):
    """Many points on a polyline [K, 2]."""
    fraction = torch.linspace(0, 1, steps)[:, None, None]
    return (points[:-1] + fraction * (points[1:] - points[:-1])).reshape(-1, 2)


def test_footprint_of_an_upright_box_is_exact():
    """A box turned about z covers its own rectangle, whichever of its sides is longer."""
    quat = torch.tensor([math.cos(0.2), 0.0, 0.0, math.sin(0.2)])
    x, y, yaw, long, wide = footprint(torch.tensor([1.0, 2.0, 0.3]), quat, torch.tensor([0.9, 0.2, 0.1])).tolist()
    assert (x, y) == (1.0, 2.0)
    assert abs(math.sin(yaw - 0.4)) < 1e-6
    assert (long, wide) == pytest.approx((0.9, 0.2), abs=1e-6)


def test_footprint_covers_a_tipped_box():
    """No corner of a box in any orientation lies outside its rectangle."""
    rng = np.random.default_rng(0)
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    for _ in range(50):
        quat, half = rng.normal(size=4), rng.uniform(0.1, 1.0, 3)
        quat /= np.linalg.norm(quat)
        seen = torch.tensor((corners * half) @ rotation(quat).T[:, :2], dtype=torch.float32)
        box = footprint(torch.zeros(3), torch.tensor(quat).float(), torch.tensor(half).float())
        assert signed_distance(seen[None], box[None, None]).max() < 1e-5


def test_a_way_keeps_its_clearance():
    """Ways among random boxes never come closer than the clearance they claim, and are as short as can be without."""
    generator = torch.Generator().manual_seed(1)
    worlds, count = 40, 5
    spread = torch.tensor([6.0, 3.0, math.pi, 0.8, 0.3])
    low = torch.tensor([-3.0, -1.5, 0.0, 0.2, 0.1])
    boxes = low + spread * torch.rand(worlds, count, 5, generator=generator)
    start, goal = torch.tensor([[0.0, -3.5]]).repeat(worlds, 1), torch.tensor([[0.0, 3.5]]).repeat(worlds, 1)
    ways = plan(start, goal, Floor(boxes, (-6.0, -6.0), (6.0, 6.0)))
    assert (ways.length < BLOCKED).all()
    for world in range(worlds):
        points = along(ways.points[world])
        gap = signed_distance(points[None], boxes[world : world + 1]).min()
        assert gap > ways.clearance[world] - 1e-3
        assert points.abs().max() < 6.0
    assert (ways.points[:, 0] == start).all() and (ways.points[:, -1] == goal).all()
    assert ways.length.min() >= 7.0 - 1e-4
    free = plan(start[:1], goal[:1], Floor(boxes[:1] + torch.tensor([50.0, 0, 0, 0, 0])))
    assert float(free.length) == pytest.approx(7.0, abs=1e-4)


def test_a_closed_wall_has_no_way():
    """Behind a wall across the room there is no path, and that is reported."""
    wall = torch.tensor([[[0.0, 0.0, 0.0, 5.0, 0.1]]])
    ways = plan(torch.tensor([[0.0, -2.0]]), torch.tensor([[0.0, 2.0]]), Floor(wall, (-3.0, -3.0), (3.0, 3.0)))
    assert float(ways.length) >= BLOCKED and float(ways.clearance) == 0.0


def test_expert_by_name():
    """`expert` is a policy without argument, and needs an environment to look into."""
    policy = policies.get("expert")
    assert policy.describe()["tasks"] == sorted(name for name in tasks.names() if tasks.get(name).expert)
    with pytest.raises(InputError, match="takes no argument"):
        policies.get("expert:boxing")
    seen = Observation(torch.zeros(1, 64), None, np.ones(1, bool), "boxing", "", "")
    with pytest.raises(InputError, match="attach"):
        policy.act(seen)


def test_unknown_task_is_named():
    """A task without an expert is refused by name, with those that have one."""
    football = tasks.get("football")
    tasks.register(dataclasses.replace(football, name="waiting", gym_id="Waiting", expert=None, scene=football.layer))
    try:
        with pytest.raises(InputError, match=r"no expert for task waiting; there are .*vis_navi"):
            policies.get("expert").attach(SimpleNamespace(spec=SimpleNamespace(name="waiting")))
    finally:
        tasks.unregister("waiting")


def play(task, indices, ticks):
    """Worlds that succeed when robots obey their references exactly, and each one's phases in their order."""
    env = ArenaEnv(task, tracker=trackers.get("pd"), worlds=len(indices), engine="mujoco", device="cpu", threads=1)
    seeds = [seeding.episode_seed(env.spec.gym_id, i // 20, i % 20) for i in indices]
    env.reset(seeds)
    for _ in range(env.startup_ticks):  # dropped obstacles come to rest; the robot is put back afterwards
        env.physics.step()
    spawn = np.array([*env.spec.spawn_position, *env.spec.spawn_quat])
    pose(env, np.tile(spawn, (env.worlds, 1)), np.tile(DEFAULT_POSE, (env.worlds, 1)))
    policy = policies.get("expert")
    policy.attach(env)
    policy.reset(seeds, [task] * env.worlds)
    done = np.zeros(env.worlds, bool)
    phases = [[] for _ in indices]
    for _ in range(ticks // policy.chunk_size):
        chunk = policy.act(env.observe(~done))
        validate_action(chunk.actions, task)
        for world in np.flatnonzero(~done):
            if chunk.phases[world] not in phases[world][-1:]:
                phases[world].append(chunk.phases[world])
        frames = policy.generator.frames
        pose(env, np.concatenate([frames.root_pos, frames.root_quat], axis=1), frames.joint_pos.numpy())
        env.judge.evaluate(env.physics)
        done |= env.judge.success.numpy() > 0
        if done.all():
            break
    return done, phases


def pose(env, roots, joints):
    """Put the robots where their references are."""
    robot = env.scene.robot
    for world, data in enumerate(env.physics._data):
        data.qpos[robot.root_qpos : robot.root_qpos + 7] = roots[world]
        data.qpos[robot.joint_qpos] = joints[world]
        data.qvel[:] = 0.0
        env.physics._publish(world, data)


@pytest.mark.parametrize("task", EPISODES)
def test_reference_solves_the_task(task):
    """A robot that follows the expert's reference solves the task in two thirds of its budget, phase by phase."""
    done, phases = play(task, EPISODES[task], tasks.get(task).steps.of("paper") * 2 // 3)
    assert done.all()
    for named in phases:
        if task == "boxing":
            assert named[:4] == ["look", "approach", "go round", "step up"]
        else:
            walk = named[: named.index("goal") + 1]
            assert walk == [f"waypoint {i}" for i in range(1, len(walk))] + ["goal"] and len(walk) > 1


def test_boxing_through_twist2(shared):
    """The released TWIST2 checkpoint strikes the target in its first attempt."""
    checkpoint = shared / "reference" / "twist2" / "twist2_1017_20k.onnx"
    tracker = trackers.get("twist2", checkpoint=checkpoint)
    env = ArenaEnv("boxing", tracker=tracker, worlds=2, engine="mujoco", device="cpu", threads=1, fast_physics=True)
    episodes = [
        SimpleNamespace(episode_seed=seeding.episode_seed(env.spec.gym_id, i // 20, i % 20)) for i in EPISODES["boxing"]
    ]
    results = Rollout(env, policies.get("expert"), episodes, max_steps=600).run()
    assert [r.outcome for r in results] == ["success", "success"]
