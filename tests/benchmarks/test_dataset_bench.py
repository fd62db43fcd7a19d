"""The bench `dataset`: both readers, building and verifying, sets of any size from copies."""

import datasets
import numpy as np
import pytest

from arena_newton.data.datasets.lerobot_dataset import choose, write_dataset
from arena_newton.data.recording.episode import EpisodeFile, episode_files
from arena_newton.data.recording.layouts import LAYOUTS
from benchmarks.__main__ import main
from benchmarks.episode_copies import copy_episodes
from tests.arena_newton.data.consistent import ROWS, consistent_episode


@pytest.fixture
def recordings(tmp_path):
    """Two recorded episodes."""
    for repeat in range(2):
        consistent_episode(tmp_path / "r", ROWS + repeat, repeat=repeat)
    return tmp_path / "r"


def test_readers_build_and_check_are_measured(recordings, tmp_path, capsys):
    """It prints reads of LeRobot and of ours, and the time of build and check; a wrong flag is named."""
    root = tmp_path / "d"
    write_dataset(choose(episode_files([recordings])), root, kind=LAYOUTS["arena"])
    code = main(["dataset", "--dataset", str(root), "--reads", "20", "--recordings", str(recordings)])
    lines = capsys.readouterr().out.splitlines()
    for line, words in zip(
        lines, ("random reads", "random reads, data.Frames, 32x32", "building", "verifying"), strict=True
    ):
        assert words in line and "by CPU time" in line
    assert "2 episodes, 1 camera" in lines[1] and "2 episodes, 81 rows" in lines[2]
    assert code == int(any("MISS" in line for line in lines))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d", "r"], "what was built is removed"
    for flags, words in {
        ("--dataset", str(root), "--reads", "0"): "--reads 0",
        ("--made", "-1"): "--made -1",
        ("--made", "2", "--dataset", str(root)): "--made: makes a dataset of copies",
        ("--made", "2", "--recordings", str(root)): "holds no episodes",
        (): "--dataset: name a folder",
    }.items():
        assert main(["dataset", *flags]) == 2
        assert words in capsys.readouterr().err


def test_a_set_of_any_size_is_made(recordings, tmp_path, capsys, monkeypatch):
    """Copies under other seeds make a sound set of the size asked for; nothing of it is left, also not in a cache."""
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")
    main(["dataset", "--recordings", str(recordings), "--reads", "20", "--made", "5"])
    lines = capsys.readouterr().out.splitlines()
    assert "5 episodes, 1 camera" in lines[1] and "building, 32x32, 5 episodes, 202 rows" in lines[2]
    assert "verifying, 32x32, 5 episodes, 202 rows" in lines[3]
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


def test_copies_are_recordings(recordings, tmp_path):
    """Each copy has a seed of its own and the arrays and pictures of its source."""
    sources = [EpisodeFile(file) for file in episode_files([recordings])]
    copies = [EpisodeFile(file) for file in copy_episodes(sources, tmp_path / "c", 5)]
    assert len({copy.integer("arena_episode_seed") for copy in copies}) == 5
    for number, copy in enumerate(copies):
        source = sources[number % 2]
        np.testing.assert_array_equal(copy.action, source.action)
        assert copy.video("front").read_bytes() == source.video("front").read_bytes()
