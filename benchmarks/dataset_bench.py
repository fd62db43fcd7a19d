"""``python -m benchmarks dataset``: random reads of a dataset, and the time that building and verifying take.

Both readers take turns, block by block, so that other work on the machine slows both alike.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import datasets
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.import_utils import get_safe_default_video_backend

from arena_newton.data.checks.verification import verify
from arena_newton.data.datasets.data_options import VerifyOptions
from arena_newton.data.datasets.lerobot_dataset import choose, write_dataset
from arena_newton.data.readers.dataset_files import DatasetFiles
from arena_newton.data.readers.frame_reader import Frames
from arena_newton.data.recording.episode import episode_files, opened
from arena_newton.data.recording.layouts import layout
from arena_newton.errors import InputError
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.files.new_folder import scratch_folder
from arena_newton.files.text import counted
from arena_newton.physics.devices import torch_threads
from benchmarks.bench_options import DatasetBenchOptions
from benchmarks.episode_copies import copy_episodes

__all__ = ["dataset_figures"]

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


def dataset_figures(options: DatasetBenchOptions) -> Iterator[BenchFigure]:
    """Figures of a dataset, and of building its recordings where they are named.

    Raises:
        InputError: It is no dataset with pictures, or a flag is unfit.
    """
    if options.reads < 1:
        raise InputError(f"--reads {options.reads}: expected at least 1")
    if not 0 <= options.made <= MOST_MADE:
        raise InputError(f"--made {options.made}: expected 0 to {MOST_MADE} episodes")
    if options.made and (options.dataset or not options.recordings):
        raise InputError("--made: makes a dataset of copies of --recordings; name those, and no --dataset")
    if not options.made and options.dataset is None:
        raise InputError("--dataset: name a folder, or --recordings with --made")
    if options.dataset is not None and not options.recordings:
        yield from _reads(options.dataset, options)
        return
    source = (options.dataset or options.recordings[0]).resolve()
    with scratch_folder(source.with_name(f"{source.name}_bench"), "bench") as own:
        recordings, built = options.recordings, own / "dataset"
        if options.made:
            copy_episodes(list(opened(episode_files(recordings))), own / "recordings", options.made)
            recordings = (own / "recordings",)
        building = _building(recordings, built)
        yield from _reads(options.dataset or built, options, own)
        yield from building


def _building(recordings: Sequence[Path], out: Path) -> list[BenchFigure]:
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
        BenchFigure(f"building, {about}", bar, "s", True, built[0], _note(built[1])),
        BenchFigure(f"verifying, {about}", None, "s", True, verified[0], _note(verified[1])),
    ]


def _reads(root: Path, options: DatasetBenchOptions, scratch: Path | None = None) -> list[BenchFigure]:
    """Random reads of a dataset."""
    files = DatasetFiles(root)
    frames = Frames(root)
    order = np.random.default_rng(options.seed).integers(0, len(frames), WARM_READS + options.reads).tolist()
    logging.getLogger("lerobot").setLevel(logging.ERROR)
    try:
        height, width = frames[0].shape[:2]
        with torch_threads(1), _cache_in(scratch):
            dataset = LeRobotDataset(f"local/{root.resolve().name}", root=root, return_uint8=True)
            backend = get_safe_default_video_backend()
            read, own = _rates(order, (dataset.__getitem__, frames.__getitem__))
    finally:
        frames.close()
    cameras = len(files.video_keys)
    about = f"{width}x{height}, {counted(files.episodes, 'episode')}, {counted(cameras, 'camera')}"
    bars = (READS_BAR, OWN_READS_BAR) if max(height, width) <= BAR_SIZE else (None, None)
    read *= cameras  # a row of LeRobot's holds a picture of each
    name = f"random reads, LeRobotDataset with {backend}, {about}"
    return [
        BenchFigure(name, bars[0], "frames/s", False, read[0], _note(read[1])),
        BenchFigure(f"random reads, data.Frames, {about}", bars[1], "frames/s", False, own[0], _note(own[1])),
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


def _note(cpu: float) -> str:
    """The same figure by time of the CPU, which other work on the machine hardly changes, and how busy that is."""
    return f"{cpu:.1f} by CPU time; {len(os.sched_getaffinity(0))} CPU cores, load {os.getloadavg()[0]:.1f}"


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
