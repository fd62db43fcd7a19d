"""``data bench``: how fast a dataset is read in random order, and how long it takes to build and to verify.

Both readers take turns, block by block, so that other work on the machine slows both alike.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import datasets
import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.import_utils import get_safe_default_video_backend

from arena_newton.data.checks.episode_copies import copy_episodes
from arena_newton.data.checks.verification import verify
from arena_newton.data.datasets.data_options import VerifyOptions
from arena_newton.data.datasets.layouts import layout
from arena_newton.data.datasets.lerobot_dataset import choose, write_dataset
from arena_newton.data.readers.dataset_files import DatasetFiles
from arena_newton.data.readers.frame_reader import Frames
from arena_newton.data.recording.episode import episode_files, opened
from arena_newton.errors import InputError
from arena_newton.files.new_folder import scratch_folder
from arena_newton.files.text import counted

if TYPE_CHECKING:
    from arena_newton.data.datasets.data_options import DatasetBenchOptions

__all__ = ["DataFigure", "bench", "measured"]

WARM_READS = 100
"""Reads before the clock starts: files are opened, decoders made."""
READS_BAR, OWN_READS_BAR = 450.0, 1000.0
"""Pictures of 224 x 224 per second from one process, LeRobot with torchcodec and our own reader."""
BLOCK = 100
"""Reads of one reader before it is the other's turn."""
MOST_MADE = 10_000
"""Most episodes that are made of copies."""
BAR_SIZE = 224
"""Larger pictures [px] are measured and not judged."""
BUILD_BAR = 40.0
"""Time to build 100 episodes of 80,000 rows on two CPU cores [s]."""
BUILD_ROWS = 80_000


@dataclass(frozen=True)
class DataFigure:
    """One line of the bench."""

    name: str
    value: float
    bar: float | None
    """None where nothing is asked of it."""
    unit: str
    at_most: bool = False
    cpu: float | None = None
    """The same figure by time of the CPU instead of the clock: what other work on the machine hardly changes."""

    @property
    def met(self) -> bool:
        """True if it reaches its bar."""
        return self.bar is None or (self.value <= self.bar if self.at_most else self.value >= self.bar)

    @property
    def verdict(self) -> str:
        """The bar, and whether it is reached."""
        if self.bar is None:
            return ""
        return f"{'<=' if self.at_most else '>='} {self.bar:6.0f}  {'pass' if self.met else 'MISS'}"


def bench(folders: Sequence[Path], options: DatasetBenchOptions) -> int:
    """Measure and print.

    Returns:
        Exit code: 0 when no figure misses its bar, otherwise 1.

    Raises:
        InputError: It is no dataset with pictures, or a flag is unfit.
    """
    if len(folders) != 1:
        raise InputError(f"bench: name one folder, not {len(folders)}")
    figures = measured(folders[0], options)
    for figure in figures:
        cpu = "" if figure.cpu is None else f"{figure.cpu:9.1f} by CPU time"
        print(f"{figure.name:<75} {figure.value:9.1f} {figure.unit:<9} {cpu:<21} {figure.verdict}".rstrip())
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    print(f"{cores} CPU cores, load {load:.1f}; bars are for 224x224 pictures and an idle machine of 2 cores")
    return 0 if all(figure.met for figure in figures) else 1


def measured(folder: Path, options: DatasetBenchOptions) -> list[DataFigure]:
    """Figures of a dataset, and of building its recordings where they are named.

    Args:
        folder: The dataset; with `options.made` recordings, of which one is made.
        options: What to measure.

    Raises:
        InputError: It is no dataset with pictures, or a flag is unfit.
    """
    if options.reads < 1:
        raise InputError(f"--reads {options.reads}: expected at least 1")
    if not 0 <= options.made <= MOST_MADE:
        raise InputError(f"--made {options.made}: expected 0 to {MOST_MADE} episodes")
    if options.made and options.recordings:
        raise InputError("--made: the folder holds the recordings, so --recordings names no others")
    if not options.made and not options.recordings:
        return _reads(folder, options)
    with scratch_folder(folder.resolve().with_name(f"{folder.resolve().name}_bench"), "bench") as own:
        recordings = options.recordings
        if options.made:
            copy_episodes(list(opened(episode_files([folder]))), own / "recordings", options.made)
            recordings = (own / "recordings",)
        built = own / "dataset"
        figures = _building(recordings, built)
        return [*_reads(built if options.made else folder, options, scratch=own), *figures]


def _building(recordings: Sequence[Path], out: Path) -> list[DataFigure]:
    """Build recordings, and verify the dataset against them."""
    with contextlib.redirect_stderr(io.StringIO()):
        begin = _now()
        chosen = choose(episode_files(recordings), allow_evaluation_seeds=True)
        write_dataset(chosen, out, kind=layout("arena", "v3.1"))
        built = _now() - begin
        begin = _now()
        with contextlib.redirect_stdout(io.StringIO()):
            verify([out], VerifyOptions(recordings=tuple(recordings)))
        verified = _now() - begin
    sizes = [f"{video.width}x{video.height}" for video in chosen.videos[0].values()]
    judged = bool(sizes) and all(max(v.width, v.height) <= BAR_SIZE for v in chosen.videos[0].values())
    about = ", ".join([*dict.fromkeys(sizes), counted(len(chosen.episodes), "episode"), f"{chosen.rows} rows"])
    bar = max(1.0, BUILD_BAR * chosen.rows / BUILD_ROWS) if judged else None
    return [
        DataFigure(f"building, {about}", built[0], bar, "s", at_most=True, cpu=built[1]),
        DataFigure(f"verifying, {about}", verified[0], None, "s", at_most=True, cpu=verified[1]),
    ]


def _reads(root: Path, options: DatasetBenchOptions, scratch: Path | None = None) -> list[DataFigure]:
    """Random reads of a dataset."""
    files = DatasetFiles(root)
    frames = Frames(root)
    order = np.random.default_rng(options.seed).integers(0, len(frames), WARM_READS + options.reads).tolist()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    logging.getLogger("lerobot").setLevel(logging.ERROR)
    try:
        height, width = frames[0].shape[:2]
        with _cache_in(scratch):
            dataset = LeRobotDataset(f"local/{root.resolve().name}", root=root, return_uint8=True)
            backend = get_safe_default_video_backend()
            read, own = _rates(order, (dataset.__getitem__, frames.__getitem__))
    finally:
        frames.close()
        torch.set_num_threads(threads)
    cameras = len(files.video_keys)
    about = f"{width}x{height}, {counted(files.episodes, 'episode')}, {counted(cameras, 'camera')}"
    bars = (READS_BAR, OWN_READS_BAR) if max(height, width) <= BAR_SIZE else (None, None)
    read *= cameras  # a row of LeRobot's holds a picture of each
    name = f"random reads, LeRobotDataset with {backend}, {about}"
    return [
        DataFigure(name, read[0], bars[0], "frames/s", cpu=read[1]),
        DataFigure(f"random reads, data.Frames, {about}", own[0], bars[1], "frames/s", cpu=own[1]),
    ]


@contextlib.contextmanager
def _cache_in(folder: Path | None) -> Iterator[None]:
    """Have LeRobot copy the tables of a dataset that will be removed into a folder, not into the user's cache."""
    before = datasets.config.HF_DATASETS_CACHE
    if folder is not None:
        datasets.config.HF_DATASETS_CACHE = folder / "cache"
    try:
        yield
    finally:
        datasets.config.HF_DATASETS_CACHE = before


def _now() -> np.ndarray:
    """Time of the clock and of the CPU, all threads together [s]."""
    return np.array([time.perf_counter(), time.process_time()])


def _rates(order: Sequence[int], readers: Sequence[Callable[[int], object]]) -> list[np.ndarray]:
    """Reads per second of each reader, in turns, by the clock and by the CPU."""
    for reader in readers:
        for row in order[:WARM_READS]:
            reader(row)
    passed = [np.zeros(2) for _ in readers]
    for first in range(WARM_READS, len(order), BLOCK):
        for number, reader in enumerate(readers):
            begin = _now()
            for row in order[first : first + BLOCK]:
                reader(row)
            passed[number] += _now() - begin
    return [(len(order) - WARM_READS) / seconds for seconds in passed]
