"""Rows of noise, for measurements of trainings without a dataset."""

from __future__ import annotations

import numpy as np
import torch

from arena_newton.pictures.changed_looks import COLOURS
from arena_newton.policies.train.frames.demonstration_rows import EpisodeRows
from arena_newton.policies.train.frames.frame_store import FrameStore, assembled, check_memory
from arena_newton.policies.train.frames.look_store import LookStore
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH

__all__ = ["made_frames", "made_looks"]


def made_frames(
    frames: int, size: int, device: torch.device, *, seed: int = 0, length: int = 500, network: int = 0
) -> FrameStore:
    """Rows of noise, for measurements without a dataset.

    Args:
        size: Height and width of a picture [px]; an eighth of the rows above and below is black, as in a padded one.
        length: Rows of an episode.
        network: Memory that the network needs beside them [bytes].

    Raises:
        InputError: They do not fit.
    """
    band = size // 8
    check_memory(frames, frames, size - 2 * band, size, device, network)
    generator = torch.Generator(device).manual_seed(seed)
    pictures = torch.empty((frames, size - 2 * band, size, 3), dtype=torch.uint8, device=device)
    for start in range(0, frames, length):
        part = pictures[start : start + length]
        part.copy_(torch.randint(0, 256, part.shape, generator=generator, dtype=torch.uint8, device=device))
    rng = np.random.default_rng(seed)
    episodes = []
    for start in range(0, frames, length):
        rows = min(length, frames - start)
        states = rng.normal(size=(rows, STATE_WIDTH)).astype(np.float32)
        actions = rng.normal(size=(rows, ACTION_WIDTH)).astype(np.float32)
        episodes.append(EpisodeRows(states, actions, "Walk to the sign.", "vis_navi"))
    return assembled(episodes, pictures, [False] * len(episodes), band, band)


def made_looks(store: FrameStore, fraction: float, shapes: int = 40) -> LookStore:
    """Looks of all rows of a store: upright strips of so many shapes, under lights of noise.

    Args:
        fraction: Fraction of the samples whose looks change.
    """
    device, (count, height, width) = store.device, store.pictures.shape[:3]
    frames = torch.randint(64, 192, (count, height, width, 2), dtype=torch.uint8, device=device)
    frames[..., 0] = 2 + torch.arange(width, device=device) * shapes // width
    rows = torch.arange(store.rows, device=device)
    every = torch.zeros_like(rows)
    return LookStore(
        frames=frames,
        number=store.picture[rows],
        back=every,
        table=every,
        chances=torch.ones((1, 256), device=device),
        objects=torch.arange(256, device=device)[None],
        colours=torch.arange(COLOURS, device=device)[None],
        fractions=torch.full((store.rows,), fraction, device=device),
    )
