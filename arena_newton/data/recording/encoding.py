"""Threads that write episodes, and films that are encoded by threads, while their worlds go on.

An episode belongs to one worker, which does its jobs in their order: frame after frame, then the files. Pictures wait
in slots of memory that were allocated once; where all are taken, whoever brings the next pictures waits. So memory is
bounded, no frame is dropped, and a slow disk slows the simulation instead of failing it.

Python's global lock lets few threads encode at once; `encoder_pool` does the same with processes.
"""

from __future__ import annotations

import abc
import queue
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from arena_newton.data.recording.episode_film import Film, FilmFacts
from arena_newton.files.interrupts import Uninterrupted

__all__ = [
    "Encoders",
    "EncoderThreads",
    "VideoEncoder",
    "PictureSlot",
    "PictureSlots",
    "Pictured",
    "VideoStream",
    "copy_pictures",
    "slots_of",
]

SLOT_BYTES = 512 << 20
"""Memory of the pictures of one camera that wait [B]: as many slots as fit into it, `SLOTS` of them at least and most.
"""
SLOTS = (2, 12)
"""Least and most slots of a camera."""

Job = Callable[[], None]


def slots_of(size: int) -> int:
    """Slots of a camera whose pictures of one tick take so many bytes."""
    return min(max(SLOT_BYTES // max(size, 1), SLOTS[0]), SLOTS[1])


def copy_pictures(rows: torch.Tensor, pictures: torch.Tensor) -> None:
    """Copy pictures [n, ...] to the first rows on the host; from a GPU on torch's stream, without waiting for it."""
    if pictures.is_cuda:
        rows[: len(pictures)].copy_(pictures, non_blocking=True)
    else:  # torch would wake a thread per core, while every core encodes
        np.copyto(rows.numpy()[: len(pictures)], pictures.numpy())


@dataclass(frozen=True)
class Pictured:
    """The pictures of a camera."""

    worlds: int
    height: int
    """[px]."""
    width: int
    """[px]."""
    depth: bool
    """True if their depths are recorded too."""


@dataclass(eq=False)
class VideoStream:
    """A film that others make: what its recorder knows of it."""

    number: int
    """No other one of the same `VideoEncoder` has it."""
    worker: int
    """Whoever makes the films of its episode."""
    video: Path
    """The MP4."""
    depth: Path
    """Raw depths, until they are written into the episode's file."""
    film: Film | None = None
    """The film itself, where it is made in this process."""
    broken: bool = False
    """It could not be written; nothing is left of it."""


Finished = Callable[[Mapping[str, FilmFacts | None] | None], None]
"""Callback for an episode's finished films, by camera; it gets None where one of them is broken. A film without
pictures has no facts."""


class VideoEncoder(abc.ABC):
    """Makes the films of the episodes that are recorded at the same time, and then writes the episodes' files."""

    @abc.abstractmethod
    def bind(self, cameras: Mapping[str, Pictured], device: torch.device) -> None:
        """Prepare for pictures of these cameras, which come from a device; no film is in the making."""

    @abc.abstractmethod
    def join(self) -> int:
        """A worker for a new episode; `leave` gives it back."""

    @abc.abstractmethod
    def leave(self, worker: int) -> None:
        """The episode brings no more pictures."""

    @abc.abstractmethod
    def open(self, worker: int, video: Path, depth: Path, fps: float, lossless: bool = False) -> VideoStream:
        """A film of an episode; `lossless` keeps every byte of its pictures."""

    @abc.abstractmethod
    def add(
        self, camera: str, streams: Sequence[VideoStream], pictures: torch.Tensor, depths: torch.Tensor | None
    ) -> None:
        """Append a picture to each film; waits where the workers are too far behind.

        Args:
            camera: Its name in `bind`.
            streams: The films. A list that is given again must be the same one in content.
            pictures: uint8, shape [len(streams), H, W, 3]; they may change afterwards.
            depths: float16 [m], shape [len(streams), H, W].

        Raises:
            OSError: A worker ended.
        """

    @abc.abstractmethod
    def finish(self, worker: int, streams: Mapping[str, VideoStream], then: Finished) -> None:
        """Finish an episode's films, and then do that; not necessarily at once, and in any thread."""

    @abc.abstractmethod
    def discard(self, worker: int, streams: Mapping[str, VideoStream], then: Job) -> None:
        """Drop an episode's films, and then do that."""

    @abc.abstractmethod
    def check(self) -> None:
        """Raise the first error since the last call.

        Raises:
            OSError: A file could not be written, which the error names, or a worker ended.
        """

    @abc.abstractmethod
    def wait(self) -> None:
        """Return when all that was asked for is done."""

    @abc.abstractmethod
    def close(self) -> None:
        """Do what was asked for, and end the workers."""


class Encoders:
    """Threads that each work off a queue; without a thread, jobs are done at once by whoever brings them."""

    def __init__(self, threads: int):
        """Start the threads."""
        self._queues: list[queue.SimpleQueue[Job | None]] = [queue.SimpleQueue() for _ in range(threads)]
        self._open = [0] * threads
        self._unfinished = 0
        self._errors: deque[BaseException] = deque()
        self._changed = threading.Condition()
        self._whole = Uninterrupted()
        self._threads = [
            threading.Thread(target=self._work, args=(jobs,), name=f"encoder-{number}", daemon=True)
            for number, jobs in enumerate(self._queues)
        ]
        for thread in self._threads:
            thread.start()

    def join(self) -> int:
        """A thread for a new episode: that with the fewest; `leave` gives it back."""
        if not self._queues:
            return 0
        number = self._open.index(min(self._open))
        self._open[number] += 1
        return number

    def leave(self, number: int) -> None:
        """The episode brings no more jobs."""
        if self._queues:
            self._open[number] -= 1

    def submit(self, number: int, job: Job) -> None:
        """Have a thread do a job after those that it was given before; an exception is kept for `check`."""
        if not self._queues:
            self._do(job)
            return
        with self._whole:  # a job that is counted and not queued would be waited for without end
            with self._changed:
                self._unfinished += 1
            self._queues[number].put(job)

    def check(self) -> None:
        """Raise the first exception of a job since the last call."""
        if self._errors:
            first = self._errors.popleft()
            self._errors.clear()
            raise first

    def wait(self) -> None:
        """Return when all jobs are done."""
        with self._changed:
            self._changed.wait_for(lambda: not self._unfinished)

    def close(self) -> None:
        """Do what was submitted, and end the threads."""
        for jobs in self._queues:
            jobs.put(None)
        for thread in self._threads:
            thread.join()
        self._queues, self._threads, self._open = [], [], []

    def _work(self, jobs: queue.SimpleQueue[Job | None]) -> None:
        while (job := jobs.get()) is not None:
            self._do(job)
            del job  # what it holds must not wait for the next one
            with self._changed:
                self._unfinished -= 1
                if not self._unfinished:
                    self._changed.notify_all()

    def _do(self, job: Job) -> None:
        try:
            job()
        except BaseException as error:  # a thread that ended would leave its episodes waiting for ever
            self._errors.append(error)


class PictureSlot:
    """Pictures of one tick and camera on the host, until the last of their users has released them."""

    def __init__(self, rows: torch.Tensor):
        """Wrap the memory, [n, ...]."""
        self.rows = rows
        self.array: np.ndarray = rows.numpy()
        self.users = 0
        self._copied: torch.cuda.Event | None = None

    def fill(self, pictures: torch.Tensor) -> None:
        """Take pictures [n, ...]; from a GPU without waiting for them."""
        copy_pictures(self.rows, pictures)
        if pictures.is_cuda:
            self._copied = torch.cuda.Event()
            self._copied.record(torch.cuda.current_stream(pictures.device))

    def picture(self, row: int) -> np.ndarray:
        """A picture; waits until it is there."""
        if self._copied is not None:
            self._copied.synchronize()
        picture: np.ndarray = self.array[row]
        return picture


class PictureSlots:
    """Slots of one camera."""

    def __init__(self, shape: Sequence[int], dtype: torch.dtype, count: int, *, pinned: bool = False):
        """Allocate slots for pictures of this shape [n, ...], pinned where they come from a GPU."""
        self._slots = [PictureSlot(torch.empty(shape, dtype=dtype, pin_memory=pinned)) for _ in range(count)]
        self._changed = threading.Condition()

    def take(self, users: int) -> PictureSlot:
        """A free slot, for so many users; waits until there is one."""
        with self._changed:
            self._changed.wait_for(lambda: any(not slot.users for slot in self._slots))
            slot = next(slot for slot in self._slots if not slot.users)
            slot.users = users
        return slot

    def release(self, slot: PictureSlot) -> None:
        """One of its users needs it no more."""
        with self._changed:
            slot.users -= 1
            if not slot.users:
                self._changed.notify()


class EncoderThreads(VideoEncoder):
    """Films that threads make; without a thread, whoever brings the pictures."""

    def __init__(self, threads: int):
        """Start the threads."""
        self._encoders, self._threads = Encoders(threads), threads
        self._slots: dict[str, tuple[PictureSlots, PictureSlots | None]] = {}
        self._opened = 0

    def bind(self, cameras: Mapping[str, Pictured], device: torch.device) -> None:
        """Allocate the slots."""
        pinned = device.type == "cuda"
        self._slots = {}
        for name, made in cameras.items():
            shape = made.worlds, made.height, made.width
            count = slots_of(3 * made.worlds * made.height * made.width) if self._threads else 1
            depths = PictureSlots(shape, torch.float16, count, pinned=pinned) if made.depth else None
            self._slots[name] = PictureSlots((*shape, 3), torch.uint8, count, pinned=pinned), depths

    def join(self) -> int:
        """The thread with the fewest episodes."""
        return self._encoders.join()

    def leave(self, worker: int) -> None:
        """The episode brings no more pictures."""
        self._encoders.leave(worker)

    def open(self, worker: int, video: Path, depth: Path, fps: float, lossless: bool = False) -> VideoStream:
        """A film of an episode."""
        self._opened += 1
        return VideoStream(self._opened, worker, video, depth, Film(video, depth, fps, lossless))

    def add(
        self, camera: str, streams: Sequence[VideoStream], pictures: torch.Tensor, depths: torch.Tensor | None
    ) -> None:
        """Append a picture to each film; waits while all slots are taken."""
        slots, depth_slots = self._slots[camera]
        slot = slots.take(len(streams))
        slot.fill(pictures)
        depth = None
        if depth_slots is not None and depths is not None:
            depth = depth_slots.take(len(streams))
            depth.fill(depths)
        for row, stream in enumerate(streams):
            self._encoders.submit(stream.worker, partial(self._encode, camera, stream, row, slot, depth))

    def _encode(self, camera: str, stream: VideoStream, row: int, slot: PictureSlot, depth: PictureSlot | None) -> None:
        """A picture's encoding, in the episode's thread."""
        slots, depth_slots = self._slots[camera]
        try:
            if not stream.broken and stream.film is not None:
                stream.film.add(slot.picture(row), None if depth is None else depth.picture(row))
        except BaseException:
            stream.broken = True
            raise
        finally:
            slots.release(slot)
            if depth is not None and depth_slots is not None:
                depth_slots.release(depth)

    def finish(self, worker: int, streams: Mapping[str, VideoStream], then: Finished) -> None:
        """Finish an episode's films, and then do that, in its thread."""
        self._encoders.submit(worker, partial(self._finish, streams, then))

    def _finish(self, streams: Mapping[str, VideoStream], then: Finished) -> None:
        found: dict[str, FilmFacts | None] | None = None
        try:
            if not any(stream.broken for stream in streams.values()):
                found = {name: stream.film.close() if stream.film else None for name, stream in streams.items()}
        finally:
            if found is None:
                _discard(streams)
            then(found)

    def discard(self, worker: int, streams: Mapping[str, VideoStream], then: Job) -> None:
        """Drop an episode's films, and then do that, in its thread."""

        def drop() -> None:
            _discard(streams)
            then()

        self._encoders.submit(worker, drop)

    def check(self) -> None:
        """Raise the first error since the last call."""
        self._encoders.check()

    def wait(self) -> None:
        """Return when all that was asked for is done."""
        self._encoders.wait()

    def close(self) -> None:
        """Do what was asked for, and end the threads."""
        self._encoders.close()


def _discard(streams: Mapping[str, VideoStream]) -> None:
    for stream in streams.values():
        if stream.film is not None:
            stream.film.discard()
