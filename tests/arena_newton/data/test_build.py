"""`data build`: LeRobot v3.0 datasets from recorded episodes."""

import gc
import hashlib
import importlib.metadata
import inspect
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pyarrow")

from lerobot.datasets import dataset_writer  # noqa: E402
from lerobot.datasets.aggregate import aggregate_datasets  # noqa: E402
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from lerobot.datasets.video_utils import StreamingVideoEncoder  # noqa: E402

import arena_newton  # noqa: E402
from arena_newton import trackers  # noqa: E402
from arena_newton.data.__main__ import main  # noqa: E402
from arena_newton.data.datasets import lerobot_dataset  # noqa: E402
from arena_newton.data.datasets.lerobot_dataset import FinishedVideos, choose, write_dataset  # noqa: E402
from arena_newton.data.readers.frame_reader import OpenVideo  # noqa: E402
from arena_newton.data.readers.label_protocols import encode_v4  # noqa: E402
from arena_newton.data.recording.demonstration import DemonstrationRecorder  # noqa: E402
from arena_newton.data.recording.episode import EpisodeFile, episode_files  # noqa: E402
from arena_newton.data.recording.layouts import LAYOUTS  # noqa: E402
from arena_newton.env import ArenaEnv  # noqa: E402
from arena_newton.errors import ArenaError, InputError  # noqa: E402
from arena_newton.pictures.settings import CameraConfig  # noqa: E402
from arena_newton.policies.stand import StandPolicy  # noqa: E402
from arena_newton.robot import g1  # noqa: E402
from arena_newton.rollout import Rollout  # noqa: E402
from arena_newton.rules import seeding  # noqa: E402
from tests.arena_newton.data import made_episodes  # noqa: E402
from tests.arena_newton.data.consistent import ROWS, consistent_episode  # noqa: E402

ROOT = Path(__file__).resolve().parents[3]


def content(folder):
    """Hash of every file by its name."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def written(recordings, out, layout="arena", labels="v3.1", **more):
    """A dataset of all recordings of a folder."""
    write_dataset(choose(episode_files([recordings])), out, kind=LAYOUTS[layout], labels=labels, **more)
    return out


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Three episodes of different lengths."""
    folder = tmp_path_factory.mktemp("recordings")
    for repeat in range(3):
        consistent_episode(folder, ROWS + 7 * repeat, repeat=repeat)
    return folder


@pytest.fixture(scope="module")
def dataset(recordings, tmp_path_factory):
    """They as a dataset."""
    return written(recordings, tmp_path_factory.mktemp("built") / "boxing")


def test_names_are_those_of_the_released_data(dataset):
    """Features, robot type and protocol are the original's, and its 40 and 64 names in their order."""
    info = json.loads((dataset / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["robot_type"], info["fps"]) == ("v3.0", "unitree_g1_refpose_v3_1", 50)
    state, action = info["features"]["observation.state"], info["features"]["action"]
    assert (state["dtype"], state["shape"], action["dtype"], action["shape"]) == ("float32", [64], "float32", [40])
    assert state["names"][:7] == [
        *(f"state.root_heading_canonical_rot6d.{i}" for i in range(6)),
        "state.dof_pos.left_hip_pitch_joint",
    ]
    assert state["names"][7] == "state.dof_pos.right_hip_pitch_joint" and state["names"][8].endswith("waist_yaw_joint")
    assert state["names"][-1] == "state.dof_vel.right_wrist_yaw_joint"
    assert action["names"][:4] == [
        "action.root_ref_base_local_xy_delta.x",
        "action.root_ref_base_local_xy_delta.y",
        "action.root_z",
        "action.root_ref_rot6d.0",
    ]
    assert action["names"][9:11] == [
        "action.joint_pos.left_hip_pitch_joint",
        "action.joint_pos.right_hip_pitch_joint",
    ]
    assert action["names"][-2:] == ["action.hand_binary.left", "action.hand_binary.right"]
    protocol = info["vla_protocol"]
    assert protocol == {
        "schema": "unitree_g1_gmt_refpose_v3_1",
        "version": "3.1",
        "action_dim": 40,
        "action_layout": "root_xy_delta_z_rot6d_joints29_hands2",
        "rotation_6d_layout": "row",
        "action_semantics": "reference_pose_not_robot_current_residual",
        "root_xy_delta_frame": "current_reference_base_frame",
        "root_rotation_frame": "episode_reference_frame",
        "fps": 50.0,
        "control_dt": 0.02,
        "dt_source": "system_control_frequency_or_metadata",
        "backend_source": "twist2",
        "twist2_reference_source": "decided_action",
        "sonic_reference_source": None,
    }
    assert info["arena"]["slots"]["action"]["root_rot6d"] == [3, 9]


def test_the_codec_is_told_as_it_was_used(dataset):
    """`info.json` names the options with which the recorder encoded, not LeRobot's defaults."""
    about = json.loads((dataset / "meta" / "info.json").read_text())["features"]["observation.images.front"]
    assert about["shape"] == [32, 32, 3] and about["dtype"] == "video"
    told = {name: about["info"][f"video.{name}"] for name in ("codec", "g", "crf", "preset", "extra_options")}
    assert told == {"codec": "h264", "g": 10, "crf": 20, "preset": "veryfast", "extra_options": {"bf": 0, "mbtree": 0}}


def test_where_episodes_come_from_is_stored(dataset, recordings):
    """Seeds, their range, trackers, versions and hashes of the recordings are in the dataset, in the plan's order."""
    arena = json.loads((dataset / "meta" / "info.json").read_text())["arena"]
    files = episode_files([recordings])
    assert [e["source"] for e in arena["episodes"]] == [file.stem for file in files]
    assert [e["sha256"] for e in arena["episodes"]] == [hashlib.sha256(f.read_bytes()).hexdigest() for f in files]
    assert [e["episode_seed"] for e in arena["episodes"]] == [
        EpisodeFile(file).integer("arena_episode_seed") for file in files
    ]
    assert arena["seed_ranges"] == ["demonstration"] and arena["trackers"] == ["twist2"]
    assert arena["versions"]["lerobot"] == lerobot_dataset.LEROBOT
    codes = {e["configuration"] for e in arena["episodes"]}
    assert codes == set(arena["configurations"])


def test_lerobot_reads_it(dataset, recordings):
    """LeRobot gives rows, instruction and the very pictures of the recorded MP4s."""
    read = LeRobotDataset("local/boxing", root=dataset, return_uint8=True, video_backend="pyav")
    episodes = [EpisodeFile(file) for file in episode_files([recordings])]
    assert (read.num_episodes, len(read)) == (3, sum(e.rows for e in episodes))
    first = 0
    for number, episode in enumerate(episodes):
        video = OpenVideo(episode.video("front"))
        for row in (0, 11, episode.rows - 1):
            item = read[first + row]
            assert item["task"] == episode.text("arena_instruction") and item["episode_index"] == number
            np.testing.assert_array_equal(item["observation.state"].numpy(), episode.state[row])
            np.testing.assert_array_equal(item["action"].numpy(), episode.action[row])
            picture = item["observation.images.front"].permute(1, 2, 0).numpy()
            np.testing.assert_array_equal(picture, video.read(row))
        first += episode.rows


def test_lerobots_loader_and_merge_take_it(dataset, recordings, tmp_path):
    """A DataLoader with two worker processes gives every row, and LeRobot's own merge joins two such datasets."""
    import torch

    read = LeRobotDataset("local/boxing", root=dataset)
    batches = list(torch.utils.data.DataLoader(read, batch_size=16, num_workers=2))
    index = torch.cat([batch["index"] for batch in batches])
    assert index.tolist() == list(range(len(read)))
    assert batches[0]["observation.images.front"].shape[1:] == (3, 32, 32)
    other = tmp_path / "others"
    consistent_episode(other, repeat=8, tracker="sonic")
    second = written(other, tmp_path / "second")
    aggregate_datasets(["local/a", "local/b"], "local/both", roots=[dataset, second], aggr_root=tmp_path / "both")
    both = LeRobotDataset("local/both", root=tmp_path / "both")
    assert both.num_episodes == 4 and len(both) == len(read) + ROWS


@pytest.mark.release
def test_bytes_do_not_depend_on_the_hash_seed(dataset, recordings, tmp_path):
    """Another process with another PYTHONHASHSEED, and files in another order, write the same bytes."""
    files = sorted(map(str, episode_files([recordings])), reverse=True)
    environment = {**os.environ, "PYTHONHASHSEED": "4711"}
    command = [sys.executable, "-m", "arena_newton.data", "build", *files, "--out", str(tmp_path / "other")]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    assert content(tmp_path / "other") == content(dataset)
    assert not [file for file in dataset.rglob("*.mp4") if file.stat().st_mode & 0o777 != 0o644 & ~umask()]


def umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def record(folder, worlds):
    """Three short episodes of a standing robot, in so many worlds."""
    env = ArenaEnv("boxing", tracker=trackers.get("twist2", None), worlds=worlds, engine="mujoco")
    env.startup_ticks = 2
    episodes = []
    for repeat in range(3):
        seed = seeding.recording_seed(env.spec.gym_id, seeding.DEMONSTRATION, 0, repeat)
        about = {"task": "boxing", "tracker": "twist2", "policy": "stand", "mode": "base", "rules": "paper"}
        seeds = {"episode_seed": seed, "object_seed": seeding.object_seed(seed)}
        episodes.append(SimpleNamespace(index=repeat, group_seed=0, repeat=repeat, **about, **seeds))
    recorder = DemonstrationRecorder(folder, cameras={"front": CameraConfig(width=32, height=32)}, facts={"code": "x"})
    list(Rollout(env, StandPolicy(), episodes, max_steps=12, recorder=recorder).run())
    recorder.close()
    return folder


def test_bytes_do_not_depend_on_the_worlds(tmp_path):
    """Episodes that one world recorded one after the other, and three at once, make the same dataset; it is sound."""
    built = [written(record(tmp_path / f"r{n}", n), tmp_path / f"d{n}") for n in (1, 3)]
    assert content(built[0]) == content(built[1])
    assert main(["verify", str(built[0]), "--recordings", str(tmp_path / "r3")]) == 0


def build_and_kill(recordings, out, delay):
    """Build in a process of its own, which is killed so long [s] after it has begun to write.

    Returns the time from its beginning to the end, and whether it left an unfinished folder.
    """
    part = out.with_name("d.part")
    child = os.fork()
    if child == 0:
        try:
            written(recordings, out)
        finally:
            os._exit(0)
    while not (part / "temporary").exists() and not out.exists():
        time.sleep(0.0005)
    begin = time.monotonic()
    if delay is None:
        os.waitpid(child, 0)
    else:
        time.sleep(delay)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    return time.monotonic() - begin, part.exists()


def test_a_killed_build_leaves_nothing_or_everything(recordings, dataset, tmp_path, tmp_path_factory, monkeypatch):
    """Killed at random moments, a build leaves no dataset or a whole one; the next one sweeps its remains.

    LeRobot's temporary folders are among those: in the system's folder for such nothing is left.
    """
    system = tmp_path_factory.mktemp("system")
    monkeypatch.setenv("TMPDIR", str(system))
    monkeypatch.setattr(tempfile, "tempdir", str(system))
    whole, chance, out = content(dataset), random.Random(5), tmp_path / "d"
    duration, _ = build_and_kill(recordings, out, None)
    assert content(out) == whole
    shutil.rmtree(out)
    unfinished = 0
    for number in range(4):
        # The first one at once: it certainly meets a build at work.
        _, left = build_and_kill(recordings, out, chance.uniform(0.0, 1.1 * duration) if number else 0.0)
        unfinished += left
        if out.exists():
            assert content(out) == whole
            shutil.rmtree(out)
    assert unfinished, "no kill met a build at work"
    written(recordings, out)
    assert content(out) == whole and sorted(os.listdir(tmp_path)) == ["d"]
    assert not list(system.iterdir())


def test_a_package_that_is_not_installed_has_no_version(recordings, tmp_path, monkeypatch):
    """This package builds from PYTHONPATH alone too and tells its own version; versions that nobody tells are null."""
    version = importlib.metadata.version

    def told(absent):
        def find(name):
            if name in absent:
                raise importlib.metadata.PackageNotFoundError(name)
            return version(name)

        return find

    monkeypatch.setattr(importlib.metadata, "version", told({"arena-newton", "pandas"}))
    first = written(recordings, tmp_path / "first")
    versions = json.loads((first / "meta" / "info.json").read_text())["arena"]["versions"]
    assert versions["arena-newton"] == arena_newton.__version__ and versions["pandas"] is None
    assert versions["lerobot"] == lerobot_dataset.LEROBOT
    consistent_episode(tmp_path / "r", repeat=8)
    second = written(tmp_path / "r", tmp_path / "second")
    assert main(["merge", str(first), str(second), "--out", str(tmp_path / "both")]) == 0
    assert json.loads((tmp_path / "both" / "meta" / "info.json").read_text())["arena"]["versions"] == versions
    monkeypatch.setattr(importlib.metadata, "version", told({"lerobot"}))
    with pytest.raises(InputError, match="one without a version is installed"):
        written(recordings, tmp_path / "third")


def test_a_disk_that_is_full_at_the_end_leaves_nothing(recordings, tmp_path, monkeypatch, capsys):
    """A table of episodes that cannot be written: exit code 2, and nothing writes into the removed folder later."""
    with monkeypatch.context() as patch:

        def full(_):
            raise OSError(28, "No space left on device")

        patch.setattr(LeRobotDatasetMetadata, "_flush_metadata_buffer", full)
        assert main(["build", str(recordings), "--out", str(tmp_path / "d")]) == 2
    gc.collect()
    assert "No space left" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_error(recordings, tmp_path, monkeypatch):
    """The error of a video that cannot be copied names the dataset, and nothing of it stays."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(ArenaError, match=r"d2: cannot be written .*No space left"):
        written(recordings, tmp_path / "d2")
    assert not os.listdir(tmp_path)


def test_private_names_of_lerobot():
    """Private names of LeRobot that the build uses are there, with the meaning that it relies on."""
    lerobot_dataset.check_version()
    source = inspect.getsource(dataset_writer.DatasetWriter)
    assert "self._streaming_encoder = streaming_encoder" in source
    assert "ep_dataset = embed_images(ep_dataset)" in source
    assert "compute_episode_stats(non_video_buffer, non_video_features)" in source
    assert "self._streaming_encoder.finish_episode()" in source and "get_task_index(task) for task in tasks" in source
    for kind in (dataset_writer.DatasetWriter, LeRobotDatasetMetadata):
        assert 'if getattr(self, "_finalized", False):' in inspect.getsource(kind.finalize)
    assert "shutil.rmtree(str(ep_path.parent))" in source, "hands over a copy, alone in its folder"
    for name in ("finish_episode", "cancel_episode", "close"):
        own = inspect.signature(getattr(FinishedVideos, name))
        assert own.parameters.keys() == inspect.signature(getattr(StreamingVideoEncoder, name)).parameters.keys()


def test_another_lerobot_is_refused(recordings, tmp_path, monkeypatch):
    """A version whose writer is unknown is refused before anything is written."""
    monkeypatch.setattr(lerobot_dataset, "LEROBOT", "0.7.0")
    with pytest.raises(InputError, match=r"knows the writer of lerobot 0\.7\.0, 0\.6\.1 is installed"):
        written(recordings, tmp_path / "d")


def test_statistics_are_exact_and_hands_are_never_constant(dataset, recordings):
    """Mean and deviation are those of all rows in double precision; quantiles of a still hand are 0 and 1."""
    stats = json.loads((dataset / "meta" / "stats.json").read_text())
    assert list(stats) == sorted(stats)
    rows = np.concatenate([EpisodeFile(file).action for file in episode_files([recordings])]).astype(np.float64)
    np.testing.assert_allclose(stats["action"]["mean"], rows.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(stats["action"]["std"], rows.std(axis=0), atol=1e-12)
    assert stats["action"]["count"] == [len(rows)]
    assert not rows[:, 38:].any(), "hands that stay open"
    for quantile, value in (("q01", 0.0), ("q10", 0.0), ("q90", 1.0), ("q99", 1.0)):
        assert stats["action"][quantile][38:] == [value, value]


def test_files_are_as_small_as_asked(tmp_path, monkeypatch):
    """A video goes on in another file where the next episode would make it larger than was asked."""

    def noise(rows, size, seed):
        return np.random.default_rng(seed).integers(0, 255, (rows, size, size, 3), np.uint8)

    monkeypatch.setattr(made_episodes, "pictures", noise)
    for repeat in range(4):
        consistent_episode(tmp_path / "r", ROWS, repeat=repeat, size=64)
    size = max(file.stat().st_size for file in (tmp_path / "r" / "videos").iterdir()) / 2**20
    for most, files in ((1.5 * size, 4), (2.5 * size, 2), (100, 1)):
        built = written(tmp_path / "r", tmp_path / f"d{files}", file_mb=most)
        assert len(list((built / "videos").rglob("*.mp4"))) == files
        read = LeRobotDataset("local/many", root=built, return_uint8=True, video_backend="pyav")
        assert read[ROWS]["observation.images.front"].float().std() > 20.0


@pytest.mark.parametrize("labels", ["v3.1", "v4"])
def test_labels(recordings, tmp_path, labels):
    """Actions are those of the protocol that was asked for, and robot type and names say so."""
    built = written(recordings, tmp_path / "d", labels=labels)
    info = json.loads((built / "meta" / "info.json").read_text())
    read = LeRobotDataset("local/d", root=built)
    episode = EpisodeFile(episode_files([recordings])[0])
    expected = episode.action if labels == "v3.1" else encode_v4(episode.action)
    got = np.stack([read.hf_dataset[i]["action"].numpy() for i in range(episode.rows)])
    np.testing.assert_array_equal(got, expected)
    assert info["robot_type"] == {"v3.1": "unitree_g1_refpose_v3_1", "v4": "unitree_g1_gmt_cmd_v4"}[labels]
    assert info["vla_protocol"]["version"] == labels[1:]
    assert ("action.root_yaw_rate" in info["features"]["action"]["names"]) == (labels == "v4")


def test_layout_sonic(recordings, tmp_path):
    """SONIC's names: 43 joints with fingers, root, gravity, whole-body targets, double precision."""
    built = written(recordings, tmp_path / "d", layout="sonic")
    read = LeRobotDataset("local/d", root=built)
    assert read.meta.camera_keys == ["observation.images.ego_view"]
    item, episode = read.hf_dataset[5], EpisodeFile(episode_files([recordings])[0])
    names = read.meta.features["observation.state"]["names"]
    assert names[22:29] == [
        f"left_hand_{f}_joint" for f in "index_0 index_1 middle_0 middle_1 thumb_0 thumb_1 thumb_2".split()
    ]
    joints = dict(zip(names, item["observation.state"].tolist(), strict=True))
    measured = episode.array("robot_qpos_before_decimation")[5]
    for name, value in zip(g1.MUJOCO_JOINTS, measured, strict=True):
        assert joints[name] == pytest.approx(value, abs=1e-7)
    assert joints["left_hand_index_0_joint"] == pytest.approx(episode.array("arena_qpos")[5, 29], abs=1e-7)
    w, x, y, z = item["observation.root_orientation"].tolist()
    down = [-2 * (x * z - w * y), -2 * (y * z + w * x), -(1 - 2 * (x * x + y * y))]
    assert item["observation.projected_gravity"].tolist() == pytest.approx(down, abs=1e-6) and down[2] < -0.99
    modality = json.loads((built / "meta" / "modality.json").read_text())
    assert modality["state"]["left_hand"] == {"start": 22, "end": 29, "original_key": "observation.state"}
    assert modality["video"] == {"ego_view": {"original_key": "observation.images.ego_view"}}
    assert modality["annotation"] == {"human.task_description": {"original_key": "task_index"}}


def test_layout_lerobot(recordings, tmp_path):
    """LeRobot's own names of the robot: 29 motors measured, 29 joint targets."""
    built = written(recordings, tmp_path / "d", layout="lerobot")
    read = LeRobotDataset("local/d", root=built)
    names = read.meta.features["action"]["names"]
    assert (names[0], names[3], names[-1], len(names)) == ("kLeftHipPitch.q", "kLeftKnee.q", "kRightWristYaw.q", 29)
    assert read.meta.camera_keys == ["observation.images.head_camera"] and read.meta.robot_type == "unitree_g1"
    episode = EpisodeFile(episode_files([recordings])[1])
    row = read.hf_dataset[ROWS + 3]
    np.testing.assert_array_equal(row["observation.state"].numpy(), episode.array("robot_qpos_before_decimation")[3])
    np.testing.assert_array_equal(row["action"].numpy(), episode.array("robot_twist2_inference_qpos")[3])


def judged(folder):
    """An episode on a seed of the evaluation."""
    consistent_episode(folder, repeat=9, arena_episode_seed=np.uint64(7), arena_seed_range=np.str_("evaluation"))


def torn(folder):
    """A video that is a frame short."""
    other = folder.parent / "short"
    consistent_episode(other, ROWS - 1, repeat=9)
    file = consistent_episode(folder, repeat=9)
    shutil.copy(next((other / "videos").iterdir()), EpisodeFile(file).video("front"))


BAD = {
    "an evaluation seed": (judged, "judge policies"),
    "another rate": (
        lambda folder: consistent_episode(folder, repeat=9, system_control_frequency=np.full(40, 30.0)),
        "30 rows per second",
    ),
    "another size": (lambda folder: consistent_episode(folder, repeat=9, size=48), "48x48"),
    "another set of cameras": (
        lambda folder: consistent_episode(folder, repeat=9, cameras=("front", "world")),
        "cameras front world",
    ),
    "a missing frame": (torn, "has 39 frames, the episode has 40 rows"),
    "rows that were dropped": (
        lambda folder: consistent_episode(folder, repeat=9, vision_frame_indices=np.arange(ROWS) + 1),
        "frame_indices is not 0 to 39",
    ),
    "the same episode twice": (
        lambda folder: consistent_episode(
            folder, repeat=9, arena_episode_seed=EpisodeFile(episode_files([folder])[0]).array("arena_episode_seed")
        ),
        "is the same episode as",
    ),
    "a state that is no number": (
        lambda folder: consistent_episode(folder, repeat=9, arena_state=np.full((ROWS, 64), np.nan, np.float32)),
        "arena_state holds a number that is not finite",
    ),
}


@pytest.mark.parametrize("fault", BAD)
def test_what_does_not_fit_is_refused(fault, tmp_path, capsys):
    """One line names the file and what is wrong, the exit code is 2, and nothing is written."""
    folder = tmp_path / "recordings"
    consistent_episode(folder, repeat=0)
    spoil, words = BAD[fault]
    spoil(folder)
    assert main(["build", str(folder), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert words in error and ".npz" in error or "mp4" in error, error
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--layout", "gr00t"], "--layout gr00t: unknown, choose from arena, sonic, lerobot"),
        (["--labels", "v5"], "--labels v5: unknown"),
        (["--labels", "v4", "--layout", "sonic"], "layout sonic holds joint targets"),
        (["--cameras", "world"], "--cameras world:"),
        (["--file-mb", "-1"], "--file-mb -1"),
    ],
)
def test_wrong_flags_are_refused(recordings, tmp_path, capsys, flags, words):
    """One line names the flag; the exit code is 2."""
    assert main(["build", str(recordings), "--out", str(tmp_path / "d"), *flags]) == 2
    assert words in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_folder_that_exists_is_kept(recordings, dataset, capsys):
    """`--out` never overwrites."""
    before = content(dataset)
    assert main(["build", str(recordings), "--out", str(dataset)]) == 2
    assert "exists" in capsys.readouterr().err and content(dataset) == before


def test_only_success(tmp_path, capsys):
    """Failed episodes are left out and counted; failures alone are refused."""
    folder = tmp_path / "r"
    consistent_episode(folder, repeat=0)
    consistent_episode(folder, repeat=1, outcome="fall")
    assert main(["build", str(folder), "--out", str(tmp_path / "d"), "--only-success"]) == 0
    assert "1 episode, 40 rows, 1 without success left out" in capsys.readouterr().out
    failed = tmp_path / "f"
    consistent_episode(failed, repeat=1, outcome="fall")
    assert main(["build", str(failed), "--out", str(tmp_path / "e"), "--only-success"]) == 2


def test_without_pictures(tmp_path):
    """Episodes without pictures make a dataset of states and actions."""
    consistent_episode(tmp_path / "r", cameras=())
    built = written(tmp_path / "r", tmp_path / "d")
    assert LeRobotDataset("local/d", root=built)[3]["action"].shape == (40,)
    assert main(["verify", str(built), "--recordings", str(tmp_path / "r")]) == 0
