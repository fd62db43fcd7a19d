"""The heading of v4 labels is realigned to the measured one, as a checkpoint asks."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arena_newton.data.readers.label_decoder import V4Decoder
from arena_newton.data.readers.label_protocols import V4
from arena_newton.policies.base import Chunk, Policy
from arena_newton.policies.label_reader import V4Policy, measured_yaw
from arena_newton.robot import g1
from arena_newton.robot.rotations import matrix_from_quat, quat_from_euler

RATE = 0.05
"""Fraction of the gap that is closed each tick, large so that a short episode shows it."""
DRIFT = 0.001
"""Turn per tick by which the robot lags behind the policy's rate [rad]."""


def labels(rates):
    """Chunks of v4 that turn at given rates [rad/s], shape [worlds, n]."""
    chunk = torch.zeros((*rates.shape, 40))
    chunk[..., V4["yaw_rate"].start] = rates
    return chunk


def yaws(actions):
    """Headings that actions of v3.1 name [rad]."""
    return torch.atan2(actions[..., 5], actions[..., 3]).double()


def state_of(yaw, pitch=0.3, roll=-0.2):
    """States of robots with given headings [rad], shape [worlds, 64]."""
    yaw = torch.as_tensor(yaw, dtype=torch.float64)
    angles = torch.stack([yaw, torch.full_like(yaw, pitch), torch.full_like(yaw, roll)], dim=-1)
    matrix = matrix_from_quat(quat_from_euler(angles))
    state = torch.zeros((len(yaw), 64))
    state[:, :6] = matrix[..., :2].flatten(-2).float()
    return state


class Turning(Policy):
    """Turns at a constant rate, whatever it sees."""

    name = "turning"

    def __init__(self, rate, length, realign):
        self.rate, self.chunk_size, self.realign = rate, length, realign

    def act(self, observation):
        return Chunk(labels(torch.full((len(observation.state), self.chunk_size), self.rate)))


def test_the_measured_heading_is_that_of_the_state():
    """Headings all around, for any roll and pitch."""
    wanted = torch.linspace(-3.1, 3.1, 9, dtype=torch.float64)
    assert torch.allclose(measured_yaw(state_of(wanted)), wanted, atol=1e-6)


def test_the_gap_closes_by_its_fraction_each_tick():
    """After k ticks (1 - fraction)^k of the gap at the measurement is left, the short way around."""
    decoder = V4Decoder(2, realign=RATE)
    decoder.decode(labels(torch.full((2, 1), 3.0 / g1.TICK)))
    decoder.measure(torch.tensor([2.5, -3.0]))
    done = yaws(decoder.decode(labels(torch.zeros(2, 30))))
    left = (1.0 - RATE) ** torch.arange(1, 31, dtype=torch.float64)
    assert torch.allclose(done[0], 2.5 + 0.5 * left, atol=1e-5)
    around = 2.0 * np.pi - 6.0  # from 3 to -3 across the half turn
    wanted = 3.0 + around * (1.0 - left)
    assert torch.allclose(torch.remainder(done[1], 2 * np.pi), wanted, atol=1e-5)


def test_chunks_worlds_and_masks_do_not_matter():
    """One chunk of 12 equals twelve of 1 and 5 + 7, alone or among others, bit for bit; a mask leaves others out."""
    rates = torch.randn(3, 12, generator=torch.Generator().manual_seed(1))
    measured = torch.tensor([0.4, -0.2, 1.0])

    def played(pieces, rows):
        decoder = V4Decoder(len(rows), realign=RATE)
        decoder.decode(labels(torch.full((len(rows), 1), 0.7)))
        decoder.measure(measured[rows])
        return torch.cat([decoder.decode(labels(piece)) for piece in rates[rows].split(pieces, dim=1)], dim=1)

    whole = played(12, [0, 1, 2])
    assert torch.equal(whole, played(1, [0, 1, 2]))
    assert torch.equal(whole, played([5, 7], [0, 1, 2]))
    assert torch.equal(whole[1:2], played(12, [1]))
    decoder = V4Decoder(3, realign=RATE)
    decoder.measure(measured, np.array([True, False, True]))
    some = yaws(decoder.decode(labels(torch.zeros(3, 4)), np.array([True, True, False])))
    assert some[0, -1] > 0.0
    assert torch.equal(some[1], torch.zeros(4, dtype=torch.float64))
    again = yaws(decoder.decode(labels(torch.zeros(3, 1))))
    assert again[0] > some[0, -1]
    assert again[2] == some[2, 0]  # its yaw did not go on


def test_without_realign_a_measurement_changes_nothing():
    """Yaws are sums of the rates, exactly as before."""
    rates = torch.randn(2, 9, generator=torch.Generator().manual_seed(2))
    plain, measured = V4Decoder(2), V4Decoder(2)
    measured.measure(torch.tensor([1.0, float("nan")]))
    assert torch.equal(plain.decode(labels(rates)), measured.decode(labels(rates)))
    broken = V4Decoder(1, realign=RATE)
    broken.measure(torch.tensor([float("nan")]))
    assert torch.equal(yaws(broken.decode(labels(torch.zeros(1, 3)))), torch.zeros(1, 3, dtype=torch.float64))


@pytest.mark.parametrize("length", [5, 20])
def test_a_loop_with_drift_stays_near_the_robot(length):
    """A robot that turns too little: without realign the command runs away from it, with it no further than d / r."""
    left = {}
    for realign in (0.0, RATE):
        policy = V4Policy(Turning(0.5, length, realign))
        policy.reset([0], ["boxing"])
        robot_yaw = 0.0
        for _ in range(400 // length):
            seen = SimpleNamespace(state=state_of([robot_yaw]), mask=np.ones(1, bool))
            commanded = yaws(policy.act(seen).actions)[0, -1].item()
            robot_yaw += length * (0.5 * g1.TICK - DRIFT)
        left[realign] = abs((commanded - robot_yaw + np.pi) % (2.0 * np.pi) - np.pi)
    assert left[0.0] == pytest.approx(400 * DRIFT, rel=1e-3)
    assert left[RATE] == pytest.approx(DRIFT / RATE, abs=DRIFT * length)  # where as much is closed as is added
    again = V4Policy(Turning(0.5, length, RATE))
    again.reset([0], ["boxing"])
    first = again.act(SimpleNamespace(state=state_of([0.3]), mask=np.ones(1, bool))).actions
    again.reset([0], ["boxing"])
    assert torch.equal(first, again.act(SimpleNamespace(state=state_of([0.3]), mask=np.ones(1, bool))).actions)


@pytest.mark.parametrize("late", [0, 5, 15])
def test_a_look_is_compared_with_the_heading_of_its_own_tick(late):
    """A robot at its commanded pose has no gap, however many ticks before its chunk the policy looks."""
    policy = V4Policy(Turning(0.5, 20, RATE), late)
    policy.reset([0], ["boxing"])
    commanded = [0.0] * (late + 1)  # it stands until the first chunk begins
    for _ in range(6):
        seen = SimpleNamespace(state=state_of([commanded[-1 - late]]), mask=np.ones(1, bool))
        commanded += yaws(policy.act(seen).actions)[0].tolist()
    turned = np.diff(commanded[late:])
    assert np.allclose(turned, 0.5 * g1.TICK, atol=1e-6)
