"""Looks of the pictures on the device: which samples change theirs, and what of."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import torch

from arena_newton.data.readers.dataset_files import DatasetFiles
from arena_newton.data.readers.looks import dataset_looks
from arena_newton.errors import InputError
from arena_newton.pictures.changed_looks import USUAL, Changes, goal_colour, unlike
from arena_newton.policies.train.frames.decoder_pool import DecoderPool, EpisodeFilm, decoding_processes
from arena_newton.policies.train.frames.demonstration_rows import DatasetRows
from arena_newton.policies.train.frames.frame_store import FrameStore, free_memory

__all__ = ["LookStore", "load_looks"]

GOAL_FRAMES = 200
"""Most frames of a scene that are read for the mean colour of its goal."""


@dataclass(frozen=True)
class LookStore:
    """Frames of looks of all episodes that have some, on the device of their pictures."""

    frames: torch.Tensor
    """A shape and one or two light ratios per pixel, uint8, shape [frames, height, width, 2 or 3], cut as pictures."""
    number: torch.Tensor
    """Frame of each row, or of the last row before it that has one, int64, shape [rows]; -1: none."""
    back: torch.Tensor
    """Rows from that row to each row, int64, shape [rows]."""
    table: torch.Tensor
    """Table of each row's shapes, int64, shape [rows]."""
    chances: torch.Tensor
    """Probability of another colour of each shape, float32, shape [tables, 256]."""
    objects: torch.Tensor
    """First shape of the object that each shape is part of, int64, shape [tables, 256]."""
    colours: torch.Tensor
    """Colours of the palette that are not like the goal's, int64, shape [tables, 4096]."""
    fractions: torch.Tensor
    """Fraction of the samples of each row's task whose looks change, float32, shape [rows]."""
    changes: Changes = USUAL
    """Probabilities of the kinds of change."""

    def chosen(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Samples whose looks change, drawn from the device's default generator.

        Args:
            rows: Rows of the samples, int64, shape [B].

        Returns:
            The rows, of a changed sample the last one that has a frame, and which ones change, bool, both of shape [B].
        """
        changed = (torch.rand(len(rows), device=rows.device) < self.fractions[rows]) & (self.number[rows] >= 0)
        return torch.where(changed, rows - self.back[rows], rows), changed


def load_looks(
    datasets: Sequence[DatasetRows],
    store: FrameStore,
    fraction: float,
    fractions: Mapping[str, float],
    changes: Mapping[str, float] = MappingProxyType({}),
    *,
    jobs: int = 0,
    network: int = 0,
) -> LookStore:
    """Decode the films of looks onto the device of the pictures.

    Args:
        datasets: Those of the pictures, in the same order.
        store: Their pictures.
        fraction: Fraction of the samples whose looks change.
        fractions: The same of single tasks.
        changes: Probabilities of kinds of change, of those that are not the usual ones.
        jobs: Cores that decode; 0: all that the process may use.
        network: Memory that the network needs beside them [bytes].

    Raises:
        InputError: A dataset has no looks, one has damaged ones, they do not fit, a task is none of the datasets', or a
            kind of change is unknown.
    """
    kinds = [one.name for one in dataclasses.fields(Changes)]
    for kind in changes:
        if kind not in kinds:
            raise InputError(f"--look-changes {kind}=: unknown, choose from {' '.join(kinds)}")
    for task in fractions:
        if task not in store.tasks:
            raise InputError(f"--looks {task}=: the datasets have {', '.join(store.tasks)}")
    films: list[EpisodeFilm] = []
    number, back, table = (np.zeros(store.rows, np.int64) for _ in range(3))
    number -= 1
    tables: dict[tuple[tuple[str, float], ...], int] = {}
    chances, objects = [np.zeros(256, np.float32)], [np.zeros(256, np.int64)]
    row = count = lights = 0
    for dataset in datasets:
        listed = dataset_looks(dataset.root, DatasetFiles(dataset.root).episodes)
        if not any(listed):
            raise InputError(f"--looks: {dataset.root} has none; record with `eval record --looks 1`")
        for episode, film in zip(dataset.episodes, listed, strict=False):
            rows = np.arange(episode.length)
            if film is not None:
                looks, mine = film.looks, slice(row, row + episode.length)
                lights = max(lights, len(looks.lights))
                step = math.lcm(looks.stride, store.every)  # rows that have a picture too
                frames = -(-episode.length // step)
                number[mine], back[mine] = count + rows // step, rows % step
                table[mine] = tables.setdefault(looks.shapes, len(tables) + 1)
                if len(tables) == len(chances):
                    chances.append(looks.chances())
                    objects.append(looks.objects())
                films.append(EpisodeFilm(dataset.root, film.episode, film.path, 0, frames, count, step // looks.stride))
                count += frames
            row += episode.length
    height, width, device = store.height, store.width, store.device
    shape = (count, *store.pictures.shape[1:3], 1 + lights)
    size, free = math.prod(shape), free_memory(device) - network
    if size > free:
        raise InputError(
            f"--looks: {count} frames need {size / 1e9:.1f} GB of memory on {device}, {max(0, free) / 1e9:.1f} GB are "
            "free beside pictures and network"
        )
    stored = torch.empty(shape, dtype=torch.uint8, device=device)

    def put(first: int, found: np.ndarray) -> None:
        stored[first : first + len(found)].copy_(torch.from_numpy(found[..., : 1 + lights]))

    cores = jobs or len(os.sched_getaffinity(0))
    processes = decoding_processes(cores, count)
    with DecoderPool(height, width, threads=cores, processes=processes, device=device) as pool:
        for _ in pool.decode(films, store.top, store.bottom, put):
            pass
    kept, picture = torch.from_numpy(np.stack(chances)).to(device), store.picture.cpu().numpy()
    colours = []
    for one in range(len(chances)):
        shown = np.flatnonzero((table == one) & (number >= 0) & (back == 0))
        shown = shown[:: -(-len(shown) // GOAL_FRAMES) or 1]
        shapes = stored[torch.from_numpy(number[shown]).to(device)][..., 0]
        seen = store.pictures[torch.from_numpy(picture[shown]).to(device)]
        colours.append(unlike(goal_colour(seen, shapes, kept[one])))
    shares = torch.tensor([fractions.get(task, fraction) for task in store.tasks], device=device)
    return LookStore(
        frames=stored,
        number=torch.from_numpy(number).to(device),
        back=torch.from_numpy(back).to(device),
        table=torch.from_numpy(table).to(device),
        chances=kept,
        objects=torch.from_numpy(np.stack(objects)).to(device),
        colours=torch.stack(colours),
        fractions=shares[store.task],
        changes=Changes(**changes),
    )
