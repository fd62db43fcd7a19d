"""Backend of a worker pool: starts processes that play, on this machine or in a Ray cluster, and waits for them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from typing import Protocol

from arena_newton.eval.plan.options import Workers
from arena_newton.eval.workers.slice_events import Done, Event, Node, Opened

__all__ = ["Backend", "Process", "WorkerLost", "backend_of"]


class WorkerLost(Exception):
    """A process has ended without an answer: killed, out of memory, or native code crashed."""

    def __init__(self, *, with_node: bool = False):
        """Say why; `with_node` where its machine left the cluster."""
        super().__init__("its machine left the cluster" if with_node else "it died")
        self.with_node = with_node


class Process(Protocol):
    """An `EpisodeActor` in another process, which answers one call at a time."""

    def ask(self, method: str, *arguments: object) -> None:
        """Call a method; `play` answers with events until `Done`, the others once."""

    def take(self) -> Node | Opened | Event | Done:
        """The next answer; waits for it.

        Raises:
            WorkerLost: The process has ended.
        """

    def end(self) -> None:
        """End the process at once; it may have ended."""


class Backend(Protocol):
    """Where processes come from."""

    flag: str
    """The flag that asks for it, as it is typed."""
    gpus: float
    """GPUs of each process."""
    minutes: float
    """Deadline of a slice [min]."""

    def room(self) -> int:
        """Processes that there is room for now."""

    def demand(self) -> str:
        """What each process asks for, for a reader who waits for the first one."""

    def cores(self, rank: int) -> tuple[int, int]:
        """First core and number of cores of the process of a machine that has this number, from 0."""

    def start(self) -> Process:
        """Start a process; where there is no room it answers when there is."""

    def wait(self, processes: Sequence[Process], timeout: float) -> Sequence[Process]:
        """Those that have answered or ended; waits for the first one, so long at most [s]."""


@contextlib.contextmanager
def backend_of(flags: Workers, device: str) -> Iterator[Backend]:
    """Processes that flags ask for.

    Args:
        flags: The flags, checked.
        device: Device of the runs.

    Raises:
        InputError: No cluster answers, or it has no room.
    """
    if flags.ray is None:
        from arena_newton.eval.workers.local_backend import LocalBackend

        yield LocalBackend(flags.jobs, device)
        return
    os.environ["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"  # read on import: each process would be another `uv run`
    from arena_newton.eval.workers.ray_backend import RayBackend, in_cluster

    with in_cluster(flags.ray):
        yield RayBackend(flags, device)
