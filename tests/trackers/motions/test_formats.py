"""Files of every known format come in as the same motion, and defects are named."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from arena_newton.errors import InputError
from arena_newton.robot import rotations
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO
from arena_newton.trackers.motions import frames, kinematics, measure
from arena_newton.trackers.motions.formats import ReadOptions, read_file, read_library
from arena_newton.trackers.motions.library import MotionLibrary
from arena_newton.trackers.motions.load import JOINTS_23, Clip

FPS = 50.0


def motion(ticks: int = 80) -> Clip:
    """A leaning walk along a bend; every joint moves differently."""
    t = np.arange(ticks) / FPS
    yaw, lean = 1.0 + 0.8 * t, 0.1 + 0.1 * np.sin(2 * t)
    turn = np.stack([np.cos(yaw / 2), 0 * t, 0 * t, np.sin(yaw / 2)], axis=1)
    tilt = np.stack([np.cos(lean / 2), 0 * t, np.sin(lean / 2), 0 * t], axis=1)
    quat = rotations.quat_multiply(torch.from_numpy(turn), torch.from_numpy(tilt)).numpy()
    pos = np.stack([0.5 * t, 0.2 * t, 0.75 + 0.02 * np.sin(4 * t)], axis=1)
    joints = 0.3 * np.sin(t[:, None] + np.arange(29)) * np.linspace(0.4, 1.0, 29)
    return Clip(FPS, pos, quat, joints)


def beyond_mimic(clip: Clip, isaac: bool, permute: bool = True) -> dict:
    """Clips of BeyondMimic: joints and bodies in Isaac Lab's order, or both in MuJoCo's (mjlab)."""
    poses = kinematics.forward(*(torch.from_numpy(x) for x in (clip.root_pos, clip.root_quat, clip.joint_pos)))
    links = [kinematics.link_index(n) for n in kinematics.LINK_NAMES if "hand" not in n]
    if isaac:
        links = [links[0]] + [links[1 + j] for j in CANONICAL_TO_MUJOCO]
    return {
        "fps": np.array([50]),
        "joint_pos": clip.joint_pos[:, list(CANONICAL_TO_MUJOCO)] if isaac else clip.joint_pos,
        "joint_vel": np.zeros((len(clip.joint_pos), 29)),
        "body_pos_w": poses.position[:, links].numpy().astype(np.float32),
        "body_quat_w": poses.quat[:, links].numpy().astype(np.float32),
    }


def write_csv(path: Path, clip: Clip, order: str, joints: np.ndarray | None = None, header: str = "") -> Path:
    quat = clip.root_quat if order == "wxyz" else clip.root_quat[:, [1, 2, 3, 0]]
    table = np.concatenate([clip.root_pos, quat, clip.joint_pos if joints is None else joints], axis=1)
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    return path


def same(got: Clip, wanted: Clip, atol: float = 1e-6) -> None:
    assert got.fps == wanted.fps
    np.testing.assert_allclose(got.root_pos, wanted.root_pos, atol=atol)
    np.testing.assert_allclose(np.abs((got.root_quat * wanted.root_quat).sum(axis=1)), 1.0, atol=1e-6)
    np.testing.assert_allclose(got.joint_pos, wanted.joint_pos, atol=atol)


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_table(tmp_path, order):
    """Tables are read with either order of quaternions, found by itself or stated, with or without column names."""
    wanted = motion()
    path = write_csv(tmp_path / "a.csv", wanted, order)
    reading = read_file(path, ReadOptions(fps=FPS))
    same(reading.clips[0], wanted)
    assert f"quaternions {order}" in reading.report.line() and reading.names == ("a",)
    assert read_file(path).clips[0].fps == 30.0
    named = write_csv(tmp_path / "b.csv", wanted, order, header="x,y,z" + ",q" * 33)
    same(read_file(named, ReadOptions(fps=FPS, quat_order=order)).clips[0], wanted)


def test_table_23(tmp_path):
    """A table of 23 joints gets wrists at zero and says so."""
    wanted = motion()
    path = write_csv(tmp_path / "a.csv", wanted, "wxyz", wanted.joint_pos[:, JOINTS_23])
    reading = read_file(path, ReadOptions(fps=FPS))
    got = reading.clips[0].joint_pos
    np.testing.assert_allclose(got[:, JOINTS_23], wanted.joint_pos[:, JOINTS_23])
    assert not got[:, [19, 20, 21, 26, 27, 28]].any() and "wrists at zero" in reading.report.line()


def test_unclear_quaternions(tmp_path):
    """A robot that faces -x all the time is upright in both orders: the user is asked."""
    clip = motion()
    clip.root_quat[:] = [0.0, 0.0, 0.0, 1.0]
    with pytest.raises(InputError, match="--quat-order"):
        read_file(write_csv(tmp_path / "a.csv", clip, "wxyz"))


@pytest.mark.parametrize("isaac", [True, False])
def test_beyond_mimic(tmp_path, isaac):
    """BeyondMimic's NPZ is read whether its joints stand in Isaac Lab's order or in MuJoCo's."""
    wanted = motion()
    np.savez(tmp_path / "a.npz", **beyond_mimic(wanted, isaac))
    reading = read_file(tmp_path / "a.npz")
    same(reading.clips[0], wanted)
    assert ("Isaac" if isaac else "MuJoCo") in reading.report.line()
    other = read_file(tmp_path / "a.npz", ReadOptions(joint_order="mujoco" if isaac else "isaac"))
    assert np.abs(other.clips[0].joint_pos - wanted.joint_pos).max() > 0.1


def test_pickles(tmp_path):
    """GMR's and ASAP's fields, xyzw quaternions and 23 joints; several clips of a file keep their names."""
    wanted = motion()
    xyzw = wanted.root_quat[:, [1, 2, 3, 0]]
    gmr = {"fps": FPS, "root_pos": wanted.root_pos, "root_rot": xyzw, "dof_pos": wanted.joint_pos}
    asap = {"fps": 50, "root_trans_offset": wanted.root_pos, "root_rot": xyzw, "dof": wanted.joint_pos[:, JOINTS_23]}
    for name, content in (("gmr", gmr), ("one", {"x": asap}), ("two", {"kick": asap, "walk": asap})):
        (tmp_path / f"{name}.pkl").write_bytes(pickle.dumps(content))
    same(read_file(tmp_path / "gmr.pkl").clips[0], wanted)
    assert read_file(tmp_path / "one.pkl").names == ("one",)
    two = read_file(tmp_path / "two.pkl")
    assert two.names == ("kick", "walk") and "23 joints" in two.report.line()


def test_actions(tmp_path):
    """A file of canonical actions becomes the motion that they integrate to, hands included."""
    wanted = motion()
    arrays = [torch.from_numpy(x) for x in (wanted.root_pos, wanted.root_quat, wanted.joint_pos)]
    closed = torch.zeros(len(wanted.root_pos), 2)
    closed[40:, 1] = 1.0
    np.savez(tmp_path / "a.npz", action=frames.motion_actions(*arrays, closed).numpy())
    got = read_file(tmp_path / "a.npz").clips[0]
    np.testing.assert_allclose(got.joint_pos, wanted.joint_pos, atol=1e-6)
    np.testing.assert_array_equal(got.hands, closed.numpy())
    length = np.linalg.norm(np.diff(got.root_pos, axis=0), axis=1).sum()
    assert length == pytest.approx(np.linalg.norm(np.diff(wanted.root_pos, axis=0), axis=1).sum(), abs=1e-4)


def test_read_library(tmp_path):
    """Files and libraries become one: names stay apart, libraries keep licence and source, jumps are reported."""
    clip = motion()
    (tmp_path / "b").mkdir()
    for path in (tmp_path / "a.csv", tmp_path / "b" / "a.csv"):
        write_csv(path, clip, "wxyz")
    clip.root_pos[:2, 2] = 1.9
    write_csv(tmp_path / "jump.csv", clip, "wxyz")
    first, _ = read_library([tmp_path / "a.csv"], ReadOptions(fps=FPS), licence="MIT", source="site", family="walk")
    first.save(tmp_path / "first.npz")
    files = [tmp_path / "first.npz", tmp_path / "b" / "a.csv", tmp_path / "jump.csv"]
    library, reports = read_library(files, ReadOptions(fps=FPS), licence="Apache-2.0", source="elsewhere")
    assert library.clip_names.tolist() == ["a", "a-2", "jump"]
    assert library.licence.tolist() == ["MIT", "Apache-2.0", "Apache-2.0"]
    assert library.source.tolist() == ["site: a.csv", "elsewhere: a.csv", "elsewhere: jump.csv"]
    assert library.family_names.tolist() == ["walk", "clips"]
    assert [report.trimmed for report in reports] == [0, 0, 2] and "2 frames of a jump" in reports[2].line()
    assert library.clip_length.tolist() == [80, 80, 78]


def test_defects(tmp_path):
    """Every defect is one line that names the file."""
    clip = motion(5)
    good = beyond_mimic(clip, True)
    (tmp_path / "words.csv").write_text("a,b\nc,d\n")
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "holes.csv").write_text(("1," * 35 + "1\n") * 3 + "1," * 35 + "\n")
    (tmp_path / "nan.csv").write_text(("0," * 35 + "1\n") * 3 + "nan," * 35 + "1\n")
    (tmp_path / "clip.bvh").write_text("HIERARCHY")
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "strange.npz", a=np.zeros(3))
    np.savez(tmp_path / "few.npz", **{k: v for k, v in good.items() if k != "fps"})
    np.savez(tmp_path / "thin.npz", **good | {"joint_pos": np.zeros((5, 28))})
    np.savez(tmp_path / "short.npz", **good | {"body_quat_w": good["body_quat_w"][:4]})
    np.savez(tmp_path / "objects.npz", **good | {"fps": np.array([{}], dtype=object)})
    for name, text in {
        "words.csv": "has 2 columns, expected 36",
        "empty.csv": "holds no frame",
        "holes.csv": "line 4 does not hold 36 numbers",
        "nan.csv": "line 4 holds NaN",
        "clip.bvh": "expected .pkl, .csv or .npz",
        "text.npz": "not a readable NPZ",
        "strange.npz": "no known motion file",
        "few.npz": "array fps is missing",
        "thin.npz": r"joint_pos has shape \[5, 28\]",
        "short.npz": r"body_quat_w has shape \[4, 30, 4\]",
        "objects.npz": "not a readable NPZ",
        "none.npz": "no such file",
    }.items():
        with pytest.raises(InputError, match=text) as caught:
            read_file(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)


def standing(height: float, ticks: int = 40) -> MotionLibrary:
    from arena_newton.robot.g1 import DEFAULT_POSE

    pos = np.tile([0.0, 0.0, kinematics.neutral_stance().height + height], (ticks, 1))
    quat, joints = np.tile([1.0, 0, 0, 0], (ticks, 1)), np.tile(DEFAULT_POSE, (ticks, 1))
    return MotionLibrary.from_clips([Clip(50.0, pos, quat, joints)], [f"at {height}"])


def test_measures():
    """Floating clips, joints beyond their range, jumps and sliding soles are found and measured."""
    library = MotionLibrary.concatenate([standing(0.0), standing(0.05), standing(0.0), standing(0.0)])
    library.joint_pos[library.rows(1), 3] = 3.0
    library.root_pos[library.rows(2).start + 20 : library.rows(2).stop, 0] += 0.3
    library.root_pos[library.rows(3), 1] = np.arange(40) * 0.02 * 0.1
    plain, floating, jumping, sliding = measure.measure_clips(library)
    assert plain.beyond_limits == 0.0 and plain.jumps == 0 and plain.slip == pytest.approx(0.0, abs=1e-4)
    assert plain.floor == pytest.approx(0.0, abs=1e-4)
    assert floating.beyond_limits == pytest.approx(3.0 - 2.8798, abs=1e-4)
    assert floating.beyond_limits_joint == "left_knee_joint"
    assert jumping.jumps == 1 and sliding.slip == pytest.approx(0.1, abs=1e-3) and sliding.speed > 0.09
    level, shift = measure.grounded(MotionLibrary.concatenate([standing(0.0), standing(0.05)]))
    np.testing.assert_allclose(shift, [0.0, -0.05], atol=1e-4)
    assert measure.measure_clips(level)[1].floor == pytest.approx(0.0, abs=1e-4)


def test_supports_keep_their_height():
    """A clip on a seat is not shifted: the seat's height is part of it."""
    library = standing(0.05)
    library.support_kind[:] = 1
    assert measure.grounded(library)[1].tolist() == [0.0]


def test_real_files(shared):
    """The clips of five projects are read; GMT's own body positions agree with the joints as they were padded."""
    from arena_newton.trackers.motions.load import load_plain_pickle

    files = sorted((shared / "reference" / "motions").iterdir())
    library, reports = read_library(files, licence="MIT", source="test")
    assert library.clips == len(files) and {r.kind for r in reports} >= {"ASAP pickle", "table", "TWIST2/GMR pickle"}
    assert all(m.jumps == 0 and m.beyond_limits == 0.0 and m.lowest > 0.4 for m in measure.measure_clips(library))
    path = shared / "reference" / "motions" / "gmt_walk_stand.pkl"
    raw, clip = load_plain_pickle(path), read_file(path).clips[0]
    still = torch.zeros(len(clip.joint_pos), 3, dtype=torch.float64)
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(len(still), 4)
    links = kinematics.forward(still, upright, torch.from_numpy(clip.joint_pos)).position.numpy()
    for i, name in enumerate(raw["link_body_list"]):
        if name in kinematics.LINK_NAMES:
            np.testing.assert_allclose(links[:, kinematics.link_index(name)], raw["local_body_pos"][:, i], atol=1e-3)
