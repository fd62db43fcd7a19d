"""`replay:<LeRobot dataset>#<episode>`: the original's released data and our own through the world."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the extra [data]")

from original_dataset import ACTION_NAMES, features, write_dataset
from recorded_actions import Actions

from arena_newton import policies, trackers
from arena_newton.cli import extras
from arena_newton.data.readers.label_protocols import encode_v4
from arena_newton.data.readers.lerobot_reader import DatasetActions
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding

V4 = {"robot_type": "unitree_g1_gmt_cmd_v4", "vla_protocol": {"version": "4"}}


@pytest.fixture(scope="module")
def played():
    """Boxing, two planned episodes, how the expert ended, and its actions."""
    env = ArenaEnv("boxing", tracker=trackers.get("twist2", None), worlds=2, engine="mujoco")
    seeds = [seeding.episode_seed(env.spec.gym_id, 0, repeat) for repeat in range(2)]
    episodes = [SimpleNamespace(episode_seed=seed, object_seed=seeding.object_seed(seed)) for seed in seeds]
    kept = Actions(startup=False)
    results = Rollout(env, policies.get("expert"), episodes, recorder=kept).run()
    assert [result.outcome for result in results] == ["success"] * 2
    yield env, episodes, results, [np.stack(kept.rows[seed]) for seed in seeds]
    env.close()


@pytest.fixture
def standing():
    """Two short episodes."""
    return [np.tile(STAND_ACTION, (n, 1)) for n in (5, 7)]


def arena(seeds, **changes):
    """Block `arena` of our own datasets."""
    entry = {"task": "boxing", "mode": "base", "tracker": "twist2"} | changes
    return {"arena": {"episodes": [entry | {"episode_seed": int(seed)} for seed in seeds]}}


def test_the_originals_data_move_the_robot(played, tmp_path):
    """An episode of a set of the released schema, in its own folder, is played action by action and succeeds."""
    env, episodes, results, actions = played
    root = write_dataset(tmp_path / "HSI_boxing" / "twist2_refpose_v3_1", actions)
    policy = policies.get(f"replay:{root}#1")
    policy.check_task("boxing", "base", [episodes[1].episode_seed])
    kept = Actions(startup=False)
    (again,) = Rollout(env, policy, episodes[1:], recorder=kept).run()
    assert (again.outcome, again.steps) == ("success", results[1].steps)
    np.testing.assert_array_equal(np.stack(kept.rows[episodes[1].episode_seed]), actions[1])


OLDER = {
    "schema": "unitree_g1_refpose_v3_1",
    "version": "3.1",
    "rot6d_layout": "row",
    "action_layout": {"hands": [38, 40]},
}


@pytest.mark.parametrize("block", [OLDER, None], ids=["older keys", "no block"])
def test_other_descriptions_of_the_protocol_are_read(block, standing, tmp_path):
    """A set whose block has other keys beside its version, or none, gives the same actions."""
    root = write_dataset(tmp_path / "set", standing, info={"vla_protocol": block})
    np.testing.assert_array_equal(DatasetActions(root).actions(1), standing[1].astype(np.float32))


def test_each_episode_finds_its_own_recording(played, tmp_path):
    """With #all the episodes of our own data are played in the worlds of their seeds, of v4 too, in any order."""
    env, episodes, results, actions = played
    seeds = [episode.episode_seed for episode in episodes]
    plain = write_dataset(tmp_path / "plain", actions, info=arena(seeds))
    velocities = write_dataset(tmp_path / "v4", [encode_v4(rows) for rows in actions], info=V4 | arena(seeds))
    for root in (plain, velocities):
        again = Rollout(env, policies.get(f"replay:{root}#all"), episodes[::-1]).run()
        assert [result.outcome for result in again] == ["success"] * 2
        assert [result.steps for result in again] == [result.steps for result in results[::-1]]


def test_the_same_seed_through_two_trackers(played, standing, tmp_path):
    """The recording through the environment's tracker, of several, is played."""
    env, episodes, _, _ = played
    seed = episodes[0].episode_seed
    info = arena([seed, seed])
    info["arena"]["episodes"][0]["tracker"] = "sonic"
    policy = policies.get(f"replay:{write_dataset(tmp_path / 'set', standing, info=info)}#all")
    policy.attach(env)
    policy.reset([seeding.policy_seed(seed)], [env.spec.gym_id])
    assert len(policy.playing[0]) == len(standing[1])
    policy.reset([seed], [env.spec.gym_id])
    answer = policy.act(SimpleNamespace(state=np.zeros((1, 64)), mask=np.array([True])))
    assert "no recording of" in answer.errors[0]


UNFIT = {
    "legacy v1": ({"robot_type": "unitree_g1_smpl_pose6d_vla"}, "legacy protocol v1.*supported are unitree_g1_refpose"),
    "v3": ({"robot_type": "unitree_g1_rotlocal_v3"}, "protocol v3, whose orientations are relative"),
    "other robot": ({"robot_type": "so100"}, "robot_type is 'so100'; supported are"),
    "no robot": ({"robot_type": None}, "robot_type is 'None'"),
    "contradiction": ({"vla_protocol": {"version": "4"}}, "version '4', robot_type unitree_g1_refpose_v3_1 is of v3.1"),
    "fps": ({"fps": 30}, "fps is 30; an action is a tick"),
    "version": ({"codebase_version": "v2.1"}, r"codebase_version is 'v2.1', expected v3.0"),
    "no action": ({"features": {}}, "features has no action"),
    "width": (
        {"features": features() | {"action": {"dtype": "float32", "shape": [35]}}},
        r"action has shape \[35\], expected \[40\]",
    ),
    "joint order": (
        {"features": {"action": {"shape": [40], "names": [*ACTION_NAMES[:9], ACTION_NAMES[10], *ACTION_NAMES[10:]]}}},
        r"slot 9 is joint \w+, expected \w+ \(canonical order\)",
    ),
    "episodes": ({"total_episodes": 3}, "holds 2 episodes, info.json says 3"),
}


@pytest.mark.parametrize("case", UNFIT)
def test_what_cannot_be_played_is_named(case, standing, tmp_path):
    """A set of another protocol, robot or rate is refused, and the message says what is supported."""
    info, message = UNFIT[case]
    root = write_dataset(tmp_path / "set", standing, info=info)
    with pytest.raises(InputError, match=message) as error:
        policies.get(f"replay:{root}#0")
    assert str(root) in str(error.value)


def test_wrong_episodes_are_named(standing, tmp_path):
    """No number, one that does not exist, `all` without seeds, another task or mode, other seeds: one clear line."""
    root = write_dataset(tmp_path / "set", standing)
    for ending, message in {
        "": "name an episode: --policy replay:.*#0 to #1",
        "#": "is no episode",
        "#-1": "#-1: is no episode",
        "#2": "has no episode 2, its episodes are 0 to 1",
        "#all": "does not say which seeds",
    }.items():
        with pytest.raises(InputError, match=message):
            policies.get(f"replay:{root}{ending}")
    with pytest.raises(InputError, match="is an episode of boxing, not of football"):
        policies.get(f"replay:{root}#0").check_task("football")
    policy = policies.get(f"replay:{write_dataset(tmp_path / 'own', standing, info=arena([2**31 + 5, 2**31 + 6]))}#all")
    policy.check_task("boxing", "base", [seeding.policy_seed(2**31 + 6)])
    for arguments, message in {
        ("football",): "no recording of task football",
        ("boxing", "visual"): "in mode visual, only base",
        ("boxing", "base", (5,)): r"but of other seeds \(of demonstration\)",
    }.items():
        with pytest.raises(InputError, match=message):
            policy.check_task(*arguments)


def test_damaged_blocks_of_our_own_are_named(standing, tmp_path):
    """A block `arena` with too few episodes or without seeds is an error, not another episode's actions."""
    for number, block in enumerate([[], {"episodes": []}, {"episodes": [{}, {}]}, {"episodes": ["a", "b"]}]):
        root = write_dataset(tmp_path / str(number), standing, info={"arena": block})
        with pytest.raises(InputError, match="arena: episode"):
            policies.get(f"replay:{root}#all")


def test_the_command_line(played, tmp_path, capsys, monkeypatch):
    """`run` journals the replay by the name of dataset and episode; a wrong episode and a missing extra are code 2."""
    _, episodes, results, actions = played
    root = write_dataset(tmp_path / "HSI_boxing" / "twist2_refpose_v3_1", actions)
    run = ["run", "--task", "boxing", "--seeds", "0", "--repeats", "1", "--engine", "mujoco"]
    out = tmp_path / "out"
    assert main([*run, "--policy", f"replay:{root}#0", "--out", str(out)]) == 0
    line = json.loads((out / "episodes.jsonl").read_text().splitlines()[0])
    assert (line["policy"], line["outcome"]) == ("replay:twist2_refpose_v3_1#0", "success")
    assert (line["episode_seed"], line["steps"]) == (episodes[0].episode_seed, results[0].steps)
    capsys.readouterr()
    assert main([*run, "--policy", f"replay:{root}#7", "--out", str(tmp_path / "other")]) == 2
    assert "has no episode 7" in capsys.readouterr().err
    monkeypatch.setattr(extras, "EXTRAS", extras.EXTRAS | {"data": ("no_such_module",)})
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    assert main([*run, "--policy", f"replay:{root}#0", "--out", str(tmp_path / "third")]) == 2
    assert "needs the extra [data]" in capsys.readouterr().err
