"""Limited channels, and the realignment of a reference, as Warp functions."""

import numpy as np
import torch
import warp as wp

from arena_newton.kernels.footwork import approach
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator

TICK = 0.02


@wp.kernel
def approach_kernel(
    state: wp.array[wp.vec2], target: wp.array[float], top: wp.array[float], acceleration: wp.array[float]
):
    """One thread per channel."""
    i = wp.tid()
    state[i] = approach(state[i][0], state[i][1], target[i], top[i], acceleration[i], TICK)


def test_channels_land_on_their_targets(device):
    """A channel keeps its rate and acceleration, overshoots by less than 1e-6, and ends on the target's bits."""
    rng, count = np.random.default_rng(0), 500
    start, target = rng.normal(size=count).astype(np.float32), rng.normal(size=count).astype(np.float32)
    target[:100] = 0.0
    top, acceleration = rng.uniform(0.2, 2.0, count), rng.uniform(0.5, 10.0, count)

    def up(values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=wp.float32, device=device)

    state = wp.array(np.stack([start, np.zeros(count)], axis=1), dtype=wp.vec2, device=device)
    arrays, course = [up(target), up(top), up(acceleration)], []
    for _ in range(1200):
        wp.launch(approach_kernel, dim=count, inputs=[state, *arrays], device=device)
        course.append(state.numpy())
    value, rate = np.stack(course).astype(np.float64).transpose(2, 0, 1)
    assert (np.abs(rate) <= top + 1e-6).all()
    assert (np.abs(np.diff(rate, axis=0)) <= acceleration * TICK + 1e-6).all()
    beyond = (value - target) * np.sign(target - start)
    assert beyond.max() < 1e-6
    np.testing.assert_array_equal(course[-1][:, 0], target)
    np.testing.assert_array_equal(course[-1][:, 1], 0.0)


def test_realign_without_weight_keeps_every_bit():
    """A world whose weight is zero keeps feet, frame and action to the bit while another one turns."""
    generator, command = ReferenceGenerator(2), MotionCommand.neutral(2)
    command.velocity[:] = torch.tensor([0.4, 0.0, 0.2])
    for _ in range(60):
        generator.step(command)
    before = (generator.feet_pos, generator.action(), generator.frames.root_quat, generator.com.clone())
    generator.realign(torch.tensor([1.0, 1.0]), torch.tensor([0.0, 0.1]))
    after = (generator.feet_pos, generator.action(), generator.frames.root_quat, generator.com)
    for old, new in zip(before, after, strict=True):
        assert torch.equal(old[0], new[0])
        assert not torch.equal(old[1], new[1])


def test_a_kick_beyond_the_feet_is_the_right_foots():
    """A kick of 3 counts as the nearest foot that there is, not as a row outside the arrays."""
    generators = ReferenceGenerator(2), ReferenceGenerator(2)
    for generator, kick in zip(generators, (2, 3), strict=True):
        command = MotionCommand.neutral(2)
        command.kick[:] = kick
        for _ in range(120):
            generator.step(command)
    assert float(generators[0].kick_progress[0]) > 0.3
    np.testing.assert_array_equal(generators[0].action(), generators[1].action())
