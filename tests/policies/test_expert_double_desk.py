"""DoubleDesk's expert: it grasps, carries over the sill and lets go in the crate, and its worlds are independent."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from recorded_actions import assert_same_elsewhere, episodes, expert_rollout

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.policies.experts.base import DECISION, Sight
from arena_newton.policies.experts.double_desk import LONGEST, MOST_ROLL, RIGHT_ROLL, SILL_STEP, DoubleDeskExpert
from arena_newton.policies.experts.style import Style
from arena_newton.robot.canonical import ACTION
from arena_newton.robot.g1 import CANONICAL_JOINTS

EXAMPLES = Path(__file__).parents[2] / "examples"
SEED, EPISODES = 904, (0, 1)
"""Two episodes that no number of the expert was tuned on."""
ORDER = [phase for phase in LONGEST if phase not in ("look", "back off", "rest")]
"""Phases of an episode without a second attempt; the hammer may be in view from the start."""


@pytest.fixture(scope="module")
def env():
    """Two worlds through our TWIST2 weights."""
    return ArenaEnv("double_desk", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", device="cpu", threads=2)


@pytest.fixture(scope="module")
def played(env):
    """Both episodes from beginning to end: results, actions by seed, and ticks in which the sill was touched."""
    sill = env.scene.geom_ids("/World/Sill")[0]
    touched = np.zeros(env.worlds, dtype=int)

    def count(active):
        for world, data in enumerate(env.physics._data):
            pairs = data.contact.geom[data.contact.dist < 0.0]
            touched[world] += bool((pairs == sill).any())

    depth = runpy.run_path(str(EXAMPLES / "release_depth.py"))["ReleaseDepth"](env)
    return *expert_rollout(env, episodes(env, *EPISODES, group=SEED), recorders=[depth], on_tick=count), touched


def test_two_episodes_end_in_the_crate(played):
    """The hammer is carried into the crate within the budget, phase by phase, and the sill is not stood on."""
    results, _, touched = played
    assert [r.outcome for r in results] == ["success", "success"]
    for result in results:
        assert [name for name, _ in result.phases if name != "look"] == ORDER
    assert (touched < 25).all(), "a foot that lands on the sill bears on it for half a second"


def test_the_hand_opens_over_the_middle_of_the_crate(played):
    """The hammer is 0.12 m and more from the near wall when the hand opens, by the metric of the example."""
    assert all(abs(result.extra["release_depth"]) < 0.08 for result in played[0])


def test_the_free_wrist_shows_the_time_of_a_grasp(env, played):
    """The right wrist rolls on with every decision from hover to lift, to its end; before that it rests."""
    results, actions, _ = played
    column = ACTION["joint_pos"].start + CANONICAL_JOINTS.index("right_wrist_roll_joint")
    for episode, result in zip(episodes(env, *EPISODES, group=SEED), results, strict=True):
        roll = torch.stack(actions[episode.episode_seed]).numpy()[:, column]
        begins = {name: tick + len(roll) - result.steps for name, tick in result.phases}
        assert (roll[: begins["hover"]] == 0.0).all()
        grasp = roll[begins["hover"] : begins["step back"]]
        assert (np.diff(grasp) >= 0.0).all() and grasp.max() <= MOST_ROLL
        decided = grasp[DECISION::DECISION]
        assert (np.diff(decided)[decided[1:] < MOST_ROLL - 0.02] > 0.03).all()
        assert decided[-1] > 1.5, "the roll goes on until the hammer is lifted"


def test_worlds_are_independent(env, played):
    """An episode's actions are the same bits in either world, next to either episode."""
    assert_same_elsewhere(env, played[1], episodes(env, 5, EPISODES[0], group=SEED))
    one, other = (torch.stack(rows[:200]) for rows in played[1].values())
    assert not torch.equal(one, other)


@pytest.fixture
def expert(env):
    """An expert of worlds that have just been reset, with a reference that stands still."""
    env.reset([episode.episode_seed for episode in episodes(env, *EPISODES, group=SEED)])
    found = DoubleDeskExpert(Sight(env))
    found.reference = SimpleNamespace(phase=torch.zeros(env.worlds))
    found.begin(torch.ones(env.worlds, dtype=torch.bool), Style(env.worlds))
    return found


def test_pace_ends_with_the_feet_together(expert):
    """Walked at the pace that it asks for, the robot is at its place when the right foot lands."""
    root = expert.sight._root
    for distance in (0.45, 0.70, 0.95):
        for phase in (0.0, 0.3, 0.6, 0.9):
            root[:, 1] = expert._sill - distance
            expert.reference.phase = torch.full((2,), phase)
            speed, time = expert._pace()
            landings = time / (2.0 * SILL_STEP) + phase
            assert torch.allclose(landings, landings.round(), atol=1e-4)
            assert (speed <= 0.38).all(), "a walk this fast would come short"
            root[:, 1] += speed * time
            expert.reference.phase = torch.zeros(2)
            assert torch.allclose(expert._pace()[0], torch.zeros(2), atol=1e-3)


def test_a_lift_without_the_hammer_is_repeated(expert):
    """A hand that comes up empty opens and the robot steps in again; rows outside the mask stay."""
    machine, everyone = expert.machine, torch.ones(2, dtype=torch.bool)
    machine.enter("lift", everyone)
    machine.advance(everyone, LONGEST["lift"])
    only = torch.tensor([True, False])
    command = expert.command(only, 0.1)
    assert expert.phases() == ["step in", "lift"]
    assert command.hands[:, 0].tolist() == [0.0, 1.0]


def test_a_hammer_on_the_floor_ends_the_attempt(expert):
    """A hammer dropped out of reach is not looked for; one dropped onto the desk is."""
    everyone = torch.ones(2, dtype=torch.bool)
    body = expert.sight.scene.body_id("/World/Hammer")
    expert.sight._xpos[0, body, 2] = 0.02
    expert.machine.enter("turn", everyone)
    expert.command(everyone, 0.1)
    assert expert.phases() == ["rest", "look"]


def test_an_episode_begins_as_if_it_were_the_first(expert):
    """Hands at the end of an episode are no part of the next one in its world; other worlds keep theirs."""
    everyone = torch.ones(2, dtype=torch.bool)
    expert.machine.enter("open", everyone)
    for _ in range(5):
        expert.command(everyone, 0.1)
    expert.palms.correction[:], expert.wrists.correction[:] = 0.1, 0.2
    expert.begin(torch.tensor([True, False]), Style(2))
    for correction in (expert.palms.correction, expert.wrists.correction):
        assert (correction[0] == 0.0).all() and (correction[1] > 0.0).all()
    roll = expert.command(everyone, 0.1).arms[:, RIGHT_ROLL]
    assert roll[0] == 0.0 and roll[1] > 0.3
