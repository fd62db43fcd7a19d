"""OpenDoor's expert: where it stands, its phases with and without a missed lever, doors passed through a tracker."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from recorded_actions import assert_same_elsewhere, episodes, expert_rollout

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.policies.experts.open_door import (
    AJAR,
    BELOW,
    BEYOND,
    DEEP,
    LEARN,
    ON_LEVER,
    PASSING,
    PRESSING,
    SIDE,
    SINKING,
    STAND,
    TOUCHING,
    OpenDoorExpert,
)
from arena_newton.policies.experts.style import Style
from arena_newton.robot.rotations import rotate_xy
from arena_newton.tasks.open_door import DOORWAY, HANDLE, LEAF

PIVOT = (0.43, -0.065)
"""The lever's pivot in the door's frame [m], at height 0.95 m."""
HANDS, FRAME, LEVER = (0, 1), 2, 3
"""Bodies of the door without physics."""


class Door:
    """A `Sight` without physics: robot, door and hands are where a test puts them."""

    def __init__(self, doors):
        self.doors = torch.tensor(doors, dtype=torch.float32)
        """Frame x, y [m], yaw [rad], shape [worlds, 3]."""
        self.worlds, self.device = len(doors), torch.device("cpu")
        self.pose = torch.tensor([[-1.6, 0.2, math.pi / 2]]).repeat(self.worlds, 1)
        self.angles = {"leaf": torch.zeros(self.worlds), "lever": torch.zeros(self.worlds)}
        self.hands = torch.zeros(self.worlds, 2, 3)
        self.scene = SimpleNamespace(
            link=lambda name: HANDS[name.startswith("right")],
            body_id=lambda prim: {HANDLE: LEVER}[prim],
            marker=lambda prim: SimpleNamespace(body_id=FRAME),
        )

    def once(self, key, measure):
        return measure()

    @property
    def root_position(self):
        return torch.cat([self.pose[:, :2], torch.full((self.worlds, 1), 0.75)], dim=1)

    def at(self, local, height):
        """A point of the door's frame, shape [worlds, 3]."""
        turned = rotate_xy(self.doors[:, 2], torch.tensor(local).expand(self.worlds, 2))
        return torch.cat([self.doors[:, :2] + turned, torch.full((self.worlds, 1), height)], dim=1)

    def body(self, body):
        half, zero = self.doors[:, 2] / 2, torch.zeros(self.worlds)
        quat = torch.stack([half.cos(), zero, zero, half.sin()], dim=1)
        return (self.at(PIVOT, 0.95) if body == LEVER else self.at((0.0, 0.0), 0.0)), quat

    def frame(self, prim):
        assert prim == DOORWAY
        return lambda: self.at((0.0, 0.0), 1.07)

    def joint(self, prim):
        name = "leaf" if prim == LEAF else "lever"
        return lambda: self.angles[name]

    def point(self, body, offset):
        return self.hands[:, body]


DOORS = [[-1.6, 2.3, 0.0], [-2.0, 1.6, 0.3]]


@pytest.fixture
def door():
    """Two doors, one of them turned, and an expert whose episodes have begun."""
    sight = Door(DOORS)
    expert, style, every = OpenDoorExpert(sight), Style(2), np.ones(2, bool)
    style.begin(every, [3, 4])
    expert.begin(torch.from_numpy(every), style)
    return sight, expert


def after(expert, seconds, worlds=2):
    """Phases after so many seconds of decisions for the first worlds."""
    mask = torch.arange(2) < worlds
    for _ in range(math.ceil(seconds / 0.1 - 1e-6)):
        expert.command(mask, 0.1)
    return expert.phases()


def at_the_lever(sight, expert):
    """Lead the expert to `lower`, with the robot `PASSING` short of the lever, where it goes on."""
    for walk, following in (("approach", "step in"), ("step in", "lower")):
        assert after(expert, 0.1) == [walk] * 2
        sight.pose = short_of(expert.walk.goal, 0.9 * PASSING[0])
        expert.walk.to(torch.ones(2, dtype=torch.bool), expert.walk.goal)  # a robot that jumps has left its path
        assert after(expert, 0.1) == [following] * 2


def short_of(pose, distance):
    """Poses so far behind others [m], shape [worlds, 3]."""
    ahead = torch.stack([pose[:, 2].cos(), pose[:, 2].sin()], dim=1)
    return torch.cat([pose[:, :2] - distance * ahead, pose[:, 2:]], dim=1)


def test_the_lever_is_in_front_of_the_right_shoulder(door):
    """The robot is led to where the point to press is `STAND` less `BEYOND` ahead and `SIDE` to its right."""
    sight, expert = door
    at_the_lever(sight, expert)
    pressed, goal = sight.at((PIVOT[0] - ON_LEVER, PIVOT[1]), 0.95), expert.walk.goal
    local = rotate_xy(-goal[:, 2], pressed[:, :2] - goal[:, :2])
    assert torch.allclose(local, torch.tensor([STAND - BEYOND, -SIDE]).expand(2, 2), atol=1e-5)
    assert torch.allclose(goal[:, 2], sight.doors[:, 2] + math.pi / 2, atol=1e-5)


def test_it_goes_on_while_it_still_walks(door):
    """Both walks end `PASSING` before their goals, the arm up since the first: nothing waits for centimetres."""
    sight, expert = door
    every = torch.ones(2, dtype=torch.bool)
    for following in ("step in", "lower"):
        sight.pose = short_of(expert.walk.goal, 1.2 * PASSING[0])
        expert.walk.to(every, expert.walk.goal)
        command = expert.command(every, 0.1)
        assert (command.velocity[:, 0] > 0.1).all() and expert.phases() != [following] * 2
        sight.pose = short_of(expert.walk.goal, 0.8 * PASSING[0])
        assert after(expert, 0.1) == [following] * 2
    assert (expert.command(every, 0.1).reach[:, 1] == 1).all()


def test_the_hand_never_pauses_at_the_lever(door):
    """The commanded palm sinks with every decision from `lower` until the press has reached its end."""
    sight, expert = door
    at_the_lever(sight, expert)
    sight.hands[:, 1] = sight.at((PIVOT[0] - ON_LEVER, PIVOT[1]), 0.95 + TOUCHING)
    every, heights = torch.ones(2, dtype=torch.bool), []
    expert.palms.gain = 0.0  # of the command itself
    while expert.phases() != ["press"] * 2 or PRESSING * float(expert.states.clock[0]) < BELOW - 0.05:
        heights.append(expert.command(every, 0.1).hand_point[:, 1, 2])
    sunk = -torch.diff(torch.stack(heights), dim=0)
    assert len(heights) > 15 and (sunk > 0.9 * 0.1 * SINKING).sum() >= sunk.numel() - 2


def test_a_released_latch_is_pushed_and_passed(door):
    """A lever that is `DEEP` leads to the push, a robot inside with the leaf open to the end; else it goes on."""
    sight, expert = door
    at_the_lever(sight, expert)
    sight.hands[:, 1] = sight.at((PIVOT[0] - ON_LEVER, PIVOT[1]), 1.08)
    assert after(expert, 1.2) == ["press"] * 2
    sight.angles["lever"] = torch.tensor([-0.95, -1.05]) * DEEP
    assert after(expert, 0.1) == ["press", "push"]
    sight.angles["lever"] = torch.full((2,), -1.05 * DEEP)
    assert after(expert, 0.1) == ["push"] * 2
    every = torch.ones(2, dtype=torch.bool)
    low = expert.command(every, 0.1).hand_point[:, 1, 2]
    sight.angles["leaf"] = torch.full((2,), 1.05 * AJAR)
    assert (expert.command(every, 0.1).hand_point[:, 1, 2] > low + 0.3).all()  # it presses until the leaf is ajar
    sight.pose = torch.cat([sight.at((0.1, 0.6), 0.0)[:, :2], sight.pose[:, 2:]], dim=1)
    sight.angles["leaf"] = torch.tensor([1.2, 0.7])
    assert after(expert, 0.1) == ["through", "push"]


def test_a_missed_lever_is_tried_again_from_a_better_stance(door):
    """A palm that is below a closed latch leads back to `step in`, and the stance moves by part of what it missed."""
    sight, expert = door
    at_the_lever(sight, expert)
    before = expert.walk.goal.clone()
    sight.hands[:, 1] = sight.at((PIVOT[0] - ON_LEVER, PIVOT[1] - 0.05), 1.08)  # 5 cm short
    assert after(expert, 1.2) == ["press"] * 2
    sight.hands[:, 1, 2] = 0.85
    assert after(expert, 0.1) == ["retreat"] * 2
    sight.pose = expert.walk.goal.clone()
    expert.walk.to(torch.ones(2, dtype=torch.bool), expert.walk.goal)
    assert after(expert, 0.2) == ["step in"] * 2
    moved = rotate_xy(-before[:, 2], expert.walk.goal[:, :2] - before[:, :2])
    assert torch.allclose(moved, torch.tensor([0.05 * LEARN, 0.0]).expand(2, 2), atol=1e-5)


def test_phases_end_without_progress(door):
    """A robot that never moves and a hand that never arrives keep no phase longer than its longest time."""
    sight, expert = door
    sight.hands = sight.hands + 1.2
    seen = set()
    for _ in range(70):
        expert.command(torch.ones(2, dtype=torch.bool), 0.5)
        seen |= set(expert.phases())
    assert seen == {"approach", "step in", "lower", "press", "retreat"}


def test_worlds_outside_the_mask_keep_their_state(door):
    """Decisions for the first world alone leave the phase, clock, goal and palm of the other as they were."""
    sight, expert = door
    at_the_lever(sight, expert)
    sight.hands = sight.hands + 1.2
    before = [expert.states.clock.clone(), expert.walk.goal.clone(), expert.palms.correction.clone()]
    assert after(expert, 1.2, worlds=1) == ["press", "lower"]
    assert torch.equal(expert.states.clock[1], before[0][1]) and torch.equal(expert.walk.goal[1], before[1][1])
    assert torch.equal(expert.palms.correction[1], before[2][1])
    assert not torch.equal(expert.palms.correction[0], before[2][0])


def test_doors_through_twist2_whatever_runs_beside():
    """Both robots pass the door at their first try; alone an episode has the same actions bit for bit."""
    env = ArenaEnv("open_door", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", device="cpu", threads=2)
    results, rows = expert_rollout(env, episodes(env, 5, 1), 900)
    assert [r.outcome for r in results] == ["success", "success"]
    order = ["approach", "step in", "lower", "press", "push"]
    assert all([name for name, _ in r.phases] == order for r in results)
    assert_same_elsewhere(env, rows, episodes(env, 5))
