"""Navigation brings a robot to its goal, holds there, stays on its route and within its limits."""

import math

import torch

from arena_newton.robot.rotations import heading, rotate_xy, wrap_angle
from arena_newton.trackers.motions.navigate import NavigationLimits, Navigator, steer

DT = 0.1
"""Interval at which an expert decides [s]."""


def drive(pose, velocity, dt=DT):
    """A robot that follows its commands exactly."""
    moved = rotate_xy(pose[:, 2], velocity[:, :2]) * dt
    return torch.cat([pose[:, :2] + moved, pose[:, 2:] + velocity[:, 2:] * dt], dim=1)


def poses(count, seed, reach=3.0):
    generator = torch.Generator().manual_seed(seed)
    xy = (2 * torch.rand(count, 2, generator=generator) - 1) * reach
    yaw = (2 * torch.rand(count, 1, generator=generator) - 1) * math.pi
    return torch.cat([xy, yaw], dim=1)


def test_heading_and_wrap():
    """A quaternion's heading is its yaw, and angles come back into one turn."""
    yaw = torch.tensor([-3.0, 0.0, 2.0])
    quat = torch.stack([torch.cos(yaw / 2), torch.zeros(3), torch.zeros(3), torch.sin(yaw / 2)], dim=1)
    assert torch.allclose(heading(quat), yaw, atol=1e-6)
    assert torch.allclose(
        wrap_angle(torch.tensor([2 * math.pi + 0.1, -4.0])), torch.tensor([0.1, 2 * math.pi - 4.0]), atol=1e-5
    )


def test_goals_are_reached_and_held():
    """A robot that obeys reaches any goal within 8 cm and 5 degrees and then gets no command at all."""
    goal, pose = poses(100, 0), poses(100, 1)
    navigator = Navigator(100)
    for _ in range(300):
        command = navigator.command(pose, goal, DT)
        pose = drive(pose, command.velocity)
    assert command.arrived.all()
    assert (command.velocity == 0).all()
    assert torch.linalg.vector_norm(pose[:, :2] - goal[:, :2], dim=1).max() < 0.08
    assert wrap_angle(pose[:, 2] - goal[:, 2]).abs().max() < math.radians(5)


def test_command_stays_within_limits():
    """No pose makes the controller ask for more than its limits."""
    limits = NavigationLimits()
    pose, goal = poses(2000, 2), poses(2000, 3)
    left = torch.linalg.vector_norm(goal[:, :2] - pose[:, :2], dim=1)
    x, y, turn = steer(pose, goal[:, :2], goal[:, 2], left, limits).unbind(1)
    assert x.max() <= limits.forward + 1e-5 and x.min() >= -limits.backward - 1e-5
    assert y.abs().max() <= limits.sideways + 1e-5
    assert turn.abs().max() <= limits.turn + 1e-5
    assert x.max() > 0.9 * limits.forward


def test_small_errors_do_not_move_a_robot_that_holds():
    """Inside the tolerance a standing robot is left alone; outside it is sent back."""
    limits = NavigationLimits()
    goal = torch.zeros(2, 3)
    navigator = Navigator(2)
    assert navigator.command(goal, goal, DT).arrived.all()
    off = torch.tensor([[0.8 * limits.leave_position, 0.0, 0.0], [1.5 * limits.leave_position, 0.0, 0.0]])
    for _ in range(20):
        command = navigator.command(off, goal, DT)
    assert command.arrived.tolist() == [True, False]
    assert (command.velocity[0] == 0).all() and command.velocity[1, 0] < 0


def test_stops_that_end_beside_the_goal_are_learned():
    """A tracker that slips 6 cm to the left with every stop comes to rest at the goal after a few stops."""
    goal, pose = torch.zeros(1, 3), torch.tensor([[1.0, 0.2, 0.3]])
    limits = NavigationLimits(leave_position=0.05)
    navigator, moving, stops = Navigator(1, limits=limits), True, 0
    for _ in range(600):
        command = navigator.command(pose, goal, DT)
        pose = drive(pose, command.velocity)
        if moving and bool(command.arrived):
            pose[:, :2] += rotate_xy(pose[:, 2], torch.tensor([[0.0, 0.06]]))
            stops += 1
        moving = not bool(command.arrived)
    assert command.arrived.all() and torch.linalg.vector_norm(pose[0, :2]) < 0.05
    assert 1 < stops < 6


def test_a_route_is_followed_around_its_corner():
    """The robot passes the corner of a route instead of cutting across, and never leaves the route by 0.3 m."""
    route = torch.tensor([[[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [2.0, 2.0]]])
    goal, pose = torch.tensor([[2.0, 2.0, 1.5]]), torch.zeros(1, 3)
    navigator, nearest, stray = Navigator(1), 1e9, 0.0
    for _ in range(200):
        command = navigator.command(pose, goal, DT, route=route)
        pose = drive(pose, command.velocity)
        nearest = min(nearest, float(torch.linalg.vector_norm(pose[0, :2] - torch.tensor([2.0, 0.0]))))
        stray = max(stray, float(command.stray))
    assert command.arrived.all()
    assert nearest < 0.3 and stray < 0.3


def test_masked_worlds_keep_their_memory():
    """A call for one world changes nothing in the others, and a reset forgets only its own."""
    goal, navigator = torch.zeros(2, 3), Navigator(2)
    navigator.command(goal, goal, DT)
    only_first = torch.tensor([True, False])
    away = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    for _ in range(20):
        navigator.command(away, goal, DT, mask=only_first)
    assert navigator.holding.tolist() == [False, True]
    navigator.reset(torch.tensor([False, True]))
    assert navigator.holding.tolist() == [False, False]
