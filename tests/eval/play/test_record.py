"""Recording as a sink of evaluation: what is written, that it survives kills and full disks, and its bytes."""

import errno
import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import av
import numpy as np
import pytest

from arena_newton import policies
from arena_newton.data.recording import demonstration, encoder_pool
from arena_newton.data.recording.episode import EpisodeFile, episode_files
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.play import recording
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.records.journal import read_journal
from arena_newton.pictures.camera import Camera
from arena_newton.pictures.settings import CameraConfig
from tests.children import Child
from tests.patience import wait_for

SMALL = ["--task", "boxing", "--size", "64x64", "--engine", "mujoco", "--device", "cpu"]
COUNT = 3
BRIEF = [*SMALL, "--policy", "stand", "--episodes", str(COUNT)]
"""Episodes in worlds where each soon succeeds: what counts is what happens to their files."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, kept_worlds):
    """A whole disturbed episode of boxing."""
    folder = tmp_path_factory.mktemp("recorded") / "whole"
    assert main(["record", *SMALL, "--episodes", "1", "--out", str(folder)], Factories(env=kept_worlds)) == 0
    return folder


@pytest.fixture(scope="module")
def brief(tmp_path_factory, parts):
    """Three brief episodes, recorded in three worlds without interruption."""
    folder = tmp_path_factory.mktemp("brief") / "whole"
    assert main(["record", *BRIEF, "--worlds", "3", "--out", str(folder)], parts) == 0
    return folder


@pytest.fixture
def copied(brief, tmp_path):
    """A copy of the brief episodes that a test may damage."""
    return shutil.copytree(brief, tmp_path / "copy")


def contents(folder):
    """Bytes of all episode files by name."""
    found = {path.relative_to(folder).as_posix(): path for path in sorted((folder / "episodes").rglob("*"))}
    return {name: path.read_bytes() for name, path in found.items() if path.is_file()}


def same(folder, other):
    """Asserts that two folders hold the same episodes, byte for byte; the names that differ are shown."""
    mine, others = contents(folder), contents(other)
    assert sorted(mine) == sorted(others)
    assert [name for name in mine if mine[name] != others[name]] == []


def test_every_row_has_its_frame_and_the_label_is_clean(recorded):
    """Frames equal rows, the executed action has noise that the stored one lacks, and the seed is a demonstration's."""
    (file,) = map(EpisodeFile, episode_files([recorded]))
    with av.open(str(file.video("front"))) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(pictures) == file.rows == file.integer("vision_rgb_video_num_frames")
    assert pictures[0].shape == (64, 64, 3) and not pictures[0][:7].max() > 40  # black bars of a square
    histogram = file.array("arena_vision_histogram", 3, 256)
    mean = (histogram * np.arange(256)).sum(axis=1) / histogram.sum(axis=1)
    assert np.allclose(np.mean(pictures, axis=(0, 1, 2)), mean, atol=3)
    noise = file.array("arena_executed_action") - file.action
    assert not noise[0].any() and (noise[:, 9:38].std(axis=0) > 0.01).all() and not noise[:, 38:].any()
    assert file.text("arena_seed_range") == "demonstration" and file.integer("arena_episode_seed") >> 31 == 1
    assert set(file.phases) >= {"approach", "go round", "step up"}


def test_an_episodes_facts_name_no_folder_time_or_number_of_worlds(recorded):
    """The configuration in a file holds hashes of what moved, the noise and the versions, and nothing of the call."""
    text = EpisodeFile(episode_files([recorded])[0]).text("arena_configuration")
    facts = json.loads(text)
    assert all(facts[key] for key in ("code", "checkpoint", "rules_hash", "scenes", "versions", "tracker_facts"))
    assert facts["disturbance"]["velocity"] == 0.16 and facts["worlds"] is None and facts["versions"]["av"]
    assert str(recorded) not in text and "started_at" not in text


def test_the_journal_names_the_files(brief):
    """An episode's line names its NPZ and its videos, below the folder."""
    records, _ = read_journal(brief / "episodes.jsonl")
    assert len(records) == COUNT
    for record in records:
        assert set(record.media) == {"episode", "front"}
        assert all((brief / path).is_file() for path in record.media.values())


def test_bytes_do_not_depend_on_worlds(brief, tmp_path, parts):
    """One world after the other writes the same bytes as three at once."""
    other = tmp_path / "one"
    assert main(["record", *BRIEF, "--worlds", "1", "--out", str(other)], parts) == 0
    same(brief, other)


def test_bytes_do_not_depend_on_who_encodes(brief, tmp_path, parts, monkeypatch):
    """Processes write the same bytes as threads."""
    monkeypatch.setattr(recording, "encoding_processes", lambda: 2)
    other = tmp_path / "processes"
    assert main(["record", *BRIEF, "--worlds", "2", "--out", str(other)], parts) == 0
    same(brief, other)


def test_a_killed_encoder_stops_the_run(brief, tmp_path, parts, monkeypatch, capsys):
    """Kill -9 of a process that encodes is one error, exit code not 0, without partial files; resumed, all is there."""
    folder, started, frames = tmp_path / "killed", [], []
    popen, add = subprocess.Popen, encoder_pool.EncoderPool.add

    def start(*command, **options):
        started.append(popen(*command, **options))
        return started[-1]

    def kill(self, *pictures):
        add(self, *pictures)
        frames.append(1)
        if len(frames) == 10:
            started[0].kill()

    monkeypatch.setattr(recording, "encoding_processes", lambda: 2)
    monkeypatch.setattr(encoder_pool.subprocess, "Popen", start)
    monkeypatch.setattr(encoder_pool.EncoderPool, "add", kill)
    assert main(["record", *BRIEF, "--worlds", "3", "--out", str(folder)], parts) != 0
    said = capsys.readouterr().err
    assert "a process that encodes pictures ended (SIGKILL; out of memory?)" in said and "Traceback" not in said
    assert len(started) == 2 and not list(folder.rglob("*.part"))
    monkeypatch.undo()
    assert main(["resume", str(folder)], parts) == 0
    same(brief, folder)


def test_kills_lose_at_most_what_was_running(brief, tmp_path, parts):
    """Killed while it writes and resumed by another process, a recording has the bytes of a whole one."""
    folder = tmp_path / "killed"
    run = Child("quick_worlds", ["record", *BRIEF, "--worlds", "2", "--out", str(folder)])
    wait_for(lambda: list(folder.glob("episodes/**/*.part")) or run.poll() is not None, "partial file", 400.0)
    run.kill()
    assert run.wait() == -signal.SIGKILL, run.printed()
    records, _ = read_journal(folder / "episodes.jsonl")
    for record in records:  # whatever is journalled is whole
        assert EpisodeFile(folder / record.media["episode"]).rows == record.steps
    assert main(["resume", str(folder)], parts) == 0
    same(brief, folder)
    assert not list(folder.rglob("*.part"))


@pytest.mark.parametrize("processes", [0, 2])
def test_ctrl_c_leaves_nothing_behind(brief, tmp_path, parts, monkeypatch, capsys, processes):
    """Ctrl-C while pictures are encoded: code 130, no process or partial file stays; resumed, the bytes are equal."""
    folder, started, rendered = tmp_path / "interrupted", [], []
    popen, render = subprocess.Popen, Camera.render

    def start(*command, **options):
        started.append(popen(*command, **options))
        return started[-1]

    def interrupt(self, *pictures):
        rendered.append(1)
        if len(rendered) == 12:
            while not list(folder.glob("episodes/**/*.part")):
                time.sleep(0.01)
            signal.raise_signal(signal.SIGINT)
        return render(self, *pictures)

    monkeypatch.setattr(recording, "encoding_processes", lambda: processes)
    monkeypatch.setattr(encoder_pool.subprocess, "Popen", start)
    monkeypatch.setattr(Camera, "render", interrupt)
    assert main(["record", *BRIEF, "--worlds", "2", "--out", str(folder)], parts) == 130
    said = capsys.readouterr()
    assert "resume" in said.out + said.err and "Traceback" not in said.err
    assert len(started) == processes and not any(Path(f"/proc/{child.pid}").exists() for child in started)
    assert not list(folder.rglob("*.part"))
    assert len(read_journal(folder / "episodes.jsonl")[0]) < COUNT
    monkeypatch.undo()
    assert main(["resume", str(folder)], parts) == 0
    same(brief, folder)


def test_missing_and_torn_files_are_recorded_again(brief, copied, parts, capsys):
    """A removed video, a cut NPZ and another video: those episodes are played again, with the same bytes."""
    files = episode_files([copied])
    files[0].write_bytes(files[0].read_bytes()[:-100])
    EpisodeFile(files[1]).video("front").unlink()
    other = EpisodeFile(episode_files([brief])[0]).video("front")
    shutil.copyfile(other, EpisodeFile(files[2]).video("front"))
    lines = (copied / "episodes.jsonl").read_bytes()
    assert main(["resume", str(copied)], parts) == 0
    assert "of 3 episodes the recording is missing" in capsys.readouterr().err
    same(brief, copied)
    assert (copied / "episodes.jsonl").read_bytes().startswith(lines)  # the journal only grows
    assert len(load_run(copied).records) == COUNT


def test_a_full_disk_loses_no_finished_episode(brief, tmp_path, parts, monkeypatch, capsys):
    """A file that cannot be written stops the run by its name, exit code 2; resumed, the bytes are those of a whole."""
    folder, written = tmp_path / "full", []
    write = demonstration.write_episode

    def full(path, arrays, **options):
        written.append(path.name)
        if len(written) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write(path, arrays, **options)

    monkeypatch.setattr(demonstration, "write_episode", full)
    assert main(["record", *BRIEF, "--worlds", "3", "--out", str(folder)], parts) == 2
    said = capsys.readouterr().err
    assert "disk full" in said and written[1] in said and "resume" in said
    records, _ = read_journal(folder / "episodes.jsonl")
    done = {record.media["episode"].split("/")[1] for record in records}
    assert written[0] in done and written[1] not in done
    assert not (folder / "episodes" / written[1]).exists() and not list(folder.rglob("*.part"))
    monkeypatch.undo()
    assert main(["resume", str(folder)], parts) == 0
    same(brief, folder)


def test_only_successes_are_kept_in_rounds(brief, tmp_path, parts, capsys):
    """Under a cap that the slowest episode misses, another attempt is made; what failed is counted, and has no file."""
    steps = {r.repeat: r.steps for r in load_run(brief).records if r.repeat < 2}
    slowest = max(steps, key=steps.get)
    cap = steps[slowest] - 1
    folder = tmp_path / "successes"
    flags = ["--episodes", "2", "--only-success", "--max-steps", str(cap), "--cameras", "--worlds", "2"]
    code = main(["record", *SMALL[:2], *SMALL[4:], *flags, "--out", str(folder)], parts)
    records = load_run(folder).records
    kept = [r for r in records if r.outcome == "success"]
    assert slowest not in {r.repeat for r in kept} and len(records) > 2
    assert {r.repeat for r in records} == set(range(len(records)))
    assert len(episode_files([folder])) == len(kept) <= 2 and code == (0 if len(kept) == 2 else 1)
    assert all("episode" not in r.media for r in records if r.outcome != "success")
    said = capsys.readouterr().out
    assert f"recorded: {len(kept)} episode" in said and f"{len(records) - len(kept)} timeout" in said
    assert json.loads((folder / "results.json").read_text())["complete"] is True


@pytest.mark.parametrize("names", [("front",), ("left_wrist", "front", "right_wrist")])
def test_a_picture_for_a_policy_is_rendered_once(brief, tmp_path, parts, monkeypatch, names):
    """If the policy asks for the recorded pictures, recording renders none besides, and the videos are the same."""
    renders, seen = [], []
    render = Camera.render
    monkeypatch.setattr(Camera, "render", lambda self, *a: renders.append(1) or render(self, *a))

    def seeing(spec, **options):
        policy = policies.get(spec, **options)
        if len(names) == 1:
            policy.needs_image, policy.camera = True, CameraConfig(width=64, height=64)
        else:
            policy.cameras = dict.fromkeys(names, CameraConfig(width=64, height=64))
            policy.cameras["world"] = CameraConfig(width=40, height=32, depth=True)
        act = policy.act
        policy.act = lambda observation: seen.append(observation) or act(observation)
        return policy

    command = ["record", *BRIEF, "--episodes", "1", "--cameras", *names]
    assert main([*command, "--out", str(tmp_path / "seen")], Factories(env=parts.env, policy=seeing)) == 0
    (record,) = load_run(tmp_path / "seen").records
    assert len(renders) <= (record.steps + 1) * len(seen[0].images)
    other = brief
    if len(names) > 1:
        other = tmp_path / "unseen"
        assert main([*command, "--out", str(other)], parts) == 0
        assert [*seen[0].images] == [*names, "world"] and seen[0].image is seen[0].images["front"]
        assert [*seen[0].depths] == ["world"] and seen[0].depths["world"].shape == (1, 32, 40)
        assert 0.5 < float(seen[0].depths["world"].max()) < 50.0
    films = [[(folder / record.media[name]).read_bytes() for name in names] for folder in (tmp_path / "seen", other)]
    assert films[0] == films[1] and len(set(films[0])) == len(names)


@pytest.mark.parametrize("name", ["episodes", "episodes/videos"])
def test_links_are_not_followed(copied, tmp_path, capsys, name):
    """A linked folder of episodes is refused."""
    (copied / name).rename(tmp_path / "elsewhere")
    (copied / name).symlink_to(tmp_path / "elsewhere")
    assert main(["resume", str(copied)]) == 2
    assert "is a link" in capsys.readouterr().err


def test_a_folder_keeps_its_pictures(brief, capsys):
    """Another size in the same folder is refused."""
    assert main(["record", *BRIEF, "--size", "96x96", "--out", str(brief)]) == 2
    assert "was begun with --record-size 64x64" in capsys.readouterr().err
