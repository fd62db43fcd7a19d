"""`data merge` and `data split`: datasets of episodes of others, whose pictures are copied as they are."""

import json
import random
import shutil
import sys
from pathlib import Path

import av
import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the extra [data]")

import pyarrow.parquet
from made_episodes import make_episode

from arena_newton.data.__main__ import main
from arena_newton.data.datasets.sets import held_out
from arena_newton.data.readers.dataset_files import DatasetFiles
from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.pictures.video import VideoWriter

sys.path.insert(0, str(Path(__file__).parents[2] / "fuzz"))
sys.path.insert(0, str(Path(__file__).parents[2] / "policies"))
from mutants import damaged
from original_dataset import write_dataset


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Recordings of two tasks and trackers, each as a dataset of its own, both as one, and both datasets merged."""
    folder = tmp_path_factory.mktemp("built")
    for repeat in range(3):
        make_episode(folder / "ra", 30 + repeat, repeat=repeat)
    for repeat in range(2):
        make_episode(folder / "rb", 20 + repeat, repeat=repeat, task="football", tracker="sonic")
    for name, recordings in {"a": ["ra"], "b": ["rb"], "both": ["ra", "rb"]}.items():
        assert main(["build", *(str(folder / one) for one in recordings), "--out", str(folder / name)]) == 0
    assert main(["merge", str(folder / "a"), str(folder / "b"), "--out", str(folder / "merged")]) == 0
    return folder


def pictures(root):
    """Every frame of every episode, decoded, in order."""
    files, found = DatasetFiles(root), []
    for row in files.episode_rows:
        part = files.video(row, "observation.images.front")
        with av.open(str(part.path)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        found += frames[part.first : part.first + part.frames]
    return np.stack(found)


def rows(root):
    """All rows of a dataset as one table."""
    return pyarrow.concat_tables([pyarrow.parquet.read_table(f) for f in sorted(root.glob("data/*/*.parquet"))])


def near(one, other):
    """True if two JSON values are the same but for rounding."""
    if isinstance(one, dict):
        return set(one) == set(other) and all(near(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(near, one, other))
    return one == other or (isinstance(one, float) and abs(one - other) <= 1e-6 * max(1.0, abs(one)))


def test_merged_is_built_together(built):
    """Two datasets merged are, in rows, pictures, statistics and description, that of all recordings built at once."""
    out = built / "merged"
    assert rows(out).equals(rows(built / "both"))
    np.testing.assert_array_equal(pictures(out), pictures(built / "both"))
    files, wanted = DatasetFiles(out), DatasetFiles(built / "both")
    assert files.tasks == wanted.tasks
    assert files.info == wanted.info
    for one, other in zip(files.episode_rows, wanted.episode_rows, strict=True):
        assert near(dict(one.values), dict(other.values))
    stats = [json.loads((root / "meta" / "stats.json").read_text()) for root in (out, built / "both")]
    assert near(*stats)
    assert (out / "meta" / "modality.json").read_bytes() == (built / "both" / "meta" / "modality.json").read_bytes()


def test_seeds_of_evaluations_among_others_are_told(built, tmp_path, capsys):
    """A set that joins episodes on which policies are judged with others says how many; one of a kind says nothing."""
    judged = tmp_path / "judged"
    make_episode(tmp_path / "r", 12, arena_seed_range=np.str_("evaluation"), arena_episode_seed=np.uint64(7))
    assert main(["build", str(tmp_path / "r"), "--allow-evaluation-seeds", "--out", str(judged)]) == 0
    capsys.readouterr()
    assert main(["merge", str(built / "a"), str(judged), "--out", str(tmp_path / "mixed")]) == 0
    assert "note: 1 of them are on seeds of evaluations" in capsys.readouterr().out
    assert main(["merge", str(built / "a"), str(built / "b"), "--out", str(tmp_path / "alike")]) == 0
    assert "note" not in capsys.readouterr().out


def test_merged_passes_verify(built, tmp_path, capsys):
    """`data verify` finds no fault in a merged set, nor in either side of a split."""
    pytest.importorskip("arena_newton.data.checks.verification")
    out = built / "merged"
    train, held = tmp_path / "train", tmp_path / "held"
    split = ["split", str(out), "--fraction", "0.4", "--out-train", str(train), "--out-held-out", str(held)]
    assert main(split) == 0
    recordings = ["--recordings", str(built / "ra"), str(built / "rb")]
    for root in (out, train, held):
        assert main(["verify", str(root), *(recordings if root is out else [])]) == 0, capsys.readouterr()


def test_equal_sources_give_equal_bytes(built, tmp_path):
    """A merge done again has the same bytes in every file."""
    for name in ("one", "two"):
        assert main(["merge", str(built / "b"), str(built / "a"), "--out", str(tmp_path / name)]) == 0
    files = sorted(f.relative_to(tmp_path / "one") for f in (tmp_path / "one").rglob("*") if f.is_file())
    assert len(files) >= 6
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file


def test_lerobot_reads_what_was_merged(built):
    """LeRobot's own loader gives the rows and pictures of the sources."""
    lerobot_dataset = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    out = built / "merged"
    dataset = lerobot_dataset.LeRobotDataset("local/x", root=out, video_backend="pyav")
    assert (len(dataset), dataset.num_episodes) == (134, 5)
    shown = pictures(out)
    for index in (0, 30, 92, 93, 133):
        item = dataset[index]
        picture = (item["observation.images.front"].numpy() * 255).round().astype(np.uint8).transpose(1, 2, 0)
        np.testing.assert_array_equal(picture, shown[index])
        assert item["task"] == ("Kick the soccer ball into the goal." if index >= 93 else DatasetFiles(out).tasks[0])


def test_pictures_of_two_encoders_are_merged(tmp_path):
    """A set that has episodes of two entropy coders is continued by none of the others' pictures in the same file."""
    for repeat in range(3):
        make_episode(tmp_path / f"r{repeat}", 30 + repeat, repeat=repeat)
    film = next(tmp_path.glob("r1/**/*_front_rgb.mp4"))
    with av.open(str(film)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    with VideoWriter(film, *frames[0].shape[1::-1], 50, gop=10, b_frames=False) as writer:
        writer._stream.options |= {"coder": "0"}
        for frame in frames:
            writer.write(frame)
    for name, recordings in {"a": ["r0", "r1"], "b": ["r2"]}.items():
        assert main(["build", *(str(tmp_path / one) for one in recordings), "--out", str(tmp_path / name)]) == 0
    assert main(["merge", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "merged")]) == 0
    shown = pictures(tmp_path / "merged")
    np.testing.assert_array_equal(shown, np.concatenate([pictures(tmp_path / "a"), pictures(tmp_path / "b")]))


def released(root, actions):
    """A set of the original's schema, with a small video where its own is."""
    write_dataset(root, actions)
    video = root / "videos" / "observation.images.front" / "chunk-000" / "file-000.mp4"
    with VideoWriter(video, 32, 32, 50, gop=2, b_frames=False) as writer:
        for number, episode in enumerate(actions):
            # An episode's pictures begin with a key frame, as they were encoded on their own: here by even lengths.
            assert len(episode) % 2 == 0
            for frame in range(len(episode)):
                writer.write(np.full((32, 32, 3), 20 + 60 * number + frame, np.uint8))
    return root


def test_the_originals_released_sets_are_merged_and_split(built, tmp_path, capsys):
    """Sets of the original's schema, without our block, become one and two again, by content; ours do not mix in."""
    actions = rows(built / "a")["action"].combine_chunks().flatten().to_numpy().reshape(-1, 40)
    one = released(tmp_path / "one", [actions[:10], actions[10:30]])
    two = released(tmp_path / "two", [actions[30:44]])
    out = tmp_path / "out"
    assert main(["merge", str(one), str(two), "--out", str(out)]) == 0
    files = DatasetFiles(out)
    assert [row.length for row in files.episode_rows] == [10, 20, 14]
    assert files.info["vla_protocol"]["version"] == "3.1" and "arena" not in files.info
    np.testing.assert_array_equal(pictures(out), np.concatenate([pictures(one), pictures(two)]))
    sides = ["--fraction", "0.5", "--seed", "1", "--out-train", str(tmp_path / "t"), "--out-held-out"]
    assert main(["split", str(out), *sides, str(tmp_path / "h")]) == 0
    assert DatasetFiles(tmp_path / "t").frames + DatasetFiles(tmp_path / "h").frames == 44
    assert main(["merge", str(one), str(built / "a"), "--out", str(tmp_path / "mixed")]) == 2
    assert str(built / "a") in capsys.readouterr().err


def test_pictures_that_begin_inside_a_group_are_refused(built, tmp_path, capsys):
    """An episode whose frames need those of another one cannot be taken out as they are, and the error says so."""
    actions = rows(built / "a")["action"].combine_chunks().flatten().to_numpy().reshape(-1, 40)
    one = released(tmp_path / "one", [actions[:10], actions[10:30]])
    video = next(one.rglob("*.mp4"))
    with VideoWriter(video, 32, 32, 50, gop=30, b_frames=False) as writer:
        for frame in range(30):
            writer.write(np.full((32, 32, 3), frame, np.uint8))
    two = released(tmp_path / "two", [actions[30:44]])
    assert main(["merge", str(one), str(two), "--out", str(tmp_path / "out")]) == 2
    assert "do not begin with a key frame" in capsys.readouterr().err


def changed(root, to, **info):
    """A copy of a dataset with entries of info.json changed."""
    shutil.copytree(root, to)
    path = to / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | info))
    return to


def test_sets_of_two_kinds_are_refused(built, tmp_path, capsys):
    """Other rates, robots, features, label protocols and episodes that are in both are named; nothing is written."""
    info = DatasetFiles(built / "b").info
    narrow = json.loads(json.dumps(info["features"]))
    narrow["action"]["shape"] = [39]
    without = {key: value for key, value in info["features"].items() if key != "observation.images.front"}
    cases = {
        "fps is 30": {"fps": 30},
        "robot_type is so100": {"robot_type": "so100"},
        "features: action: shape is [39]": {"features": narrow},
        "features is [": {"features": without},
        "arena: labels is v4": {"arena": info["arena"] | {"labels": "v4"}},
        "arena: episodes are no list": {"arena": info["arena"] | {"episodes": []}},
    }
    for number, (message, entries) in enumerate(cases.items()):
        other = changed(built / "b", tmp_path / f"b{number}", **entries)
        assert main(["merge", str(built / "a"), str(other), "--out", str(tmp_path / "out")]) == 2
        error = capsys.readouterr().err
        assert message in error and str(other) in error, error
    copy = changed(built / "a", tmp_path / "copy")
    assert main(["merge", str(built / "a"), str(copy), "--out", str(tmp_path / "out")]) == 2
    assert "is in" in capsys.readouterr().err
    assert main(["merge", str(built / "a"), "--out", str(tmp_path / "out")]) == 2
    assert main(["merge", str(built / "a"), str(built / "b"), "--out", str(built / "both")]) == 2
    assert "exists" in capsys.readouterr().err
    assert not list(tmp_path.glob("out*"))


def test_damaged_sets(built, tmp_path, capsys, mutants):
    """Each of many damaged sets is merged, or refused in one line that names it; nothing half is left."""
    rng, other = random.Random(5), changed(built / "b", tmp_path / "b")
    sound = {path: path.read_bytes() for path in sorted(other.rglob("*")) if path.is_file()}
    counts = {0: 0, 2: 0}
    for number in range(mutants):
        path = rng.choice(list(sound))
        path.write_bytes(damaged(sound[path], rng, text=path.suffix == ".json"))
        code = main(["merge", str(built / "a"), str(other), "--out", str(tmp_path / f"out{number}")])
        error = capsys.readouterr().err
        counts[code] += 1
        assert (code == 0) or str(tmp_path) in error, error
        path.write_bytes(sound[path])
        shutil.rmtree(tmp_path / f"out{number}", ignore_errors=True)
    assert counts[2] > mutants // 5 and counts[0] > 0 and not list(tmp_path.glob("*.part*"))


def test_a_side_depends_on_the_seed_alone():
    """About the fraction is held out, another number draws other sides, and no other episode matters."""
    sides = [held_out(seed, 0.1) for seed in range(10_000)]
    assert 850 < sum(sides) < 1150
    assert sides != [held_out(seed, 0.1, salt=1) for seed in range(10_000)]
    assert all(held_out(seed, 0.2) for seed in range(10_000) if sides[seed]), "a larger fraction holds out more"
    assert not held_out(1, 0.0) and held_out(1, 1.0)


def test_parts_and_whole_are_split_alike(built, tmp_path, capsys):
    """Recordings, their dataset and a merged one hold out the same episodes; nothing is lost."""
    merged = tmp_path / "m"
    assert main(["merge", str(built / "b"), str(built / "a"), "--out", str(merged)]) == 0
    sides = {}
    for name, given in {
        "recordings": [built / "ra", built / "rb"],
        "datasets": [built / "a", built / "b"],
        "merged": [merged],
    }.items():
        folders = [tmp_path / f"{name}-{side}" for side in ("train", "held")]
        flags = ["--fraction", "0.4", "--out-train", str(folders[0]), "--out-held-out", str(folders[1])]
        assert main(["split", *map(str, given), *flags]) == 0
        for side, folder in zip(("train", "held"), folders, strict=True):
            if name == "recordings":
                seeds = [EpisodeFile(file).integer("arena_episode_seed") for file in folder.glob("*.npz")]
                assert all(EpisodeFile(file).video("front").is_file() for file in folder.glob("*.npz"))
            else:
                seeds = [episode["episode_seed"] for episode in DatasetFiles(folder).info["arena"]["episodes"]]
            sides[name, side] = sorted(seeds)
    for side in ("train", "held"):
        assert sides["recordings", side] == sides["datasets", side] == sides["merged", side]
    assert len(sides["merged", "train"]) + len(sides["merged", "held"]) == 5
    train = DatasetFiles(tmp_path / "merged-train")
    assert len(pictures(train.root)) == train.frames == len(rows(train.root))


def test_wrong_splits_are_named(built, tmp_path, capsys):
    """A fraction outside 0 to 1, an empty side, one folder for both, mixed kinds: one line and exit code 2."""
    out = ["--out-train", str(tmp_path / "t"), "--out-held-out", str(tmp_path / "h")]
    for arguments, message in {
        (str(built / "a"), "--fraction", "1.5", *out): "--fraction 1.5: expected a number between 0 and 1",
        (str(built / "a"), "--fraction", "1e-9", *out): "none is held out; another --seed draws again",
        (str(built / "a"), str(built / "ra"), *out): "some folders are datasets and some recordings",
        (str(built / "a"), "--out-train", "x", "--out-held-out", "x"): "is the folder of --out-train",
        (str(tmp_path / "none"), *out): "no such folder",
    }.items():
        assert main(["split", *arguments]) == 2
        assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
