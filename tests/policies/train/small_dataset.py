"""A dataset of three short demonstrations with padded 64 x 64 pictures, made in seconds."""

import json

import numpy as np
import pytest

from arena_newton.data.datasets.lerobot_dataset import choose, write_dataset
from arena_newton.data.recording.episode import episode_files
from arena_newton.data.recording.layouts import LAYOUTS
from tests.arena_newton.data import made_episodes
from tests.arena_newton.data.consistent import consistent_episode

SIZE, BAND = 64, 8
"""Pictures, and their black rows above and below [px]."""
LENGTHS = (30, 37, 25)


def padded(rows, size, seed):
    """Pictures of a moving bar between black bands."""
    found = np.zeros((rows, size, size, 3), np.uint8)
    found[:, BAND:-BAND] = 70
    for number in range(rows):
        found[number, BAND : size // 2, (number + np.arange(size // 4)) % size] = 180
    found[:, size // 2 : -BAND, : size // 4] = np.random.default_rng(seed + rows).integers(60, 200, 3)
    return found


def make_dataset(
    folder, *, labels="v3.1", lengths=LENGTHS, task="boxing", tracker="twist2", pictures=padded, size=SIZE
):
    """Write a dataset into `folder/<task>_<tracker>_<labels>` and return it."""
    recordings = folder / f"{task}_{tracker}_recordings"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(made_episodes, "pictures", pictures)
        for repeat, rows in enumerate(lengths):
            consistent_episode(recordings, rows, repeat=repeat, size=size, task=task, tracker=tracker)
    out = folder / f"{task}_{tracker}_{labels}"
    write_dataset(choose(episode_files([recordings])), out, kind=LAYOUTS["arena"], labels=labels)
    return out


def info(dataset):
    """Its `info.json`."""
    return json.loads((dataset / "meta" / "info.json").read_text())
