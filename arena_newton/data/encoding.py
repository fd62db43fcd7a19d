"""Threads that encode and write episodes while their worlds go on.

An episode belongs to one thread, which does its jobs in their order: frame after frame, then the files. Pictures wait
in slots of memory that were allocated once; where all are taken, whoever brings the next pictures waits. So memory is
bounded, no frame is dropped, and a slow disk slows the simulation instead of failing it.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable

import numpy as np
import torch

__all__ = ["Encoders", "PictureSlot", "PictureSlots"]

SLOT_BYTES = 512 << 20
"""Memory of the pictures of one camera that wait [B]: as many slots as fit into it, `SLOTS` of them at least and most.
"""
SLOTS = (2, 12)
"""Least and most slots of a camera."""

Job = Callable[[], None]


class Encoders:
    """Threads that each work off a queue; without a thread, jobs are done at once by whoever brings them."""

    def __init__(self, threads: int):
        """Start the threads."""
        self._queues: list[queue.SimpleQueue[Job | None]] = [queue.SimpleQueue() for _ in range(threads)]
        self._open = [0] * threads
        self._unfinished = 0
        self._errors: deque[BaseException] = deque()
        self._changed = threading.Condition()
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
        self.rows[: len(pictures)].copy_(pictures, non_blocking=True)
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

    def __init__(self, like: torch.Tensor, count: int | None = None):
        """Allocate slots for pictures of this shape [n, ...], pinned where they come from a GPU."""
        size = like.numel() * like.element_size()
        count = count or min(max(SLOT_BYTES // max(size, 1), SLOTS[0]), SLOTS[1])
        self._slots = [
            PictureSlot(torch.empty(like.shape, dtype=like.dtype, pin_memory=like.is_cuda)) for _ in range(count)
        ]
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
