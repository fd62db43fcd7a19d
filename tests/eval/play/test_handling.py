"""Failures of tasks that are done with the hands: what saboteurs do there, and how a carried object counts as moved."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arena_newton import tasks, trackers
from arena_newton.env import ArenaEnv
from arena_newton.eval.certification.stand_ins.handling import HANDLING
from arena_newton.eval.certification.stand_ins.sabotage import (
    BENT,
    GROWS,
    KNEES,
    LEAN,
    SABOTAGES,
    ClumsyExpert,
    MisledSight,
    RelocatingEnv,
    StubbornExpert,
    UnbalancedExpert,
    WeakTracker,
)
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.signal_recorder import SignalRecorder
from arena_newton.policies.experts import Sight
from arena_newton.policies.experts.style import Style
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.rotations import matrix_from_quat, quat_from_rot6d
from arena_newton.rules import seeding
from arena_newton.trackers.motions.commands import MotionCommand

WORLDS = 2


@pytest.fixture(scope="module")
def envs():
    """Two worlds of each task in which objects are moved, with short start-ups, made when they are asked for."""
    made = {}

    def env(task):
        if task not in made:
            tracker = trackers.get("twist2")
            made[task] = RelocatingEnv(task, tracker=tracker, worlds=WORLDS, engine="mujoco", threads=1)
            made[task].startup_ticks = 5
        made[task].reset([seeding.episode_seed(tasks.get(task).gym_id, 0, repeat) for repeat in range(WORLDS)])
        return made[task]

    yield env
    for one in made.values():
        one.close()


def standing(env):
    """Actions of robots that stand."""
    action = np.zeros((WORLDS, 40), np.float32)
    action[:, 2], action[:, 3], action[:, 6] = 0.8, 1.0, 1.0
    return action


def acting(env):
    """The worlds past their start-up."""
    while env.tick.min() < 1:
        env.step(standing(env))


@pytest.fixture
def style():
    """Draws of eight episodes."""
    style = Style(8)
    style.begin(np.ones(8, dtype=bool), range(8))
    return style


@pytest.mark.parametrize("task", HANDLING)
def test_blind_robots_believe_the_object_where_the_table_says(task, style):
    """They are far off, in the table's directions."""
    handling = HANDLING[task]
    far = handling.elsewhere(style, (2.4, 3.2))
    assert (far.norm(dim=1) > tasks.get(task).interaction.near).all() and not far[:, 2].any()
    turn = torch.atan2(far[:, 1], far[:, 0]).remainder(2 * math.pi)
    least, most = (math.radians(angle) for angle in handling.blind)
    assert ((turn > least - 1e-4) & (turn < most + 1e-4)).all()


def test_hands_let_go_after_a_touch(style):
    """Long after the touch fingers are open and palms apart; before, and where the table has no such time, nothing."""
    handling = HANDLING["pp_box"]
    command = dataclasses.replace(MotionCommand.neutral(8), hands=torch.ones(8, 2))
    late = torch.full((8,), handling.opens[1] + 1.0)
    for after, opened in ((torch.full((8,), handling.opens[0] - 1.0), False), (late, True)):
        found = handling.let_go(command, style, after)
        width = (found.hand_point - command.hand_point)[:, 0, 1] - (found.hand_point - command.hand_point)[:, 1, 1]
        assert bool((found.hands == 0).all()) is opened
        assert width.numpy() == pytest.approx(np.full(8, opened * 2 * handling.apart))
    never = dataclasses.replace(handling, opens=None)
    assert never.let_go(command, style, late) is command


@pytest.mark.parametrize("task", ["open_door", "pp_box"])
def test_the_whole_object_is_moved_at_its_touch(task, envs):
    """A box on the table is put elsewhere, a door with leaf, lever and frame; once, and it is back after a reset."""
    env = envs(task)
    acting(env)
    before, spec = env.view.centre.clone(), env.view.spec
    for touch, way in ((-1.0, 0.0), (9.0, -1.5)):
        env.view.spec = dataclasses.replace(spec, touch=touch)
        for _ in range(3):
            env.step(standing(env))
        assert (env.view.centre - before)[:, 0].numpy() == pytest.approx([way, way], abs=0.02)
        assert env.relocated[:, 0].tolist() == [way, way]
    env.view.spec = spec
    env.reset([seeding.episode_seed(tasks.get(task).gym_id, 0, repeat) for repeat in range(WORLDS)])
    assert not env.relocated.any() and (env.view.centre - before).norm() < 0.05


def test_a_stubborn_robot_believes_a_box_where_it_was(envs):
    """It knows neither that the box was moved nor that it fell from there."""
    env = envs("pp_box")
    acting(env)
    policy = StubbornExpert()
    policy.attach(env)
    policy.reset([1, 2], ["pp_box"] * WORLDS)
    read = policy.sight.frame(tasks.get("pp_box").interaction.box)
    policy.act(env.observe())
    before = read().clone()
    env._relocate(0)
    for _ in range(30):
        env.step(standing(env))
    policy.act(env.observe())
    assert (env.view.centre - before)[0].norm() > 1.0
    assert (read() - before).norm(dim=1).numpy() == pytest.approx([0.0, 0.0], abs=0.02)


def test_everything_of_a_door_is_believed_elsewhere(envs):
    """Frame, leaf and lever are displaced together; a hammer's centre of mass goes with the hammer."""
    env = envs("open_door")
    sight, true = MisledSight(env), Sight(env)
    sight.object_off += torch.tensor([1.0, 0.0, 0.0])
    for prim in ("/World/Door/Frame", "/World/Door/Leaf", "/World/Door/Handle"):
        body = env.scene.body_id(prim)
        assert (sight.body(body)[0] - true.body(body)[0])[:, 0].numpy() == pytest.approx([1.0, 1.0])
    root = env.scene.link("pelvis")
    assert torch.equal(sight.body(root)[0], true.body(root)[0])
    desk = envs("double_desk")
    sight, true = MisledSight(desk), Sight(desk)
    sight.object_off += torch.tensor([0.0, 0.0, 0.5])
    hammer = tasks.get("double_desk").interaction.box
    assert (sight.com(hammer)() - true.com(hammer)())[:, 2].numpy() == pytest.approx([0.5, 0.5])


def test_a_carried_object_has_moved_from_where_hands_left_it(envs):
    """In the hands it does not move, nor by falling; away from them it does."""
    env = envs("pp_box")
    acting(env)
    recorder = SignalRecorder(env)
    recorder.start(env, 0, SimpleNamespace(index=0))
    body, spec = env.scene.joint_qpos(env.spec.interaction.box), recorder.spec

    def moved(touch, way):
        view = recorder._view
        recorder.spec = view.spec = dataclasses.replace(spec, touch=touch)
        for world in range(WORLDS):
            env.physics.data[world].qpos[body : body + 3] += way
        env.step(standing(env))
        recorder.tick(env)
        return float(recorder._now["moved"][0])

    recorder.spec = dataclasses.replace(spec, touch=9.0)
    assert moved(9.0, (0.0, 0.0, 0.0)) == pytest.approx(0.0, abs=0.02)
    assert moved(9.0, (0.4, 0.0, 0.2)) == pytest.approx(0.0, abs=0.02)
    assert moved(0.0, (0.0, 0.0, -0.3)) == pytest.approx(0.0, abs=0.02)
    assert moved(0.0, (0.0, 0.5, 0.0)) == pytest.approx(0.5, abs=0.03)


def test_a_reluctant_robot_stands_before_a_door(envs):
    """It stands still from the distance of the table on, and its arms hang all the time."""
    env = envs("open_door")
    acting(env)
    policy = SABOTAGES["reluctant"].body.equip(Factories()).policy("expert")
    policy.attach(env)
    policy.reset([1, 2], ["open_door"] * WORLDS)
    command, still = MotionCommand.neutral(WORLDS), MotionCommand.neutral(WORLDS)
    walking = dataclasses.replace(command, velocity=torch.ones(WORLDS, 3), reach=torch.ones(WORLDS, 2))
    policy.sight.view.spec = dataclasses.replace(policy.sight.view.spec, bearing=9.0)
    far = policy.overrule(walking)
    assert torch.equal(far.reach, still.reach) and far.velocity.any() and not policy.halted.any()
    policy.handling = dataclasses.replace(policy.handling, halts=9.0)
    near = policy.overrule(walking)
    assert policy.halted.all() and not near.velocity.any() and not near.reach.any()


def test_an_unbalanced_robot_leans_back_on_one_foot(envs):
    """It leans backwards and bends the knee of one side more and more; once it touched the object, neither."""
    policy = UnbalancedExpert()
    policy.attach(envs("pp_box"))
    policy.reset(range(WORLDS), ["pp_box"] * WORLDS)
    standing = torch.from_numpy(STAND_ACTION).repeat(WORLDS, 1, 1)
    assert torch.allclose(torch.as_tensor(policy.spoil(standing)), standing, atol=1e-6)
    policy.since[:] = GROWS
    spoilt = torch.as_tensor(policy.spoil(standing))
    tilt = matrix_from_quat(quat_from_rot6d(spoilt[:, 0, ACTION["root_rot6d"]]))[:, :, 2]
    assert (tilt[:, 2] < math.cos(LEAN - math.radians(10))).all() and (tilt[:, 0] < 0).all()
    knees = spoilt[:, 0, list(KNEES)]
    assert torch.allclose(knees.max(dim=1).values, torch.full((WORLDS,), BENT))
    assert torch.equal(knees.min(dim=1).values, standing[:, 0, KNEES[0]])
    policy.touched[0] = True
    assert torch.allclose(torch.as_tensor(policy.spoil(standing))[0], standing[0], atol=1e-6)


def test_legs_are_weakened_as_the_task_says():
    """Each task of the table has its part; the others keep the common one."""
    built = {}

    def env(task, *, tracker, **options):
        built[task] = tracker.part
        return SimpleNamespace()

    weak = SABOTAGES["weakened"].body.equip(Factories(env=env))
    for task in (*HANDLING, "boxing"):
        weak.env(task, tracker=weak.tracker("twist2", None), worlds=1)
    assert built == {task: handling.weak for task, handling in HANDLING.items()} | {"boxing": 0.5}
    assert isinstance(weak.tracker("twist2", None), WeakTracker)


def test_clumsy_hands_are_off_only_with_the_hands():
    """Tasks outside the table keep their own clumsiness."""
    env = ArenaEnv("boxing", tracker=trackers.get("twist2"), worlds=WORLDS, engine="mujoco", threads=1)
    policy = ClumsyExpert()
    policy.attach(env)
    policy.reset([1, 2], ["boxing"] * WORLDS)
    policy.mislead()
    assert policy.handling is None and (policy.sight.object_off[:, 2].abs() > 0.17).all()
    env.close()
