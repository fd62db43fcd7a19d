"""Episodes: results do not depend on the batch, errors stay in their world, start-up falls are told apart."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arena_newton import trackers
from arena_newton.env import SETTLE_TICKS, STAND_ACTION, ArenaEnv
from arena_newton.interfaces import Chunk
from arena_newton.robot import DEFAULT_POSE

STEPS = 30


class Sway:
    """A policy whose action depends on the world's own state, so that any mixing of worlds shows."""

    needs_image = False

    def __init__(self, worlds=1):
        self.bad = {}
        self.calls = 0

    def reset(self, seeds, tasks, mask):
        pass

    def act(self, observation):
        state = observation.state
        actions = torch.from_numpy(STAND_ACTION).repeat(len(state), 5, 1)
        actions[:, :, 9:38] += 0.05 * torch.sin(10.0 * state[:, None, 6:35])
        actions[:, :, 0] = 0.004
        self.calls += 1
        return Chunk(actions)


class Network(trackers.base.Tracker):
    """A tracker with a random network in fixed blocks, of TWIST2's size."""

    name = "network"

    def bind(self, worlds, device="cpu", scene=None):
        from arena_newton.trackers.blocks import BlockRunner

        torch.manual_seed(0)
        layers = [
            torch.nn.Linear(64, 512),
            torch.nn.ELU(),
            torch.nn.Linear(512, 256),
            torch.nn.ELU(),
            torch.nn.Linear(256, 29),
        ]
        self.run = BlockRunner(torch.nn.Sequential(*layers), 64, worlds, device)
        self.default = torch.tensor(DEFAULT_POSE)

    def step(self, command, state):
        x = self.run.input[: state.joint_pos.shape[0]]
        x[:, :29], x[:, 29:58], x[:, 58:61], x[:, 61:64] = state.joint_pos, command.joints, state.ang_vel_body, 0
        return command.joints + 0.2 * self.run.run()[: len(x)]


def _episodes(n):
    return [SimpleNamespace(episode_seed=1000 + 7 * i, index=i) for i in range(n)]


def _run(worlds, episodes):
    env = ArenaEnv("football", tracker=Network(), worlds=worlds, engine="mujoco", device="cpu", fast_physics=True)
    finals = {}

    def keep(result):
        w = next(i for i, d in enumerate(env.draws) if d is env_draw(env, result))
        finals[result.episode.index] = env.physics.qpos.numpy()[w].copy()

    def env_draw(env, result):
        expected = env.spec.draw(result.episode.episode_seed, "base", env.rules)
        return next(d for w, d in enumerate(env.draws) if d == expected)

    results = env.run_episodes(Sway(), episodes, on_finish=keep, max_steps=STEPS)
    return {r.episode.index: (r.outcome, r.steps, r.margin, finals[r.episode.index].tobytes()) for r in results}


def test_results_do_not_depend_on_batch_or_order():
    """Engine mujoco: 1, 3 and 20 worlds, forward and backward, give bit-identical episodes, tracker included."""
    episodes = _episodes(6)
    alone = _run(1, episodes)
    three = _run(3, episodes)
    twenty = _run(20, episodes[::-1])
    assert alone == three == twenty
    assert len({v[3] for v in alone.values()}) == 6


@pytest.fixture(scope="module")
def env():
    """Two worlds of football under the PD tracker."""
    return ArenaEnv("football", tracker=trackers.get("pd"), worlds=2, engine="mujoco", device="cpu", fast_physics=True)


def test_bad_action_ends_only_its_world(env):
    """A NaN in one world's action is that world's error; the other runs to its end."""

    class OneBad(Sway):
        def act(self, observation):
            chunk = super().act(observation)
            chunk.actions[0, 2, 12] = float("nan")
            return chunk

    first, second = env.run_episodes(OneBad(), _episodes(2), max_steps=8)
    assert (first.outcome, first.reason, first.steps) == ("error", "bad_action", 3)
    assert second.outcome == "timeout" and second.steps == 8


def test_policy_error_ends_only_its_world(env):
    """A policy that fails for one world ends that episode as error with its message."""

    class Half(Sway):
        def act(self, observation):
            chunk = super().act(observation)
            chunk.errors = {1: "server said no"} if observation.mask[1] else {}
            return chunk

    first, second = env.run_episodes(Half(), _episodes(2), max_steps=8)
    assert first.outcome == "timeout"
    assert (second.outcome, second.error) == ("error", "server said no")


def test_nonfinite_state_is_an_error(env):
    """A world whose state becomes NaN ends as error, the other goes on."""
    done = []

    def poison(_):
        if env.tick[0] == 2 and not done:
            done.append(1)
            env.physics._data[0].qpos[:] = np.nan

    first, second = env.run_episodes(Sway(), _episodes(2), on_tick=poison, max_steps=8)
    assert (first.outcome, first.reason) == ("error", "nonfinite_state")
    assert second.outcome == "timeout"


def test_startup_fall_is_told_apart():
    """A robot that falls before step 0 is reported as a start-up fall with no steps."""

    class Drop(trackers.base.Tracker):
        name = "drop"

        def step(self, command, state):
            target = command.joints.clone()
            target[:, 4] = target[:, 10] = -1.0
            target[:, 0] = target[:, 6] = -2.0
            return target

    env = ArenaEnv("football", tracker=Drop(), worlds=1, engine="mujoco", device="cpu", fast_physics=True)
    (result,) = env.run_episodes(Sway(), _episodes(1), max_steps=8)
    assert result.outcome == "fall" and result.startup_fall and result.steps == 0


def test_settle_ticks_precede_step_zero(env):
    """Reset starts a world at minus the start-up length; the policy is first asked at tick 0."""
    env.reset([1, 2])
    assert (env.tick == -SETTLE_TICKS).all()
