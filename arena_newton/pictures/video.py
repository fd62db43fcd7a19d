"""Pictures on disk: H.264 videos, film strips, and the text on both."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import av
import cv2
import numpy as np

from arena_newton.errors import ArenaError
from arena_newton.files.own_files import PARTIAL, replace_atomically
from arena_newton.files.untrusted_files import create

if TYPE_CHECKING:  # a process that encodes pictures starts without torch
    import torch

    Picture = np.ndarray | torch.Tensor
    """A frame, uint8, shape [H, W, 3]."""

__all__ = ["VideoWriter", "caption", "evenly", "film_strip", "key_frames"]

GAP = 4
"""Space between the frames of a film strip [px]."""
LABEL_HEIGHT = 18
"""Least height of a film strip's label line, and of the line of captions under it [px]."""
LABEL_FRACTION = 0.12
"""The same as a fraction of the frame's height, for larger frames: a page shows a strip at a third of its size."""
JPEG_QUALITY = 90
"""Quality of film strips that are JPEGs: a third of the PNG's size, no visible loss at the size of a page."""
SMALL = 256
"""Recorded pictures up to this height [px] have a key frame every `GOP_SMALL` frames, larger ones every `GOP_LARGE`."""
GOP_SMALL, GOP_LARGE = 8, 2
"""Frames from one key frame to the next, between the size of the files and the time to read any one frame. Who reads
every eighth picture, as the trainings of the policy that ships, decodes no other: in half the time that ten take."""


def key_frames(height: int) -> int:
    """Frames from one key frame to the next, of recorded pictures of this height [px]."""
    return GOP_SMALL if height <= SMALL else GOP_LARGE


def _rgb(frame: Picture) -> np.ndarray:
    """A frame as a contiguous array."""
    frame = np.asarray(frame.cpu() if hasattr(frame, "cpu") else frame)
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ArenaError(f"a frame must be uint8 [H, W, 3], got {frame.dtype} {list(frame.shape)}")
    return np.ascontiguousarray(frame)


def _named(error: OSError, path: Path) -> OSError:
    """The same error with the file's name, which a failed write does not carry."""
    return OSError(error.errno, os.strerror(error.errno) if error.errno else str(error), str(path))


class VideoWriter:
    """An H.264 MP4 (yuv420p, or RGB without loss) that appears under its name only when it is complete.

    Frames go to `<name>.part` next to the target; `close` renames it. Odd sizes are padded by one black row or column,
    because yuv420p halves both.
    """

    def __init__(
        self,
        path: str | Path,
        width: int,
        height: int,
        fps: float = 25.0,
        *,
        crf: int = 20,
        gop: int | None = None,
        b_frames: bool = True,
        sync: bool = False,
        lossless: bool = False,
    ):
        """Open the file.

        Args:
            path: Target, `.mp4`.
            width: Frame width [px].
            height: Frame height [px].
            fps: Frame rate [1/s].
            crf: x264's constant rate factor; smaller is better and larger on disk.
            gop: Frames from one key frame to the next; x264's own, at most 250, by default. A reader that wants one
                frame decodes all from the key frame before it.
            b_frames: Allow frames that are predicted from later ones: smaller, slower to read in any order.
            sync: Wait at the end until the file is on the disk.
            lossless: Keep every byte of the frames; `crf` is not used. Their preset takes half the time to encode, and
                their entropy coder half the time to decode, for files larger by a fifth.

        Raises:
            OSError: The file cannot be written; the error carries its name.
        """
        self.path = Path(path)
        self.width, self.height, self.sync = int(width), int(height), sync
        self.frames = 0
        """Frames written so far."""
        self._size = (self.height + self.height % 2, self.width + self.width % 2)
        self._part = self.path.with_name(self.path.name + PARTIAL)
        self._part.parent.mkdir(parents=True, exist_ok=True)
        create(self._part).close()  # a link of that name would be followed
        self._container: av.container.OutputContainer | None
        self._container = av.open(str(self._part), mode="w", format="mp4", options={"movflags": "+faststart"})
        rate = Fraction(float(fps)).limit_denominator(1000)
        stream = self._container.add_stream("libx264rgb" if lossless else "libx264", rate=rate)
        assert isinstance(stream, av.VideoStream)
        self._stream = stream
        self._stream.height, self._stream.width = self._size
        self._stream.pix_fmt = "rgb24" if lossless else "yuv420p"
        # One frame for all pictures, which the encoder copies; black where odd sizes are padded.
        self._frame = av.VideoFrame(self._size[1], self._size[0], "rgb24")
        (plane,) = self._frame.planes
        whole = np.ndarray((*self._size, 3), np.uint8, plane, strides=(plane.line_size, 3, 1))
        whole[:] = 0
        self._pixels = whole[: self.height, : self.width]
        # One encoder thread: videos are written during a simulation that uses every core.
        self._stream.codec_context.thread_count = 1
        # Without mbtree: it reads memory that nobody wrote, so that equal frames give different bytes now and then.
        preset, quality = ("ultrafast", {"qp": "0"}) if lossless else ("veryfast", {"crf": str(crf)})
        self._stream.options = {**quality, "preset": preset, "mbtree": "0"}
        if gop is not None:
            self._stream.options |= {"g": str(gop), "keyint_min": str(gop), "sc_threshold": "0"}
        if not b_frames:
            self._stream.options |= {"bf": "0"}

    def write(self, frame: Picture) -> None:
        """Append a frame, uint8 [height, width, 3] (array or torch tensor).

        Raises:
            ArenaError: The frame has another size or type, or the video is closed.
            OSError: The file cannot be written; what was written of it is removed.
        """
        if self._container is None:
            raise ArenaError(f"{self.path}: the video is closed")
        pixels = _rgb(frame)
        if pixels.shape[:2] != (self.height, self.width):
            raise ArenaError(f"{self.path}: expected frames of {self.width}×{self.height}, got {pixels.shape[1::-1]}")
        self._pixels[:] = pixels
        self._frame.pts = self.frames
        try:
            self._mux(self._stream.encode(self._frame))
        except OSError as error:
            self.discard()
            raise _named(error, self.path) from None
        self.frames += 1

    def _mux(self, packets: Sequence[av.Packet]) -> None:
        if self._container is not None:
            self._container.mux(packets)

    def close(self) -> None:
        """Finish the file and give it its name; a video without frames leaves nothing.

        Raises:
            OSError: The file cannot be finished; what was written of it is removed.
        """
        if self._container is None:
            return
        if not self.frames:
            self.discard()
            return
        try:
            self._mux(self._stream.encode(None))
            container, self._container = self._container, None
            container.close()
            if self.sync:
                with self._part.open("rb") as file:
                    os.fsync(file.fileno())
            os.replace(self._part, self.path)
        except OSError as error:
            self.discard()
            raise _named(error, self.path) from None

    def discard(self) -> None:
        """Drop the file."""
        container, self._container = self._container, None
        if container is not None:
            # An MP4 without a frame cannot be finished: the muxer complains, and the file is dropped anyway.
            with contextlib.suppress(av.error.FFmpegError, ValueError):
                container.close()
        with contextlib.suppress(OSError):
            self._part.unlink(missing_ok=True)

    def __enter__(self) -> VideoWriter:
        """The writer itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Finish the file, or drop it after an error."""
        if kind is None:
            self.close()
        else:
            self.discard()


def caption(
    frame: Picture, text: str, colour: tuple[int, int, int] = (255, 255, 255), *, at_top: bool = False
) -> np.ndarray:
    """A copy of a frame with a line of text at the lower or upper left, as large as suits its height.

    Args:
        frame: uint8 [H, W, 3].
        text: ASCII.
        colour: RGB of the text; a dark edge keeps it readable on any ground.
        at_top: Whether it is at the upper left.
    """
    picture = _rgb(frame).copy()
    scale = max(0.35, picture.shape[0] / 600)
    margin = round(12 * scale) + 2
    at = (round(10 * scale) + 2, margin + round(22 * scale) if at_top else picture.shape[0] - margin)
    for line, thickness in (((16, 16, 16), 3 * max(1, round(scale))), (colour, max(1, round(scale)))):
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, line, thickness, cv2.LINE_AA)
    return picture


def evenly(count: int, n: int) -> list[int]:
    """Indices of `n` evenly spaced ones of `count`, first and last included; all of them where there are fewer."""
    return [int(i) for i in np.linspace(0, count - 1, min(n, count)).round()]


def film_strip(
    frames: Sequence[Picture],
    path: str | Path,
    n: int = 10,
    label: str | None = None,
    *,
    colour: tuple[int, int, int] = (0, 0, 0),
    captions: Sequence[str] | None = None,
) -> Path:
    """Write `n` evenly spaced frames side by side as one picture, first and last frame included.

    Args:
        frames: Frames of one size, uint8 [H, W, 3].
        path: Target, `.png` or `.jpg`.
        n: Number of frames; with fewer frames than that, all of them.
        label: Line of text above the strip.
        colour: RGB of the label.
        captions: A line under each of `frames`, for the chosen ones.

    Returns:
        The path.

    Raises:
        ArenaError: No frames, frames of different sizes, or another kind of file.
        OSError: The file cannot be written; the error carries its name.
    """
    path = Path(path)
    if len(frames) == 0:
        raise ArenaError(f"{path}: a film strip needs at least one frame")
    if path.suffix not in (".png", ".jpg"):
        raise ArenaError(f"{path}: a film strip is a .png or a .jpg")
    picks = evenly(len(frames), n)
    chosen = [_rgb(frames[i]) for i in picks]
    height, width = chosen[0].shape[:2]
    if any(frame.shape != chosen[0].shape for frame in chosen):
        raise ArenaError(f"{path}: the frames of a film strip must be of one size")
    line = max(LABEL_HEIGHT, round(LABEL_FRACTION * height))
    top, bottom = line if label else 0, line if captions else 0
    strip = np.full((top + height + bottom, len(chosen) * (width + GAP) - GAP, 3), 255, np.uint8)

    def write(text: str, x: int, y: int, ink: tuple[int, int, int]) -> None:
        at = (x, y + line - round(0.28 * line))
        cv2.putText(strip, text, at, cv2.FONT_HERSHEY_SIMPLEX, line / 43, ink, round(line / 25), cv2.LINE_AA)

    for i, frame in enumerate(chosen):
        strip[top : top + height, i * (width + GAP) : i * (width + GAP) + width] = frame
        if captions:
            write(captions[picks[i]], i * (width + GAP) + 2, top + height, (60, 60, 60))
    if label:
        write(label, GAP, 0, colour)
    how = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if path.suffix == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 6]
    encoded = cv2.imencode(path.suffix, cv2.cvtColor(strip, cv2.COLOR_RGB2BGR), how)[1]
    try:
        with replace_atomically(path) as file:
            file.write(encoded.tobytes())
    except OSError as error:
        raise _named(error, path) from None
    return path
