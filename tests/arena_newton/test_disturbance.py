"""Disturbed execution: an episode's own noise on what is executed, none on the label."""

from types import SimpleNamespace

import numpy as np
import torch

from arena_newton.data.recording.disturbed_execution import ActionNoise, noise_series
from arena_newton.data.recording.noise_levels import NoiseLevels
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.g1 import TICK

LEVELS = NoiseLevels()


def worlds(count, ticks):
    """Part of an environment that the noise reads."""
    return SimpleNamespace(worlds=count, tick=np.array(ticks), torch_device=torch.device("cpu"))


def test_noise_has_the_levels_and_time_constants_that_were_measured():
    """Deviation and correlation time of joints and velocity are those of the levels; the turn stays bounded."""
    series = noise_series(1 << 31, 60_000, LEVELS).astype(np.float64)
    velocity = series[:, 29:31] / TICK
    for part, deviation, time in ((series[:, :29], 0.04, 0.3), (velocity, 0.08, 0.8)):
        assert np.allclose(part.std(axis=0), deviation, rtol=0.1)
        lag = round(time / TICK)
        correlation = (part[lag:] * part[:-lag]).mean() / (part * part).mean()
        assert abs(correlation - np.exp(-1)) < 0.05
    turn = np.unwrap(np.arctan2(series[:, 32], series[:, 31]))
    assert 0.1 < turn.std() < 0.6  # 0.12 rad/s over 0.8 s, leaking in 10 s: 0.32 rad in theory
    rate = np.diff(turn) / TICK
    assert abs(rate.std() - 0.12) < 0.02


def test_an_episode_begins_undisturbed_and_follows_from_its_seed():
    """The first tick has no noise, equal seeds give equal bits whatever the length, other seeds other noise."""
    series = noise_series(7, 100, LEVELS)
    assert not series[0, :31].any() and series[0, 31] == 1.0 and series[0, 32] == 0.0
    assert series.tobytes() == noise_series(7, 300, LEVELS)[:100].tobytes()
    assert not np.array_equal(series, noise_series(8, 100, LEVELS))


def test_a_world_has_its_episodes_noise_in_any_batch():
    """World 2 of three at its tick is disturbed as the same episode alone, bit for bit."""
    seeds = [5, 6, 7]
    batch, alone = ActionNoise(50), ActionNoise(50)
    env = worlds(3, [3, 10, 20])
    for world, seed in enumerate(seeds):
        batch.start(env, world, SimpleNamespace(episode_seed=seed))
    one = worlds(1, [20])
    alone.start(one, 0, SimpleNamespace(episode_seed=7))
    action = torch.tensor(STAND_ACTION).repeat(3, 1)
    together, single = batch(env, action), alone(one, action[:1])
    assert torch.equal(together[2], single[0]) and not torch.equal(together[0], together[1])
    assert not torch.equal(together[0], action[0])  # later beginnings keep the noise of the first world
    assert torch.equal(action, torch.tensor(STAND_ACTION).repeat(3, 1))


def test_the_turn_is_a_rotation_about_the_vertical():
    """The executed orientation is R_z times the label's; height and hands stay."""
    noise = ActionNoise(400)
    env = worlds(1, [399])
    noise.start(env, 0, SimpleNamespace(episode_seed=11))
    drawn = noise_series(11, 400, LEVELS)[399]
    cosine, sine = drawn[31], drawn[32]
    roll = 0.3
    matrix = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    action = torch.tensor(STAND_ACTION).repeat(1, 1)
    action[0, ACTION["root_rot6d"]] = torch.tensor(matrix[:, :2].reshape(6), dtype=torch.float32)
    action[0, ACTION["hands"]] = 1.0
    executed = noise(env, action)[0].numpy()
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    assert np.allclose(executed[ACTION["root_rot6d"]], (turn @ matrix)[:, :2].reshape(6), atol=1e-6)
    assert abs(sine) > 1e-3 and executed[2] == action[0, 2] and (executed[ACTION["hands"]] == 1.0).all()
    assert np.allclose(executed[ACTION["joint_pos"]] - action[0, ACTION["joint_pos"]].numpy(), drawn[:29], atol=1e-6)
    assert np.allclose(executed[:2] - action[0, :2].numpy(), drawn[29:31], atol=1e-7)
