"""`data verify` finds every fault that is planted, and names it."""

import json
import os
import random
import shutil
import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow")

import pyarrow as pa  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402

from arena_newton.data.__main__ import main  # noqa: E402
from arena_newton.data.checks import video_checks  # noqa: E402
from arena_newton.data.checks.verification import rebuilt_state, verify  # noqa: E402
from arena_newton.data.checks.video_checks import CameraVideos, DatasetMismatch, check_videos  # noqa: E402
from arena_newton.data.datasets.data_options import VerifyOptions  # noqa: E402
from arena_newton.data.datasets.lerobot_dataset import choose, write_dataset  # noqa: E402
from arena_newton.data.readers.dataset_files import DatasetFiles  # noqa: E402
from arena_newton.data.recording.episode import EpisodeFile, episode_files  # noqa: E402
from arena_newton.data.recording.layouts import LAYOUTS  # noqa: E402
from arena_newton.errors import ArenaError  # noqa: E402
from arena_newton.pictures.video import VideoWriter  # noqa: E402
from tests.arena_newton.data import made_episodes  # noqa: E402
from tests.arena_newton.data.consistent import ROWS, consistent_episode  # noqa: E402
from tests.fuzz.mutants import damaged  # noqa: E402

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = "videos/observation.images.front/chunk-000/file-000.mp4"


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Three episodes."""
    folder = tmp_path_factory.mktemp("recordings")
    for repeat in range(3):
        consistent_episode(folder, ROWS + repeat, repeat=repeat)
    return folder


@pytest.fixture(scope="module")
def sound(recordings, tmp_path_factory):
    """They as a dataset."""
    out = tmp_path_factory.mktemp("built") / "boxing"
    write_dataset(choose(episode_files([recordings])), out, kind=LAYOUTS["arena"])
    return out


@pytest.fixture
def dataset(sound, tmp_path):
    """A copy to spoil."""
    return Path(shutil.copytree(sound, tmp_path / "d"))


def check(dataset, recordings=None):
    verify([dataset], VerifyOptions(recordings=() if recordings is None else (recordings,)))


def change(file, column, edit):
    """Edit a column of a parquet file, which is given as a list."""
    table = pq.read_table(file)
    at = table.column_names.index(column)
    values = table.column(column).to_pylist()
    edited = edit(values)
    pq.write_table(table.set_column(at, table.field(at), pa.array(edited or values, table.field(at).type)), file)


def edit_json(file, edit):
    value = json.loads(file.read_text())
    edit(value)
    file.write_text(json.dumps(value))


def item(*path):
    """Sets a value deep in lists and tables."""
    *way, last, new = path

    def edit(value):
        for step in way:
            value = value[step]
        value[last] = new

    return edit


def swapped(rows):
    for row in rows:
        row[10], row[11] = row[11], row[10]


def without_row(dataset):
    table = pq.read_table(dataset / DATA)
    pq.write_table(pa.concat_tables([table.slice(0, 50), table.slice(51)]), dataset / DATA)


def video_of(dataset, pick):
    """Encode the video again from other frames."""
    import av

    with av.open(str(dataset / VIDEO)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    with VideoWriter(dataset / VIDEO, 32, 32, 50.0, crf=1, gop=10, b_frames=False) as writer:
        for frame in pick(frames):
            writer.write(frame)


def without_last_frame(dataset, video=VIDEO):
    """Copy the video's packets but one."""
    import av

    short = dataset / "short.mp4"
    with av.open(str(dataset / video)) as source, av.open(str(short), "w") as target:
        stream = source.streams.video[0]
        copy = target.add_stream_from_template(stream)
        packets = [packet for packet in source.demux(stream) if packet.dts is not None]
        for packet in packets[:-1]:
            packet.stream = copy
            target.mux(packet)
    short.rename(dataset / video)


def two_tasks(dataset):
    file = dataset / "meta" / "tasks.parquet"
    change(file, "task" if "task" in pq.read_table(file).column_names else "__index_level_0__", lambda _: ["Dance."])
    change(dataset / EPISODES, "tasks", lambda rows: [["Dance."] for _ in rows])


def test_rows_of_next_to_no_bytes_are_not_read(dataset, monkeypatch):
    """Numbers and texts that a file repeats are refused before they take memory, by the header or after a few rows."""
    frames = DatasetFiles(dataset).frames
    rows = 2_000_000
    edit_json(dataset / "meta/info.json", item("total_frames", rows))
    zeros = {"action": pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(rows * 40, np.float32)), 40)}
    pq.write_table(pa.table(zeros).slice(0, rows // 8), dataset / DATA)
    assert (dataset / DATA).stat().st_size < 100_000
    monkeypatch.setattr("arena_newton.files.limits.ROWS_MEMORY", 2**25)
    monkeypatch.setattr(pq.ParquetFile, "read", lambda *a, **k: pytest.fail("read"))
    with pytest.raises(ArenaError, match="file-000.parquet: its rows take more than 32 MiB of memory"):
        DatasetFiles(dataset).columns(dataset / DATA, ("action",))
    pq.write_table(pa.table({"tasks": ["x" * 2**20] * frames}), dataset / EPISODES)
    with pytest.raises(ArenaError, match="file-000.parquet: its rows take more than 32 MiB of memory"):
        DatasetFiles(dataset).table(dataset / EPISODES)


FAULTS = {
    "one number of a state": (
        lambda d: change(d / DATA, "observation.state", item(57, 12, 3.0)),
        r"file-000.parquet, episode 1, row 17: state.dof_pos.waist_yaw_joint|episode 1, row 17: state\.",
    ),
    "one number of an action, by a little": (
        lambda d: change(d / DATA, "action", lambda rows: item(3, 9, rows[3][9] + 3e-5)(rows)),
        r"episode 0, row 3: action.joint_pos.left_hip_pitch_joint is .*gives",
    ),
    "a number that is none": (
        lambda d: change(d / DATA, "action", item(80, 39, float("nan"))),
        r"episode 1, row 40: action.hand_binary.right is nan",
    ),
    "two columns swapped": (lambda d: change(d / DATA, "action", swapped), r"episode 0, row \d+: action.joint_pos"),
    "a dropped row": (without_row, r"episode 1, row 10: frame_index is 11, expected 10"),
    "a wrong frame index": (
        lambda d: change(d / DATA, "frame_index", item(5, 6)),
        r"episode 0, row 5: frame_index is 6, expected 5",
    ),
    "a wrong timestamp": (
        lambda d: change(d / DATA, "timestamp", item(6, 0.125)),
        r"episode 0, row 6: timestamp is 0.125",
    ),
    "a wrong episode index": (
        lambda d: change(d / DATA, "episode_index", item(45, 2)),
        r"episode 1, row 5: episode_index is 2, expected 1",
    ),
    "a wrong global index": (lambda d: change(d / DATA, "index", item(45, 9)), r"row 5: index is 9, expected 45"),
    "another task's instruction": (two_tasks, r"instruction is 'Dance\.', that of boxing is"),
    "an episode's length": (
        lambda d: change(d / EPISODES, "length", item(1, ROWS)),
        r"episode 1|episode 2: begins at row",
    ),
    "a column's statistics": (
        lambda d: change(d / EPISODES, "stats/action/mean", item(2, 5, 0.5)),
        r"episode 2: stats/action/mean: action.root_ref_rot6d.2 is 0.5, the numbers give",
    ),
    "the pictures' statistics": (
        lambda d: change(d / EPISODES, "stats/observation.images.front/q50", lambda rows: item(0, 0, 0, 0, 0.9)(rows)),
        r"episode 0: stats/observation.images.front/q50",
    ),
    "the dataset's statistics": (
        lambda d: edit_json(d / "meta/stats.json", item("observation.state", "std", 7, 0.25)),
        r"stats.json: observation.state/std: state.dof_pos.right_hip_pitch_joint is 0.25",
    ),
    "a feature's statistics missing": (
        lambda d: edit_json(d / "meta/stats.json", lambda v: v.pop("action")),
        r"stats.json: action is missing",
    ),
    "a name": (
        lambda d: edit_json(d / "meta/info.json", item("features", "action", "names", 2, "action.root_height")),
        r"info.json: feature action: name 2 is 'action.root_height', expected action.root_z",
    ),
    "the robot": (
        lambda d: edit_json(d / "meta/info.json", item("robot_type", "unitree_g1_rotlocal_v3")),
        r"robot_type is 'unitree_g1_rotlocal_v3', known are unitree_g1_refpose_v3_1",
    ),
    "the protocol": (
        lambda d: edit_json(d / "meta/info.json", item("vla_protocol", "version", "4")),
        r"vla_protocol: version is '4'",
    ),
    "the slices": (
        lambda d: edit_json(d / "meta/modality.json", item("action", "root_z", "start", 3)),
        r"modality.json: does not name",
    ),
    "no chunks": (lambda d: edit_json(d / "meta/info.json", item("chunks_size", 0)), "chunks_size is 0, expected"),
    "a split beyond the end": (
        lambda d: edit_json(d / "meta/info.json", item("splits", {"train": "0:99999999999"})),
        "splits: train is '0:99999999999', expected a range of its 3 episodes",
    ),
    "a split backwards": (lambda d: edit_json(d / "meta/info.json", item("splits", {"train": "2:1"})), "splits: train"),
    "rows beyond the end": (
        lambda d: pq.write_table(pa.concat_tables([pq.read_table(d / DATA)] * 3), d / DATA),
        r"file-000.parquet: has [0-9,]+ rows, info.json says [0-9,]+ total_frames",
    ),
    "the rate": (lambda d: edit_json(d / "meta/info.json", item("fps", 30)), r"fps is 30|timestamp"),
    "an episode's seed": (
        lambda d: edit_json(d / "meta/info.json", item("arena", "episodes", 1, "episode_seed", 5)),
        r"episode 1: arena: episode_seed is 5, recorded",
    ),
    "the range of the seeds": (
        lambda d: edit_json(d / "meta/info.json", item("arena", "seed_ranges", ["evaluation"])),
        r"arena: seed_ranges is \['evaluation'\]",
    ),
    "a frame missing": (without_last_frame, r"episode 2, row 41: the video has no frame for it"),
    "a video shifted by one frame": (
        lambda d: video_of(d, lambda f: [*f[1:], f[0]]),
        r"episode 0, row 0: observation.images.front differs from frame 0 of",
    ),
    "a video encoded again": (
        lambda d: video_of(d, lambda f: f),
        r"episode 0, row \d+: observation.images.front differs from frame",
    ),
    "another picture": (lambda d: video_of(d, lambda f: [255 - x for x in f]), r"differs from frame"),
    "a torn video": (
        lambda d: (d / VIDEO).write_bytes((d / VIDEO).read_bytes()[:-900]),
        r"cannot be decoded|no frame for it|another time|differs from frame|mean of the pictures",
    ),
    "no video": (lambda d: (d / VIDEO).unlink(), r"file-000.mp4: is missing"),
    "a video of nobody": (
        lambda d: shutil.copy(d / VIDEO, (d / VIDEO).with_name("file-001.mp4")),
        r"file-001.mp4: no episode has frames in it",
    ),
    "a torn table": (
        lambda d: (d / DATA).write_bytes((d / DATA).read_bytes()[:5000]),
        r"not a readable parquet file",
    ),
}


def test_a_sound_dataset_passes(sound, recordings, capsys):
    """A dataset as it was built passes, alone and against its recordings, and the answer says which it was."""
    assert main(["verify", str(sound), "--recordings", str(recordings)]) == 0
    assert "3 episodes, 123 rows, 123 decoded frames: sound, equal to 3 recorded episodes" in capsys.readouterr().out
    assert main(["verify", str(sound)]) == 0
    assert "sound, not compared with recordings" in capsys.readouterr().out


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_named(fault, dataset, recordings):
    """Each fault alone is found, and the message names file, episode, row and column."""
    spoil, words = FAULTS[fault]
    spoil(dataset)
    with pytest.raises(DatasetMismatch, match=words):
        check(dataset, recordings)


ALONE = [
    "a number that is none",
    "two columns swapped",
    "a dropped row",
    "a wrong timestamp",
    "another task's instruction",
    "a column's statistics",
    "the dataset's statistics",
    "a name",
    "a frame missing",
    "another picture",
]


@pytest.mark.parametrize("fault", ALONE)
def test_faults_are_found_without_recordings(fault, dataset):
    """Contradictions of a dataset with itself are found without recordings."""
    FAULTS[fault][0](dataset)
    with pytest.raises(DatasetMismatch):
        check(dataset)


def test_frames_that_nobody_has(dataset):
    """A video that goes on after the last row is found in the dataset alone."""
    video_of(dataset, lambda frames: [*frames, frames[0]])
    with pytest.raises(DatasetMismatch, match="episode 2: .*goes on after the last episode's last frame"):
        check(dataset)


@pytest.fixture(scope="module")
def many_files(tmp_path_factory):
    """A dataset whose four episodes have a video file each, and its recordings."""
    folder, out = tmp_path_factory.mktemp("recordings"), tmp_path_factory.mktemp("built") / "d"
    with pytest.MonkeyPatch.context() as patch:

        def noise(rows, size, seed):
            return np.random.default_rng(seed + 10 * rows).integers(0, 255, (rows, size, size, 3), np.uint8)

        patch.setattr(made_episodes, "pictures", noise)
        for repeat in range(4):
            consistent_episode(folder, ROWS, repeat=repeat, size=48)
    write_dataset(choose(episode_files([folder])), out, kind=LAYOUTS["arena"], file_mb=1e-6)
    return out, folder


def test_the_first_mismatch_is_that_of_any_number_of_threads(many_files, tmp_path):
    """A late fault in an early file is named, not early ones in later files, however many threads work."""
    sound, recordings = many_files
    videos = [f"videos/observation.images.front/chunk-000/file-{number:03d}.mp4" for number in range(4)]
    assert all((sound / video).is_file() for video in videos)
    spoiled = Path(shutil.copytree(sound, tmp_path / "d"))
    without_last_frame(spoiled, videos[1])
    for video in videos[2:]:
        (spoiled / video).write_bytes(b"no video")
    verify([sound], VerifyOptions(recordings=(recordings,), jobs=8))
    for jobs in (1, 2, 8):
        with pytest.raises(DatasetMismatch, match=r"file-001\.mp4, episode 1, row 39: the video has no frame for it"):
            verify([spoiled], VerifyOptions(recordings=(recordings,), jobs=jobs))


def test_an_interruption_ends_the_threads(many_files, monkeypatch):
    """Ctrl-C while videos are decoded ends every thread at its next frame."""
    files = DatasetFiles(many_files[0])
    decoded, means, interrupted = [], [], threading.Event()

    def slow(frame):
        means.append(frame)
        if len(means) > 10:
            interrupted.wait(60.0)
        return np.full(3, 127.5)

    def interrupt(count):
        decoded.append(count)
        interrupted.set()
        raise KeyboardInterrupt

    monkeypatch.setattr(video_checks, "_mean", slow)
    monkeypatch.setattr(video_checks, "REPORT_SECONDS", 0.05)
    camera = CameraVideos("observation.images.front", [np.full(3, 0.5)] * 4, {})
    with pytest.raises(KeyboardInterrupt):
        check_videos(files, [camera], jobs=2, progress=interrupt)
    assert len(decoded) == 1 and decoded[0] < 2 * ROWS
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("decoder")]


def test_it_writes_nothing(sound, recordings, tmp_path, monkeypatch):
    """Neither the dataset nor the folder of temporary files changes, so that a killed check leaves nothing behind."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = {file: (file.stat().st_mtime_ns, file.stat().st_size) for file in sound.rglob("*")}
    check(sound, recordings)
    assert {file: (file.stat().st_mtime_ns, file.stat().st_size) for file in sound.rglob("*")} == before
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("jobs", [-1, 257])
def test_a_wrong_number_of_threads_is_refused(sound, capsys, jobs):
    """One line names the flag; the exit code is 2."""
    assert main(["verify", str(sound), "--jobs", str(jobs)]) == 2
    assert f"--jobs {jobs}: expected 0 to 256" in capsys.readouterr().err


def test_the_exit_code_is_one(dataset, recordings, capsys):
    """A mismatch is a failed check, what is no dataset is bad input."""
    change(dataset / DATA, "frame_index", item(5, 6))
    assert main(["verify", str(dataset), "--recordings", str(recordings)]) == 1
    assert "frame_index is 6, expected 5" in capsys.readouterr().err
    assert main(["verify", str(recordings)]) == 2
    assert main(["verify", str(dataset / "nothing")]) == 2


def test_a_changed_recording_is_noticed(sound, recordings, tmp_path):
    """A recording that is not the file it was built from is named."""
    other = Path(shutil.copytree(recordings, tmp_path / "r"))
    consistent_episode(other, ROWS + 1, repeat=1, arena_margin=np.float64(0.2))
    with pytest.raises(DatasetMismatch, match=r"episode 1: arena: .*repeat0001.npz is not the file"):
        check(sound, other)
    os.remove(episode_files([other])[1])
    with pytest.raises(DatasetMismatch, match=r"its recording boxing__.*repeat0001 is not among"):
        check(sound, other)


@pytest.mark.parametrize(("layout", "labels"), [("arena", "v4"), ("sonic", "v3.1"), ("lerobot", "v3.1")])
def test_other_labels_and_layouts(recordings, tmp_path, layout, labels):
    """Datasets of every layout and of both protocols are checked, and a changed number is found in each."""
    out = tmp_path / "d"
    write_dataset(choose(episode_files([recordings])), out, kind=LAYOUTS[layout], labels=labels)
    check(out, recordings)
    column = "action.wbc" if layout == "sonic" else "action"
    change(out / DATA, column, lambda rows: item(50, 5, rows[50][5] + 1e-3)(rows))
    with pytest.raises(DatasetMismatch, match="episode 1, row 10: "):
        check(out, recordings)


def test_what_lerobot_itself_writes(recordings, sound, tmp_path):
    """A dataset of the original's schema from LeRobot's own writer, without our block, is checked too."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = json.loads((sound / "meta/info.json").read_text())["features"]
    chosen = {key: dict(features[key]) for key in ("observation.state", "action")}
    made = LeRobotDataset.create("local/o", 50, chosen, root=tmp_path / "d", robot_type="unitree_g1_refpose_v3_1")
    files = [EpisodeFile(file) for file in episode_files([recordings])]
    for episode in files:
        for state, action in zip(episode.state, episode.action, strict=True):
            made.add_frame({"observation.state": state, "action": action, "task": episode.text("arena_instruction")})
        made.save_episode()
    made.finalize()
    check(tmp_path / "d", recordings)
    change(tmp_path / "d" / DATA, "action", item(50, 20, 0.5))
    with pytest.raises(DatasetMismatch, match="episode 1, row 10: action.joint_pos"):
        check(tmp_path / "d", recordings)


def test_the_state_is_rebuilt_from_raw_fields(recordings):
    """Joints, orientation and heading give the canonical state within 1e-6, and depend on the heading."""
    episode = EpisodeFile(episode_files([recordings])[0])
    state = rebuilt_state(episode)
    np.testing.assert_allclose(state, episode.state, atol=1e-6)
    assert np.ptp(state[:, :6], axis=0).min() > 0.0 or np.ptp(state[:, 1]) > 0.1


def test_damaged_files_are_one_error(sound, tmp_path, mutants):
    """Damaged tables, JSON files and videos are refused or sound, and never a traceback."""
    chance = random.Random(3)
    files = ("meta/info.json", "meta/stats.json", "meta/modality.json", "meta/tasks.parquet", DATA, EPISODES, VIDEO)
    refused = 0
    for number in range(mutants):
        name = files[number % len(files)]
        folder = tmp_path / "d"
        shutil.copytree(sound, folder)
        (folder / name).write_bytes(damaged((sound / name).read_bytes(), chance, text=name.endswith(".json")))
        try:
            check(folder)
        except ArenaError as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 1000
        shutil.rmtree(folder)
    assert refused > mutants // 2
