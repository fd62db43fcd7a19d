"""Pictures on disk: H.264 videos and film strips."""

from __future__ import annotations

import os
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from arena_newton.errors import ArenaError

__all__ = ["VideoWriter", "film_strip"]

GAP = 4
"""Space between the frames of a film strip [px]."""
LABEL_HEIGHT = 18
"""Height of a film strip's label line [px]."""


def _rgb(frame: Any) -> np.ndarray:
    """A frame as a contiguous uint8 array [H, W, 3]; torch tensors and arrays are accepted."""
    if hasattr(frame, "cpu"):
        frame = frame.cpu().numpy()
    elif not isinstance(frame, np.ndarray) and hasattr(frame, "numpy"):
        frame = frame.numpy()
    frame = np.asarray(frame)
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ArenaError(f"a frame must be uint8 [H, W, 3], got {frame.dtype} {list(frame.shape)}")
    return np.ascontiguousarray(frame)


class VideoWriter:
    """An H.264 MP4 (yuv420p) that appears under its name only when it is complete.

    Frames go to `<name>.part` beside the target; `close` renames it. Odd sizes are padded by one black row or column,
    because yuv420p halves both.
    """

    def __init__(self, path: str | Path, width: int, height: int, fps: float = 25.0, *, crf: int = 20):
        """Open the file.

        Args:
            path: Target, `.mp4`.
            width: Frame width [px].
            height: Frame height [px].
            fps: Frame rate [1/s].
            crf: x264's constant rate factor; smaller is better and larger on disk.
        """
        import av

        self.path = Path(path)
        self.width, self.height = int(width), int(height)
        self.frames = 0
        """Frames written so far."""
        self._size = (self.height + self.height % 2, self.width + self.width % 2)
        self._part = self.path.with_name(self.path.name + ".part")
        self._part.parent.mkdir(parents=True, exist_ok=True)
        self._container: Any = av.open(str(self._part), mode="w", format="mp4", options={"movflags": "+faststart"})
        rate = Fraction(float(fps)).limit_denominator(1000)
        self._stream = self._container.add_stream("libx264", rate=rate)
        self._stream.height, self._stream.width = self._size
        self._stream.pix_fmt = "yuv420p"
        # One encoder thread: videos are written beside a simulation that uses every core.
        self._stream.codec_context.thread_count = 1
        self._stream.options = {"crf": str(crf), "preset": "veryfast"}

    def write(self, frame: Any) -> None:
        """Append a frame, uint8 [height, width, 3] (array or torch tensor).

        Raises:
            ArenaError: The frame has another size or type, or the video is closed.
        """
        import av

        if self._container is None:
            raise ArenaError(f"{self.path}: the video is closed")
        pixels = _rgb(frame)
        if pixels.shape[:2] != (self.height, self.width):
            raise ArenaError(f"{self.path}: expected frames of {self.width}×{self.height}, got {pixels.shape[1::-1]}")
        if self._size != pixels.shape[:2]:
            pixels = np.pad(pixels, ((0, self._size[0] - self.height), (0, self._size[1] - self.width), (0, 0)))
        self._mux(self._stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        self.frames += 1

    def _mux(self, packets: Any) -> None:
        for packet in packets:
            self._container.mux(packet)

    def close(self) -> None:
        """Finish the file and give it its name; a video without frames leaves nothing."""
        if self._container is None:
            return
        try:
            if self.frames:
                self._mux(self._stream.encode(None))
        finally:
            container, self._container = self._container, None
            if self.frames:
                container.close()
        if self.frames:
            os.replace(self._part, self.path)
        else:
            self._abandon(container)

    def discard(self) -> None:
        """Drop the file."""
        if self._container is not None:
            container, self._container = self._container, None
            self._abandon(container)

    def _abandon(self, container: Any) -> None:
        import contextlib

        import av

        # An MP4 without a frame cannot be finished: the muxer complains, and the file is dropped anyway.
        with contextlib.suppress(av.error.FFmpegError, ValueError):
            container.close()
        self._part.unlink(missing_ok=True)

    def __enter__(self) -> VideoWriter:
        """The writer itself."""
        return self

    def __exit__(self, kind: Any, *_: Any) -> None:
        """Finish the file, or drop it after an error."""
        if kind is None:
            self.close()
        else:
            self.discard()


def film_strip(frames: Sequence[Any], path: str | Path, n: int = 10, label: str | None = None) -> Path:
    """Write `n` evenly spaced frames side by side as one PNG, first and last frame included.

    Args:
        frames: Frames of one size, uint8 [H, W, 3].
        path: Target, `.png`.
        n: Number of frames; with fewer frames than that, all of them.
        label: Line of text above the strip.

    Returns:
        The path.

    Raises:
        ArenaError: No frames.
    """
    from PIL import Image, ImageDraw

    if len(frames) == 0:
        raise ArenaError(f"{path}: a film strip needs at least one frame")
    picks = np.linspace(0, len(frames) - 1, min(n, len(frames))).round().astype(int)
    chosen = [_rgb(frames[i]) for i in picks]
    height, width = chosen[0].shape[:2]
    top = LABEL_HEIGHT if label else 0
    strip = Image.new("RGB", (len(chosen) * (width + GAP) - GAP, height + top), "white")
    for i, frame in enumerate(chosen):
        strip.paste(Image.fromarray(frame), (i * (width + GAP), top))
    if label:
        ImageDraw.Draw(strip).text((GAP, 3), label, fill="black")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    strip.save(part, format="PNG")
    os.replace(part, path)
    return path
