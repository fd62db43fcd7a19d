"""The plan of a tick in Warp: against its oracle in torch, for any batch, and with packed commands."""

import numpy as np
import pytest
import torch

from arena_newton.errors import InputError
from arena_newton.trackers.motions.commands import COMMAND_WIDTH, MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator
from tests.trackers.motions import torch_plan

DISCRETE = ("stepping", "side", "first", "final", "floor", "kick_side", "kick_pending", "kick_command", "support")
TICKS = 200
COURSES = ("body", "channels", "rates", "feet", "lift_off", "landing", "phase", "gait", "base", "kick_weight", "euler")


class Stream:
    """Random commands, masks, resets and headings for a batch.

    Every channel jumps at every command. The first quarter of the worlds walks ahead all the same, so that its feet
    get onto other ground.
    """

    def __init__(self, worlds: int, seed: int):
        """Nothing is drawn yet."""
        self.worlds, self.rng, self.raised = worlds, np.random.default_rng(seed), 0.0

    def uniform(self, low: float, high: float, *shape: int) -> torch.Tensor:
        """Float32, shape [worlds, ...]."""
        return torch.tensor(self.rng.uniform(low, high, (self.worlds, *shape)), dtype=torch.float32)

    def sometimes(self, probability: float) -> torch.Tensor:
        """A mask, shape [worlds]."""
        return torch.tensor(self.rng.random(self.worlds) < probability)

    def command(self) -> MotionCommand:
        """Every channel at random: walks, steps onto ground, kicks, seats, reaches within and out of reach."""
        neutral = MotionCommand.neutral(self.worlds)
        noise = torch.tensor(self.rng.normal(0.0, 0.3, (self.worlds, COMMAND_WIDTH)), dtype=torch.float32)
        c = MotionCommand.unpack(neutral.pack() + noise)
        c.velocity *= self.sometimes(0.6)[:, None]
        c.height, c.stance_width, c.step_time = self.uniform(0.5, 0.8), self.uniform(0.18, 0.28), self.uniform(0.3, 0.6)
        c.stagger, c.foot_offset = self.uniform(-0.1, 0.1), self.uniform(-0.02, 0.1)
        c.swing_height = self.uniform(0.05, 0.15)
        c.pelvis_back = self.uniform(0.0, 0.3) * self.sometimes(0.1)
        c.ground = self.uniform(0.0, 0.15) * self.sometimes(0.3)
        c.reach, c.hands = self.uniform(-1.0, 1.0, 2), self.uniform(0.0, 1.0, 2)
        c.arm_speed, c.kick_speed = self.uniform(1.0, 8.0), self.uniform(1.0, 3.0)
        c.kick = self.sometimes(0.15) * torch.tensor(self.rng.integers(1, 3, self.worlds))
        c.step_in_place = self.sometimes(0.1)
        ahead = slice(self.worlds // 4)
        c.velocity[ahead] = torch.tensor([0.5, 0.0, 0.0])
        c.step_time[ahead], c.pelvis_back[ahead], c.kick[ahead], c.stagger[ahead] = 0.5, 0.0, 0, 0.0
        c.ground[ahead] = self.raised = 0.1 if self.rng.random() < 0.2 else self.raised * (self.rng.random() < 0.8)
        return c


def test_plan_is_the_oracles():
    """200 random ticks in 72 worlds give the oracle's events and, to 1e-5, its courses, roots, joints and hands.

    A foot may leave or meet the ground a tick apart where its height or phase is on the boundary, in 3 of the 14,400
    ticks. The oracle's plan runs freely. The memory of the joints' solver is the product's before every tick: an arm
    that is folded against its limits amplifies the last bits of its goal to millimetres within seconds. Joints agree
    to 1e-4 in all ticks, and to 1e-5 in 199 of 200: a leg that does not reach its footstep has no better condition.
    """
    stream = Stream(worlds := 72, 0)
    product, oracle = ReferenceGenerator(worlds), torch_plan.TorchGenerator(worlds)
    seen = dict.fromkeys(("stepping", "kick_side", "pelvis_back", "base"), 0)
    loose, on_boundary = 0, 0
    for tick in range(TICKS):
        if tick % 25 == 0:
            command = stream.command()
        if tick % 100 == 60:
            mask, pose = stream.sometimes(0.1), stream.uniform(-3.0, 3.0, 3)
            for generator in (product, oracle):
                generator.reset(mask, root_xy=pose[:, :2], yaw=pose[:, 2])
        if tick % 3 == 0:
            yaw, weight = stream.uniform(-6.0, 6.0), 0.05 * stream.sometimes(0.5)
            for generator in (product, oracle):
                generator.realign(yaw, weight)
        mask = stream.sometimes(0.9) if tick % 2 else None
        oracle.remember(product._solved)
        ours, theirs = product.step(command, mask), oracle.step(command, mask)
        state = {name: getattr(oracle._s, name) for name in (*DISCRETE, *COURSES)}
        differ = [(product._s[name] != state[name]).reshape(worlds, -1).any(1) for name in DISCRETE]
        on_boundary += int(torch.stack(differ).any(0).sum())
        for name in COURSES:
            assert float((product._s[name] - state[name]).abs().max()) <= 1e-5, (tick, name)
        for name in ("root_pos", "root_quat", "hands"):
            assert float((getattr(ours, name) - getattr(theirs, name)).abs().max()) <= 1e-5, (tick, name)
        off = (ours.joint_pos - theirs.joint_pos).abs().amax(1)
        assert float(off.max()) <= 1e-4, tick
        loose += int((off > 1e-5).sum())
        assert float((product.action()[:, :9] - oracle.action()[:, :9]).abs().max()) <= 1e-5, tick
        seen["stepping"] += int(state["stepping"].sum())
        seen["kick_side"] += int((state["kick_side"] > 0).sum())
        seen["pelvis_back"] += int((product.channel("pelvis_back") > 0.01).sum())
        seen["base"] += int((state["base"][:, 0] > 0.02).sum())
    assert loose <= TICKS * worlds // 200 and on_boundary <= 3
    # The stream shows what it must: each of these in at least one world tick of a hundred.
    assert min(seen.values()) > TICKS * worlds // 100, seen


def test_no_bit_depends_on_the_batch():
    """A world's frames and actions are the same bits alone, among 24 and among 24 in another order."""
    stream = Stream(24, 2)
    commands, order = [stream.command() for _ in range(6)], torch.tensor(stream.rng.permutation(24))
    batch, shuffled, alone = ReferenceGenerator(24), ReferenceGenerator(24), ReferenceGenerator(1)
    row = int((order == 7).nonzero())
    for tick in range(150):
        table = commands[tick // 25].pack()
        yaw = stream.uniform(-0.3, 0.3)
        for generator, rows in ((batch, torch.arange(24)), (shuffled, order), (alone, torch.tensor([7]))):
            generator.realign(yaw[rows], 0.05)
            generator.step(table[rows])
        assert torch.equal(batch.action(), shuffled.action()[torch.argsort(order)])
        assert torch.equal(batch.action()[7], alone.action()[0]) and torch.equal(
            shuffled.action()[row], alone.action()[0]
        )
    assert torch.equal(batch.frames.root_pos[7], alone.frames.root_pos[0])


def test_packed_commands_are_commands():
    """Packed rows give the frames of the command that they were packed from; other shapes are refused."""
    stream = Stream(3, 3)
    packed, plain = ReferenceGenerator(3), ReferenceGenerator(3)
    for _ in range(4):
        command = stream.command()
        table = command.pack()
        for _ in range(20):
            a, b = packed.step(table), plain.step(command)
        assert torch.equal(a.joint_pos, b.joint_pos) and torch.equal(a.root_pos, b.root_pos)
    with pytest.raises(InputError, match=r"packed rows have shape \[2, "):
        packed.step(table[:2])


def test_masked_worlds_keep_every_bit():
    """Worlds outside the mask keep frame, action and state, and a frame that was given does not change later."""
    stream = Stream(4, 4)
    g, mask = ReferenceGenerator(4), torch.tensor([True, False, True, False])
    for _ in range(30):
        given = g.step(command := stream.command())
    kept = {name: value.clone() for name, value in vars(given).items()}
    action, feet, support = g.action(), g.feet_pos, g.support
    for _ in range(30):
        later = g.step(command, mask)
    for name, value in kept.items():
        assert torch.equal(getattr(given, name), value), name
        assert torch.equal(getattr(later, name)[~mask], value[~mask]), name
    assert torch.equal(g.action()[~mask], action[~mask])
    assert torch.equal(g.feet_pos[~mask], feet[~mask]) and torch.equal(g.support[~mask], support[~mask])
    assert not torch.equal(later.root_pos[mask], kept["root_pos"][mask])


def test_a_command_that_is_not_a_number_shows():
    """NaN in a channel gives frames of NaN in its world alone, and never a reference that drifts off unseen."""
    command = MotionCommand.neutral(2)
    command.velocity[1, 0] = float("nan")
    frames = ReferenceGenerator(2).step(command)
    assert frames.root_pos[0].isfinite().all() and not frames.root_pos[1].isfinite().all()
