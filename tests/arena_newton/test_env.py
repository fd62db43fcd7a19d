"""The batch of worlds: resets, observations, steps, verdicts; what happens to one world changes no bit of another."""

import dataclasses

import numpy as np
import pytest
import torch

from arena_newton import trackers
from arena_newton.env import STAND_ACTION, ArenaEnv
from arena_newton.errors import InputError
from arena_newton.interfaces import EpisodeEvent
from arena_newton.kernels import tick as codes
from arena_newton.robot.g1 import SONIC_DRIVE, TWIST2_HUMANOIDARENA_DRIVE
from arena_newton.tasks.football import FootballJudge


@pytest.fixture(scope="module")
def env():
    """Two worlds of football under the PD tracker."""
    return ArenaEnv("football", tracker=trackers.get("pd"), worlds=2, engine="mujoco", device="cpu", fast_physics=True)


@pytest.fixture
def won(monkeypatch):
    """Two worlds of football whose success predicate always holds."""
    monkeypatch.setattr(FootballJudge, "evaluate", lambda self, physics: self.success.fill_(1))
    return ArenaEnv("football", tracker=trackers.get("pd"), worlds=2, engine="mujoco", device="cpu", fast_physics=True)


def test_settle_ticks_precede_step_zero(env):
    """Reset starts a world at minus the start-up length; the policy is first asked at tick 0."""
    env.reset([1, 2])
    assert (env.tick == -env.startup_ticks).all()


def test_a_tracker_is_no_name():
    """A name instead of a tracker is refused before a scene is built, with what makes one of it."""
    with pytest.raises(InputError, match=r"tracker 'twist2': is a name, expected what arena_newton.trackers.get"):
        ArenaEnv("boxing", tracker="twist2")


def test_startup_gives_no_success(won):
    """While the robot takes its stance neither success nor an event is reported; falls and errors are."""
    won.reset([1, 2])
    seen = [won.step(np.tile(STAND_ACTION, (2, 1))) for _ in range(won.startup_ticks + 1)]
    assert all((status == codes.RUNNING).all() for status in seen[:-1])
    assert (seen[-1] == codes.SUCCESS).all()


def test_statuses_are_kept(env):
    """Statuses that a step returned do not change with the next step."""
    env.reset([1, 2])
    action = torch.from_numpy(STAND_ACTION).repeat(2, 1)
    for _ in range(env.startup_ticks):
        env.step(action)
    action[0, 20] = float("nan")
    first = env.step(action)
    kept = first.copy()
    env.step(torch.from_numpy(STAND_ACTION).repeat(2, 1))
    assert (first == kept).all() and first.tolist() == [codes.ERROR_ACTION, codes.RUNNING]


def test_observe_anchors(env):
    """At step 0 the state's heading is zero, whoever asks first, and stays relative to that moment."""
    turned = (env.spec.spawn_position, (np.cos(0.4), 0.0, 0.0, np.sin(0.4)))
    env.reset([1, 2], spawn=lambda seed: turned if seed == 2 else (env.spec.spawn_position, env.spec.spawn_quat))
    for _ in range(env.startup_ticks):
        env.step(np.tile(STAND_ACTION, (2, 1)))
    w, x, y, z = env.physics.qpos.numpy()[1, env.scene.robot.root_qpos + 3 :][:4]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    state = env.observe().state
    heading = torch.atan2(state[:, 2], state[:, 0])
    assert heading.abs().max() < 1e-5
    assert env.loop.reference.heading.numpy()[1] == pytest.approx(yaw, abs=1e-5) and yaw != pytest.approx(0.8, abs=1e-6)


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


def test_a_held_out_mode_and_a_variant_exclude_each_other():
    """Both replace the scene, so an environment takes one of them."""
    with pytest.raises(InputError, match="--variant my.usda: --mode semantic-2 has a scene of its own"):
        ArenaEnv("boxing", tracker=trackers.get("pd"), mode="semantic-2", variant_file="my.usda")


def test_step_before_reset_is_refused():
    """An environment in which nothing runs does not step."""
    idle = ArenaEnv("football", tracker=trackers.get("pd"), worlds=1, engine="mujoco")
    with pytest.raises(InputError, match=r"reset\(\) first"):
        idle.step(np.tile(STAND_ACTION, (1, 1)))
    idle.close()


def test_spawn_replaces_the_tasks_pose(env):
    """A reset may put the robot elsewhere, by its episode seed."""
    env.reset([3, 4], spawn=lambda seed: ((0.1 * seed, -5.0, 0.9), (1.0, 0.0, 0.0, 0.0)))
    root = env.physics.qpos.numpy()[:, env.scene.robot.root_qpos :][:, :7]
    assert np.allclose(root[:, :3], [[0.3, -5.0, 0.9], [0.4, -5.0, 0.9]]) and (root[:, 3] == 1.0).all()


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


def test_hands_can_be_chosen(env):
    """Fixed hands have no joints and no actuators, and are named in results; the usual ones are not."""
    fixed = ArenaEnv("football", tracker=trackers.get("pd"), worlds=1, engine="mujoco", device="cpu", hands="fixed")
    fixed.reset([1])
    assert fixed.step(np.tile(STAND_ACTION, (1, 1))).tolist() == [codes.RUNNING]
    assert fixed.describe()["hands"] == "fixed" and "hands" not in env.describe()
    assert env.physics.mj_model.nu - fixed.physics.mj_model.nu == 14
    with pytest.raises(InputError, match=r"prim /World/Robot has no hands 'claws', known are dex3 fixed"):
        ArenaEnv("football", tracker=trackers.get("pd"), worlds=1, engine="mujoco", device="cpu", hands="claws")


def test_a_tracker_belongs_to_one_environment():
    """One object in a second environment is refused in the first, where its past would be that of other worlds."""
    tracker, options = trackers.get("pd"), {"engine": "mujoco", "device": "cpu", "fast_physics": True}
    first, second = (ArenaEnv("football", tracker=tracker, worlds=worlds, **options) for worlds in (2, 1))
    second.reset([1])
    second.step(np.tile(STAND_ACTION, (1, 1)))
    with pytest.raises(InputError, match="tracker pd: another environment has bound this object since; make a tracker"):
        first.reset([1, 2])


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
        assert "armature" not in env.describe()["gains"]


def test_a_drive_declares_the_rotor_inertia_that_its_gains_are_made_for():
    """Declared rotor inertia is that of the body joints, and is described; fingers and root keep theirs."""
    declared = tuple(0.01 + 0.001 * joint for joint in range(29))
    tracker = trackers.get("pd")
    plain = ArenaEnv("football", tracker=tracker, worlds=1, engine="mujoco")
    drive = dataclasses.replace(tracker.drive, armature=declared)
    env = ArenaEnv("football", tracker=tracker, worlds=1, engine="mujoco", drive=drive)
    found, body = env.physics.mj_model.dof_armature, env.scene.robot.joint_qvel
    assert np.allclose(found[body], declared) and env.describe()["gains"]["armature"] == declared
    others = np.setdiff1d(np.arange(len(found)), body)
    assert np.array_equal(found[others], plain.physics.mj_model.dof_armature[others])


def test_a_fall_counts_in_the_startup_whatever_the_predicate_says(won):
    """A robot that lies on the ground before step 0 has fallen, also where the success predicate holds."""
    lying = lambda seed: ((0.0, -8.0, 0.15), (0.7071068, 0.7071068, 0.0, 0.0))  # noqa: E731
    won.reset([1, 2], spawn=lying)
    for _ in range(6):
        status = won.step(np.tile(STAND_ACTION, (2, 1)))
    assert status.tolist() == [codes.FALL, codes.FALL]
    assert won.verdict(1).events == (EpisodeEvent("fall", 1 - won.startup_ticks, "tilt"),)


def _play(env, visit):
    """States and verdicts of worlds 0 and 2 over eight ticks; with `visit` world 1 is reset twice and led on alone.

    The first visit happens while the others stand still between two ticks, the second while they run.
    """
    others, seen = [0, 2], []
    env.reset([5, 6, 7])
    action = torch.from_numpy(STAND_ACTION).repeat(3, 1)
    for tick in range(8):
        action[:, 9:38] += 0.02 * np.sin(np.arange(29) + tick)
        if visit and tick == 3:
            env.reset([9], [1])
            for _ in range(4):
                env.step(action, np.array([False, True, False]))
        if visit and tick == 6:
            env.reset([11], [1])
        status = env.step(action)
        arrays = (env.physics.qpos, env.physics.qvel, env.physics.ctrl, env.physics.xpos, env.loop.reference.mimic)
        bits = b"".join(np.ascontiguousarray(a.numpy()[others]).tobytes() for a in arrays)
        seen.append((bits, status[others].tolist(), [env.verdict(world) for world in others]))
    return seen


@pytest.mark.parametrize(
    ("engine", "tracker"), [("mujoco", "twist2"), ("mujoco", "sonic"), ("mujoco", "pd"), ("warp", "twist2")]
)
def test_resetting_and_settling_a_world_changes_no_bit_of_another(engine, tracker):
    """One world is reset and led through its start-up while the others run or wait: they keep every bit."""
    env = ArenaEnv("football", tracker=trackers.get(tracker), worlds=3, engine=engine, device="cpu", fast_physics=True)
    assert _play(env, visit=True) == _play(env, visit=False)
    env.close()


def test_counters_of_waiting_worlds_stand_still(env):
    """Ticks, streaks and verdicts of a world that does not step stay as they are."""
    lying = lambda seed: ((0.0, -8.0, 0.25), (0.8, 0.6, 0.0, 0.0))  # noqa: E731
    action, first = np.tile(STAND_ACTION, (2, 1)), np.array([True, False])
    env.reset([1, 2], spawn=lying)
    env.step(action)
    before, tick = env.verdict(1), env.tick[1]
    for _ in range(8):
        assert env.step(action, first)[1] == codes.RUNNING
    assert (env.verdict(1), env.tick[1]) == (before, tick) and env.tick[0] == tick + 8


def test_released_worlds_stand_still(env):
    """A released world takes part in no step; when none is left, a step is refused."""
    env.reset([1, 2])
    env.release([0])
    still = env.physics.qpos.numpy()[0].copy()
    env.step(np.tile(STAND_ACTION, (2, 1)))
    assert np.array_equal(env.physics.qpos.numpy()[0], still) and env.tick.tolist() == [-50, -49]
    env.release([1])
    with pytest.raises(InputError, match="no world runs an episode"):
        env.step(np.tile(STAND_ACTION, (2, 1)))
