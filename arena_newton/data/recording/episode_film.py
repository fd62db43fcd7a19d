"""The film of one camera and episode while it is made: the MP4, and the depths of its pictures.

Nothing here needs torch, so that a process that encodes pictures starts at once.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from arena_newton.files.untrusted_files import create
from arena_newton.pictures.video import VideoWriter, key_frames

__all__ = ["CRF", "Film", "FilmFacts"]

CRF = 20
"""Constant rate factor of x264."""


@dataclass(frozen=True)
class FilmFacts:
    """Facts about a finished film."""

    width: int
    """[px]."""
    height: int
    """[px]."""
    frames: int
    """Number of pictures."""
    depth_shape: tuple[int, ...]
    """Shape of a picture's depth, [H, W]; empty where none was recorded."""


class Film:
    """Pictures of one camera of an episode, in their order; nothing is opened before the first one."""

    def __init__(self, video: Path, depth: Path, fps: float, lossless: bool = False):
        """Name the files.

        Args:
            video: The MP4, which has its name when it is complete.
            depth: Raw float16 of all depths, there until it is removed.
            fps: Frame rate [1/s].
            lossless: Keep every byte of the pictures.
        """
        self.video, self.depth, self.fps = video, depth, fps
        self._how: dict[str, bool] = {"b_frames": False, "sync": True, "lossless": lossless}
        self._writer: VideoWriter | None = None
        self._depth_file: BinaryIO | None = None
        self._depth_shape: tuple[int, ...] = ()

    def add(self, picture: np.ndarray, depth: np.ndarray | None) -> None:
        """Append a frame, uint8 [H, W, 3], and its depth [m], float16 [H, W], if that is recorded.

        Raises:
            OSError: A file cannot be written; the error carries its name.
        """
        if self._writer is None:
            height, width = picture.shape[:2]
            self._writer = VideoWriter(
                self.video, width, height, self.fps, crf=CRF, gop=key_frames(height), **self._how
            )
        self._writer.write(picture)
        if depth is not None:
            if self._depth_file is None:
                self._depth_file, self._depth_shape = create(self.depth), depth.shape
            try:
                self._depth_file.write(np.ascontiguousarray(depth).data)
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(self.depth)) from None

    def close(self) -> FilmFacts | None:
        """Finish the files; None where there was no picture.

        Raises:
            OSError: A file cannot be finished; the error carries its name.
        """
        if self._writer is None:
            return None
        self._writer.close()
        if self._depth_file is not None:
            try:
                self._depth_file.close()
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(self.depth)) from None
        writer = self._writer
        return FilmFacts(writer.width, writer.height, writer.frames, self._depth_shape)

    def discard(self) -> None:
        """Remove what was written."""
        if self._writer is not None:
            self._writer.discard()
            self.video.unlink(missing_ok=True)
        if self._depth_file is not None:
            with contextlib.suppress(OSError):  # what is buffered may not fit on the disk
                self._depth_file.close()
            self.depth.unlink(missing_ok=True)
