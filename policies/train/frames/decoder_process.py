"""``python -m arena_newton.policies.train.frames.decoder_process``: a process that decodes episodes for a training.

The training starts it, says on its input which episode is wanted, and finds the pictures in memory that both map; lines
of JSON in both directions. The process waits before it writes over pictures that have not been read, and ends with the
training: by the end of its input, or when nobody reads its output.
"""

from __future__ import annotations

import json
import mmap
import os
import sys
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import av
import numpy as np

from arena_newton.data.readers.frame_reader import OpenVideo
from arena_newton.errors import InputError

__all__ = ["SLOTS", "EpisodeDecoder", "chunk", "main", "mapped"]

SLOTS = 2
"""Slots of a process: it decodes into one while the other is read."""


class EpisodeDecoder:
    """Decodes episodes one after the other; the file of the last one stays open, as others are in it too."""

    def __init__(self, height: int, width: int):
        """Prepare; nothing is opened yet.

        Args:
            height: Of the pictures [px].
            width: Of the pictures [px].
        """
        self._shape = height, width, 3
        self._video: OpenVideo | None = None
        self._above = self._below = np.zeros((0, width, 3), np.uint8)

    def begin(self, top: int, bottom: int) -> None:
        """Begin an episode.

        Args:
            top: Rows above that are cut off [px].
            bottom: Rows below that are cut off [px].
        """
        width = self._shape[1]
        self._above, self._below = np.zeros((top, width, 3), np.uint8), np.zeros((bottom, width, 3), np.uint8)

    def fill(self, path: Path, first: int, pictures: np.ndarray, every: int = 1) -> None:
        """Decode as many pictures as there is room for.

        Args:
            first: Number of the first one in it.
            pictures: Where they are wanted without the rows that are cut off, uint8, shape [N, rows, width, 3].
            every: Pictures of the film from one to the next.

        Raises:
            InputError: The film lacks one, cannot be decoded, or has pictures of another size.
        """
        top, end = len(self._above), self._shape[0] - len(self._below)
        try:
            video = self._opened(path)
            if (last := first + (len(pictures) - 1) * every) >= len(video.times):
                raise InputError(f"{path}: has {len(video.times)} frames, none is {last}")
            for number in range(len(pictures)):
                picture = video.read(first + number * every)
                if picture.shape != self._shape:
                    raise InputError(f"{path}: a picture has shape {list(picture.shape)}, expected {list(self._shape)}")
                pictures[number] = picture[top:end]
                np.maximum(self._above, picture[:top], out=self._above)
                np.maximum(self._below, picture[end:], out=self._below)
        except (av.error.FFmpegError, OSError, IndexError) as error:
            self.close()
            raise InputError(f"{path}: cannot be decoded ({type(error).__name__})") from error

    def brightest(self) -> tuple[np.ndarray, np.ndarray]:
        """Largest values since `begin` in each row that is cut off above, uint8 [top], and below, uint8 [bottom]."""
        return self._above.max(axis=(1, 2)), self._below.max(axis=(1, 2))

    def _opened(self, path: Path) -> OpenVideo:
        if self._video is None or self._video.path != path:
            self.close()
            self._video = OpenVideo(path)
        return self._video

    def close(self) -> None:
        """Close the file."""
        if self._video is not None:
            self._video.close()
            self._video = None


def chunk(slot: int, shape: tuple[int, ...]) -> int:
    """Pictures of a shape that go into a slot of so many bytes at once."""
    return max(1, slot // max(1, int(np.prod(shape))))


def mapped(fd: int, process: int, slot: int) -> mmap.mmap:
    """The slots of a process.

    Args:
        fd: File of the memory of all processes.
        slot: Bytes of a slot, whole pages.
    """
    return mmap.mmap(fd, SLOTS * slot, offset=process * SLOTS * slot)


class _Decoding:
    """Work of the process."""

    def __init__(self, height: int, width: int, memory: mmap.mmap, slot: int):
        self._height, self._width = height, width
        self._decoder = EpisodeDecoder(height, width)
        self._memory, self._slot = memory, slot
        self._free = deque(range(SLOTS))
        self._wanted: deque[dict[str, object]] = deque()

    def work(self) -> None:
        """Decode what is asked for until the input ends."""
        while self._wanted or self._hear():
            if self._wanted and not self._decode(self._wanted.popleft()):
                return

    def _hear(self) -> bool:
        """Read a message; False where none will come."""
        line = sys.stdin.readline()
        if not line:
            return False
        message = json.loads(line)
        if "free" in message:
            self._free.append(int(message["free"]))
        else:
            self._wanted.append(message)
        return True

    def _decode(self, episode: Mapping[str, object]) -> bool:
        """Decode an episode; False where the training has ended, or it cannot be decoded."""
        path = Path(cast("str", episode["path"]))
        names = ("first", "frames", "every", "top", "bottom")
        first, frames, every, top, bottom = (cast("int", episode[name]) for name in names)
        shape = self._height - top - bottom, self._width, 3
        most = chunk(self._slot, shape)
        self._decoder.begin(top, bottom)
        for start in range(0, frames, most):
            while not self._free:
                if not self._hear():
                    return False
            slot, count = self._free.popleft(), min(most, frames - start)
            pictures = np.ndarray((count, *shape), np.uint8, self._memory, slot * self._slot)
            try:
                self._decoder.fill(path, first + start * every, pictures, every)
            except InputError as error:
                _say({"error": str(error)})
                return False
            _say({"slot": slot, "start": start, "count": count})
        above, below = self._decoder.brightest()
        _say({"above": above.tolist(), "below": below.tolist()})
        return True


def _say(message: Mapping[str, object]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def main(*numbers: str) -> None:
    """Decode until the training ends.

    Args:
        numbers: Open file of the memory, number of this process, bytes of a slot, height and width of a picture [px].
    """
    fd, process, slot, height, width = map(int, numbers)
    try:
        _Decoding(height, width, mapped(fd, process, slot), slot).work()
    except BrokenPipeError:  # nobody listens; what is still to be written at the exit must not say so
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main(*sys.argv[1:])
