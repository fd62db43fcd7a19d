"""Pictures of an episode under changed looks, as a training sees them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from arena_newton.data.readers.frame_reader import OpenVideo
from arena_newton.data.readers.looks import Looks
from arena_newton.pictures.changed_looks import changed_looks, goal_colour, unlike

__all__ = ["changed_rows"]


def changed_rows(
    pictures: Sequence[np.ndarray], rows: Sequence[int], looks: Looks, film: Path, count: int
) -> list[list[np.ndarray]]:
    """Change the looks of pictures; things are cut out of each other.

    Args:
        pictures: uint8, each of shape [H, W, 3].
        rows: Their rows of the episode, which have frames of looks.
        looks: Meaning of these.
        film: Film of looks.
        count: Looks of each picture.

    Returns:
        For each look all pictures, uint8, shape [H, W, 3].
    """
    video = OpenVideo(film)
    try:
        frames = np.stack([video.read(row // looks.stride) for row in rows])
    finally:
        video.close()
    chances = torch.from_numpy(looks.chances()).expand(len(rows), -1)
    objects = torch.from_numpy(looks.objects()).expand(len(rows), -1)
    number, seen, shown = torch.arange(len(rows)), torch.from_numpy(np.stack(pictures)), torch.from_numpy(frames)
    colours = unlike(goal_colour(seen, shown[..., 0], chances[0])).expand(len(rows), -1)
    with torch.random.fork_rng([]):
        torch.manual_seed(len(rows))
        changed = [changed_looks(seen, shown, chances, objects, colours, number) for _ in range(count)]
    return [list((255.0 * one).round().byte().numpy()) for one in changed]
