"""Processes of this machine that play: each answers calls through a pipe, and ends when the other end is closed.

`python -m arena_newton.eval.workers.local_backend 5` is such a process; 5 is its end of the pipe.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from multiprocessing import connection
from typing import cast

from arena_newton.eval.workers.actor import EpisodeActor
from arena_newton.eval.workers.backend import Process, WorkerLost
from arena_newton.eval.workers.messages import Done, Event, Node, Opened
from arena_newton.files.own_processes import environment, start_module
from arena_newton.files.text import counted
from arena_newton.physics.devices import visible_gpus

__all__ = ["LocalBackend", "LocalProcess"]

PROGRAM = "arena_newton.eval.workers.local_backend"
"""Module that each process runs."""


class LocalProcess:
    """Process of this machine; it is in a session of its own, so that Ctrl-C does not reach it."""

    def __init__(self, gpu: str):
        """Start it.

        Args:
            gpu: The GPU that it sees, as `CUDA_VISIBLE_DEVICES` names it; empty: none.
        """
        self.gpu, self.runs = gpu, True
        self.pipe, other = connection.Pipe()
        with other:
            variables = environment() | {"CUDA_VISIBLE_DEVICES": gpu}
            end = other.fileno()
            self._process = start_module(PROGRAM, end, files=[end], variables=variables, errors=subprocess.DEVNULL)

    def ask(self, method: str, *arguments: object) -> None:
        """Call a method; of a process that has ended `take` tells."""
        with contextlib.suppress(OSError):
            self.pipe.send((method, arguments))

    def take(self) -> Node | Opened | Event | Done:
        """The next answer, or `WorkerLost`."""
        try:
            return cast("Node | Opened | Event | Done", self.pipe.recv())
        except (EOFError, OSError):
            raise WorkerLost from None

    def end(self) -> None:
        """Kill the process."""
        self.runs = False
        self.pipe.close()
        self._process.kill()
        self._process.wait()


class LocalBackend:
    """Processes of this machine, which divide its cores and take its GPUs in turn."""

    minutes = math.inf

    def __init__(self, jobs: int, device: str):
        """Count cores and GPUs.

        Args:
            jobs: Processes at once.
        """
        self.flag, self._jobs, self._cores = f"--jobs {jobs}", jobs, len(os.sched_getaffinity(0))
        self._gpus = [] if device == "cpu" else visible_gpus()
        self.gpus = min(1.0, len(self._gpus) / jobs)
        self._started: list[LocalProcess] = []
        if jobs > self._cores:
            print(f"  {self.flag}: processes share {counted(self._cores, 'core')}", file=sys.stderr, flush=True)

    def room(self) -> int:
        """Number of processes that were requested."""
        return self._jobs

    def demand(self) -> str:
        """Cores of each."""
        return f"each loads with {counted(self.cores(0)[1], 'core')}"

    def cores(self, rank: int) -> tuple[int, int]:
        """First core of a process, and their number."""
        first, end = (number * self._cores // self._jobs for number in (rank, rank + 1))
        return first, max(1, end - first)

    def start(self) -> LocalProcess:
        """Start a process on the GPU that has the fewest."""
        taken = [process.gpu for process in self._started if process.runs]
        process = LocalProcess(min(self._gpus, key=taken.count, default=""))
        self._started.append(process)
        return process

    def wait(self, processes: Sequence[Process], timeout: float) -> Sequence[Process]:
        """Those that have answered or ended."""
        mine = cast("Sequence[LocalProcess]", processes)
        ready = connection.wait([process.pipe for process in mine], timeout)
        return [process for process in mine if process.pipe in ready]


def _serve(pipe: connection.Connection) -> None:
    """Answer calls until the other end is closed."""
    threading.Thread(target=_end_with, args=(pipe.fileno(),), daemon=True).start()
    actor = EpisodeActor()
    while True:
        method, arguments = pipe.recv()
        answer = getattr(actor, method)(*arguments)
        if isinstance(answer, Iterator):
            for event in answer:
                pipe.send(event)
            answer = Done()
        pipe.send(answer)


def _end_with(pipe: int) -> None:
    """End this process when the other end of its pipe is closed, whatever it plays."""
    closed = select.poll()
    closed.register(pipe, 0)
    closed.poll()
    os._exit(1)


if __name__ == "__main__":
    _serve(connection.Connection(int(sys.argv[1])))
