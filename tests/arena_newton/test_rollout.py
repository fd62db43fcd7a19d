"""Episodes: results do not depend on the batch, errors stay in their world, hooks see what they are promised."""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import warp as wp

from arena_newton import tasks, trackers
from arena_newton.env import STAND_ACTION, ArenaEnv
from arena_newton.errors import InputError
from arena_newton.interfaces import NEEDS, Chunk, EpisodeEvent, Predicate, Recorder
from arena_newton.policies.base import Policy
from arena_newton.policies.lerobot.chunk_memory import ChunkMemory
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, DEFAULT_POSE
from arena_newton.rollout import Rollout
from arena_newton.tasks.football import FootballJudge
from arena_newton.tracking import TrackerLoop

STEPS = 30


class Sway(Policy):
    """A policy whose action depends on the world's own state, so that any mixing of worlds shows."""

    def act(self, observation):
        state = observation.state
        actions = torch.from_numpy(STAND_ACTION).repeat(len(state), 5, 1)
        actions[:, :, 9:38] += 0.05 * torch.sin(10.0 * state[:, None, 6:35])
        actions[:, :, 0] = 0.004
        return Chunk(actions)


class Network(trackers.base.Tracker):
    """A tracker with a random network in fixed blocks, of TWIST2's size."""

    name = "network"

    def bind(self, worlds, device="cpu"):
        from arena_newton.trackers.inference.blocks import BlockRunner

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

    def step(self, command, state, mask=None):
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

    results = Rollout(env, Sway(), episodes, on_finish=keep, max_steps=STEPS).run()
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

    first, second = Rollout(env, OneBad(), _episodes(2), max_steps=8).run()
    assert (first.outcome, first.reason, first.steps) == ("error", "bad_action", 3)
    assert second.outcome == "timeout" and second.steps == 8


def test_policy_error_ends_only_its_world(env):
    """A policy that fails for one world ends that episode as error with its message."""

    class Half(Sway):
        def act(self, observation):
            chunk = super().act(observation)
            chunk.errors = {1: "server said no"} if observation.mask[1] else {}
            return chunk

    first, second = Rollout(env, Half(), _episodes(2), max_steps=8).run()
    assert first.outcome == "timeout"
    assert (second.outcome, second.error) == ("error", "server said no")


def test_nonfinite_state_is_an_error(env):
    """A world whose state is NaN ends as error, the other goes on."""
    own = (env.spec.spawn_position, env.spec.spawn_quat)

    def spawn(seed):
        return ((np.nan,) * 3, own[1]) if seed == 1000 else own

    first, second = Rollout(env, Sway(), _episodes(2), max_steps=8, spawn=spawn).run()
    assert (first.outcome, first.reason) == ("error", "nonfinite_state")
    assert second.outcome == "timeout"


def test_startup_fall_is_told_apart():
    """A robot that falls before step 0 is reported as a start-up fall with no steps."""

    class Drop(trackers.base.Tracker):
        name = "drop"

        def step(self, command, state, mask=None):
            target = command.joints.clone()
            target[:, 4] = target[:, 10] = -1.0
            target[:, 0] = target[:, 6] = -2.0
            return target

    env = ArenaEnv("football", tracker=Drop(), worlds=1, engine="mujoco", device="cpu", fast_physics=True)
    (result,) = Rollout(env, Sway(), _episodes(1), max_steps=8).run()
    assert result.outcome == "fall" and result.startup_fall and result.steps == 0
    (event,) = result.events
    assert event.kind == "fall" and event.tick <= 0 and event.detail in ("tilt", "tilt_held", "contact")


class Broken(trackers.base.Tracker):
    """Answers the reference, spoiled by `spoil`."""

    name = "broken"

    def step(self, command, state, mask=None):
        return self.spoil(command.joints.clone())


@pytest.fixture(scope="module")
def broken():
    """Two worlds of football under a tracker whose `spoil` a test sets."""
    return ArenaEnv("football", tracker=Broken(), worlds=2, engine="mujoco", device="cpu", fast_physics=True)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_nonfinite_targets_are_the_trackers_error(broken, value):
    """A joint target that is not finite ends that world as error under the tracker's name; the other runs on."""

    def spoil(targets):
        if broken.tick[0] == 3:
            targets[0, 7] = value
        return targets

    broken.tracker.spoil = spoil
    first, second = Rollout(broken, Sway(), _episodes(2), max_steps=8).run()
    assert (first.outcome, first.reason, first.steps) == ("error", "tracker", 4)
    assert "tracker broken" in first.error
    assert second.outcome == "timeout" and second.steps == 8


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda targets: targets[:, :28], r"\[2, 28\]"),
        (lambda targets: targets[:1], r"\[1, 29\]"),
        (lambda targets: targets.double(), "float64"),
        (lambda targets: targets.numpy(), "float32"),
        (lambda targets: None, "NoneType"),
    ],
)
def test_targets_of_another_kind_are_refused(broken, spoil, said):
    """An answer of another shape or type stops the run with one line that names the tracker."""
    broken.tracker.spoil = spoil
    with pytest.raises(InputError, match=f"tracker broken: joint targets are .*{said}"):
        Rollout(broken, Sway(), _episodes(2), max_steps=8).run()


def test_released_asks_at_the_spawn_pose(env):
    """`released` has no start-up: the policy's first state is the spawn pose at rest."""

    class First(Sway):
        state = None

        def act(self, observation):
            self.state = observation.state.clone() if self.state is None else self.state
            return super().act(observation)

    other = ArenaEnv("football", tracker=trackers.get("pd"), worlds=2, engine="mujoco", rules="released")
    assert (other.startup_ticks, env.startup_ticks) == (0, 50)
    policy = First()
    results = Rollout(other, policy, _episodes(2), max_steps=3).run()
    assert [r.steps for r in results] == [3, 3] and results[0].sim_s == pytest.approx(0.06)
    spawn = np.array(DEFAULT_POSE, np.float32)[list(CANONICAL_TO_MUJOCO)]
    assert np.array_equal(policy.state[0, 6:35].numpy(), spawn)
    assert not policy.state[:, 35:].any()


def test_errors_of_worlds_that_did_not_ask_are_ignored(env):
    """A policy that names a world without a question ends nothing and breaks nothing."""

    class Loud(Sway):
        def act(self, observation):
            chunk = super().act(observation)
            chunk.errors = {w: "not asked" for w in range(2) if not observation.mask[w]}
            return chunk

    results = Rollout(env, Loud(), _episodes(3), max_steps=7).run()
    assert [r.outcome for r in results] == ["timeout"] * 3


@pytest.mark.parametrize("cut", [lambda a: a[:, :0], lambda a: a[:, :, :39], lambda a: a[:1], lambda a: a[:, 0]])
def test_chunks_of_another_shape_are_refused(env, cut):
    """A chunk without actions or of another width stops the run with one line that names the policy."""

    class Cut(Sway):
        name = "cut"

        def act(self, observation):
            chunk = super().act(observation)
            chunk.actions = cut(chunk.actions)
            return chunk

    with pytest.raises(InputError, match=r"policy cut: a chunk of shape .*expected \[2, n, 40\]"):
        Rollout(env, Cut(), _episodes(2), max_steps=7).run()


def _ends(env, episodes, **options):
    """Every ending's outcome and the states of all worlds at it, to the last bit."""
    ends = []

    def keep(result):
        ends.append((result.outcome, result.steps, env.physics.qpos.numpy().tobytes()))

    Rollout(env, Sway(), episodes, max_steps=8, on_finish=keep, **options).run()
    return ends


class Watch(Recorder):
    """Keeps what it is shown."""

    def __init__(self, wants):
        self.wants_observation = wants
        self.calls, self.labels, self.states = [], [], []

    def start(self, env, world, episode):
        self.calls.append(("start", world, episode.index))

    def before_physics(self, env, observation, action):
        if (env.tick == 2).any():
            self.labels.append(action.clone())
            self.states.append(None if observation is None else observation.state.clone())
            self.expected = env.observe().state.clone()

    def finish(self, env, world, result):
        self.calls.append(("finish", world, result.episode.index))


@pytest.mark.parametrize("wants", [False, True])
def test_hooks_see_label_and_observation(env, wants):
    """Recorders see the policy's actions, not the disturbed ones, and the state of the tick where one asks for it."""
    seen, executed = [Watch(wants), Watch(False)], []

    def push(env, actions):
        executed.append(actions.clone())
        return actions + 1e-3

    plain = _ends(env, _episodes(2))
    assert plain != _ends(env, _episodes(2), recorder=seen, disturbance=push)
    assert len(executed) == 8 + env.startup_ticks and torch.equal(seen[0].labels[0], executed[env.startup_ticks + 2])
    assert seen[0].calls == [("start", 0, 0), ("start", 1, 1), ("finish", 0, 0), ("finish", 1, 1)] == seen[1].calls
    for one in seen:
        assert torch.equal(one.states[0], one.expected) if wants else one.states == [None]


def test_watching_changes_no_bit(env):
    """Episodes end the same with and without recorders that observe."""
    assert _ends(env, _episodes(3)) == _ends(env, _episodes(3), recorder=Watch(True))


def test_phases_are_reported(env):
    """Each phase of the policy is named once, with the tick of the chunk that began it."""

    class Phased(Sway):
        def act(self, observation):
            chunk = super().act(observation)
            now = int(env.tick[observation.mask].min())
            chunk.phases = [None if now == 0 else "walk" if now < 15 else "kick"] * 2
            return chunk

    results = Rollout(env, Phased(), _episodes(2), max_steps=22).run()
    assert [r.phases for r in results] == [(("walk", 5), ("kick", 15))] * 2


def test_an_event_ends_the_episode_and_is_dated(monkeypatch):
    """The task names its events: reason of the timeout, and an event of the tick at which it happened."""
    monkeypatch.setattr(FootballJudge, "evaluate", lambda self, physics: self.event.fill_(1))
    env = ArenaEnv("football", tracker=trackers.get("pd"), worlds=1, engine="mujoco", rules="released")
    (result,) = Rollout(env, Sway(), _episodes(1), max_steps=8).run()
    assert (result.outcome, result.reason, result.steps) == ("timeout", "ball_out", 1)
    assert result.events == (EpisodeEvent("object_out", 1, "ball"),) and result.progress < 1.0


def test_progress_is_one_after_a_success(monkeypatch):
    """A success is full progress, whatever the predicates say."""
    monkeypatch.setattr(FootballJudge, "evaluate", lambda self, physics: self.success.fill_(1))
    env = ArenaEnv("football", tracker=trackers.get("pd"), worlds=1, engine="mujoco", rules="released")
    (result,) = Rollout(env, Sway(), _episodes(1), max_steps=8).run()
    assert (result.outcome, result.progress) == ("success", 1.0)


def test_predicates_carry_their_first_ticks(monkeypatch):
    """A task's predicates come with the first tick at which each held; progress is their fraction."""
    judged = []

    def evaluate(self, physics):
        judged.append(None)
        held = [[len(judged) in (3, 5), False], [len(judged) >= 6, len(judged) == 2]]
        self.predicates.assign(np.array(held, np.int32))

    own = FootballJudge.__init__

    def init(self, scene, rules):
        own(self, scene, rules)
        self.predicates = wp.zeros((2, 2), dtype=wp.int32, device="cpu")

    monkeypatch.setattr(FootballJudge, "evaluate", evaluate)
    monkeypatch.setattr(FootballJudge, "__init__", init)
    spec = dataclasses.replace(tasks.get("football"), predicates=(Predicate("a", "."), Predicate("b", ".")))
    monkeypatch.setattr(tasks, "get", lambda name: spec)
    env = ArenaEnv("football", tracker=trackers.get("pd"), worlds=2, engine="mujoco", rules="released")
    results = Rollout(env, Sway(), _episodes(2), max_steps=8).run()
    assert [r.predicates for r in results] == [{"a": 3, "b": None}, {"a": 6, "b": 2}]
    assert [r.progress for r in results] == [0.5, 1.0]


class Dated(Policy):
    """Chunks of six actions whose forward step names the tick of the query: query t gives t/1000 + action/100000 m."""

    name = "dated"
    length = 6

    def __init__(self):
        self.queries = []

    def attach(self, env):
        self.env = env

    def act(self, observation):
        worlds = len(observation.state)
        self.queries.append((self.env.tick.copy(), observation.mask.copy()))
        actions = torch.from_numpy(STAND_ACTION).repeat(worlds, self.length, 1)
        actions[:, :, 0] = torch.from_numpy(self.env.tick)[:, None] / 1e3 + torch.arange(self.length) / 1e5
        return Chunk(actions, phases=[f"query {tick}" for tick in self.env.tick])


def test_a_policy_reads_the_world_and_writes_nothing(env):
    """The view that `attach` gives shows positions of this tick; writing is an error, or moves nothing."""
    seen = []

    class Meddling(Sway):
        def attach(self, env):
            self.env, self.qpos = env, wp.to_torch(env.physics.qpos)

        def act(self, observation):
            seen.append(bool((self.qpos == there).all()))
            self.qpos += 1.0
            self.env.tick[:] = -100
            for write in (
                lambda: setattr(self.env, "budget", 1),
                lambda: self.env.physics.add_velocity,
                lambda: self.env.physics.data,
                lambda: self.env.step,
                lambda: self.env.scene.model,
                lambda: setattr(self.env.scene.mj_model.opt, "timestep", 1.0),
            ):
                with pytest.raises(InputError, match="a policy"):
                    write()
            self.env.scene.mj_model.geom_pos[:] = 0.0
            return super().act(observation)

    there = wp.to_torch(env.physics.qpos)
    first = Rollout(env, Sway(), _episodes(2), max_steps=12).run()
    second = Rollout(env, Meddling(), _episodes(2), max_steps=12).run()
    assert [(r.steps, r.margin) for r in first] == [(r.steps, r.margin) for r in second] and all(seen)


class Seeing(trackers.base.Tracker):
    """The PD tracker with all that a tracker may declare; keeps what it is given."""

    name, drive = "seeing", trackers.get("pd").drive
    needs, lookahead = NEEDS, 4

    def bind(self, worlds, device="cpu"):
        super().bind(worlds, device)
        self.seen = []

    def step(self, command, state, mask=None):
        self.seen.append([{name: tensor.clone() for name, tensor in one.tensors().items()} for one in (command, state)])
        return command.joints


@pytest.fixture(scope="module")
def seeing(env):
    """An environment after 20 ticks of chunks of six actions under `Seeing`, which changes nothing of PD's results."""
    own = ArenaEnv("football", tracker=Seeing(), worlds=2, engine="mujoco", device="cpu", fast_physics=True)
    expected, results = (Rollout(one, Dated(), _episodes(2), max_steps=20).run() for one in (env, own))
    assert [(r.steps, r.margin) for r in results] == [(r.steps, r.margin) for r in expected]
    return own


def test_a_window_holds_the_references_that_come(seeing):
    """Bit for bit those of the next ticks; from a chunk's end on its last is repeated, and during the start-up."""
    commands = [command for command, _ in seeing.tracker.seen]
    names = [name.removeprefix("ahead.") for name in commands[0] if name.startswith("ahead.")]
    assert names == ["mimic", "joints", "joint_vel", "quat", "position"]
    start = seeing.startup_ticks
    for tick in range(start + 18):
        last = tick if tick < start else start + (tick - start) // 6 * 6 + 5
        for k, name in itertools.product(range(4), names):
            coming = commands[min(tick + 1 + k, last)][name]
            assert torch.equal(commands[tick][f"ahead.{name}"][:, k], coming), (tick, k, name)


def test_an_action_that_cannot_be_executed_ends_the_window(seeing):
    """From the first such action of a row on the reference before it is repeated, whatever follows."""
    env, coming = seeing, torch.from_numpy(STAND_ACTION).repeat(2, 4, 1)
    coming[:, :, 0] = 0.01
    coming[1, 2, 5] = torch.nan
    env.reset([1, 2])
    env.loop.announce(coming)
    env.loop.tick(coming[:, 0].contiguous(), np.ones(2, dtype=bool))
    travelled = (env.loop.command.ahead.position - env.loop.command.position[:, None]).norm(dim=2)
    assert torch.allclose(travelled / 0.01, torch.tensor([[1.0, 2, 3, 4], [1, 2, 2, 2]]), atol=1e-3)


def test_needs_are_measured(seeing):
    """Position and velocity are the root's; the feet of a robot that stands carry its weight, half each or so."""
    commands, states = zip(*seeing.tracker.seen, strict=True)
    model, root = seeing.scene.mj_model, seeing.scene.robot.root_body
    travelled = 0.02 * torch.stack([state["lin_vel"] for state in states[1:41]]).sum(0)
    assert torch.allclose(states[40]["position"] - states[0]["position"], travelled, atol=3e-3)
    weight = 9.81 * model.body_subtreemass[root]
    carried = torch.stack([state["foot_force"] for state in states[30:50]]).mean(0) / weight
    assert torch.allclose(carried.sum(1), torch.ones(2), atol=0.1) and (carried > 0.3).all()
    assert torch.allclose(commands[49]["position"][:, :2], states[0]["position"][:, :2], atol=1e-6)


def test_an_unknown_need_is_refused(env):
    """A field that no state has is one error with the names of those that there are."""
    tracker = trackers.get("pd")
    tracker.needs = ("altitude",)
    with pytest.raises(InputError, match="tracker pd: needs 'altitude'; known are position, lin_vel, foot_force"):
        TrackerLoop(env.physics, env.scene.robot, tracker)


class Executed(Recorder):
    """Keeps the forward steps that each world executed."""

    def start(self, env, world, episode):
        self.steps = getattr(self, "steps", {}) | {world: []}

    def before_physics(self, env, observation, action):
        for world in np.flatnonzero(env.active & (env.tick >= 0)):
            self.steps[world].append(round(float(action[world, 0]) * 1e5))


@pytest.mark.parametrize("latency", [0, 1, 4, 5])
def test_a_chunk_begins_so_many_ticks_after_its_query(env, latency):
    """The robot stands first; then chunk follows chunk, whole, each looked at `latency` ticks before it begins."""
    policy, seen = Dated(), Executed()
    results = Rollout(env, policy, _episodes(2), recorder=seen, max_steps=20, latency=latency).run()
    chunks = [100 * query + action for query in (0, 6, 12, 18) for action in range(6)]
    assert [r.steps for r in results] == [20, 20]
    assert seen.steps[0] == seen.steps[1] == ([0] * latency + chunks)[:20]
    assert [ticks[0] for ticks, _ in policy.queries] == [0, 6, 12, 18]
    begun = [(f"query {query}", query + latency) for query in (0, 6, 12, 18) if query + latency < 20]
    assert list(results[0].phases) == begun


def test_latency_does_not_mix_worlds():
    """Episodes that begin at other ticks of the batch execute the same delayed chunks as alone, bit for bit."""

    class Late(Sway):
        name = "late"

    def run(worlds, episodes):
        env = ArenaEnv(
            "football", tracker=trackers.get("pd"), worlds=worlds, engine="mujoco", device="cpu", fast_physics=True
        )
        return {
            r.episode.index: (r.steps, r.margin) for r in Rollout(env, Late(), episodes, max_steps=17, latency=3).run()
        }

    assert run(1, _episodes(3)) == run(2, _episodes(3)[::-1])


def test_a_chunk_no_longer_than_the_latency_is_refused(env):
    """A chunk that would be over before it begins is one error that names flag, policy and length."""
    with pytest.raises(InputError, match="--latency-ticks 6: policy dated gives chunks of 6 actions"):
        Rollout(env, Dated(), _episodes(1), max_steps=8, latency=6).run()


class Pieces(Dated):
    """The same chunks from two ticks: all actions but the last at once, the last one singly."""

    name, chunk_size, in_pieces = "pieces", 6, True

    def __init__(self):
        super().__init__()
        self.memory, self.seen = None, []

    def reset(self, seeds, tasks, mask=None):
        self.memory = self.memory or ChunkMemory(
            len(seeds), torch.device("cpu"), observations=2, predicted=6, executed=6, ensemble=False
        )
        for world in np.flatnonzero(mask).tolist():
            self.memory.reset(world)

    def act(self, observation):
        whole, asking = super().act(observation), np.flatnonzero(observation.mask).tolist()
        for world in asking:
            self.memory.glimpse(world, {"tick": torch.tensor(int(self.env.tick[world]))})
        querying = [world for world in asking if not self.memory.waits(world)]
        if querying:
            self.memory.answer(querying, whole.actions[querying])
            if 0 in querying:
                self.seen.append(tuple(int(one["tick"]) for one in self.memory.queried(0)))
        given = self.memory.give(asking)
        actions = torch.zeros(len(observation.state), given.shape[1], 40, dtype=given.dtype)
        actions[asking] = given
        return Chunk(actions)


@pytest.mark.parametrize("latency", [0, 1, 4, 5])
def test_a_late_policy_of_two_ticks_sees_the_tick_before_its_query(env, latency):
    """Its chunks begin `latency` ticks after a look at that tick and the one before, as a policy's of one tick do."""
    policy, executed = Pieces(), Executed()
    Rollout(env, policy, _episodes(2), recorder=executed, max_steps=20, latency=latency).run()
    chunks = [100 * query + action for query in (0, 6, 12, 18) for action in range(6)]
    assert executed.steps[0] == executed.steps[1] == ([0] * latency + chunks)[:20]
    assert policy.seen == [(0, 0), (5, 6), (11, 12), (17, 18)]


def test_a_late_policy_in_pieces_decides_once_at_a_time(env):
    """Its whole chunk, not a piece of it, must be longer than the latency."""
    with pytest.raises(InputError, match="--latency-ticks 6: policy pieces gives chunks of 6 actions"):
        Rollout(env, Pieces(), _episodes(1), max_steps=8, latency=6).run()
