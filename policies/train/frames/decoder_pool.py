"""Decodes episodes with all cores: by processes, or by threads where there are few cores.

Python's global lock lets the threads of one process decode little more than one film's pictures at a time. Each process
is started as a program (`decoder_process`) and hands pictures over in memory that both map, a few at a time, so that an
episode of any length needs no more of it.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import mmap
import os
import selectors
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import torch

from arena_newton.errors import ArenaError, InputError
from arena_newton.files.interrupts import Uninterrupted
from arena_newton.files.own_processes import environment, how_it_ended, start_module
from arena_newton.files.pinned_memory import pin, unpin
from arena_newton.policies.train.frames.decoder_process import SLOTS, EpisodeDecoder, chunk, mapped

__all__ = ["DecoderPool", "EpisodeFilm", "decoding_processes"]

PROGRAM = "arena_newton.policies.train.frames.decoder_process"
"""Module that each process runs."""
PROCESS_CORES = 4
"""Cores from which on processes decode: threads of one process use little more than one."""
MOST_PROCESSES = 32
"""Processes at most; each has 70 MB."""
PROCESS_PICTURES = 1000
"""Pictures for which a process is worth its start: 0.3 s."""
SLOT_BYTES = 4 * 2**20
"""Memory of a slot, or that of one picture: 37 pictures of 224x168."""
DEATH_PATIENCE = 10.0
"""Time for which the exit code of a process that is gone is waited for [s]: its pipe closes a little before it ends,
and where all cores are busy that little takes long."""


CPU = torch.device("cpu")


@dataclass(frozen=True)
class EpisodeFilm:
    """Pictures of one episode, and where they are wanted."""

    root: Path
    """Dataset."""
    episode: int
    path: Path
    first: int
    """Number of the first one in the film."""
    frames: int
    row: int
    """Number of the first one among all that are wanted."""
    every: int = 1
    """Pictures of the film from one that is wanted to the next."""

    def __str__(self) -> str:
        return f"{self.root}: episode {self.episode}"


@dataclass(eq=False)
class _Worker:
    """A process, as its training sees it."""

    process: subprocess.Popen[bytes]
    slots: mmap.mmap
    film: int = -1
    """Number of the episode that it decodes; -1: none."""
    received: bytearray = field(default_factory=bytearray)


Brightest = tuple[np.ndarray, np.ndarray]
"""Largest value in each row that is cut off above and below, uint8, shapes [top] and [bottom]."""
Put = Callable[[int, np.ndarray], None]
"""Is given the row of the first of some pictures, and these, uint8 [N, rows, width, 3]; they last until it returns."""


def decoding_processes(cores: int, pictures: int) -> int:
    """Processes that decode; 0 where threads do: with few cores, or few pictures.

    Args:
        cores: That may be used; one of them is left to whoever reads the pictures.
        pictures: That are to be decoded.
    """
    count = min(MOST_PROCESSES, cores - 1, pictures // PROCESS_PICTURES)
    return count if cores >= PROCESS_CORES and count > 1 else 0


class DecoderPool:
    """Threads or processes that decode episodes; a context that ends them, whatever happens."""

    def __init__(self, height: int, width: int, *, threads: int, processes: int = 0, device: torch.device = CPU):
        """Start the processes.

        Args:
            height: Of all pictures [px].
            width: Of all pictures [px].
            threads: That decode where no processes do.
            processes: 0: none. Where a system does not let them start, threads decode.
            device: Of whoever reads the pictures.

        Raises:
            ArenaError: There is no memory to share.
        """
        self._size = height, width
        self._threads = threads
        self._workers: list[_Worker] = []
        self._fd = -1
        self._pinned: list[torch.Tensor] = []
        self._whole = Uninterrupted()
        """Around what a Ctrl-C must not tear apart: a process that is started and not known would remain."""
        if processes:
            try:
                self._start(processes, device)
            except BaseException:
                self.close()
                raise

    @property
    def processes(self) -> int:
        """Processes that decode; 0: threads do."""
        return len(self._workers)

    def _start(self, count: int, device: torch.device) -> None:
        height, width = self._size
        pages = -(-max(SLOT_BYTES, height * width * 3) // mmap.ALLOCATIONGRANULARITY)
        self._slot = pages * mmap.ALLOCATIONGRANULARITY
        total = count * SLOTS * self._slot
        try:
            memory = os.memfd_create("arena_newton_decoded", os.MFD_CLOEXEC)
            # 0 to 2 are the processes' own; they are free where whoever started this one closed them.
            self._fd = fcntl.fcntl(memory, fcntl.F_DUPFD_CLOEXEC, 3)
            os.close(memory)
            # Taken at once: memory that is missing later would be a signal that kills whoever writes into it.
            os.posix_fallocate(self._fd, 0, total)
        except OSError as error:
            raise ArenaError(
                f"decoding: no {total / 1e6:.0f} MB of memory that {count} processes could share "
                f"({error.strerror or error}); --jobs 1 needs none"
            ) from error
        variables = environment(one_thread=True)
        for number in range(count):
            facts = self._fd, number, self._slot, height, width
            with self._whole:
                try:
                    slots = mapped(self._fd, number, self._slot)
                    process = start_module(
                        PROGRAM, *facts, files=[self._fd], variables=variables, output=subprocess.PIPE
                    )
                except OSError:  # the user's limit of processes, or of memory: those that there are decode
                    break
                self._workers.append(_Worker(process, slots))
        if device.type == "cuda":
            self._pin(device)

    def _pin(self, device: torch.device) -> None:
        """Let a GPU read the memory itself; where it cannot be pinned, it is read all the same."""
        for worker in self._workers:
            view = torch.from_numpy(np.ndarray((SLOTS * self._slot,), np.uint8, worker.slots))
            if not pin(view, device):
                return
            self._pinned.append(view)

    def decode(self, films: Sequence[EpisodeFilm], top: int, bottom: int, put: Put) -> Iterator[tuple[int, Brightest]]:
        """Decode episodes; what is not read to its end is broken off, and the processes with it: threads decode then.

        Args:
            top: Rows above that are cut off [px].
            bottom: Rows below that are cut off [px].
            put: Is given the pictures, in any order, by this thread or, where threads decode, by any.

        Yields:
            Number of an episode all of whose pictures were given, and how bright the rows are that were cut off; with
            processes in the order in which they are done.

        Raises:
            InputError: A film is damaged; dataset and episode are named.
            ArenaError: A process ended.
        """
        if self._workers:
            return self._by_processes(films, top, bottom, put)
        return self._by_threads(films, top, bottom, put)

    def _by_threads(
        self, films: Sequence[EpisodeFilm], top: int, bottom: int, put: Put
    ) -> Iterator[tuple[int, Brightest]]:
        height, width = self._size
        shape = height - top - bottom, width, 3
        most = chunk(SLOT_BYTES, shape)
        own = threading.local()
        decoders: list[EpisodeDecoder] = []

        def begin() -> None:
            own.decoder, own.pictures = EpisodeDecoder(height, width), np.empty((most, *shape), np.uint8)
            decoders.append(own.decoder)

        def one(film: EpisodeFilm) -> Brightest:
            decoder: EpisodeDecoder = own.decoder
            decoder.begin(top, bottom)
            for start in range(0, film.frames, most):
                pictures = own.pictures[: min(most, film.frames - start)]
                try:
                    decoder.fill(film.path, film.first + start * film.every, pictures, film.every)
                except InputError as error:
                    raise InputError(f"{film}: {error}") from error
                put(film.row + start, pictures)
            return decoder.brightest()

        with ThreadPoolExecutor(self._threads, initializer=begin) as pool:
            running = pool.map(one, films)
            try:
                yield from enumerate(running)
            finally:
                pool.shutdown(cancel_futures=True)
                for decoder in decoders:
                    decoder.close()

    def _by_processes(
        self, films: Sequence[EpisodeFilm], top: int, bottom: int, put: Put
    ) -> Iterator[tuple[int, Brightest]]:
        height, width = self._size
        shape = height - top - bottom, width, 3
        waiting = deque(range(len(films)))

        def give(worker: _Worker) -> None:
            worker.film = waiting.popleft() if waiting else -1
            if worker.film >= 0:
                film = films[worker.film]
                about = {"path": str(film.path), "first": film.first, "frames": film.frames, "every": film.every}
                _tell(worker, about | {"top": top, "bottom": bottom})

        left = len(films)
        try:
            with selectors.DefaultSelector() as selector:
                for worker in self._workers:
                    give(worker)
                    assert worker.process.stdout is not None
                    selector.register(worker.process.stdout, selectors.EVENT_READ, worker)
                while left:
                    for key, _ in selector.select():
                        worker = key.data
                        for message in self._heard(worker, films):
                            film = films[worker.film]
                            match message:
                                case {"slot": int(slot), "start": int(start), "count": int(count)}:
                                    at = slot * self._slot
                                    put(film.row + start, np.ndarray((count, *shape), np.uint8, worker.slots, at))
                                    _tell(worker, {"free": slot})
                                case {"above": above, "below": below}:
                                    number, left = worker.film, left - 1
                                    give(worker)
                                    yield number, (np.array(above, np.uint8), np.array(below, np.uint8))
                                case {"error": str(reason)}:
                                    raise InputError(f"{film}: {reason}")
        finally:
            if left:
                self.close()  # what they would still say belongs to no later decoding

    def _heard(self, worker: _Worker, films: Sequence[EpisodeFilm]) -> Iterator[dict[str, object]]:
        """Messages of a process.

        Raises:
            ArenaError: It ended.
        """
        assert worker.process.stdout is not None
        part = os.read(worker.process.stdout.fileno(), 1 << 16)
        if not part:
            where = f"{films[worker.film]}: " if worker.film >= 0 else ""
            raise ArenaError(
                f"{where}the process that decodes pictures ended ({how_it_ended(worker.process, DEATH_PATIENCE)})"
            )
        worker.received += part
        *lines, rest = worker.received.split(b"\n")
        worker.received = bytearray(rest)
        for line in lines:
            if line.startswith(b"{"):  # else what the start of an interpreter prints here and there
                yield json.loads(line)

    def close(self) -> None:
        """End the processes and give their memory back."""
        with self._whole:
            for worker in self._workers:
                worker.process.kill()  # it has nothing to finish
            for worker in self._workers:
                worker.process.wait()
                for pipe in (worker.process.stdin, worker.process.stdout):
                    assert pipe is not None
                    pipe.close()
            while self._pinned:
                unpin(self._pinned.pop())
            for worker in self._workers:
                with contextlib.suppress(BufferError):  # an error on its way out still shows its pictures
                    worker.slots.close()
            self._workers = []
            if self._fd >= 0:
                os.close(self._fd)
                self._fd = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _tell(worker: _Worker, message: dict[str, object]) -> None:
    """Say something to a process; that it is gone is found when its answer is read."""
    assert worker.process.stdin is not None
    with contextlib.suppress(BrokenPipeError):
        worker.process.stdin.write(json.dumps(message).encode() + b"\n")
