"""Films that processes encode: Python's global lock lets the threads of one process encode little more than one film.

Each process is started as a program (`encoder_process`), so that a script that records needs no guard around its main
part. Pictures reach it through memory that both map, and a message per tick, camera and process says which film each
belongs to; so a tick costs its recorder as little with a thousand worlds as with one.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import select
import selectors
import socket
import subprocess
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch

from arena_newton.data.recording.encoder_process import SlotMemory, packed, unpacked
from arena_newton.data.recording.encoding import (
    Encoders,
    Finished,
    Job,
    Pictured,
    VideoEncoder,
    VideoStream,
    copy_pictures,
    slots_of,
)
from arena_newton.data.recording.episode_film import FilmFacts
from arena_newton.errors import ArenaError
from arena_newton.files.interrupts import Uninterrupted
from arena_newton.files.own_files import PARTIAL
from arena_newton.files.own_processes import end, environment, how_it_ended, start_module
from arena_newton.files.pinned_memory import pin, unpin

__all__ = ["EncoderPool"]

PROGRAM = "arena_newton.data.recording.encoder_process"
"""Module that each process runs."""
PATIENCE = 1.0
"""Time after which whoever waits for a process looks at all of them again [s]."""
STOP_PATIENCE = 10.0
"""Time that a process gets to end [s]."""


@dataclass(eq=False)
class _Worker:
    """A process, as its recorder sees it."""

    number: int
    process: subprocess.Popen[bytes]
    connection: socket.socket
    received: bytearray = field(default_factory=bytearray)
    alive: bool = True


class _Slots:
    """The slots of one camera."""

    def __init__(self, number: int, made: Pictured, device: torch.device):
        """Allocate them; pinned where the pictures come from a GPU, so that it writes them itself."""
        self.number = number
        slots = slots_of(3 * made.worlds * made.height * made.width)
        self.fd = os.memfd_create("arena_newton_pictures", os.MFD_CLOEXEC)
        self.facts = self.fd, slots, made.worlds, made.height, made.width, int(made.depth)
        """Arguments with which a process maps them."""
        memory = SlotMemory(*self.facts)
        self.pictures = [torch.from_numpy(pictures) for pictures in memory.pictures]
        self.depths = [torch.from_numpy(depths) for depths in memory.depths or ()]
        self.users: list[set[int]] = [set() for _ in range(slots)]
        """Processes that have not read a slot yet."""
        self.streams: Sequence[VideoStream] = ()
        self.messages: dict[int, list[tuple[_Worker, bytes]]] = {}
        """Messages about each slot, valid as long as the films are `streams`."""
        self._whole = torch.from_numpy(np.ndarray((memory.size,), np.uint8, memory.memory))
        self._pinned = device.type == "cuda" and pin(self._whole, device)
        """Into memory that is not pinned a GPU copies too, and whoever asks it waits."""

    def fill(self, slot: int, pictures: torch.Tensor, depths: torch.Tensor | None) -> torch.cuda.Event | None:
        """Copy pictures and depths; from a GPU on torch's stream, the event says when they are there."""
        copy_pictures(self.pictures[slot], pictures)
        if depths is not None:
            copy_pictures(self.depths[slot], depths)
        if not pictures.is_cuda:
            return None
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(pictures.device))
        return event

    def close(self) -> None:
        """Give the memory back."""
        if self._pinned:
            unpin(self._whole)
        os.close(self.fd)


@dataclass(eq=False)
class _Ending:
    """An episode whose films are being finished or dropped."""

    streams: Mapping[str, VideoStream]
    then: Callable[[Mapping[str, FilmFacts | None] | None], None]
    missing: set[int]
    """Films whose process has not answered."""
    facts: dict[int, FilmFacts | None] = field(default_factory=dict)
    whole: bool = True


class EncoderPool(VideoEncoder):
    """Films that processes make; threads of this process do what follows, with the files."""

    def __init__(self, processes: int, threads: int):
        """Start the threads; the processes start with `bind`."""
        self._count = processes
        self._writers = Encoders(threads)
        self._turns = itertools.cycle(range(max(threads, 1)))
        self._workers: list[_Worker] = []
        self._open = [0] * processes
        self._selector = selectors.DefaultSelector()
        self._cameras: dict[str, _Slots] = {}
        self._numbers = itertools.count()
        self._unsent: deque[tuple[torch.cuda.Event | None, Sequence[tuple[_Worker, bytes]]]] = deque()
        self._endings: dict[int, _Ending] = {}
        self._errors: deque[BaseException] = deque()
        self._whole = Uninterrupted()
        """Around whatever a Ctrl-C would tear apart: a message half sent or lost is waited for without end."""

    def bind(self, cameras: Mapping[str, Pictured], device: torch.device) -> None:
        """Allocate the slots and start the processes."""
        self._stop()
        self._cameras = {name: _Slots(number, made, device) for number, (name, made) in enumerate(cameras.items())}
        for number in range(self._count):
            self._workers.append(self._start(number))

    def _start(self, number: int) -> _Worker:
        ours, theirs = socket.socketpair()
        with theirs:
            files = theirs.fileno(), *(slots.fd for slots in self._cameras.values())
            variables = environment(one_thread=True)
            process = start_module(PROGRAM, theirs.fileno(), os.getpid(), files=files, variables=variables)
        ours.setblocking(False)
        worker = _Worker(number, process, ours)
        self._selector.register(ours, selectors.EVENT_READ, worker)
        self._transmit(worker, packed({"memory": [slots.facts for slots in self._cameras.values()]}))
        return worker

    def join(self) -> int:
        """The process with the fewest episodes."""
        number = self._open.index(min(self._open))
        self._open[number] += 1
        return number

    def leave(self, worker: int) -> None:
        """The episode brings no more pictures."""
        self._open[worker] -= 1

    def open(self, worker: int, video: Path, depth: Path, fps: float, lossless: bool = False) -> VideoStream:
        """A film of an episode."""
        stream = VideoStream(next(self._numbers), worker, video, depth)
        about = {"film": stream.number, "video": str(video), "depth": str(depth), "fps": float(fps)}
        about |= {"lossless": lossless}
        with self._whole:
            self._send(self._workers[worker], about)
        return stream

    def add(
        self, camera: str, streams: Sequence[VideoStream], pictures: torch.Tensor, depths: torch.Tensor | None
    ) -> None:
        """Append a picture to each film; waits while all slots are taken."""
        slots = self._cameras[camera]
        slot = self._free(slots)
        with self._whole:
            event = slots.fill(slot, pictures, depths)
            if slots.streams is not streams:
                slots.streams, slots.messages = streams, {}
            if slot not in slots.messages:
                slots.messages[slot] = self._messages(slots, slot)
            messages = slots.messages[slot]
            slots.users[slot] = {worker.number for worker, _ in messages if worker.alive}
            self._unsent.append((event, messages))
            self._flush()

    def _free(self, slots: _Slots) -> int:
        """A slot that nobody uses; waits until there is one."""
        while True:
            for slot, users in enumerate(slots.users):
                if not users:
                    return slot
            self._flush(wait=True)
            self._receive(PATIENCE)

    def _messages(self, slots: _Slots, slot: int) -> list[tuple[_Worker, bytes]]:
        """Message to each process about the pictures in a slot."""
        rows: dict[int, list[tuple[int, int]]] = {}
        for row, stream in enumerate(slots.streams):
            rows.setdefault(stream.worker, []).append((stream.number, row))
        about = {"camera": slots.number, "slot": slot}
        return [(self._workers[number], packed(about | {"rows": theirs})) for number, theirs in rows.items()]

    def finish(self, worker: int, streams: Mapping[str, VideoStream], then: Finished) -> None:
        """Finish an episode's films, and then do that, in a thread."""
        self._end(worker, streams, then, "close")

    def discard(self, worker: int, streams: Mapping[str, VideoStream], then: Job) -> None:
        """Drop an episode's films, and then do that, in a thread."""
        self._end(worker, streams, lambda _: then(), "discard")

    def _end(self, number: int, streams: Mapping[str, VideoStream], then: Finished, what: str) -> None:
        worker, ending = self._workers[number], _Ending(streams, then, {stream.number for stream in streams.values()})
        with self._whole:
            for stream in streams.values():
                self._endings[stream.number] = ending
                if worker.alive:
                    self._send(worker, {what: stream.number})
                else:
                    self._answered(stream.number, None, whole=False)

    def _answered(self, number: int, facts: FilmFacts | None, *, whole: bool) -> None:
        """A film is finished or gone; the last one of an episode leads to what follows."""
        ending = self._endings.pop(number)
        ending.missing.discard(number)
        ending.facts[number] = facts
        ending.whole &= whole
        if ending.missing:
            return
        films = {name: ending.facts[stream.number] for name, stream in ending.streams.items()}
        if not ending.whole:
            for stream in ending.streams.values():
                made = [stream.video] if ending.facts[stream.number] is not None else []
                # What a process that is gone has left, too.
                for path in (*made, stream.depth, stream.video.with_name(stream.video.name + PARTIAL)):
                    with contextlib.suppress(OSError):
                        path.unlink()
        self._writers.submit(next(self._turns), partial(ending.then, films if ending.whole else None))

    def check(self) -> None:
        """Raise the first error since the last call."""
        self._flush()
        self._receive(0)
        if self._errors:
            first = self._errors.popleft()
            self._errors.clear()
            raise first
        self._writers.check()

    def wait(self) -> None:
        """Return when all that was asked for is done."""
        while self._unsent or self._endings or any(any(slots.users) for slots in self._cameras.values()):
            self._flush(wait=True)
            self._receive(PATIENCE)
        self._writers.wait()

    def close(self) -> None:
        """Do what was asked for, and end processes and threads."""
        self._stop()
        self._writers.close()
        self._selector.close()

    def _stop(self) -> None:
        """End the processes, and give their memory back."""
        self.wait()
        for worker in self._workers:
            if worker.alive:
                self._selector.unregister(worker.connection)
            worker.connection.close()
        for worker in self._workers:
            end(worker.process, STOP_PATIENCE)
        for slots in self._cameras.values():
            slots.close()
        self._workers, self._cameras, self._open = [], {}, [0] * self._count

    def _send(self, worker: _Worker, message: Mapping[str, object]) -> None:
        """Send a message after all earlier ones, of which those of pictures wait until the pictures are there."""
        self._unsent.append((None, [(worker, packed(message))]))
        self._flush()

    def _flush(self, *, wait: bool = False) -> None:
        """Send what is due; with `wait` also what the GPU has not copied yet."""
        while self._unsent:
            event, messages = self._unsent[0]
            if event is not None and not event.query():
                if not wait:
                    return
                event.synchronize()
            with self._whole:
                self._unsent.popleft()
                for worker, message in messages:
                    self._transmit(worker, message)

    def _transmit(self, worker: _Worker, message: bytes) -> None:
        left = memoryview(message)
        while left and worker.alive:
            try:
                left = left[worker.connection.send(left) :]
            except BlockingIOError:  # it may itself wait for us to read
                both = select.poll()
                both.register(worker.connection, select.POLLIN | select.POLLOUT)
                both.poll(1000 * PATIENCE)
                self._read(worker)
            except ConnectionError:
                self._ended(worker)

    def _receive(self, patience: float) -> None:
        """Read messages of processes, waiting for the first so long [s]."""
        for key, _ in self._selector.select(patience):
            with self._whole:
                self._read(key.data)

    def _read(self, worker: _Worker) -> None:
        try:
            part = worker.connection.recv(1 << 16)
        except BlockingIOError:
            return
        except ConnectionError:
            part = b""
        if not part:
            self._ended(worker)
            return
        worker.received += part
        for message in unpacked(worker.received):
            self._hear(worker, message)

    def _hear(self, worker: _Worker, message: dict[str, object]) -> None:
        match message:
            case {"released": [int(camera), int(slot)]}:
                slots = list(self._cameras.values())[camera]
                slots.users[slot].discard(worker.number)
            case {"closed": int(number), "whole": bool(whole), "facts": facts}:
                self._answered(number, _facts(facts), whole=whole)
            case {"dropped": int(number)}:
                self._answered(number, None, whole=True)
            case {"error": str(reason), "errno": int(code), "file": str(name)}:
                self._errors.append(OSError(code, reason, name))
            case {"error": str(reason), "file": str(name)}:
                self._errors.append(ArenaError(f"{name}: {reason}"))

    def _ended(self, worker: _Worker) -> None:
        """A process is gone, whose films are lost; the others go on."""
        if not worker.alive:
            return
        worker.alive = False
        self._selector.unregister(worker.connection)
        reason = f"a process that encodes pictures ended ({how_it_ended(worker.process, PATIENCE)})"
        self._errors.append(ChildProcessError(errno.ECHILD, reason))
        for slots in self._cameras.values():
            for users in slots.users:
                users.discard(worker.number)
        for number, ending in list(self._endings.items()):
            if any(stream.number == number and stream.worker == worker.number for stream in ending.streams.values()):
                self._answered(number, None, whole=False)


def _facts(plain: object) -> FilmFacts | None:
    """Facts as a process tells them."""
    match plain:
        case {"width": int(width), "height": int(height), "frames": int(frames), "depth_shape": depth}:
            return FilmFacts(width, height, frames, tuple(depth))
    return None
