"""Pictures, states and actions of datasets on one device: decoded once, read by index.

Pictures are uint8, of every tick or of every Nth. Rows that are black in every picture, above and below a padded 4:3
picture, are cut off, and put back when a batch is made for a network that sees them: a quarter of the memory.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from arena_newton.data.readers.frame_reader import Frames
from arena_newton.errors import InputError
from arena_newton.pictures.settings import FRONT
from arena_newton.policies.train.frames.decoder_pool import DecoderPool, EpisodeFilm, decoding_processes
from arena_newton.policies.train.frames.demonstration_rows import (
    ACTION_KEY,
    STATE_KEY,
    VECTOR_KEY,
    DatasetRows,
    EpisodeRows,
)
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH

if TYPE_CHECKING:
    from arena_newton.policies.train.frames.look_store import LookStore

__all__ = [
    "FrameStore",
    "assembled",
    "check_memory",
    "free_memory",
    "is_pad",
    "load_frames",
    "made_statistics",
    "needed_memory",
]

BLACK = 12
"""Largest value of a pixel that counts as black: a video codec leaves traces of the picture in the pad next to it."""
BLACK_PART = 0.5
"""Fraction of a pad that is black in all pictures: a codec, whose blocks have 16 rows, leaves traces of the picture in
the others. Of 224 rows 28 are a pad, of which it brightens 4 in most episodes."""
HOST_BYTES = 2**30
"""Memory of the host that is left to everything else."""


@dataclass(frozen=True)
class FrameStore:
    """Rows of all episodes, one after the other, on one device."""

    pictures: torch.Tensor
    """uint8, shape [cameras * pictures, height - top - bottom, width, 3]: all of one camera, then those of the next."""
    picture: torch.Tensor
    """Number of each row's picture by the first camera, of a row without one that of the last before it, int64, shape
    [rows]."""
    states: torch.Tensor
    """float32, shape [rows, 64]."""
    actions: torch.Tensor
    """float32, shape [rows, 40]."""
    first: torch.Tensor
    """First row of each row's episode, int64, shape [rows]."""
    last: torch.Tensor
    """Last row of each row's episode, int64, shape [rows]."""
    instruction: torch.Tensor
    """Number of each row's instruction, int64, shape [rows]."""
    task: torch.Tensor
    """Number of each row's task, int64, shape [rows]."""
    pair: torch.Tensor
    """Number of each row's pair of task and tracker, int64, shape [rows]."""
    instructions: tuple[str, ...]
    tasks: tuple[str, ...]
    """Names of tasks, sorted."""
    pairs: tuple[tuple[str, str], ...]
    """Task and tracker of each pair, sorted."""
    lengths: tuple[int, ...]
    """Rows of each episode."""
    held: tuple[bool, ...]
    """True for an episode that is held out."""
    top: int
    """Black rows above [px]."""
    bottom: int
    """Black rows below [px]."""
    every: int = 1
    """Rows from one picture of an episode to the next; the first row has one."""
    looks: LookStore | None = None
    """Looks of the pictures, where a training changes them."""
    cameras: tuple[str, ...] = (FRONT,)
    """Names of the cameras."""

    @property
    def device(self) -> torch.device:
        """Device of the rows."""
        return self.pictures.device

    @property
    def rows(self) -> int:
        """Rows of all episodes."""
        return len(self.states)

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Names of the pairs: that of the task and, where there are several trackers, that of the tracker."""
        several = len({tracker for _, tracker in self.pairs}) > 1
        return tuple("_".join(name or "unknown" for name in pair[: 1 + several]) for pair in self.pairs)

    @property
    def height(self) -> int:
        """Height of a whole picture [px]."""
        return int(self.pictures.shape[1]) + self.top + self.bottom

    @property
    def width(self) -> int:
        """Width of a picture [px]."""
        return int(self.pictures.shape[2])

    def middle(self, height: int) -> tuple[torch.Tensor, int]:
        """Pictures cut to a height about their middle.

        Args:
            height: At most that of a whole picture [px].

        Returns:
            The rows of it that are stored, uint8, shape [pictures, at most height, width, 3], a view; and the number
            of black ones above them that are not.
        """
        first = (self.height - height) // 2 - self.top
        return self.pictures[:, max(0, first) : max(0, first + height)], max(0, -first)

    def samples(self, *, held: bool = False, drop_last: int = 0) -> np.ndarray:
        """Rows at which a sample may begin: those with a picture.

        Args:
            held: Those of held-out episodes instead of the others.
            drop_last: Rows at the end of each episode at which none begins.

        Returns:
            int64, ascending.
        """
        starts = np.cumsum([0, *self.lengths])
        parts = [
            np.arange(start, start + length - drop_last, self.every)
            for start, length, out in zip(starts, self.lengths, self.held, strict=False)
            if out == held and length > drop_last
        ]
        return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def needed_memory(pictures: int, rows: int, height: int, width: int) -> int:
    """Bytes of so many pictures and rows."""
    return pictures * height * width * 3 + rows * (4 * (STATE_WIDTH + ACTION_WIDTH) + 6 * 8)


def free_memory(device: torch.device) -> int:
    """Bytes of a device that rows and a network may take."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return int(free)
    for line in Path("/proc/meminfo").read_text().splitlines() if Path("/proc/meminfo").is_file() else ():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024 - HOST_BYTES
    return 2**62


def check_memory(pictures: int, rows: int, height: int, width: int, device: torch.device, network: int) -> None:
    """Refuse what does not fit beside a network that needs so many bytes.

    Raises:
        InputError: The device has too little free memory; the message says how much is missing.
    """
    needed, free = needed_memory(pictures, rows, height, width), free_memory(device) - network
    if needed > free:
        raise InputError(
            f"--dataset: {pictures} pictures of {width}x{height} need {needed / 1e9:.1f} GB of memory on {device}, "
            f"{max(0, free) / 1e9:.1f} GB are free beside the network, for which {network / 1e9:.1f} GB are kept: name "
            "fewer datasets, a larger --picture-every, record smaller pictures, or use a device with more memory"
        )


def load_frames(
    datasets: Sequence[DatasetRows],
    device: torch.device,
    *,
    hold_out: int = 0,
    every: int = 1,
    middle: int = 0,
    jobs: int = 0,
    processes: int | None = None,
    network: int = 0,
    on_frames: Callable[[int], None] = lambda count: None,
) -> FrameStore:
    """Decode pictures onto a device.

    Args:
        datasets: Read with `read_rows`; their pictures must have one size.
        hold_out: Last episodes of each dataset that are held out.
        every: Rows from one picture of an episode to the next.
        middle: Height of the part about the middle of the pictures that is wanted alone, where a pad is around it [px];
            0: all but the rows that are black in every picture.
        jobs: Cores that decode, an episode each; 0: all that the process may use.
        processes: Processes that decode instead of threads; by default as `decoding_processes` says.
        network: Memory that the network needs beside the pictures [bytes] (`network_bytes`).
        on_frames: Receives after each episode how many pictures were decoded.

    Raises:
        InputError: The pictures differ in size, do not fit, or cannot be decoded; or no episode is left to train on.
        ArenaError: A process that decodes ended, or there is no memory for it.
    """
    height, width = datasets[0].height, datasets[0].width
    for dataset in datasets[1:]:
        if (dataset.height, dataset.width) != (height, width):
            raise InputError(
                f"--dataset {dataset.root}: pictures of {dataset.width}x{dataset.height} pixels, "
                f"{datasets[0].root} has {width}x{height}"
            )
    for dataset in datasets:
        if hold_out >= len(dataset.episodes):
            raise InputError(
                f"--hold-out {hold_out}: {dataset.root} has {len(dataset.episodes)} episodes, none would be left"
            )
    cameras = tuple(datasets[0].cameras)
    rows = sum(dataset.frames for dataset in datasets)
    films = episode_films(datasets, every)
    count = sum(film.frames for film in films)
    cores = jobs or len(os.sched_getaffinity(0))
    processes = decoding_processes(cores, count) if processes is None else processes
    with DecoderPool(height, width, threads=cores, processes=processes, device=device) as pool:
        top, bottom = black_rows(pool, films, height)
        if middle and is_pad(height, middle, top, bottom):
            top = bottom = (height - middle) // 2
        while True:
            check_memory(count, rows, height - top - bottom, width, device, network)
            pictures = torch.empty((count, height - top - bottom, width, 3), dtype=torch.uint8, device=device)
            black = _decode(pool, films, pictures, (top, bottom), on_frames)
            if black == (top, bottom) or (middle and is_pad(height, middle, *black)):
                break
            # Some picture is not black where the first ones of all episodes are: only what is black in all is cut off.
            del pictures
            if device.type == "cuda":
                torch.cuda.empty_cache()  # memory that torch keeps does not count as free
            (top, bottom), on_frames = black, lambda count: None
    episodes = [episode for dataset in datasets for episode in dataset.episodes]
    held = [number >= len(d.episodes) - hold_out for d in datasets for number in range(len(d.episodes))]
    return assembled(episodes, pictures, held, top, bottom, every, cameras)


def episode_films(datasets: Sequence[DatasetRows], every: int = 1) -> list[EpisodeFilm]:
    """Video files and time ranges of all episodes' pictures, camera by camera, and where they are wanted."""
    found: list[EpisodeFilm] = []
    row = 0
    for camera, dataset in itertools.product(datasets[0].cameras, datasets):
        parts = Frames(dataset.root, dataset.cameras[camera]).parts[: len(dataset.episodes)]
        for number, (episode, part) in enumerate(zip(dataset.episodes, parts, strict=True)):
            count = -(-episode.length // every)
            found.append(EpisodeFilm(dataset.root, number, part.path, part.first, count, row, every))
            row += count
    return found


def is_pad(height: int, middle: int, top: int, bottom: int) -> bool:
    """True where rows that are black in all pictures, above and below, are a pad around a part of some height [px]."""
    band = (height - middle) // 2
    return band > 0 and min(top, bottom) >= BLACK_PART * band


def black_rows(pool: DecoderPool, films: Sequence[EpisodeFilm], height: int) -> tuple[int, int]:
    """Rows above and below that are black in the first picture of every episode; none where a whole picture is."""
    firsts = [dataclasses.replace(film, frames=1) for film in films]
    brightest = [above for _, (above, _) in pool.decode(firsts, height, 0, lambda row, pictures: None)]
    bright = np.flatnonzero(np.max(brightest, axis=0) > BLACK)
    return (int(bright[0]), int(height - 1 - bright[-1])) if len(bright) else (0, 0)


def _decode(
    pool: DecoderPool,
    films: Sequence[EpisodeFilm],
    pictures: torch.Tensor,
    bands: tuple[int, int],
    on_frames: Callable[[int], None],
) -> tuple[int, int]:
    """Decode every episode into its rows; returns how many rows of the bands that are cut off all pictures have black.

    Where these are fewer than the bands, rows of pictures are missing.
    """
    top, bottom = bands
    above, below = np.zeros(top, np.uint8), np.zeros(bottom, np.uint8)

    def put(row: int, found: np.ndarray) -> None:
        pictures[row : row + len(found)].copy_(torch.from_numpy(found))

    for number, (brightest_above, brightest_below) in pool.decode(films, top, bottom, put):
        np.maximum(above, brightest_above, out=above)
        np.maximum(below, brightest_below, out=below)
        on_frames(films[number].frames)
    bright, dark = np.flatnonzero(above > BLACK), np.flatnonzero(below > BLACK)
    return int(bright[0]) if len(bright) else top, bottom - 1 - int(dark[-1]) if len(dark) else bottom


def assembled(
    episodes: Sequence[EpisodeRows],
    pictures: torch.Tensor,
    held: Sequence[bool],
    top: int,
    bottom: int,
    every: int = 1,
    cameras: tuple[str, ...] = (FRONT,),
) -> FrameStore:
    """Rows of episodes next to their pictures."""
    device = pictures.device
    lengths = np.array([episode.length for episode in episodes])
    ends = np.cumsum(lengths)
    counts = -(-lengths // every)
    within = np.arange(ends[-1]) - np.repeat(ends - lengths, lengths)
    instructions = tuple(sorted({episode.instruction for episode in episodes}))
    tasks = tuple(sorted({episode.task for episode in episodes}))
    pairs = tuple(sorted({(episode.task, episode.tracker) for episode in episodes}))

    def per_row(values: Iterator[int] | np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.repeat(np.fromiter(values, np.int64, len(episodes)), lengths)).to(device)

    return FrameStore(
        pictures=pictures,
        picture=per_row(np.cumsum(counts) - counts) + torch.from_numpy(within // every).to(device),
        states=torch.from_numpy(np.concatenate([e.states for e in episodes])).to(device),
        actions=torch.from_numpy(np.concatenate([e.actions for e in episodes])).to(device),
        first=per_row(ends - lengths),
        last=per_row(ends - 1),
        instruction=per_row(instructions.index(e.instruction) for e in episodes),
        task=per_row(tasks.index(e.task) for e in episodes),
        pair=per_row(pairs.index((e.task, e.tracker)) for e in episodes),
        instructions=instructions,
        tasks=tasks,
        pairs=pairs,
        lengths=tuple(lengths.tolist()),
        held=tuple(held),
        top=top,
        bottom=bottom,
        every=every,
        cameras=cameras,
    )


def made_statistics() -> dict[str, dict[str, torch.Tensor]]:
    """Statistics of rows of noise, of one task."""
    found = {}
    for key, width in ((STATE_KEY, STATE_WIDTH), (ACTION_KEY, ACTION_WIDTH), (VECTOR_KEY, 1)):
        ones = torch.ones(width)
        found[key] = {
            "mean": 0 * ones,
            "std": ones,
            "min": -4 * ones,
            "max": 4 * ones,
            "q01": -2 * ones,
            "q99": 2 * ones,
        }
    return found
