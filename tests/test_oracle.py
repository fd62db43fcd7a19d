"""The official tracker drives our G1 as it drives its own MJCF in plain MuJoCo."""

import dataclasses
import json

import numpy as np
import pytest

from arena_newton.errors import InputError
from arena_newton.robot import g1
from arena_newton.robot.canonical import STAND_ACTION
from tests import oracle

CLIPS = ("0807_yanjie_walk_002", "0807_yanjie_walk_003")
TOLERANCE = 0.15


@pytest.fixture(scope="module")
def files(shared):
    """Checkpoint, MJCF, clips."""
    reference = shared / "reference"
    checkpoint = reference / "twist2" / "twist2_1017_20k.onnx"
    mjcf = reference / "g1" / "g1_sim2sim_29dof.xml"
    clips = [reference / "twist2" / "example_motions" / f"{name}.pkl" for name in CLIPS]
    for path in (checkpoint, mjcf, *clips):
        if not path.is_file():
            pytest.skip(f"needs {path}, which is not here")
    return checkpoint, mjcf, clips


@pytest.fixture(scope="module")
def rows(files):
    """The five references on both sides, 5 ms physics, 8 s of each clip."""
    checkpoint, mjcf, clips = files
    return oracle.compare(checkpoint, mjcf, clips, fast=True, clip_seconds=8.0)


def test_official_tracker_drives_both_models_alike(rows):
    """Falls are equal and the joint error agrees within 15 % on all five references."""
    assert len(rows) == 5
    for row in rows:
        assert row.falls_equal, f"{row.reference}: one side fell\n{oracle.row_table(rows)}"
        assert abs(row.ratio - 1.0) <= TOLERANCE, f"{row.reference}\n{oracle.row_table(rows)}"


def test_references_are_followed(rows):
    """Nobody falls, standing and squat stay in place, and the walk ends within 0.4 m of its 2.3 m on both sides."""
    for row in rows:
        assert row.fell_ours is None and row.fell_oracle is None
        assert 0.01 < row.error_oracle < 0.1  # measured: .042 standing, .053 on these clips
    stand, walk, squat = rows[:3]
    assert max(stand.drift_ours, stand.drift_oracle, squat.drift_ours, squat.drift_oracle) < 0.1
    assert max(walk.drift_ours, walk.drift_oracle) < 0.4


def test_official_model_keeps_its_masses_and_takes_our_gains(files):
    """Without meshes the MJCF still weighs 33.342 kg and is driven by the TWIST2 gains."""
    model = oracle.load_official(files[1])
    assert model.body_mass.sum() == pytest.approx(33.342, abs=1e-3)
    joint = [model.joint(name).id for name in g1.MUJOCO_JOINTS]
    drives = [int(np.flatnonzero(model.actuator_trnid[:, 0] == j)[0]) for j in joint]
    np.testing.assert_allclose(model.actuator_gainprm[drives, 0], g1.TWIST2_DRIVE.kp)
    np.testing.assert_allclose(-model.actuator_biasprm[drives, 2], g1.TWIST2_DRIVE.kd)
    assert model.opt.timestep == 0.005


def test_squat_and_walk_stay_within_joint_limits(files):
    """The generated references reach their heights, respect the joint ranges and do not jump."""
    model = oracle.load_official(files[1])
    limits = np.array([model.joint(name).range for name in g1.CANONICAL_JOINTS])
    _, walk, squat = oracle.action_streams()
    assert squat.actions[:, 2].min() == pytest.approx(0.45, abs=1e-4)
    assert walk.actions[:, 2].min() > 0.7
    for stream in (walk, squat):
        joints = stream.actions[:, 9:38]
        assert (joints >= limits[:, 0] - 1e-5).all() and (joints <= limits[:, 1] + 1e-5).all()
        assert np.abs(np.diff(joints, axis=0)).max() < 0.15


def test_own_conversion_integrates_a_turning_walk():
    """The oracle's own conversion: a quarter turn at constant forward speed ends where the circle says."""
    ticks, forward = 500, 0.01
    quat = np.array([np.cos(0.4), 0.0, 0.0, np.sin(0.4)])
    command = oracle.MimicCommand(np.array([1.0, 2.0, 0.8]), quat)
    turn = 0.5 * np.pi / ticks
    for i in range(1, ticks + 1):
        c, s = np.cos(turn * i), np.sin(turn * i)
        action = np.zeros(40)
        action[:9] = forward, 0.0, 0.8, c, -s, s, c, 0.0, 0.0
        mimic = command.advance(action)
    assert mimic[0] == pytest.approx(forward / g1.TICK)
    assert mimic[5] == pytest.approx(turn / g1.TICK)
    radius = forward / turn
    c, s = np.cos(0.8), np.sin(0.8)
    end = np.array([1.0, 2.0]) + np.array([[c, -s], [s, c]]) @ [radius, radius]
    np.testing.assert_allclose(command.position[:2], end, atol=0.02)


def test_fall_ends_the_measure():
    """A robot that lies down counts as fallen at that tick, and only the time before it enters the errors."""
    stream = oracle.ActionStream("short", np.tile(STAND_ACTION, (10, 1)))
    wanted = np.tile(np.array(g1.DEFAULT_POSE), (10, 1))
    position, quat = np.tile([0.0, 0.0, 0.8], (10, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (10, 1))
    track = oracle.Track(wanted + 0.1, position.copy(), quat.copy(), position, quat)
    fell, error, legs, drift, yaw = oracle.measure_track(stream, track)
    assert fell is None
    assert (error, legs, drift, yaw) == pytest.approx((0.1, 0.1, 0.0, 0.0), abs=1e-6)
    track.quat[4:] = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]
    track.joints[5:] = 9.0
    fell, error, *_ = oracle.measure_track(stream, track)
    assert fell == pytest.approx(0.1)
    assert error == pytest.approx(0.1, abs=1e-6)


def test_table_and_json_name_every_reference():
    """The Markdown table and the rows of `--json` hold every measure."""
    row = oracle.Row("stand 8 s", 8.0, None, 3.0, 0.04, 0.05, 0.06, 0.07, 0.1, 0.2, 1.0, -2.0)
    text = oracle.row_table([row])
    assert "stand 8 s" in text and "no / 3.0 s" in text and "0.800" in text
    assert not row.falls_equal
    assert json.loads(json.dumps(dataclasses.asdict(row)))["fell_oracle"] == 3.0


def test_absent_file_is_bad_input(tmp_path, capsys):
    """A missing MJCF is named in one line with exit code 2."""
    missing = tmp_path / "none.xml"
    with pytest.raises(InputError, match="none.xml"):
        oracle.load_official(missing)
    assert oracle.main(["--checkpoint", "x.onnx", "--mjcf", str(missing)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
