"""Random access to the pictures of a LeRobot v3.0 dataset: PyAV with files kept open, no torchcodec and no LeRobot."""

from __future__ import annotations

import bisect
import os
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np

from arena_newton.data.readers.dataset_files import DatasetFiles, VideoPart
from arena_newton.errors import InputError

__all__ = ["Frames", "OpenVideo"]

OPEN_FILES = 64
"""Video files that are kept open; each holds a decoder and some MB."""


class OpenVideo:
    """One file, its decoder, and the times of its frames."""

    def __init__(self, path: Path):
        """Open the file and find its key frames.

        Raises:
            OSError: It is absent or no video (also `av.error.FFmpegError`, which PyAV raises).
        """
        self.path = path
        # A title in another encoding is no damage: nobody reads it.
        self._container = av.open(str(path), metadata_errors="replace")
        self._stream = self._container.streams.video[0]
        if self._stream.codec_context is None:
            self._container.close()
            raise OSError(f"{path}: holds no video that can be decoded")
        # One thread: frames of one group depend on each other, and a reader has processes of its own.
        self._stream.codec_context.thread_count = 1
        packets = [(p.pts, p.is_keyframe) for p in self._container.demux(self._stream) if p.pts is not None]
        self.times: list[int] = sorted(pts for pts, _ in packets)
        self._keys = sorted(pts for pts, is_key in packets if is_key)
        self._frames: Iterator[av.VideoFrame] = iter(())
        self._next = -1
        """Number of the frame that the decoder gives next."""

    def read(self, number: int) -> np.ndarray:
        """A frame, uint8, shape [H, W, 3].

        Raises:
            InputError: It cannot be decoded.
        """
        wanted = self.times[number]
        key = self._keys[max(0, bisect.bisect_right(self._keys, wanted) - 1)]
        if not 0 <= self._next <= number or self.times[self._next] < key:
            self._container.seek(key, stream=self._stream, backward=True, any_frame=False)
            self._frames = self._container.decode(self._stream)
        for frame in self._frames:
            if frame.pts == wanted:
                self._next = number + 1 if number + 1 < len(self.times) else -1
                picture: np.ndarray = frame.to_ndarray(format="rgb24")
                return picture
        raise InputError(f"{self.path}: frame {number} cannot be decoded")

    def close(self) -> None:
        """Close the file."""
        self._container.close()


class Frames:
    """Pictures of one camera by row of the dataset; `len(frames)` rows, `frames[i]` is uint8 of shape [H, W, 3].

    It can be given to worker processes: each opens the files for itself.
    """

    def __init__(self, root: str | Path, camera: str | None = None, *, open_files: int = OPEN_FILES):
        """Read the tables of a dataset.

        Args:
            camera: Feature, or its name after `observation.images.`; the first one by default.
            open_files: Video files that are kept open.

        Raises:
            InputError: It is no LeRobot v3.0 dataset, or has no such camera.
        """
        files = DatasetFiles(root)
        keys = files.video_keys
        key = f"observation.images.{camera}" if camera and camera not in keys else camera or (keys[0] if keys else "")
        if key not in keys:
            raise InputError(f"{root}: has no camera {camera or ''}, known are {' '.join(keys) or 'none'}")
        self.camera = key
        """Feature whose pictures these are."""
        rows = files.episode_rows
        self._starts = [row.first for row in rows]
        self._parts = [files.video(row, key) for row in rows]
        for row, part in zip(rows, self._parts, strict=True):
            if part.frames != row.length:
                raise InputError(f"{part.path}: episode {row.index} has {part.frames} frames and {row.length} rows")
        self._length = files.frames
        self._most = max(1, open_files)
        self._open: OrderedDict[Path, OpenVideo] = OrderedDict()
        self._process = os.getpid()

    def __len__(self) -> int:
        """Rows of the dataset."""
        return self._length

    def __getitem__(self, row: int) -> np.ndarray:
        """Picture of a row, uint8, shape [H, W, 3].

        Raises:
            IndexError: There is no such row.
            InputError: The video lacks the frame, or cannot be decoded.
        """
        number = row + self._length if row < 0 else row
        if not 0 <= number < self._length:
            raise IndexError(f"row {row} of {self._length}")
        episode = bisect.bisect_right(self._starts, number) - 1
        part = self._parts[episode]
        return self.read(part, number - self._starts[episode])

    @property
    def parts(self) -> list[VideoPart]:
        """Video file and time range of each episode."""
        return list(self._parts)

    def read(self, part: VideoPart, number: int) -> np.ndarray:
        """Frame `number` of an episode, uint8, shape [H, W, 3].

        Raises:
            InputError: The video lacks the frame, or cannot be decoded.
        """
        try:
            video = self._video(part.path)
            if not part.first + number < len(video.times):
                raise InputError(f"{part.path}: has {len(video.times)} frames, none is {part.first + number}")
            return video.read(part.first + number)
        except (av.error.FFmpegError, OSError, IndexError) as error:
            self._drop(part.path)
            raise InputError(f"{part.path}: cannot be decoded ({type(error).__name__})") from error

    def episode(self, index: int) -> Iterator[np.ndarray]:
        """Pictures of an episode in order."""
        part = self._parts[index]
        for number in range(part.frames):
            yield self.read(part, number)

    def _video(self, path: Path) -> OpenVideo:
        if self._process != os.getpid():  # a decoder does not survive a fork
            self._open, self._process = OrderedDict(), os.getpid()
        if path in self._open:
            self._open.move_to_end(path)
            return self._open[path]
        while len(self._open) >= self._most:
            self._open.popitem(last=False)[1].close()
        self._open[path] = OpenVideo(path)
        return self._open[path]

    def _drop(self, path: Path) -> None:
        if path in self._open:
            self._open.pop(path).close()

    def close(self) -> None:
        """Close all files; the next picture opens its own again."""
        while self._open:
            self._open.popitem()[1].close()

    def __getstate__(self) -> dict[str, object]:
        """Everything but open files."""
        return {**self.__dict__, "_open": OrderedDict()}
