"""One success per task side by side: a film of world videos, or a picture of film strips."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import av
import cv2
import numpy as np
from PIL import Image

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord
from arena_newton.eval.records.journal import EpisodeRecord, StorageError
from arena_newton.eval.reports.wording import media_of
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.text import counted, plain
from arena_newton.pictures.settings import STRIP_SIZES
from arena_newton.pictures.video import VideoWriter, caption
from arena_newton.robot.g1 import TICK

__all__ = ["tiled", "write"]

FILMS = (".webp", ".gif", ".mp4")
PICTURES = (".jpg", ".png")
FPS = 10
"""Frames of a film per second: fewer than a video's, which a page would have to load."""
COLUMNS = 4
"""Tiles of a film next to each other."""
QUALITIES = (80, 65, 50, 38, 28, 20)
"""Qualities of a .webp film, tried in this order until its size suits."""
LINE = 26
"""Height of the line of text over a strip [px]."""
GAP = 6
"""Space between tiles, and between strips [px]."""
GROUND = 255
"""Grey of what is between them."""
LEAST_WIDTH, MOST_WIDTH = 200, 4096
MOST_SECONDS = 120.0


def write(runs: Sequence[RunRecord], target: Path, seconds: float, width: int, max_mb: float) -> list[str]:
    """Write the film or picture.

    Args:
        runs: Runs whose successes it shows.
        seconds: Length of a film [s].
        width: Its width [px].
        max_mb: Largest size of a .webp film [MB].

    Returns:
        What it shows and where it is, in lines.

    Raises:
        InputError: No recorded success, an unfit recording, or an option out of range.
        StorageError: The file cannot be written.
    """
    if target.suffix not in FILMS + PICTURES:
        raise InputError(f"--out {target}: expected a file that ends with {' '.join(FILMS + PICTURES)}")
    if not LEAST_WIDTH <= width <= MOST_WIDTH:
        raise InputError(f"--width {width}: expected {LEAST_WIDTH} to {MOST_WIDTH} px")
    if not 1.0 <= seconds <= MOST_SECONDS:
        raise InputError(f"--seconds {seconds:g}: expected 1 to {MOST_SECONDS:g}")
    film = target.suffix in FILMS
    chosen = _successes(runs, "world" if film else "world strip")
    if not chosen:
        flag = "--video" if film else "--strip"
        raise InputError(f"{runs[0].folder}: no success with a recording of the world camera (run {flag})")
    try:
        if film:
            _film(chosen, target, seconds, width, max_mb)
        else:
            _sheet(chosen, target, width)
    except OSError as error:
        raise StorageError(f"{target}: cannot be written ({error.strerror or error})") from None
    lines = [f"{_caption(record)}: {path}" for record, path in chosen]
    absent = [name for name in tasks.PAPER if name not in {record.task for record, _ in chosen}]
    lines += [f"no recorded success of {' '.join(absent)}"] if absent else []
    return [*lines, f"{target}: {counted(len(chosen), 'task')}, {target.stat().st_size / 1e6:.2f} MB"]


def _caption(record: EpisodeRecord) -> str:
    return f"{plain(record.task)}, {plain(record.tracker)}: {record.steps} steps, {record.steps * TICK:.1f} s"


def _successes(runs: Sequence[RunRecord], medium: str) -> list[tuple[EpisodeRecord, Path]]:
    """First recorded success of each task in the order of the plan, with its recording."""
    found: dict[str, tuple[EpisodeRecord, Path]] = {}
    for run in runs:
        for record in run.records:
            path = media_of(record).get(medium)
            if record.outcome == "success" and path is not None and (run.folder / path).is_file():
                found.setdefault(record.task, (record, run.folder / path))
    return [found[name] for name in tasks.names() if name in found]


def _film(
    chosen: Sequence[tuple[EpisodeRecord, Path]], target: Path, seconds: float, whole: int, max_mb: float
) -> None:
    """Play the episodes side by side, each from its start to its end in the same time."""
    count, columns = round(seconds * FPS), min(COLUMNS, len(chosen))
    width = (whole - (columns - 1) * GAP) // columns // 2 * 2
    clips = [_clip(path, count, width, plain(record.task)) for record, path in chosen]
    frames = [tiled([clip[k] for clip in clips], columns) for k in range(count)]
    if target.suffix == ".mp4":
        with VideoWriter(target, frames[0].shape[1], frames[0].shape[0], FPS) as video:
            for frame in frames:
                video.write(frame)
        return
    pictures = [Image.fromarray(frame) for frame in frames]

    def encoded(**how: object) -> bytes:
        file = io.BytesIO()
        rest = {"append_images": pictures[1:], "duration": 1000 // FPS, "loop": 0}
        pictures[0].save(file, target.suffix[1:], save_all=True, **rest, **how)
        return file.getvalue()

    data = encoded() if target.suffix == ".gif" else _fitting(encoded, max_mb)
    with replace_atomically(target) as out:
        out.write(data)


def _fitting(encoded: Callable[..., bytes], max_mb: float) -> bytes:
    """The film at the best quality at which it is small enough."""
    data = b""
    for quality in QUALITIES:
        data = encoded(quality=quality, method=4)
        if len(data) <= 1e6 * max_mb:
            return data
    raise InputError(
        f"--max-mb {max_mb:g}: the film has {len(data) / 1e6:.1f} MB; fewer --seconds or a smaller --width"
    )


def _clip(path: Path, count: int, width: int, name: str) -> list[np.ndarray]:
    """Evenly spaced frames of a video, `width` wide, with a name on them; each uint8 [H, width, 3]."""
    try:
        with av.open(str(path)) as video:
            pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    except (av.error.FFmpegError, IndexError) as error:
        raise InputError(f"{path}: cannot be read as a video ({error})") from None
    if not pictures:
        raise InputError(f"{path}: has no frames")
    height = round(width * pictures[0].shape[0] / pictures[0].shape[1])
    picks = [round(k * (len(pictures) - 1) / max(1, count - 1)) for k in range(count)]
    small = {k: cv2.resize(pictures[k], (width, height), interpolation=cv2.INTER_AREA) for k in set(picks)}
    return [caption(small[k], name, at_top=True) for k in picks]


def tiled(tiles: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Pictures of one width in rows, the last row in the middle; uint8 [H, W, 3], sides even."""
    height, width = max(tile.shape[0] for tile in tiles), tiles[0].shape[1]
    rows = math.ceil(len(tiles) / columns)
    size = (rows * (height + GAP) - GAP, columns * (width + GAP) - GAP)
    ground = np.full((size[0] + size[0] % 2, size[1], 3), GROUND, np.uint8)
    for number, tile in enumerate(tiles):
        row, column = divmod(number, columns)
        missing = columns - min(columns, len(tiles) - row * columns)
        x, y = column * (width + GAP) + missing * (width + GAP) // 2, row * (height + GAP)
        ground[y : y + tile.shape[0], x : x + width] = tile
    return ground


def _sheet(chosen: Sequence[tuple[EpisodeRecord, Path]], target: Path, width: int) -> None:
    """Put film strips one below the other, each under a line that can be read at this width."""
    rows = []
    for record, path in chosen:
        strip = cv2.imread(str(path))
        if strip is None:
            raise InputError(f"{path}: cannot be read as a picture")
        # The strip's own lines of text, above and below the frames, are too small at this width.
        frames = strip[(strip.shape[0] - STRIP_SIZES["world"][1]) // 2 :][: STRIP_SIZES["world"][1]]
        height = round(width * frames.shape[0] / frames.shape[1])
        line = np.full((LINE, width, 3), GROUND, np.uint8)
        at = (2, LINE - 8)
        cv2.putText(line, _caption(record), at, cv2.FONT_HERSHEY_SIMPLEX, LINE / 46, (60, 60, 60), 1, cv2.LINE_AA)
        rows += [line, cv2.resize(frames, (width, height), interpolation=cv2.INTER_AREA)]
    how = [cv2.IMWRITE_JPEG_QUALITY, 88] if target.suffix == ".jpg" else []
    with replace_atomically(target) as out:
        out.write(cv2.imencode(target.suffix, np.concatenate(rows), how)[1].tobytes())
