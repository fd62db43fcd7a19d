"""A library keeps what it was given, and its derived numbers are those that the action kernel would make."""

import numpy as np
import pytest
import torch
import warp as wp

from arena_newton.errors import InputError
from arena_newton.kernels.canonical import ReferencePose, launch_integrate, launch_reset_reference
from arena_newton.robot import rotations
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, TICK
from arena_newton.trackers.motions import frames
from arena_newton.trackers.motions.library import MIRROR_JOINTS, MIRROR_SIGNS, MotionLibrary
from arena_newton.trackers.motions.load import Clip
from arena_newton.trackers.motions.playback import clip_actions


def wave(ticks: int = 90, seed: int = 0, fps: float = 50.0) -> Clip:
    """A path that turns, leans and bobs, from another place and heading each time."""
    rng = np.random.default_rng(seed)
    t = np.arange(ticks) / fps
    a, b, c = rng.uniform(0.5, 1.5, 3)
    yaw = 2.5 + a * t
    roll, pitch = 0.2 * np.sin(b * t), 0.3 * np.cos(c * t)
    quat = torch.from_numpy(np.stack([np.cos(yaw / 2), 0 * t, 0 * t, np.sin(yaw / 2)], axis=1))
    for angle, axis in ((pitch, 2), (roll, 1)):
        turn = np.zeros((ticks, 4))
        turn[:, 0], turn[:, axis] = np.cos(angle / 2), np.sin(angle / 2)
        quat = rotations.quat_multiply(quat, torch.from_numpy(turn))
    pos = np.stack([4 + np.sin(t), -7 + 0.5 * t, 0.7 + 0.05 * np.sin(3 * t)], axis=1)
    joints = 0.4 * np.sin(t[:, None] + rng.uniform(0, 6, 29))
    hands = (np.stack([t, 1 - t], axis=1) > 0.5).astype(float)
    return Clip(fps, pos, quat.numpy(), joints, hands=hands)


@pytest.fixture
def library() -> MotionLibrary:
    clips = [wave(90, 0), wave(40, 1), wave(61, 2)]
    return MotionLibrary.from_clips(
        clips, ["a", "b", "c"], family=["walk", "squat", "walk"], licence="MIT", source=["x", "y", "z"]
    )


def integrated(actions: np.ndarray, root_xy: np.ndarray, yaw: float) -> dict[str, np.ndarray]:
    """Result of the kernels for a stream of actions, tick by tick."""
    ref = ReferencePose.allocate(1, "cpu", canonical_to_mujoco=CANONICAL_TO_MUJOCO, tick=TICK)
    qpos = np.array([[*root_xy, 0.8, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]], dtype=np.float32)
    mask = wp.array([1], dtype=wp.int32, device="cpu")
    launch_reset_reference(ref, wp.array(qpos, device="cpu"), 0, mask)
    out: dict[str, list] = {"mimic": [], "position": [], "quat": [], "hands": []}
    for action in actions:
        launch_integrate(ref, wp.array(action[None].astype(np.float32), device="cpu"), mask)
        for name, rows in out.items():
            rows.append(getattr(ref, name).numpy()[0].copy())
    return {name: np.array(rows) for name, rows in out.items()}


def same_rotation(a: np.ndarray, b: np.ndarray, atol: float) -> None:
    np.testing.assert_allclose(np.abs((a * b).sum(-1)), 1.0, atol=atol)


def test_mimic_is_the_kernels(library):
    """Mimic commands of every frame equal what the action kernel writes for the clip's actions."""
    got = library.to("cpu")
    for clip in range(library.clips):
        rows = library.rows(clip)
        pos, quat = got.root_pos[rows].double(), got.root_quat[rows].double()
        actions = frames.motion_actions(pos, quat, got.joint_pos[rows].double()).numpy()
        yaw = float(rotations.heading(quat[0]))
        kernel = integrated(actions, library.root_pos[rows][0, :2], yaw)
        mimic = got.mimic[rows].numpy()
        # The kernel's own yaw is a float32: its rounding over a tick is 2e-5 rad/s.
        np.testing.assert_allclose(mimic[:, 5], kernel["mimic"][:, 5], atol=1e-4)
        np.testing.assert_allclose(np.delete(mimic, 5, 1), np.delete(kernel["mimic"], 5, 1), atol=1e-5)


def test_actions_rebuild_the_motion():
    """Actions integrate to the motion they were made from, in the kernels and in `actions_to_motion`, batched too."""
    clip = wave()
    pos, quat, joints, hands = (
        torch.from_numpy(x) for x in (clip.root_pos, clip.root_quat, clip.joint_pos, clip.hands)
    )
    actions = frames.motion_actions(pos, quat, joints, hands)
    yaw = rotations.heading(quat[0])
    kernel = integrated(actions.numpy(), clip.root_pos[0, :2], float(yaw))
    np.testing.assert_allclose(kernel["position"], clip.root_pos, atol=1e-4)
    same_rotation(kernel["quat"], clip.root_quat, 1e-6)
    np.testing.assert_array_equal(kernel["hands"], clip.hands)
    batch = frames.actions_to_motion(actions.expand(2, 3, -1, -1), pos[0, :2].expand(2, 3, 2), yaw.expand(2, 3))
    got = [part[1, 2].numpy() for part in batch]
    np.testing.assert_allclose(got[0], clip.root_pos, atol=1e-9)
    same_rotation(got[1], clip.root_quat, 1e-9)
    np.testing.assert_allclose(got[2], clip.joint_pos, atol=1e-12)
    np.testing.assert_array_equal(got[3], clip.hands)


def test_streaming_equals_whole():
    """Frame by frame gives the same actions and mimic commands as a whole motion at once."""
    clip = wave(30)
    pos, quat, joints, hands = (
        torch.from_numpy(x) for x in (clip.root_pos, clip.root_quat, clip.joint_pos, clip.hands)
    )
    actions, mimic = frames.motion_actions(pos, quat, joints, hands), frames.motion_mimic(pos, quat, joints)
    for k in range(30):
        b = max(k - 1, 0)
        one = frames.frame_action(pos[b], pos[k], quat[k], joints[k], hands[k], rotations.heading(quat[0]))
        torch.testing.assert_close(one, actions[k])
        torch.testing.assert_close(frames.frame_mimic(pos[b], quat[b], pos[k], quat[k], joints[k]), mimic[k])


def test_quat_from_matrix():
    """Rotations of every kind, half turns among them, survive the way through a matrix."""
    generator = torch.Generator().manual_seed(0)
    quat = torch.nn.functional.normalize(torch.randn(500, 4, generator=generator, dtype=torch.float64), dim=-1)
    quat = torch.cat([quat, torch.eye(4, dtype=torch.float64)])
    same_rotation(rotations.quat_from_matrix(rotations.matrix_from_quat(quat)).numpy(), quat.numpy(), 1e-12)


def test_velocities(library):
    """Velocities are backward differences, zero on a clip's first frame, the angular one in the body's frame."""
    got = library.to("cpu")
    for name in ("joint_vel", "lin_vel", "ang_vel"):
        assert not getattr(got, name)[got.clip_start].any()
    k = 100
    np.testing.assert_allclose(got.lin_vel[k], (library.root_pos[k] - library.root_pos[k - 1]) / TICK, atol=1e-4)
    np.testing.assert_allclose(got.joint_vel[k], (library.joint_pos[k] - library.joint_pos[k - 1]) / TICK, atol=1e-4)
    # Turning back by the angular velocity leads to the frame before.
    before, after = (torch.from_numpy(library.root_quat[i].astype(float)) for i in (k - 1, k))
    vector = got.ang_vel[k].double() * TICK
    half = vector.norm() / 2
    turn = torch.cat([half.cos()[None], half.sin() * vector / vector.norm()])
    same_rotation(rotations.quat_multiply(before, turn).numpy(), after.numpy(), 1e-9)


def test_index(library):
    """Steps outside a clip give its first and last frame, never a neighbour's."""
    got = library.to("cpu")
    clip, step = torch.tensor([0, 1, 1, 2]), torch.tensor([-3, 5, 400, 60])
    assert got.index(clip, step).tolist() == [0, 95, 129, 190]
    assert got.frame_clip[got.index(clip, step)].tolist() == [0, 1, 1, 2]


def test_round_trip(library, tmp_path):
    """A saved library comes back bit for bit, and its file holds no pickle."""
    library.save(tmp_path / "sub" / "lib.npz")
    back = MotionLibrary.load(tmp_path / "sub" / "lib.npz")
    for name in library.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(back, name), getattr(library, name), err_msg=name)
    with np.load(tmp_path / "sub" / "lib.npz", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)


def test_concatenate_and_select(library):
    """Families of the same name are one; selected clips keep their frames."""
    other = MotionLibrary.from_clips([wave(20, 3)], ["d"], family="squat", licence="Apache-2.0")
    both = MotionLibrary.concatenate([library, other])
    assert both.family_names.tolist() == ["walk", "squat"] and both.family.tolist() == [0, 1, 0, 1]
    assert both.licence.tolist() == ["MIT"] * 3 + ["Apache-2.0"]
    one = both.select([3, 1])
    assert one.clip_names.tolist() == ["d", "b"]
    np.testing.assert_array_equal(one.joint_pos[one.rows(1)], library.joint_pos[library.rows(1)])
    with pytest.raises(InputError, match="no clip"):
        both.select(both.family == 7)


def test_mirror(library):
    """Mirroring twice gives the library back; a mirrored turn to the left goes right; hands change sides."""
    mirrored = library.mirrored()
    twice = mirrored.mirrored()
    for name in ("root_pos", "root_quat", "joint_pos", "hands", "support_box"):
        np.testing.assert_allclose(getattr(twice, name), getattr(library, name), atol=1e-6)
    a, b = library.to("cpu").mimic, mirrored.to("cpu").mimic
    np.testing.assert_allclose(b[:, [0, 2, 4]], a[:, [0, 2, 4]], atol=1e-5)
    np.testing.assert_allclose(b[:, [1, 3, 5]], -a[:, [1, 3, 5]], atol=1e-4)
    np.testing.assert_array_equal(mirrored.hands, library.hands[:, ::-1])
    assert sorted(MIRROR_JOINTS) == list(range(29)) and MIRROR_SIGNS[0] == 1.0 and MIRROR_SIGNS[1] == -1.0


def test_from_random():
    """Tensors of the generator become named clips of equal length with their supports."""
    clips = [wave(30, seed) for seed in range(4)]
    generated = {
        "root_pos": torch.tensor(np.array([c.root_pos for c in clips])),
        "root_quat": torch.tensor(np.array([c.root_quat for c in clips])),
        "joint_pos": torch.tensor(np.array([c.joint_pos for c in clips])),
        "hands": torch.zeros(4, 30, 2),
        "family": torch.tensor([1, 0, 1, 0]),
        "family_names": ["stand", "sit"],
        "support_kind": torch.tensor([1, 0, 1, 0]),
        "support_box": torch.arange(28.0).reshape(4, 7),
    }
    library = MotionLibrary.from_random(generated)
    assert library.clip_names.tolist() == ["sit-0000", "stand-0000", "sit-0001", "stand-0001"]
    np.testing.assert_allclose(library.root_pos[library.rows(2)], clips[2].root_pos, atol=1e-5)
    assert library.support_kind.tolist() == [1, 0, 1, 0] and library.support_box[2, 0] == 14.0


def test_resampling():
    """Clips of another frame rate come in at 50 Hz with the same path and duration."""
    slow, fast = wave(61, fps=30.0), wave(101, fps=50.0)
    library = MotionLibrary.from_clips([slow], ["a"])
    assert library.frames == 101 and library.seconds[0] == pytest.approx(2.0)
    np.testing.assert_allclose(library.root_pos, fast.root_pos, atol=1e-3)
    same_rotation(library.root_quat, fast.root_quat, 1e-5)
    np.testing.assert_allclose(library.joint_pos, fast.joint_pos, atol=1e-3)


def test_replay_plays_the_same():
    """A clip's actions from a library are those that the replay policy plays from its file."""
    clip = wave(61, fps=29.9)
    library = MotionLibrary.from_clips([clip], ["a"])
    parts = (library.root_pos, library.root_quat, library.joint_pos, library.hands)
    arrays = (torch.from_numpy(x.astype(float)) for x in parts)
    actions, played = frames.motion_actions(*arrays).numpy(), clip_actions(clip)
    assert len(actions) == len(played)
    np.testing.assert_allclose(actions, played, atol=2e-6)


def test_bad_files(library, tmp_path):
    """Every defect of a file is one line that names the file and the array."""
    arrays = {name: getattr(library, name) for name in library.__dataclass_fields__}
    good = {"format": np.array("arena-newton-motions-1"), "fps": np.array(50)} | arrays
    nan = library.joint_pos.copy()
    nan[3, 3] = np.nan
    cases = {
        "array hands is missing": {k: v for k, v in good.items() if k != "hands"},
        "not a motion library": {k: v for k, v in good.items() if k != "format"},
        "30 frames per second": good | {"fps": np.array(30)},
        "joint_pos holds NaN": good | {"joint_pos": nan},
        r"joint_pos has shape \[191, 28\]": good | {"joint_pos": nan[:, :28]},
        "do not cover": good | {"clip_length": library.clip_length + 1},
        "family of clip b": good | {"family": np.array([0, 9, 0])},
        "not of length 1": good | {"root_quat": library.root_quat * 2},
        "licence holds": good | {"licence": np.zeros(3)},
        "not a readable NPZ": good | {"licence": np.array([{}] * 3, dtype=object)},
    }
    path = tmp_path / "bad.npz"
    for text, content in cases.items():
        np.savez(path, **content)
        with pytest.raises(InputError, match=text) as caught:
            MotionLibrary.load(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    path.write_text("hello")
    with pytest.raises(InputError, match="not a readable NPZ"):
        MotionLibrary.load(path)
    with pytest.raises(InputError, match="no such file"):
        MotionLibrary.load(tmp_path / "none.npz")
