"""Policies are found by name; standing and replay answer actions that rebuild what they stand for."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.policies import Observation
from arena_newton.policies.replay import ReplayPolicy
from arena_newton.robot.canonical import validate_action
from arena_newton.robot.g1 import DEFAULT_POSE, MUJOCO_TO_CANONICAL, TICK
from arena_newton.trackers.motions import Clip, load_clip
from arena_newton.trackers.motions.playback import clip_actions
from tests.conftest import SHARED

CLIPS = SHARED / "reference" / "twist2" / "example_motions"


def observation(worlds: int, mask=None) -> Observation:
    return Observation(
        state=torch.zeros(worlds, 64), image=None, mask=mask, task="football", gym_id="Football", instruction="Kick."
    )


def rotation(axis: int, angle: np.ndarray) -> np.ndarray:
    quat = np.zeros((len(angle), 4))
    quat[:, 0], quat[:, 1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return quat


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    return np.hstack([aw * bw - (av * bv).sum(1, keepdims=True), aw * bv + bw * av + np.cross(av, bv)])


def matrix(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


def walking_clip(frames: int = 90, fps: float = 29.9) -> Clip:
    t = np.arange(frames) / fps
    quat = multiply(
        rotation(2, 2.0 + 0.7 * t), multiply(rotation(1, 0.2 * np.sin(3 * t)), rotation(0, 0.1 * np.cos(2 * t)))
    )
    pos = np.stack([3 + 0.5 * np.sin(t), -1 + 0.4 * t, 0.78 + 0.03 * np.sin(5 * t)], axis=1)
    joints = np.sin(t[:, None] + np.arange(29))
    return Clip(fps, pos, quat, joints)


def integrate(actions: np.ndarray, xy: np.ndarray, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """The original's runtime: path and orientation that the actions describe, from a start position and heading."""
    heading = matrix(np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))
    path, turns, last_z = [], [], None
    xy = xy.copy()
    for a in actions.astype(float):
        x, y = a[3:9:2], a[4:9:2]
        x = x / np.linalg.norm(x)
        y = y - (x @ y) * x
        y = y / np.linalg.norm(y)
        turn = heading @ np.stack([x, y, np.cross(x, y)], axis=1)
        rise = 0.0 if last_z is None else a[2] - last_z
        up = (rise - turn[2, 0] * a[0] - turn[2, 1] * a[1]) / turn[2, 2]
        xy = xy + (turn @ [a[0], a[1], up])[:2]
        last_z = a[2]
        path.append([*xy, a[2]])
        turns.append(turn)
    return np.array(path), np.array(turns)


def save(path: Path, clip: Clip) -> Path:
    content = {
        "fps": np.array(clip.fps),
        "root_pos": clip.root_pos,
        "root_rot": clip.root_quat[:, [1, 2, 3, 0]],
        "dof_pos": clip.joint_pos,
    }
    path.write_bytes(pickle.dumps(content))
    return path


def test_stand():
    """Standing is identity orientation, height 0.8, the default pose in canonical order, open hands."""
    chunk = policies.get("stand").act(observation(3))
    assert chunk.actions.shape[0] == 3 and chunk.actions.shape[2] == 40 and chunk.errors == {}
    action = validate_action(chunk.actions, "stand")[1, 4]
    assert action[:9].tolist() == [0, 0, np.float32(0.8), 1, 0, 0, 1, 0, 0] and (action[38:] == 0).all()
    np.testing.assert_allclose(action[9:38][list(MUJOCO_TO_CANONICAL)], DEFAULT_POSE, atol=1e-7)


def test_actions_rebuild_path():
    """Integrating a clip's actions rebuilds its path, orientation and joints in the robot's own heading."""
    clip = walking_clip()
    actions = clip_actions(clip)
    validate_action(actions, "clip")
    times = np.arange(len(actions)) * TICK
    source = np.arange(len(clip.root_pos)) / clip.fps
    assert times[-1] <= clip.duration < times[-1] + TICK
    start = np.array([-1.6, 2.0])
    for yaw in (0.0, 2.2):
        path, turns = integrate(actions, start, yaw)
        # The clip, turned about z so that its first heading (2.0 rad, to within its tilt) becomes the robot's.
        first = matrix(clip.root_quat[0])
        turn = yaw - np.arctan2(first[1, 0], first[0, 0])
        spin = matrix(np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)]))
        expected = np.stack([np.interp(times, source, c) for c in clip.root_pos.T], axis=1)
        expected = (expected - expected[0]) @ spin.T + [*start, expected[0, 2]]
        np.testing.assert_allclose(path, expected, atol=2e-5)
        for k in range(0, len(source), 10):
            at = round(source[k] / TICK)
            if abs(at * TICK - source[k]) < 1e-3:
                np.testing.assert_allclose(turns[at], spin @ matrix(clip.root_quat[k]), atol=5e-3)
        np.testing.assert_allclose(turns[0], spin @ first, atol=1e-6)
    joints = np.stack([np.interp(times, source, c) for c in clip.joint_pos.T], axis=1)
    np.testing.assert_allclose(actions[:, 9:38][:, list(MUJOCO_TO_CANONICAL)], joints, atol=1e-5)


@pytest.mark.skipif(not CLIPS.is_dir(), reason="TWIST2's example motions are not next to this checkout")
def test_official_clip_path():
    """A real walking clip's path is rebuilt to a millimetre."""
    clip = load_clip(CLIPS / "0807_yanjie_walk_001.pkl")
    path, _ = integrate(clip_actions(clip), np.zeros(2), 0.0)
    times, source = np.arange(len(path)) * TICK, np.arange(len(clip.root_pos)) / clip.fps
    expected = np.stack([np.interp(times, source, c) for c in clip.root_pos[:, :2].T], axis=1)
    distance = np.linalg.norm(path[:, :2], axis=1)
    np.testing.assert_allclose(distance, np.linalg.norm(expected - expected[0], axis=1), atol=1e-3)
    assert distance.max() > 1.0


def test_start_and_end(tmp_path):
    """A clip begins from standing without displacement and ends with its last frame held still."""
    clip = walking_clip()
    policy = ReplayPolicy(save(tmp_path / "walk.pkl", clip))
    stand = policies.get("stand").act(observation(1)).actions[0, 0]
    assert (policy.actions[:50] == stand).all() and (policy.actions[:101, :2] == 0).all()
    jumps = np.abs(np.diff(policy.actions[:101, 9:38], axis=0)).max()
    assert jumps < 1.5 * np.abs(clip.joint_pos[0] - DEFAULT_POSE).max() / 50
    np.testing.assert_array_equal(policy.actions[100:], clip_actions(clip))
    validate_action(policy.actions, "replay")
    policy.reset([0], ["Football"])
    played = np.concatenate([policy.act(observation(1)).actions[0] for _ in range(15)])
    np.testing.assert_array_equal(played[: len(policy.actions)], policy.actions)
    held = played[len(policy.actions) :]
    assert (held[:, :2] == 0).all() and (held[:, 2:] == policy.actions[-1, 2:]).all() and len(held) > 10
    direct = ReplayPolicy(tmp_path / "walk.pkl", startup_stand=0.0, startup_blend=0.0)
    np.testing.assert_array_equal(direct.actions, clip_actions(clip))
    assert policy.describe()["trimmed"] == 0 and len(policy.describe()["hash"]) == 12


def test_worlds_have_their_own_clock(tmp_path):
    """Only worlds that ask advance, and a reset rewinds only the worlds of its mask."""
    actions = np.zeros((100, 40), dtype=np.float32)
    actions[:, [3, 6]] = 1.0
    actions[:, 2] = np.arange(100) / 100
    np.savez(tmp_path / "a.npz", action=actions)
    policy = policies.get(f"replay:{tmp_path / 'a.npz'}")
    policy.reset([1, 2, 3], ["Football"] * 3)
    first = policy.act(observation(3, np.array([True, False, True])))
    np.testing.assert_array_equal(first.actions[0], actions[:20])
    policy.reset([1, 2, 9], ["Football"] * 3, np.array([False, False, True]))
    second = policy.act(observation(3, torch.tensor([True, True, True]))).actions
    np.testing.assert_array_equal(second[0], actions[20:40])
    np.testing.assert_array_equal(second[1], actions[:20])
    np.testing.assert_array_equal(second[2], actions[:20])


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ("dance", "unknown policy; known are"),
        ("stand:still", "takes no argument"),
        ("replay", "needs a file"),
        ("replay:", "needs a file"),
        ("replay:none.pkl", "no such file"),
        ("replay:clip.bvh", "expected a .pkl clip or an .npz"),
        ("remote", "needs an address"),
        ("remote:localhost:8443", "expected http://host:port"),
        ("remote:http://", "expected http://host:port"),
        ("remote:http://host:port", "not an address"),
    ],
)
def test_bad_spec(spec, text):
    """Bad policy arguments are answered with one line that names the flag."""
    with pytest.raises(InputError) as caught:
        policies.get(spec)
    message = str(caught.value)
    assert text in message and message.startswith("--policy") and "\n" not in message


def test_registration(monkeypatch):
    """A third party's policy is found under its name, with its argument."""
    monkeypatch.setattr(policies.base.POLICIES, "_registered", {})

    class Mine(policies.Policy):
        def __init__(self, argument):
            self.argument = argument

    policies.register("mine", Mine)
    assert policies.get("mine:a:b").argument == "a:b" and "mine" in policies.names()
