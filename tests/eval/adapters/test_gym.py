"""Gymnasium: its spaces and flags, the same episodes as a rollout, worlds that do not touch each other."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from watched import WatchedEnv, watched_rollout

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.eval.adapters import gym
from arena_newton.eval.adapters.gym import ArenaVectorEnv
from arena_newton.eval.plan import episode_plan
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies import get
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.rules import seeding

BLIND = {"engine": "mujoco", "device": "cpu", "image_size": None}
"""Worlds on the CPU without pictures."""
WILD = np.random.default_rng(0).normal(size=(400, 40)).astype(np.float32)
"""Actions under which every robot falls soon."""


@pytest.fixture(autouse=True)
def watched(monkeypatch, watched_worlds):
    """Every environment of these tests keeps the hashes of its ticks, and is built once."""
    monkeypatch.setattr(gym, "ArenaEnv", watched_worlds)
    WatchedEnv.history.clear()


@pytest.fixture
def brief(monkeypatch, watched_worlds):
    """Start-ups of two ticks."""

    def build(task, **options):
        env = watched_worlds(task, **options)
        monkeypatch.setattr(env, "startup_ticks", 2)
        return env

    monkeypatch.setattr(gym, "ArenaEnv", build)


@pytest.fixture
def make():
    """Maker of environments that are closed in the end."""
    made = []

    def build(task="boxing", num_envs=2, **options):
        made.append(ArenaVectorEnv(task, num_envs, **(BLIND | options)))
        return made[-1]

    yield build
    for env in made:
        env.close()


WRIST = CameraConfig(40, 36, "left_wrist")
"""A camera of another size than the others of its batch."""


def stand(env):
    """The standing action for every world."""
    return np.tile(STAND_ACTION, (env.num_envs, 1))


def wild(tick, worlds):
    """Wild actions of a tick for some of the worlds, the standing action for the others."""
    return np.where(np.asarray(worlds)[:, None], WILD[tick], STAND_ACTION).astype(np.float32)


def planned(task, count, **options):
    """The first episodes of the plan."""
    return episode_plan.expand([task], trackers=["twist2"], policy="table", seeds=[0], repeats=count, **options)


def test_every_task_has_an_id():
    """All tasks of the registry are registered, and make_vec takes the batch of worlds by itself."""
    assert gym.env_id("vis_navi") == "arena_newton/VisNavi-v0" and gym.env_id("pp_box") == "arena_newton/PPBox-v0"
    assert all(gym.env_id(name) in gymnasium.registry for name in tasks.names())
    env = gymnasium.make_vec("arena_newton/Boxing-v0", num_envs=3, **BLIND)
    assert isinstance(env, ArenaVectorEnv) and env.spec.id == "arena_newton/Boxing-v0" and env.num_envs == 3
    env.close()


def test_what_it_returns_is_in_its_spaces(make, brief):
    """Observations of reset, steps and ended episodes are elements of the spaces; flags and rewards are arrays."""
    env = make(image_size=(48, 32), cameras={"front": "ego", "outside": "world", "wrist": WRIST})
    observation, info = env.reset(seed=3)
    assert env.observation_space.contains(observation) and info["seed"].tolist() == [3, 4]
    assert observation["pixels"]["front"].shape == (2, 32, 48, 3) and observation["pixels"]["wrist"].std() > 0
    assert observation["pixels"]["wrist"].shape == (2, 36, 40, 3) and observation["agent_pos"].dtype == np.float32
    assert observation["task"] == (tasks.get("boxing").instruction,) * 2
    seen = observation["pixels"]["front"].copy()
    for tick in range(200):
        observation, reward, terminated, truncated, info = env.step(wild(tick, [True, False]))
        assert env.observation_space.contains(observation)
        assert [a.dtype.kind for a in (reward, terminated, truncated)] == ["f", "b", "b"]
        if terminated.any():
            break
    assert terminated.tolist() == [True, False] and not truncated.any() and info["_final_obs"].tolist() == [True, False]
    last = info["final_obs"][0]
    assert env.single_observation_space.contains(last) and info["final_obs"][1] is None
    assert not np.array_equal(last["agent_pos"], observation["agent_pos"][0])  # the new episode is what is observed
    assert not np.array_equal(last["pixels"]["front"], observation["pixels"]["front"][0])
    assert not np.array_equal(seen[1], 0) and seen.std() > 0
    final = info["final_info"]
    assert (final["outcome"][0], final["reason"][0], final["seed"][0]) == ("fall", "fall", 3)
    assert info["seed"].tolist() == [5, 4] and info["startup"].tolist() == [True, False]
    picture = env.render()
    assert np.array_equal(picture[1], observation["pixels"]["front"][1])


def test_an_observation_is_the_callers(make, brief):
    """A returned observation does not change with later steps."""
    env = make(image_size=(40, 32), startup="reset")
    first, _ = env.reset(seed=0)
    kept = {name: first[name].copy() for name in ("agent_pos", "pixels")}
    for tick in range(10):
        last, *_ = env.step(wild(tick, [True, True]))
    for name in kept:
        assert np.array_equal(first[name], kept[name]) and not np.array_equal(last[name], kept[name])


def test_wrappers_of_gymnasium_work(make):
    """Episode statistics count the steps of each world and its reward."""
    env = RecordEpisodeStatistics(make(max_episode_steps=3))
    env.reset(seed=0)
    for _ in range(53):
        *_, truncated, info = env.step(stand(env))
    assert truncated.all() and info["episode"]["l"].tolist() == [53, 53] and info["episode"]["r"].tolist() == [0, 0]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_one_world_passes_gymnasiums_checker(brief):
    """The environment of one world is what Gymnasium's own checker accepts: spaces, seeding, determinism."""
    env = gymnasium.make("arena_newton/Football-v0", engine="mujoco", device="cpu", image_size=(40, 32))
    check_env(env.unwrapped, skip_render_check=True)
    observation, info = env.reset(seed=21)
    assert (info["seed"], info["startup"]) == (21, True)
    assert info["episode_seed"] == seeding.episode_seed(tasks.get("football").gym_id, 1, 1)
    env.close()
    with pytest.raises(InputError, match="num_envs"):
        gym.ArenaGymEnv("football", num_envs=2)


@pytest.mark.parametrize("startup", gym.STARTUP)
def test_a_seed_is_an_episode_of_the_plan(make, boxed, startup):
    """An expert's actions give the states of a rollout at every tick, start-up included, and its results."""
    table, hashes, played = boxed
    results = {result.episode.episode_seed: result for result in played}
    env = make(startup=startup, autoreset_mode="disabled")
    _, info = env.reset(seed=0)
    seeds = info["episode_seed"].tolist()
    assert seeds == [episode.episode_seed for episode in planned("boxing", 2)]
    assert info["startup"].all() == (startup == "steps")
    total, over = np.zeros(2), np.zeros(2, bool)
    while not over.all():
        action = np.stack([table.at(seed, tick) for seed, tick in zip(seeds, info["steps"], strict=True)])
        if info["startup"].any():
            action[:] = 7.0  # ignored
        _, reward, terminated, truncated, info = env.step(action)
        total += reward
        over |= terminated | truncated
    assert WatchedEnv.history == hashes and all(len(ticks) > 100 for ticks in hashes.values())
    assert info["outcome"].tolist() == [results[seed].outcome for seed in seeds] == ["success", "success"]
    assert info["steps"].tolist() == [results[seed].steps for seed in seeds] and total.tolist() == [1.0, 1.0]
    assert info["margin"] == pytest.approx([results[seed].margin for seed in seeds])


def test_autoreset_plays_the_plan_as_a_rollout_does(make, watched_worlds):
    """SAME_STEP: worlds take the next episodes in the order in which they end; every tick is a rollout's."""
    hashes, played = watched_rollout(watched_worlds, "football", 5, 2, get("stand"), max_steps=8)
    results = {result.episode.episode_seed: result for result in played}
    env = make("football", max_episode_steps=8)
    env.reset(seed=0)
    ended = {}
    while len(ended) < 5:
        *_, terminated, truncated, info = env.step(stand(env))
        for world in np.flatnonzero(terminated | truncated):
            final = info["final_info"]
            ended[int(final["episode_seed"][world])] = final["outcome"][world], int(final["steps"][world])
    for seed, ticks in hashes.items():
        assert WatchedEnv.history[seed] == ticks and len(ticks) == 58
        assert ended[seed] == (results[seed].outcome, results[seed].steps) == ("timeout", 8)


def test_next_step_resets_in_the_step_after_the_end(make, brief):
    """NEXT_STEP: the end is returned with its own observation; the next step ignores the action and begins."""
    env = make("football", autoreset_mode=AutoresetMode.NEXT_STEP, max_episode_steps=2, startup="reset")
    env.reset(seed=[4, 8])
    env.step(stand(env))
    last, _, _, truncated, info = env.step(stand(env))
    assert truncated.all() and info["seed"].tolist() == [4, 8] and "final_obs" not in info
    first, reward, terminated, truncated, info = env.step(WILD[:2])
    assert not (terminated | truncated).any() and not reward.any() and info["seed"].tolist() == [9, 10]
    assert info["steps"].tolist() == [0, 0] and not np.array_equal(first["agent_pos"], last["agent_pos"])


def test_an_ended_world_is_frozen(make, brief):
    """DISABLED: after its end a world keeps state, picture, flags and info, with reward 0, until its reset."""
    env = make(image_size=(40, 32), autoreset_mode="disabled", startup="reset", reward="margin")
    env.reset(seed=0)
    ended = None
    for tick in range(150):
        observation, reward, terminated, _, info = env.step(wild(tick, [True, False]))
        if ended is None and terminated[0]:
            ended, pose = (tick, observation, info), env.env.physics.qpos.numpy()[0].copy()
        elif ended is not None:
            assert terminated.tolist() == [True, False] and reward[0] == 0.0 and not info["is_success"][0]
            assert info["outcome"].tolist() == ["fall", None] and info["steps"][0] == ended[0] + 1
        if ended is not None and tick == ended[0] + 10:
            break
    assert ended is not None
    for name in ("agent_pos", "pixels"):
        assert np.array_equal(observation[name][0], ended[1][name][0])
        assert not np.array_equal(observation[name][1], ended[1][name][1])
    assert np.array_equal(env.env.physics.qpos.numpy()[0], pose)
    frozen = env.render()[0]
    assert np.array_equal(frozen, observation["pixels"][0])
    again, info = env.reset(options={"reset_mask": np.array([True, False])})
    assert info["_seed"].tolist() == [True, False] and info["seed"][0] == 2
    assert not np.array_equal(again["agent_pos"][0], observation["agent_pos"][0])
    *_, terminated, _, info = env.step(stand(env))
    assert not terminated.any() and info["steps"].tolist() == [1, tick + 2]


@pytest.mark.parametrize(
    ("engine", "tracker", "startup", "ticks"),
    [
        ("mujoco", "twist2", "steps", 10),
        ("mujoco", "twist2", "reset", 10),
        ("mujoco", "sonic", "steps", 10),
        ("warp", "twist2", "reset", 2),  # steps of some worlds, too
    ],
)
def test_resetting_one_world_changes_no_bit_of_another(make, monkeypatch, engine, tracker, ticks, startup):
    """World 1 goes through the same states whether world 0 is reset (start-up included) or not."""
    env = make("football", engine=engine, tracker=tracker, startup=startup)
    monkeypatch.setattr(env.env, "startup_ticks", ticks)
    runs = []
    for disturbed in (False, True):
        WatchedEnv.history.clear()
        _, info = env.reset(seed=0)
        seed = info["episode_seed"][1]
        if startup == "steps":
            for _ in range(ticks):
                env.step(stand(env))
        for tick in range(ticks):
            env.step(wild(tick, [True, False]))
        if disturbed:
            mask = np.array([True, False])
            _, info = env.reset(seed=[77, None], options={"reset_mask": mask})
            assert info["_startup"].tolist() == mask.tolist() and info["seed"].tolist() == [77, 1]
        for _ in range(ticks):
            observation, *_ = env.step(stand(env))
        runs.append((list(WatchedEnv.history[seed]), observation["agent_pos"][1].tobytes()))
    assert runs[0] == runs[1] and len(set(runs[0][0])) == 3 * ticks


def test_a_fall_in_the_start_up(make, monkeypatch):
    """Led through by the reset, it is terminated by the first step; in steps, by the step in which it falls."""
    for startup in gym.STARTUP:
        env = make("football", startup=startup, autoreset_mode="disabled")
        env.reset(seed=0)
        upside = env.env.spec.spawn_position, (0.0, 1.0, 0.0, 0.0)
        original = type(env.env).reset

        def spawn(self, seeds, worlds=None, original=original, upside=upside):
            original(self, seeds, worlds, spawn=lambda seed: upside)

        with monkeypatch.context() as patch:
            patch.setattr(type(env.env), "reset", spawn)
            _, info = env.reset(seed=0)
        assert not info["startup"].any() if startup == "reset" else info["startup"].all()
        for _ in range(51):
            _, reward, terminated, truncated, info = env.step(stand(env))
            if terminated.any() or startup == "reset":
                break
        assert terminated.all() and not truncated.any() and not reward.any()
        assert info["reason"].tolist() == ["startup_fall"] * 2 and info["steps"].tolist() == [0, 0]


def test_an_action_that_is_not_finite_ends_one_episode(make, brief):
    """It is an error, reported as truncated; the other world goes on."""
    env = make("football", startup="reset")
    env.reset(seed=0)
    action = stand(env)
    action[0, 5] = np.nan
    *_, terminated, truncated, info = env.step(action)
    assert truncated.tolist() == [True, False] and not terminated.any()
    assert (info["final_info"]["outcome"][0], info["final_info"]["reason"][0]) == ("error", "bad_action")


def test_the_margin_as_reward(make, brief):
    """Its rewards add up to the change of the task's margin since the first tick."""
    env = make(reward="margin", startup="reset", autoreset_mode="disabled")
    env.reset(seed=0)
    total = np.zeros(2)
    for tick in range(30):
        _, reward, terminated, _, info = env.step(wild(tick % 7, [True, True]))
        if tick == 0:
            first = info["margin"].copy()
            assert not reward.any() and info["_margin"].all()
        total += reward
        if terminated.any():
            break
    assert np.allclose(total, info["margin"] - first) and np.abs(total).max() > 0.0


def test_seeds_make_episodes(make):
    """One number, one per world, or none; without any, episodes outside the protocol; always the same draws."""
    env = make("football", num_envs=2, repeats=5)
    _, info = env.reset()
    assert (info["seed"] >= gym.PROTOCOL_EPISODES).all()
    _, info = env.reset(seed=[7, None])
    assert info["seed"].tolist() == [7, 8]
    five = episode_plan.expand(["football"], trackers=["twist2"], policy="table", seeds=[1], repeats=5)
    assert info["episode_seed"].tolist() == [five[2].episode_seed, five[3].episode_seed]
    first, _ = env.reset(seed=7)
    again, _ = env.reset(seed=7)
    other, _ = env.reset(seed=9)
    assert np.array_equal(first["agent_pos"], again["agent_pos"])
    assert np.array_equal(first["agent_pos"][1], again["agent_pos"][1]) and other["agent_pos"].shape == (2, 64)
    _, info = env.reset(seed=9)
    for world, seed in enumerate(info["episode_seed"].tolist()):
        assert env.env.draws[world] == env.env.spec.draw(seed, "base", env.env.rules)


def test_episodes_to_learn_from(make):
    """Seeds of the range of demonstrations are of episodes that no evaluation has, and follow from the number alone."""
    env = make("football", seed_range="demonstration")
    _, info = env.reset(seed=20)
    gym_id = tasks.get("football").gym_id
    wanted = [seeding.recording_seed(gym_id, seeding.DEMONSTRATION, 1, repeat) for repeat in (0, 1)]
    assert info["episode_seed"].tolist() == wanted and min(wanted) >= 2**31


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env: env.step(np.zeros((2, 39), np.float32)), r"actions of shape \[2, 39\], expected \[2, 40\]"),
        (lambda env: env.step(np.zeros(40, np.float32)), r"actions of shape \[40\]"),
        (lambda env: env.step([["left"] * 40] * 2), "expected an array of numbers"),
        (lambda env: env.reset(seed=[1, 2, 3]), "3 numbers for 2 worlds"),
        (lambda env: env.reset(seed=-1), "seed -1"),
        (lambda env: env.reset(seed=[1, "two"]), "seed two"),
        (lambda env: env.reset(options={"mode": "visual"}), "options mode: unknown"),
        (lambda env: env.reset(options={"reset_mask": np.array([1, 0])}), "reset_mask: expected bool"),
        (lambda env: env.reset(options={"reset_mask": np.zeros(2, bool)}), "at least one world"),
    ],
)
def test_wrong_calls_are_refused(shared_env, call, message):
    """One clear error names what is wrong, and the episode goes on."""
    shared_env.reset(seed=0)
    before = shared_env.env.physics.qpos.numpy().copy()
    with pytest.raises(InputError, match=message):
        call(shared_env)
    assert np.array_equal(shared_env.env.physics.qpos.numpy(), before)
    shared_env.step(stand(shared_env))


@pytest.fixture(scope="module")
def shared_env():
    """Two worlds for tests that only begin episodes."""
    env = ArenaVectorEnv("football", 2, **BLIND)
    with pytest.raises(InputError, match="call reset"):
        env.step(np.zeros((2, 40), np.float32))
    with pytest.raises(InputError, match="leaves out worlds"):
        env.reset(options={"reset_mask": np.array([True, False])})
    yield env
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "num_envs 0"),
        ({"task": "golf"}, "golf"),
        ({"startup": "never"}, "startup never: unknown, choose from steps, reset"),
        ({"reward": "fame"}, "reward fame"),
        ({"autoreset_mode": "sometimes"}, "autoreset_mode sometimes"),
        ({"render_mode": "human"}, "render_mode human"),
        ({"image_size": (64,)}, "image_size"),
        ({"repeats": 0}, "repeats 0"),
        ({"seed_range": "exam"}, "seed_range exam"),
        ({"max_episode_steps": 0}, "max_episode_steps 0"),
        ({"cameras": {"front": "nose"}, "image_size": (32, 32)}, "nose"),
        ({"cameras": {"front": CameraConfig(depth=True)}, "image_size": (32, 32)}, "front: depth"),
        ({"cameras": {"front": CameraConfig(0, 32)}, "image_size": (32, 32)}, r"cameras: front \[0, 32\]: expected"),
    ],
)
def test_wrong_options_are_refused(options, message):
    """An option that is unknown or unfit is named."""
    with pytest.raises(InputError, match=message):
        ArenaVectorEnv(**({"task": "football", "engine": "mujoco", "device": "cpu", "image_size": None} | options))


def test_the_page_about_gymnasium(brief):
    """Every Python block of docs/howto/program/gym.md runs, one after the other, and gives what the page says."""
    page = (Path(__file__).parents[3] / "docs" / "howto" / "program" / "gym.md").read_text()
    world = {"__name__": "docs_gym"}
    for block in re.findall(r"^```python\n(.*?)^```$", page, flags=re.DOTALL | re.MULTILINE):
        exec(compile(block, "docs/howto/program/gym.md", "exec"), world)
    assert world["action"].shape == (2, 40) and not world["info"]["startup"]
    assert (world["info"]["seed"], world["info"]["steps"]) == (21, 1)
