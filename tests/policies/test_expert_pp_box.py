"""P&PBox's expert: a squeeze of the wanted depth, phases bounded in time, a box put down and let go."""

import numpy as np
import pytest
import torch
from recorded_actions import assert_same_elsewhere, episodes, expert_rollout

from arena_newton import policies, trackers
from arena_newton.env import ArenaEnv
from arena_newton.policies.experts import pp_box
from arena_newton.policies.experts.base import DECISION, Sight
from arena_newton.policies.experts.pp_box import LONGEST, PPBoxExpert, pose_before
from arena_newton.policies.experts.style import Style
from arena_newton.robot.g1 import TICK
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding
from arena_newton.rules.modes import HELD_OUT
from arena_newton.tasks.pp_box import BOX

STILL = 6
"""Worlds of the environment without physics."""
DT = DECISION * TICK
ORDER = [name for name in LONGEST if name not in ("retreat", "stand", "leave")]
"""Phases of an episode without a slip until the box is let go."""


@pytest.fixture(scope="module")
def still():
    """An expert whose robots never move and whose boxes stay on the table: nobody steps the physics."""
    env = ArenaEnv("pp_box", tracker=trackers.get("pd"), worlds=STILL, engine="mujoco")
    env.reset([seeding.episode_seed(env.spec.gym_id, 900, i) for i in range(STILL)])
    sight = Sight(env)
    return env, sight, PPBoxExpert(sight)


@pytest.fixture(scope="module")
def twist2():
    """Two worlds with our tracker."""
    return ArenaEnv("pp_box", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", threads=1)


@pytest.fixture(scope="module")
def played(twist2):
    """Two episodes through our weights: results, actions by seed, and the judge's forces at the end."""
    results, rows = expert_rollout(twist2, episodes(twist2, 5, 8), 1600)
    return results, rows, twist2.physics.pair_force.numpy().copy()


def everybody(expert):
    """A mask of all worlds, in which an episode begins."""
    every = torch.ones(STILL, dtype=torch.bool)
    expert.begin(every, Style(STILL))
    return every


def test_a_pose_before_a_point_faces_it():
    """Half a metre ahead of the pose is the point."""
    yaw = torch.tensor([0.0, 0.7, 3.0])
    point = torch.tensor([[1.0, 2.0], [0.0, 0.0], [-1.0, 5.0]])
    pose = pose_before(point, yaw, torch.full((3,), 0.5))
    ahead = 0.5 * torch.stack([torch.cos(pose[:, 2]), torch.sin(pose[:, 2])], dim=1)
    torch.testing.assert_close(pose[:, :2] + ahead, point)


def test_the_robot_faces_a_side_of_the_box_from_the_tables_edge(still):
    """It stands square to the box's nearest side within its limit, and never with the pelvis over the table."""
    _, sight, expert = still
    everybody(expert)
    yaw = 2.0 * torch.atan2(sight.body(expert._body)[1][:, 3], sight.body(expert._body)[1][:, 0])
    facing = expert._stand[:, 2]
    assert facing.abs().max() <= pp_box.MOST_TURN + 1e-6 and len(facing.unique()) > 1
    turned = torch.remainder(yaw - facing + torch.pi / 4, torch.pi / 2) - torch.pi / 4
    straight = facing.abs() < pp_box.MOST_TURN - 1e-6
    assert straight.any() and turned[straight].abs().max() < 1e-4
    assert (expert._stand[:, 0] <= expert._edge - pp_box.EDGE + 1e-6).all()
    assert (expert._deep >= pp_box.OVERLAP - 1e-6).all()


def test_the_squeeze_ends_at_its_depth(still, monkeypatch):
    """Palms that a hard box stops are commanded so much deeper, whatever they reach in the air."""
    _, _, expert = still
    every = everybody(expert)
    expert.state.enter("close", every)
    stops = torch.linspace(0.12, 0.20, STILL)
    monkeypatch.setattr(expert, "_overlap", lambda: torch.maximum(stops, expert.half) - expert.half)
    halves = []
    for _ in range(30):
        expert._squeeze(every, DT)
        halves.append(expert.half.clone())
    steps = torch.stack(halves).diff(dim=0)
    assert steps.abs().max() <= pp_box.CLOSING * DT + 1e-6
    torch.testing.assert_close(stops - expert.half, expert._deep, atol=5e-3, rtol=0)


def test_every_phase_ends(still):
    """A robot that cannot move leaves every phase in time; a box that stays on the table is grasped again."""
    _, _, expert = still
    every, dt = everybody(expert), 0.4
    for name in ("approach", "step up", "align"):
        for _ in range(round(LONGEST[name] / dt) + 1):
            assert set(expert.phases()) <= {name, ORDER[ORDER.index(name) + 1]}
            expert.command(every, dt)
        expert.state.enter(ORDER[ORDER.index(name) + 1], every)
    expert.state.enter("lift", every)
    expert.state.advance(every, LONGEST["lift"])
    expert._go_on(every, expert.walk.command(every, DT), expert.haul.command(every, DT))
    assert set(expert.phases()) == {"retreat"}
    expert.state.advance(every, LONGEST["retreat"])
    expert._go_on(every, expert.walk.command(every, DT), expert.haul.command(every, DT))
    assert set(expert.phases()) == {"approach"}
    for first, following in (("back", "turn"), ("turn", "carry"), ("carry", "reach")):
        expert.state.enter(first, every)
        expert._go_on(every, expert.walk.command(every, DT), expert.haul.command(every, DT))
        assert set(expert.phases()) <= {first, following}
        expert.state.advance(every, LONGEST[first])
        expert._go_on(every, expert.walk.command(every, DT), expert.haul.command(every, DT))
        assert set(expert.phases()) <= {following, ORDER[ORDER.index(following) + 1]}


def test_a_box_on_the_floor_is_given_up(still):
    """The robot whose box lies on the floor stands still with empty hands, the others go on."""
    env, sight, expert = still
    every = everybody(expert)
    expert.state.enter("carry", every)
    body = expert._body
    kept = sight.body(body)[0][0].clone()
    sight.body(body)[0][0] = torch.tensor([-1.0, -4.0, 0.0])
    try:
        command = expert.command(every, DT)
    finally:
        sight.body(body)[0][0] = kept
    assert expert.phases()[0] == "stand" and "stand" not in expert.phases()[1:]
    assert not command.reach[0].any() and not command.hands[0].any() and not command.velocity[0].any()


def test_only_masked_worlds_change(still):
    """Worlds outside the mask keep phase, clock, goal, hands and command when others begin."""
    _, _, expert = still
    every = everybody(expert)
    style, none = Style(STILL), ~every
    expert.command(every, DT)
    expert.state.enter("close", every)
    expert.command(every, DT)

    def memory():
        command = expert.command(none, DT).pack()
        state = expert.state
        parts = (command, state.phase, state.clock, expert.walk.goal, expert.grip, expert.half, expert.underside)
        return [part.clone() for part in parts]

    kept = memory()
    style.begin(np.ones(STILL, bool), range(STILL))
    mask = torch.arange(STILL) % 2 == 0
    expert.begin(mask, style)
    expert.command(mask, DT)
    now = memory()
    assert all(torch.equal(new[~mask], old[~mask]) for new, old in zip(now, kept, strict=True))
    assert (now[1][mask] != kept[1][mask]).all()


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_a_box_on_a_hand_is_noticed(engine):
    """A box that falls onto a hand gives the judge's force on either engine, a robot elsewhere none."""
    env = ArenaEnv("pp_box", tracker=trackers.get("pd"), worlds=2, engine=engine, device="cpu")
    env.reset([seeding.episode_seed(env.spec.gym_id, 900, i) for i in range(2)])
    env.judge.bind(env.physics)
    address, hand = env.scene.joint_qpos(BOX), env.scene.link("right_wrist_yaw_link")
    qpos = env.physics.qpos.numpy()
    qpos[0, address : address + 3] = env.physics.xpos.numpy()[0, hand] + [0.05, 0.0, 0.06]
    if engine == "mujoco":
        env.physics.data[0].qpos[:] = qpos[0]
    else:
        env.physics.qpos.assign(qpos)
    most = np.zeros(2)
    for _ in range(15):
        env.physics.step()
        most = np.maximum(most, env.physics.pair_force.numpy())
    assert most[0] > 0.1 and most[1] == 0.0


def test_our_twist2_puts_the_box_down_and_lets_go(played):
    """Two episodes through our weights end with a released box on the deck, phase by phase, all predicates met."""
    results, _, force = played
    assert [r.outcome for r in results] == ["success", "success"]
    for result in results:
        assert [name for name, _ in result.phases][: len(ORDER)] == ORDER
        assert all(tick is not None for tick in result.predicates.values())
    assert not force.any()


def test_the_box_is_moved_among_other_clutter():
    """An episode of a held-out mode, with other things on the table, ends with the box on the shelf."""
    env = ArenaEnv("pp_box", tracker=trackers.get("twist2"), worlds=1, engine="mujoco", threads=1, mode=HELD_OUT[0])
    (result,) = Rollout(env, policies.get("expert"), episodes(env, 5), max_steps=1600).run()
    assert any(label.startswith("/World/Clutter/") for label in env.scene.geom_labels) and result.outcome == "success"


def test_an_episode_does_not_depend_on_its_world(twist2, played):
    """The same episode in another world, next to another one, gets the same actions bit for bit."""
    assert_same_elsewhere(twist2, played[1], episodes(twist2, 9, 5))
