"""Film strips and videos of clips: a row of pictures per clip, the time under each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from arena_newton.errors import InputError
from arena_newton.files.own_files import replace_atomically
from arena_newton.pictures.video import GAP, LABEL_HEIGHT, VideoWriter
from arena_newton.robot.g1 import TICK
from arena_newton.trackers.motions.library import MotionLibrary
from arena_newton.trackers.motions.render import ClipRenderer

__all__ = ["film", "movie", "picked_frames"]

VIDEO_FPS = 25.0
"""Frame rate of videos [1/s]: every other tick."""


def picked_frames(library: MotionLibrary, clip: int, count: int, start: float, end: float | None) -> np.ndarray:
    """Evenly spaced frames of a clip between two times [s], first and last included.

    Raises:
        InputError: The clip is not that long, or fewer than 1 picture is asked for.
    """
    length = float(library.seconds[clip])
    stop = length if end is None else min(end, length)
    if count < 1:
        raise InputError(f"--pictures {count}: expected 1 or more")
    if not 0.0 <= start < stop:
        name = library.clip_names[clip]
        raise InputError(f"--start {start:g}: clip {name} has nothing between {start:g} s and {stop:g} s")
    frames = np.linspace(start / TICK, stop / TICK, count).round().astype(int)
    return np.unique(np.minimum(frames, library.clip_length[clip] - 1))


def film(
    library: MotionLibrary,
    clips: Sequence[int],
    out: str | Path,
    *,
    pictures: int = 10,
    width: int = 180,
    start: float = 0.0,
    end: float | None = None,
) -> Path:
    """Write a PNG with one strip of pictures per clip, from `start` to `end` [s] (by default the clip's end).

    A picture is `width` [px] wide and a third more high.

    Raises:
        InputError: No such time, or the file cannot be written.
    """
    picked = [picked_frames(library, clip, pictures, start, end) for clip in clips]
    renderer = ClipRenderer(library, width=width, height=width * 4 // 3)
    high, row = renderer.height, renderer.height + LABEL_HEIGHT + GAP
    columns = max(map(len, picked))
    sheet = Image.new("RGB", (columns * (width + GAP) + GAP, row * len(clips)), "white")
    text = ImageDraw.Draw(sheet)
    for line, (clip, frames) in enumerate(zip(clips, picked, strict=True)):
        y = line * row
        family = library.family_names[library.family[clip]]
        text.text((GAP, y + 3), f"{library.clip_names[clip]} ({family})", fill="black")
        for column, picture in enumerate(renderer.pictures(clip, frames)):
            x = GAP + column * (width + GAP)
            sheet.paste(Image.fromarray(picture), (x, y + LABEL_HEIGHT))
            text.text((x + 3, y + LABEL_HEIGHT + high - 14), f"{frames[column] * TICK:.2f} s", fill="black")
    out = Path(out)
    try:
        with replace_atomically(out) as file:
            sheet.save(file, format="PNG")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error
    return out


def movie(
    library: MotionLibrary,
    clips: Sequence[int],
    out: str | Path,
    *,
    width: int = 360,
    start: float = 0.0,
    end: float | None = None,
) -> Path:
    """Write an MP4 of clips one after the other, at 25 frames per second; arguments as of `film`.

    Raises:
        InputError: No such time, or the file cannot be written.
    """
    picked = []
    for clip in clips:
        first, last = picked_frames(library, clip, 2, start, end)[[0, -1]]
        picked.append(np.arange(first, last + 1, round(1.0 / (VIDEO_FPS * TICK))))
    renderer = ClipRenderer(library, width=width, height=width * 4 // 3)
    try:
        with VideoWriter(out, renderer.width, renderer.height, VIDEO_FPS) as video:
            for clip, frames in zip(clips, picked, strict=True):
                for picture in renderer.pictures(clip, frames):
                    video.write(picture)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error
    return Path(out)
