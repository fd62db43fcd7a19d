"""Episodes: results do not depend on the batch, errors stay in their world, start-up falls are told apart."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arena_newton import trackers
from arena_newton.env import STAND_ACTION, ArenaEnv
from arena_newton.errors import InputError
from arena_newton.interfaces import Chunk
from arena_newton.kernels import tick as codes
from arena_newton.policies.base import Policy
from arena_newton.robot import CANONICAL_TO_MUJOCO, DEFAULT_POSE, SONIC_DRIVE, TWIST2_HUMANOIDARENA_DRIVE
from arena_newton.rollout import Rollout

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
    """A world whose state becomes NaN ends as error, the other goes on."""
    done = []

    def poison(_):
        if env.tick[0] == 2 and not done:
            done.append(1)
            env.physics._data[0].qpos[:] = np.nan

    first, second = Rollout(env, Sway(), _episodes(2), on_tick=poison, max_steps=8).run()
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
    (result,) = Rollout(env, Sway(), _episodes(1), max_steps=8).run()
    assert result.outcome == "fall" and result.startup_fall and result.steps == 0


def test_settle_ticks_precede_step_zero(env):
    """Reset starts a world at minus the start-up length; the policy is first asked at tick 0."""
    env.reset([1, 2])
    assert (env.tick == -env.startup_ticks).all()


class Broken(trackers.base.Tracker):
    """Answers the reference, spoiled by `spoil`."""

    name = "broken"

    def __init__(self, spoil):
        self.spoil = spoil

    def step(self, command, state):
        return self.spoil(command.joints.clone())


def _broken(env, spoil):
    """The environment of this module with another tracker."""
    tracker = Broken(spoil)
    tracker.bind(env.worlds)
    return tracker


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_nonfinite_targets_are_the_trackers_error(env, monkeypatch, value):
    """A joint target that is not finite ends that world as error under the tracker's name; the other runs on."""

    def spoil(targets):
        if env.tick[0] == 3:
            targets[0, 7] = value
        return targets

    monkeypatch.setattr(env, "tracker", _broken(env, spoil))
    first, second = Rollout(env, Sway(), _episodes(2), max_steps=8).run()
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
def test_targets_of_another_kind_are_refused(env, monkeypatch, spoil, said):
    """An answer of another shape or type stops the run with one line that names the tracker."""
    monkeypatch.setattr(env, "tracker", _broken(env, spoil))
    with pytest.raises(InputError, match=f"tracker broken: joint targets are .*{said}"):
        Rollout(env, Sway(), _episodes(2), max_steps=8).run()


def test_startup_gives_no_success(env, monkeypatch):
    """While the robot takes its stance neither success nor an event is reported; falls and errors are."""

    def evaluate(physics):
        env.judge.success.fill_(1)

    monkeypatch.setattr(env.judge, "evaluate", evaluate)
    env.reset([1, 2])
    seen = [env.step(np.tile(STAND_ACTION, (2, 1))) for _ in range(env.startup_ticks + 1)]
    assert all((status == codes.RUNNING).all() for status in seen[:-1])
    assert (seen[-1] == codes.SUCCESS).all()


def test_statuses_are_kept(env):
    """What a step returned does not change with the next step."""
    env.reset([1, 2])
    action = torch.from_numpy(STAND_ACTION).repeat(2, 1)
    for _ in range(env.startup_ticks):
        env.step(action)
    action[0, 20] = float("nan")
    first = env.step(action)
    kept = first.copy()
    env.step(torch.from_numpy(STAND_ACTION).repeat(2, 1))
    assert (first == kept).all() and first.tolist() == [codes.ERROR_ACTION, codes.RUNNING]


def test_observe_lays_the_frame_down(env):
    """At step 0 the state's heading is zero, whoever asks first, and stays relative to that moment."""
    env.reset([1, 2])
    for _ in range(env.startup_ticks):
        env.step(np.tile(STAND_ACTION, (2, 1)))
    turned = env.physics._data[1]
    turned.qpos[env.scene.robot.root_qpos + 3 :][:4] = [np.cos(0.4), 0, 0, np.sin(0.4)]
    env.physics._publish(1, turned)
    state = env.observe().state
    heading = torch.atan2(state[:, 2], state[:, 0])
    assert heading.abs().max() < 1e-5
    assert env.reference.heading.numpy()[1] == pytest.approx(0.8, abs=1e-5)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda env: env.reset([1], [7]), r"worlds \[7\]"),
        (lambda env: env.reset([1, 2], [0, 0]), r"worlds \[0, 0\]"),
        (lambda env: env.reset([1]), "1 seeds for 2 worlds"),
        (lambda env: env.step(torch.zeros(40)), r"shape \[40\], expected \[2, 40\]"),
    ],
)
def test_wrong_calls_are_named(env, call, said):
    """Worlds outside the batch and actions of another shape are refused in one line."""
    env.reset([1, 2])
    with pytest.raises(InputError, match=said):
        call(env)


def test_step_before_reset_is_refused():
    """An environment in which nothing runs does not step."""
    fresh = ArenaEnv("football", tracker=trackers.get("pd"), worlds=1, engine="mujoco")
    with pytest.raises(InputError, match=r"reset\(\) first"):
        fresh.step(np.tile(STAND_ACTION, (1, 1)))
    fresh.close()


def test_spawn_replaces_the_tasks_pose(env):
    """A reset may put the robot elsewhere, by its episode seed."""
    env.reset([3, 4], spawn=lambda seed: ((0.1 * seed, -5.0, 0.9), (1.0, 0.0, 0.0, 0.0)))
    root = env.physics.qpos.numpy()[:, env.scene.robot.root_qpos :][:, :7]
    assert np.allclose(root[:, :3], [[0.3, -5.0, 0.9], [0.4, -5.0, 0.9]]) and (root[:, 3] == 1.0).all()


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


@pytest.mark.parametrize("interface", ["twist2", "sonic"])
def test_history_starts_as_the_rule_set_says(interface):
    """`released` leaves the tracker's history as the original resets it, `paper` fills it with the first frame."""
    history = {}
    for rules in ("paper", "released"):
        tracker = trackers.get(interface)
        env = ArenaEnv("football", tracker=tracker, worlds=1, engine="mujoco", rules=rules)
        env.reset([1])
        env.step(np.tile(STAND_ACTION, (1, 1)))
        history[rules] = tracker.observation()[0].clone()
    if interface == "twist2":
        past = {name: row[127 : 127 + 9 * 127] for name, row in history.items()}  # the tenth holds the step itself
        assert past["paper"].abs().sum() > 1.0 and not past["released"].any()
    else:
        assert not torch.equal(history["paper"], history["released"])


def test_what_ran_is_described(env):
    """Engine, physics rate, drive and start-up are those that run."""
    said = env.describe()
    assert (said["engine"], said["physics_dt"], said["substeps"]) == ("mujoco", 0.005, 4)
    assert said["physics_dt"] == env.physics.mj_model.opt.timestep
    assert (said["drive"], said["startup_ticks"], said["history"]) == ("pd", 50, "first frame")
    assert said["tracker"]["name"] == "pd"


def test_a_drive_can_be_chosen():
    """A drive given by hand reaches the actuators; `released` takes the original's for a checkpoint that has one."""
    tracker = trackers.get("pd")
    tracker.original_drive = TWIST2_HUMANOIDARENA_DRIVE
    for options, name in (
        ({"drive": SONIC_DRIVE}, "sonic"),
        ({"rules": "released"}, "twist2-humanoidarena"),
        ({}, "pd"),
    ):
        env = ArenaEnv("football", tracker=tracker, worlds=1, engine="mujoco", **options)
        assert env.describe()["drive"] == env.drive.name == name
        gains = env.physics.mj_model.actuator_gainprm[env.scene.robot.joint_ctrl, 0]
        assert np.allclose(gains, env.drive.kp)


def test_a_fall_counts_in_the_startup_whatever_the_predicate_says(env, monkeypatch):
    """A robot that lies on the ground before step 0 has fallen, also where the success predicate holds."""

    def evaluate(physics):
        env.judge.success.fill_(1)

    lying = lambda seed: ((0.0, -8.0, 0.15), (0.7071068, 0.7071068, 0.0, 0.0))  # noqa: E731
    monkeypatch.setattr(env.judge, "evaluate", evaluate)
    env.reset([1, 2], spawn=lying)
    for _ in range(6):
        status = env.step(np.tile(STAND_ACTION, (2, 1)))
    assert status.tolist() == [codes.FALL, codes.FALL]


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
