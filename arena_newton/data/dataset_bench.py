"""``data bench``: how fast a dataset is read in random order, and how long it takes to build."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.import_utils import get_safe_default_video_backend

from arena_newton.data.dataset_files import DatasetFiles
from arena_newton.data.episode import episode_files
from arena_newton.data.frame_reader import Frames
from arena_newton.data.layouts import layout
from arena_newton.data.lerobot_dataset import choose, write_dataset
from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.data.data_options import DatasetBenchOptions

__all__ = ["DataFigure", "bench", "measured"]

WARM_READS = 100
"""Reads before the clock starts: files are opened, decoders made."""
READS_BAR, OWN_READS_BAR = 450.0, 1000.0
"""Pictures of 224 x 224 per second from one process, LeRobot with torchcodec and our own reader."""
BUILD_BAR = 40.0
"""Time to build 100 episodes of 80,000 rows on two CPU cores [s]."""
BUILD_ROWS = 80_000


@dataclass(frozen=True)
class DataFigure:
    """One line of the bench."""

    name: str
    value: float
    bar: float
    unit: str
    at_most: bool = False

    @property
    def met(self) -> bool:
        """Whether it reaches its bar."""
        return self.value <= self.bar if self.at_most else self.value >= self.bar


def bench(folders: Sequence[Path], options: DatasetBenchOptions) -> int:
    """Measure and print.

    Returns:
        Exit code: 0 when no figure misses its bar, otherwise 1.

    Raises:
        InputError: It is no dataset with pictures, or a flag is unfit.
    """
    if len(folders) != 1:
        raise InputError(f"bench: name one dataset, not {len(folders)}")
    figures = measured(folders[0], options)
    for figure in figures:
        sign = "<=" if figure.at_most else ">="
        verdict = "pass" if figure.met else "MISS"
        print(f"{figure.name:<58} {figure.value:9.1f} {figure.unit:<9} {sign} {figure.bar:6.0f}  {verdict}")
    print(
        f"{os.cpu_count()} CPU cores, load {os.getloadavg()[0]:.1f}; bars are for 224x224 pictures and an idle machine"
    )
    return 0 if all(figure.met for figure in figures) else 1


def measured(root: Path, options: DatasetBenchOptions) -> list[DataFigure]:
    """Figures of a dataset, and of building its recordings where they are named.

    Raises:
        InputError: It is no dataset with pictures, or a flag is unfit.
    """
    if options.reads < 1:
        raise InputError(f"--reads {options.reads}: expected at least 1")
    files = DatasetFiles(root)
    frames = Frames(root)
    order = np.random.default_rng(options.seed).integers(0, len(frames), WARM_READS + options.reads).tolist()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        height, width = frames[0].shape[:2]
        own = _rate(order, frames.__getitem__)
        frames.close()
        logging.getLogger("lerobot").setLevel(logging.ERROR)
        dataset = LeRobotDataset(f"local/{root.resolve().name}", root=root, return_uint8=True)
        backend = get_safe_default_video_backend()
        read = _rate(order, dataset.__getitem__)
    finally:
        torch.set_num_threads(threads)
    about = f"{width}x{height}, {files.episodes} episodes"
    found = [
        DataFigure(f"random reads, LeRobotDataset with {backend}, {about}", read, READS_BAR, "frames/s"),
        DataFigure(f"random reads, data.Frames, {about}", own, OWN_READS_BAR, "frames/s"),
    ]
    if options.recordings:
        with (
            tempfile.TemporaryDirectory(dir=root.resolve().parent) as folder,
            contextlib.redirect_stderr(io.StringIO()),
        ):
            begin = time.perf_counter()
            chosen = choose(episode_files(options.recordings), allow_evaluation_seeds=True)
            write_dataset(chosen, Path(folder) / "dataset", kind=layout("arena", "v3.1"))
            passed = time.perf_counter() - begin
        name = f"building, {len(chosen.episodes)} episodes, {chosen.rows} rows"
        bar = BUILD_BAR * chosen.rows / BUILD_ROWS
        found.append(DataFigure(name, passed, max(1.0, bar), "s", at_most=True))
    return found


def _rate(order: Sequence[int], read: Callable[[int], object]) -> float:
    """Reads per second."""
    for row in order[:WARM_READS]:
        read(row)
    begin = time.perf_counter()
    for row in order[WARM_READS:]:
        read(row)
    return (len(order) - WARM_READS) / (time.perf_counter() - begin)
