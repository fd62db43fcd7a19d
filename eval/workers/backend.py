"""Backend of a worker pool: starts processes that play, on this machine or in a Ray cluster, and waits for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from arena_newton.eval.workers.messages import Done, Event, Node, Opened

__all__ = ["PoolBackend", "Process", "WorkerLost"]


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


class PoolBackend(Protocol):
    """Source of processes."""

    flag: str
    """The flag that asks for it, as it is typed."""
    gpus: float
    """GPUs of each process."""
    minutes: float
    """Deadline of a batch [min]."""

    def room(self) -> int:
        """Processes that there is room for now."""

    def demand(self) -> str:
        """Needs of each process, for a reader who waits for the first one."""

    def cores(self, rank: int) -> tuple[int, int]:
        """First core and number of cores of the process of a machine that has this number, from 0."""

    def start(self) -> Process:
        """Start a process; where there is no room it answers when there is."""

    def wait(self, processes: Sequence[Process], timeout: float) -> Sequence[Process]:
        """Those that have answered or ended; waits for the first one, so long at most [s]."""
