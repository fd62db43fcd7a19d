"""Football's expert: its line through the ball, its phases, and goals through a tracker."""

from types import SimpleNamespace

import numpy as np
import torch
from recorded_actions import assert_same_elsewhere, episodes, expert_rollout

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.policies.experts.football import CLEAR, LANE, FootballExpert
from arena_newton.policies.experts.style import Style
from arena_newton.robot.rotations import rotate_xy
from arena_newton.tasks.football import GOAL

GOAL_MIDDLE, GOAL_HALF = (0.05, 4.03, 0.925), (2.55, 1.0, 0.925)
"""The marker `Goal/Volume` of the scene [m]."""


class Pitch:
    """A `Sight` without physics: robot and balls are where a test puts them."""

    def __init__(self, ball, other=None):
        self.worlds, self.device = len(ball), torch.device("cpu")
        self.pose = torch.tensor([[0.0, -2.0, np.pi / 2]]).repeat(self.worlds, 1)
        self.balls = [torch.tensor(b, dtype=torch.float32) for b in (ball, other) if b is not None]
        self.speed = torch.zeros(self.worlds, 3)
        marker = SimpleNamespace(half=GOAL_HALF)
        self.scene = SimpleNamespace(
            body_id=lambda prim: int("Distractor" in prim),
            has_body=lambda prim: other is not None,
            marker=lambda prim: marker,
            geom_ids=lambda prim: [0],
            mj_model=SimpleNamespace(geom_size=np.full((1, 3), 0.11)),
        )

    def body(self, body):
        xy = self.balls[body]
        return torch.cat([xy, torch.full((self.worlds, 1), 0.11)], dim=1), None

    def velocity(self, prim):
        return lambda: self.speed

    def frame(self, prim):
        assert prim == GOAL
        return lambda: torch.tensor([GOAL_MIDDLE]).repeat(self.worlds, 1)


def begun(sight, seeds):
    """An expert whose episodes have begun with these seeds."""
    expert, style, every = FootballExpert(sight), Style(sight.worlds), np.ones(sight.worlds, bool)
    style.begin(every, seeds)
    expert.begin(torch.from_numpy(every), style)
    return expert


def spread(count):
    """Balls in the range of execution mode [m], shape [count, 2]."""
    return np.random.default_rng(3).uniform(-1.45, 1.45, (count, 2))


def test_the_line_leads_the_foot_to_the_ball_and_the_ball_to_the_goal():
    """One foot's width beside its line is the ball, and the ball on that line rolls in between the posts."""
    ball = spread(40)
    expert = begun(Pitch(ball), list(range(40)))
    offset = torch.tensor(ball, dtype=torch.float32) - expert.lane[:, :2]
    ahead, left = rotate_xy(-expert.lane[:, 2], offset).unbind(1)
    assert ahead.abs().max() < 1e-5
    assert torch.allclose(left.abs(), torch.full_like(left, LANE), atol=1e-5)
    assert (left < 0).any() and (left > 0).any()  # both feet kick
    crossing = torch.tensor(ball[:, 0]).float() + (3.0 - torch.tensor(ball[:, 1]).float()) / expert.lane[:, 2].tan()
    assert (crossing - GOAL_MIDDLE[0]).abs().max() < GOAL_HALF[0] - 1.0


def test_the_foot_is_the_one_on_the_balls_side():
    """Left of the picture's middle the left foot kicks, right of it the right one, whatever the seed draws."""
    ball = spread(40)
    ball[:, 0] += np.where(ball[:, 0] > 0, 0.05, -0.05)
    left = torch.tensor(ball[:, 0] < 0.0)  # the robot looks along y from x = 0
    for seeds in (range(40), range(40, 80)):
        lane = begun(Pitch(ball), list(seeds)).lane
        offset = rotate_xy(-lane[:, 2], torch.tensor(ball, dtype=torch.float32) - lane[:, :2])
        assert torch.equal(offset[:, 1] > 0, left)


def test_the_ball_is_led_past_another_one():
    """The ball's path keeps its distance from a ball that lies on the way to the goal."""
    ball = np.array([[0.0, -0.8], [0.6, -1.0], [-0.5, -0.5]])
    other = np.array([[-0.037, 0.496], [0.4, 0.5], [-0.4, 0.5]])
    expert = begun(Pitch(ball, other), [1, 2, 3])
    offset = rotate_xy(-expert.lane[:, 2], torch.tensor(other - ball, dtype=torch.float32))
    assert (offset[:, 1].abs() > CLEAR - 0.01).all()
    free = begun(Pitch(ball), [1, 2, 3])
    offset = rotate_xy(-free.lane[:, 2], torch.tensor(other - ball, dtype=torch.float32))
    assert (offset[:, 1].abs() < CLEAR).all()  # without it they would have met


def test_phases_follow_the_ball():
    """A robot on its line kicks; a touched ball is followed, then watched; one that stops is approached again."""
    sight = Pitch(spread(3))
    expert = begun(sight, [5, 6, 7])
    every = torch.ones(3, dtype=torch.bool)

    def after(seconds):
        for _ in range(round(seconds / 0.1)):
            expert.command(every, 0.1)
        return expert.phases()

    assert after(0.1) == ["approach"] * 3
    sight.pose = expert.walk.goal.clone()
    expert.walk.to(every, expert.walk.goal)  # a robot that jumps has left its path
    assert after(0.2) == ["kick"] * 3
    sight.speed = torch.tensor([[0.0, 1.5, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.0]])
    assert after(0.2) == ["follow", "follow", "kick"]  # the third ball is not touched yet
    assert after(0.4) == ["watch", "follow", "kick"]  # the second one is touched again on the same line
    sight.speed = torch.zeros(3, 3)
    sight.pose = torch.cat([sight.balls[0] + torch.tensor([0.0, 0.5]), sight.pose[:, 2:]], dim=1)
    assert after(0.2) == ["approach"] * 3  # it stopped, and the other two were missed


def test_worlds_outside_the_mask_keep_their_state():
    """A decision for some worlds changes nothing in the others."""
    sight = Pitch(spread(2))
    expert = begun(sight, [1, 2])
    before = expert.lane.clone(), expert.walk.goal.clone(), expert.states.clock.clone()
    sight.balls[0] = sight.balls[0] + 0.5
    expert.command(torch.tensor([True, False]), 0.1)
    for old, new in zip(before, (expert.lane, expert.walk.goal, expert.states.clock), strict=True):
        assert torch.equal(old[1], new[1]) and not torch.equal(old[0], new[0])


def test_goals_through_twist2_whatever_runs_beside():
    """A left and a right foot score, phase by phase; alone an episode has the same actions bit for bit."""
    env = ArenaEnv("football", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", device="cpu", threads=2)
    results, rows = expert_rollout(env, episodes(env, 3, 4), 700)
    assert [r.outcome for r in results] == ["success", "success"]
    assert all([name for name, _ in r.phases][:3] == ["approach", "kick", "follow"] for r in results)
    assert_same_elsewhere(env, rows, episodes(env, 3))
