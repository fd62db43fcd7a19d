"""Conformance checks of policies: ours pass, and each check finds a policy that breaks its promise alone."""

import threading

import numpy as np
import pytest

from arena_newton import policies, trackers
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies import Chunk, Policy, world_mask
from arena_newton.policies.serve_example import Handler, Server
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.testing import ConformanceError, check_policy

NAMES = "attributes chunk seeds reset asks rows batch observation errors describe close".split()


class Swaying(Policy):
    """A good policy with a memory and noise: sways by what it saw and what its seed says, more with each chunk."""

    name = "swaying"
    chunk_size = 3

    def __init__(self):
        self.seeds, self.count = np.zeros(0, np.int64), np.zeros(0, np.int64)

    def reset(self, seeds, tasks, mask=None):
        if len(self.seeds) != len(seeds):
            self.seeds, self.count = np.zeros(len(seeds), np.int64), np.zeros(len(seeds), np.int64)
        rows = world_mask(mask, len(seeds))
        self.seeds[rows] = np.asarray(seeds)[rows]
        self.count[rows] = 0

    def act(self, observation):
        state = observation.state.cpu().numpy()
        actions = np.tile(STAND_ACTION, (len(state), self.chunk_size, 1))
        for world in np.flatnonzero(observation.mask):
            noise = np.random.default_rng([self.seeds[world], self.count[world]]).standard_normal(29)
            actions[world, :, 9:38] += 0.01 * noise + 0.1 * state[world, 6:35]
            self.count[world] += 1
        broken = ~np.isfinite(state).all(axis=1) & observation.mask
        return Chunk(actions, {int(world): "the state is not finite" for world in np.flatnonzero(broken)})

    def describe(self):
        return {"name": self.name, "noise": 0.01}


class Seeing(Swaying):
    """The same with pictures of a size of its own."""

    needs_image = True
    camera = CameraConfig(width=8, height=6)

    def act(self, observation):
        chunk = super().act(observation)
        assert observation.image.shape[1:] == (6, 8, 3)
        chunk.actions[:, :, 10] += 1e-3 * observation.image.float().mean(dim=(1, 2, 3)).numpy()[:, None]
        return chunk


class Chunkless(Swaying):
    chunk_size = 0

    def act(self, observation):
        self.chunk_size = 3
        chunk = super().act(observation)
        self.chunk_size = 0
        return chunk


class Mislabelled(Swaying):
    labels = "v5"


class Bare(Swaying):
    def act(self, observation):
        return super().act(observation).actions


class Narrow(Swaying):
    def act(self, observation):
        return Chunk(super().act(observation).actions[..., :39])


class Degenerate(Swaying):
    def act(self, observation):
        chunk = super().act(observation)
        chunk.actions[:, :, 3:9] = 0.0
        return chunk


class Refusing(Swaying):
    def act(self, observation):
        chunk = super().act(observation)
        return Chunk(chunk.actions, {0: "not today"} if observation.mask[0] else {})


class Misnaming(Swaying):
    """Names a world of the batch that is none."""

    def act(self, observation):
        return Chunk(super().act(observation).actions, {len(observation.mask): "beyond"})


class Unseeded(Swaying):
    def __init__(self):
        super().__init__()
        self.rng = np.random.default_rng(0)

    def act(self, observation):
        chunk = super().act(observation)
        chunk.actions[:, :, 20] += 0.1 * self.rng.standard_normal()
        return chunk


class Unforgetting(Swaying):
    """Forgets only when all worlds begin."""

    def reset(self, seeds, tasks, mask=None):
        if world_mask(mask, len(seeds)).all():
            super().reset(seeds, tasks, mask)


class Sweeping(Swaying):
    """Forgets all worlds when one begins."""

    def reset(self, seeds, tasks, mask=None):
        super().reset(seeds, tasks, mask)
        self.count[:] = 0


class Impatient(Swaying):
    """Counts the asks of all worlds, whoever asked."""

    def act(self, observation):
        chunk = super().act(observation)
        self.count[~observation.mask] += 1
        return chunk


class Crowd(Swaying):
    def act(self, observation):
        chunk = super().act(observation)
        chunk.actions[:, :, 12] += np.nan_to_num(observation.state.numpy()).mean()
        return chunk


class Head(Swaying):
    """Counts heads: the answer depends on the size of the batch alone."""

    def act(self, observation):
        chunk = super().act(observation)
        chunk.actions[:, :, 12] += 0.01 * len(observation.state)
        return chunk


class Writing(Swaying):
    def act(self, observation):
        chunk = super().act(observation)
        observation.state[:, 6:35] -= 0.1
        return chunk


class WritingMask(Swaying):
    def act(self, observation):
        chunk = super().act(observation)
        observation.mask[:] = False
        return chunk


class WritingImage(Seeing):
    def act(self, observation):
        chunk = super().act(observation)
        observation.image.zero_()
        return chunk


class Fragile(Swaying):
    def act(self, observation):
        if not observation.state.isfinite().all():
            raise ValueError("state is not finite")
        return super().act(observation)


class Blaming(Swaying):
    def act(self, observation):
        chunk = super().act(observation)
        return Chunk(chunk.actions, dict.fromkeys(range(len(observation.mask)), "broken") if chunk.errors else {})


class Moody(Swaying):
    def describe(self):
        return {"name": self.name, "asked": int(self.count.sum())}


class Opaque(Swaying):
    def describe(self):
        return {"name": self.name, "noise": np.float32(0.01)}


class CloseOnce(Swaying):
    def close(self):
        del self.seeds


BROKEN = {
    Chunkless: ("attributes", "chunk_size is 0, expected a whole number"),
    Mislabelled: ("attributes", "labels are 'v5', expected one of v3.1, v4 or None"),
    Bare: ("chunk", "act answers a ndarray, expected a Chunk"),
    Narrow: ("chunk", r"shape \[3, 3, 39\], expected \[3, n, 40\]"),
    Degenerate: ("chunk", "root_rot6d .* names no rotation"),
    Refusing: ("chunk", "world 0 got no action: not today"),
    Misnaming: ("chunk", "errors name world 3, which did not ask"),
    Unseeded: ("seeds", "draw noise from the seed"),
    Unforgetting: ("reset", "world 1 begun again and new: actions differ"),
    Sweeping: ("reset", "reset must keep to its mask"),
    Impatient: ("asks", "advance the memory of observation.mask alone"),
    Crowd: ("rows", "world 0 next to other episodes"),
    Head: ("batch", "world 0 alone and among 3: .*else declare depends_on_worlds = True"),
    Writing: ("observation", "writes into observation.state"),
    WritingMask: ("observation", "writes into observation.mask"),
    WritingImage: ("observation", "writes into observation.image"),
    Fragile: ("errors", "one world's broken state stops all: ValueError: state is not finite"),
    Blaming: ("errors", "world 0 is refused for the broken state of world 1"),
    Moody: ("describe", "answers something else after an episode"),
    Opaque: ("describe", "not JSON: .*float32"),
    CloseOnce: ("close", "raised AttributeError"),
}


@pytest.mark.parametrize("policy", [Swaying, Seeing])
def test_a_memory_conforms(policy):
    """The good policy, from which the broken ones differ in one thing, keeps every promise, with two worlds too."""
    assert [result.name for result in check_policy(policy())] == NAMES
    assert all(result.ok for result in check_policy(policy(), seeds=(5, 6)))
    with pytest.raises(ValueError, match="at least 2"):
        check_policy(policy(), seeds=(5, 5))


@pytest.mark.parametrize("broken", BROKEN, ids=lambda broken: broken.__name__)
def test_each_check_finds_its_fault(broken):
    """A policy with one fault fails the check of that promise with a message that says what is wrong."""
    name, said = BROKEN[broken]
    with pytest.raises(ConformanceError, match=said) as caught:
        check_policy(broken())
    failed = [result.name for result in caught.value.results if not result.ok]
    assert name in failed
    if name not in ("chunk", "seeds"):  # without those no other promise can be tried
        assert set(failed) - {name} <= {Crowd: {"asks", "batch", "errors", "reset"}}.get(broken, set()), failed


@pytest.mark.parametrize("cameras", [["front"], {"front": "ego"}])
def test_cameras_are_named_configurations(cameras):
    """Cameras that are no mapping of names to configurations are reported as that."""
    policy = Swaying()
    policy.cameras = cameras
    with pytest.raises(ConformanceError, match="cameras is no mapping of names to CameraConfig"):
        check_policy(policy)


def test_every_check_has_a_broken_policy():
    """No check is without a policy that fails it."""
    assert {name for name, _ in BROKEN.values()} == set(NAMES)


def test_dependence_on_worlds_can_be_declared():
    """A policy that says it depends on who asks is not held to the contrary, but to everything else."""
    for broken, names in ((Crowd, {"rows", "batch", "asks"}), (Unseeded, set())):
        policy = broken()
        policy.depends_on_worlds = True
        results = {result.name: result for result in check_policy(policy, raises=False)}
        assert all(results[name].ok and "not promised" in results[name].message for name in names)
        assert results["seeds"].ok == (broken is Crowd)


def test_own_policies_conform(tmp_path):
    """Standing, a replayed recording and a server that honours seeds keep every promise."""
    actions = np.tile(STAND_ACTION, (100, 1))
    actions[:, 20] += np.linspace(0.0, 0.3, 100)
    np.savez(tmp_path / "wave.npz", action=actions)
    server = Server(("127.0.0.1", 0), type("Silent", (Handler,), {"log_message": lambda *_: None}))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        for spec in ("stand", f"replay:{tmp_path / 'wave.npz'}", f"remote:http://127.0.0.1:{server.server_port}"):
            policy = policies.get(spec)
            policy.camera = CameraConfig(width=32, height=24, fit="native")  # noise of 640 x 480 takes seconds to send
            assert all(result.ok for result in check_policy(policy))
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture
def make_worlds():
    """Builder of real worlds, and all that it built."""

    def make(worlds):
        env = ArenaEnv("boxing", tracker=trackers.get("pd"), worlds=worlds, engine="mujoco", rules="released")
        make.made.append(env)
        return env

    make.made = []
    return make


def test_experts_conform_in_real_worlds(make_worlds):
    """A policy that reads the world itself is tried in real worlds, which are closed afterwards."""
    results = {r.name: r for r in check_policy(policies.get("expert"), task="boxing", make_worlds=make_worlds)}
    assert "not tried in real worlds" in results["errors"].message
    assert [env.worlds for env in make_worlds.made] == [3, 1]
    assert not any(env.active.any() for env in make_worlds.made)


def test_a_policy_in_real_worlds_that_averages_is_found(make_worlds):
    """Faults that made-up worlds find are found in real ones too."""
    results = check_policy(Crowd(), task="boxing", make_worlds=make_worlds, raises=False)
    assert {result.name for result in results if not result.ok} >= {"rows", "batch"}


def test_a_policy_that_cannot_do_the_task_says_so():
    """A policy's own refusal, such as of a task without an expert, is its own error and no finding."""
    with pytest.raises(InputError, match="nothing"):
        check_policy(policies.get("expert"), task="nothing")
