"""Conformance checks of trackers: ours pass, and each check finds a tracker that breaks its promise alone."""

import dataclasses
import importlib
import math
import sys
from pathlib import Path

import pytest
import torch

from arena_newton import trackers
from arena_newton.interfaces import NEEDS
from arena_newton.robot.g1 import TWIST2_DRIVE, PhysicsRate
from arena_newton.testing import ConformanceError, check_tracker
from arena_newton.trackers import Tracker

NAMES = "attributes rate targets finite deterministic rows batch mask reset prefill inputs buffers describe".split()


class Lagging(Tracker):
    """A good tracker with a memory: targets are the mean of this tick's and the last tick's reference."""

    name = "lagging"

    def bind(self, worlds, device="cpu"):
        super().bind(worlds, device)
        self.last = torch.zeros(worlds, 29, device=device)
        self.reset()

    def reset(self, mask=None):
        rows = slice(None) if mask is None else mask
        self.last[rows] = 0.0

    def prefill(self, command, state, mask=None):
        rows = slice(None) if mask is None else mask
        self.last[rows] = command.joints[rows]

    def step(self, command, state, mask=None):
        answer = 0.5 * (self.last + command.joints)
        rows = slice(None) if mask is None else mask
        self.last[rows] = command.joints[rows]
        return answer


class WeakDrive(Lagging):
    drive = dataclasses.replace(TWIST2_DRIVE, kp=TWIST2_DRIVE.kp[:28])


class HalfRate(Lagging):
    physics_rate = PhysicsRate(dt=0.005, substeps=8)


class Doubles(Lagging):
    def step(self, command, state, mask=None):
        return super().step(command, state, mask).double()


class Gradient(Lagging):
    def step(self, command, state, mask=None):
        return super().step(command, state, mask) * torch.ones(1, requires_grad=True)


class Bursting(Lagging):
    def step(self, command, state, mask=None):
        return super().step(command, state, mask) / (state.joint_vel.abs() < 90.0)


class Noisy(Lagging):
    def step(self, command, state, mask=None):
        return super().step(command, state, mask) + 1e-6 * torch.rand(1)


class Averaging(Lagging):
    def step(self, command, state, mask=None):
        answer = super().step(command, state, mask)
        return answer + 1e-4 * state.joint_pos.mean(0)


class Counting(Lagging):
    """Its targets depend on the number of worlds, and on nothing of the others."""

    def step(self, command, state, mask=None):
        return super().step(command, state, mask) + 1e-6 * self.worlds


class Restless(Lagging):
    def step(self, command, state, mask=None):
        return super().step(command, state)


class Maskless(Lagging):
    def step(self, command, state):
        return super().step(command, state)


class Remembering(Lagging):
    def reset(self, mask=None):
        if mask is None:
            super().reset()


class Forgetful(Lagging):
    def reset(self, mask=None):
        super().reset()


class Overfilling(Lagging):
    def prefill(self, command, state, mask=None):
        super().prefill(command, state)


class Scribbling(Lagging):
    def step(self, command, state, mask=None):
        answer = super().step(command, state, mask)
        state.joint_vel *= 0.05
        return answer


class Keeping(Lagging):
    """Keeps the caller's buffer instead of its numbers."""

    def step(self, command, state, mask=None):
        answer = 0.5 * (self.last + command.joints)
        rows = torch.ones(self.worlds, dtype=torch.bool) if mask is None else mask
        self.last = command.joints if rows.all() else torch.where(rows[:, None], command.joints, self.last)
        return answer

    def reset(self, mask=None):
        self.last = self.last.clone()
        super().reset(mask)

    def prefill(self, command, state, mask=None):
        self.last = self.last.clone()
        super().prefill(command, state, mask)


class Describing(Lagging):
    def describe(self):
        return {"name": self.name, "gain": math.nan}


class Nameless(Lagging):
    def describe(self):
        return {"gain": 1.0}


class Crashing(Lagging):
    def step(self, command, state, mask=None):
        raise RuntimeError("no\nnetwork")


BROKEN = {
    WeakDrive: ("attributes", "drive.kp must be 29 finite numbers"),
    HalfRate: ("rate", "0.005 s x 8, which is no tick of 0.02 s"),
    Doubles: ("targets", r"answers torch.float64 \[1, 29\], expected a float32 tensor \[1, 29\] on cpu"),
    Gradient: ("targets", "answers with a gradient"),
    Bursting: ("finite", "under extreme commands and states the targets of tick 0 are not finite"),
    Noisy: ("deterministic", "the same ticks played twice: targets differ by up to"),
    Averaging: ("rows", "world 0 next to other worlds' other commands"),
    Counting: ("batch", "world 0 alone and among 3: targets differ by up to .* depend on --worlds"),
    Restless: ("mask", "store histories of the masked rows alone"),
    Maskless: ("mask", "step takes no mask"),
    Remembering: ("reset", "reset must forget everything"),
    Forgetful: ("reset", "reset must keep to its mask"),
    Overfilling: ("prefill", "prefill must keep its mask"),
    Scribbling: ("inputs", "step writes into RobotState.joint_vel"),
    Keeping: ("buffers", "inputs in new and in reused buffers"),
    Describing: ("describe", r"not JSON: .*[Oo]ut of range"),
    Nameless: ("describe", "must hold the name 'lagging'"),
}


@pytest.fixture
def falcon_module(monkeypatch):
    """A stranger's package, importable as when it is installed."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "trackers" / "falcon_package")
    yield importlib.import_module("falcon_tracker")
    sys.modules.pop("falcon_tracker", None)


@pytest.mark.parametrize("name", ["pd", "twist2", "sonic"])
def test_own_trackers_conform(name):
    """Every tracker of the package keeps every promise."""
    results = check_tracker(trackers.get(name))
    assert [result.name for result in results] == NAMES and all(result.ok for result in results)


def test_a_memory_conforms():
    """The good tracker, from which the broken ones differ in one thing, keeps every promise, with five worlds too."""
    for worlds in (2, 3, 5):
        assert all(result.ok for result in check_tracker(Lagging(), worlds=worlds))
    with pytest.raises(ValueError, match="at least 2"):
        check_tracker(Lagging(), worlds=1)


class Foreseeing(Lagging):
    """Follows the mean of a window, moved by what state estimation says."""

    needs, lookahead = NEEDS, 3

    def step(self, command, state, mask=None):
        lean = (command.position - state.position).mean(1) + state.lin_vel[:, 0] + 1e-3 * state.foot_force[:, 1]
        wanted = command.ahead.joints[:, 0] + command.ahead.joints[:, 1] + command.ahead.joints[:, 2]
        command = dataclasses.replace(command, joints=wanted + lean[:, None] + command.ahead.position[:, 0, :1])
        return super().step(command, state, mask)


def test_declared_fields_are_given():
    """A tracker with a window and state estimation keeps every promise; one that declares nothing gets None."""
    assert all(result.ok for result in check_tracker(Foreseeing()))
    silent = type("Silent", (Foreseeing,), {"needs": ()})
    results = {result.name: result for result in check_tracker(silent(), raises=False)}
    assert results["attributes"].ok and "NoneType" in results["targets"].message
    wrong = type("Wrong", (Foreseeing,), {"lookahead": -1})
    assert "lookahead is -1" in {r.name: r for r in check_tracker(wrong(), raises=False)}["attributes"].message


def test_a_tracker_without_memory_needs_no_mask():
    """The shortest tracker of the documentation, two arguments and no history, keeps every promise."""

    class Reference(Tracker):
        name = "reference"

        def step(self, command, state):
            return command.joints

    assert all(result.ok for result in check_tracker(Reference()))


@pytest.mark.parametrize("broken", BROKEN, ids=lambda broken: broken.__name__)
def test_each_check_finds_its_fault(broken):
    """A tracker with one fault fails the check of that promise with a message that says what is wrong."""
    name, said = BROKEN[broken]
    with pytest.raises(ConformanceError, match=said) as caught:
        check_tracker(broken())
    failed = [result.name for result in caught.value.results if not result.ok]
    assert name in failed and isinstance(caught.value, AssertionError)
    also = {
        Averaging: {"batch"},
        Forgetful: {"prefill"},
        Noisy: set(NAMES) - {"attributes", "rate", "finite", "targets", "describe", "inputs"},
    }
    assert set(failed) - {name} <= also.get(broken, set()), failed


def test_every_check_has_a_broken_tracker():
    """No check is without a tracker that fails it."""
    assert {name for name, _ in BROKEN.values()} == set(NAMES)


def test_errors_are_findings():
    """A tracker that raises fails each check in which it does; the error is told once, and the others are tried."""
    results = {result.name: result for result in check_tracker(Crashing(), raises=False)}
    assert results["attributes"].ok and results["rate"].ok
    assert results["targets"].message == "raised RuntimeError: no network"
    assert results["finite"].message == "the same error as targets" and not results["finite"].ok
    assert list(results) == NAMES


def test_tolerance_is_of_the_batch_alone():
    """A tolerance lets rounding between batches pass, and nothing else."""
    results = {result.name: result for result in check_tracker(Counting(), tolerance=1e-5, raises=False)}
    assert results["batch"].ok and "1e-05" in results["batch"].message
    assert not all(result.ok for result in check_tracker(Noisy(), tolerance=1.0, raises=False))


def test_stranger_with_a_network_conforms(falcon_module):
    """FALCON's package keeps every promise with any network behind its front end."""
    from arena_newton.trackers.front_end import NetworkTracker

    torch.manual_seed(0)
    network = torch.nn.Linear(falcon_module.FRAMES * falcon_module.FRAME, 29)
    tracker = NetworkTracker(falcon_module.FalconFrontEnd(), network)
    tracker.name = "falcon"
    assert all(result.ok for result in check_tracker(tracker))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("name", ["twist2", "sonic"])
def test_own_trackers_conform_on_cuda(name):
    """On CUDA, where ticks are graphs, every promise is kept within rounding."""
    assert all(result.ok for result in check_tracker(trackers.get(name), device="cuda"))
