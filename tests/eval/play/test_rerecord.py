"""`record --from`: more cameras for recorded episodes, whose motion is the recorded one bit for bit."""

import hashlib
import json
import shutil

import av
import numpy as np
import pytest

from arena_newton.data.recording.episode import EpisodeFile, episode_files, write_episode
from arena_newton.data.recording.source_videos import source_looks
from arena_newton.eval.__main__ import main

CPU = ["--engine", "mujoco", "--device", "cpu"]


@pytest.fixture(scope="module")
def bare(tmp_path_factory, parts):
    """Two disturbed episodes of boxing without pictures, recorded in two worlds."""
    folder = tmp_path_factory.mktemp("bare") / "source"
    command = ["record", "--task", "boxing", *CPU, "--episodes", "2", "--cameras", "--worlds", "2"]
    assert main([*command, "--out", str(folder)], parts) == 0
    return folder


@pytest.fixture(scope="module")
def filmed(bare, tmp_path_factory, parts):
    """The same with pictures of two cameras, depth and looks, played in one world."""
    folder = tmp_path_factory.mktemp("filmed") / "out"
    cameras = ["--cameras", "front", "world", "--size", "64x48", "--depth", "--looks", "2", "--worlds", "1"]
    assert main(["record", "--from", str(bare), *cameras, "--out", str(folder)], parts) == 0
    return folder


def digest(folder):
    """Names and bytes of a folder's files."""
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}


def changed(bare, folder, **arrays):
    """A folder with the first recorded episode, some of its arrays changed."""
    (folder / "episodes").mkdir(parents=True)
    source = EpisodeFile(episode_files([bare])[0])
    write_episode(folder / "episodes" / source.path.name, source.copy_of(arrays))
    return folder


def test_cameras_are_added_and_nothing_else_changes(bare, filmed):
    """Each old array stays as it was, the new cameras have a frame per row, and the depth is in metres."""
    sources, files = (list(map(EpisodeFile, episode_files([folder]))) for folder in (bare, filmed))
    assert [file.stem for file in files] == [file.stem for file in sources] and len(files) == 2
    for source, file in zip(sources, files, strict=True):
        assert not source.cameras and file.cameras == ("front", "world")
        assert all(np.array_equal(source.array(name), file.array(name)) for name in source.names)
        for camera in file.cameras:
            with av.open(str(file.video(camera))) as video:
                assert sum(1 for _ in video.decode(video=0)) == file.rows
        depth = file.array("vision_world_depth")
        assert depth.dtype == np.float16 and depth.shape == (file.rows, 48, 64)
        assert 0.5 < np.median(depth) < 20 and np.isfinite(depth).all()
        assert bool(file.array("rerecord_any_success")) and float(file.array("rerecord_final_reward")) == 1.0
        assert len(source_looks(file)[0].lights) == 2


def test_a_second_camera_joins_the_first_and_the_source_stays(filmed, tmp_path, capsys, parts):
    """Episodes with pictures get more: their videos are copied byte for byte, and no bit of the source changes."""
    before = digest(filmed)
    command = ["record", "--from", str(filmed), "--cameras", "left_wrist", "--size", "64x48", "--out", str(tmp_path)]
    assert main(command, parts) == 0
    assert digest(filmed) == before
    old, new = (EpisodeFile(episode_files([folder])[0]) for folder in (filmed, tmp_path))
    assert new.cameras == ("front", "left_wrist", "world")
    assert new.video("front").read_bytes() == old.video("front").read_bytes()
    assert new.looks("front")[0] == old.looks("front")[0] and source_looks(new) is not None
    assert "largest deviation of a position from the recording: 0\n" in capsys.readouterr().out
    written = digest(tmp_path)
    assert main(command, parts) == 0  # what is there is not played again
    assert "0 to play again" in capsys.readouterr().out and digest(tmp_path) == written


def test_another_motion_is_an_error_that_names_the_tick(bare, tmp_path, capsys, parts):
    """A changed action makes another motion: exit code 1 with the first tick at which a position differs."""
    source = EpisodeFile(episode_files([bare])[0])
    actions = source.array("arena_executed_action").copy()
    actions[4, 9] += 0.3
    folder = changed(bare, tmp_path / "changed", arena_executed_action=actions)
    out = tmp_path / "out"
    assert main(["record", "--from", str(folder), "--size", "64x48", "--out", str(out)], parts) == 1
    said = capsys.readouterr().err
    assert "arena_qpos: at tick 5 " in said and source.stem in said
    assert not list(out.rglob("*.npz")) and not list(out.rglob("*.part")) and not list(out.rglob("*.mp4"))


@pytest.mark.parametrize("key", ["code", "checkpoint", "rules_hash", "scenes"])
def test_other_code_weights_rules_or_scene_are_refused(bare, tmp_path, capsys, key):
    """A recording that was made with something else is not played under a wrong name."""
    facts = EpisodeFile(episode_files([bare])[0]).json("arena_configuration") | {key: "0123456789ab"}
    folder = changed(bare, tmp_path / "other", arena_configuration=np.array(json.dumps(facts)))
    assert main(["record", "--from", str(folder), "--size", "64x48", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert f"was recorded with {key} 0123456789ab" in said and "--accept-differences" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "flags, says",
    [
        ([], "--out"),
        (["--task", "boxing"], "--task"),
        (["--no-disturb"], "--disturb"),
        (["--cameras"], "--cameras"),
        (["--only-success"], "--only-success"),
    ],
)
def test_what_a_recording_fixes_is_no_flag(bare, tmp_path, capsys, flags, says):
    """Flags that the recording decides, and a missing --out, are refused by name."""
    out = [] if says == "--out" else ["--out", str(tmp_path / "out")]
    assert main(["record", "--from", str(bare), *flags, *out]) == 2
    assert says in capsys.readouterr().err


def test_the_source_is_no_target(bare, tmp_path, capsys):
    """Neither the source nor a folder of something else is written into."""
    (tmp_path / "notes.txt").write_text("mine")
    for out in (bare, bare.parent, tmp_path):
        assert main(["record", "--from", str(bare), "--out", str(out)]) == 2
        assert "--out" in capsys.readouterr().err


def test_a_damaged_episode_is_named(bare, tmp_path, capsys):
    """A cut file is one error with its name."""
    folder = shutil.copytree(bare, tmp_path / "damaged")
    file = episode_files([folder])[1]
    file.write_bytes(file.read_bytes()[:1000])
    assert main(["record", "--from", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert file.name in capsys.readouterr().err
