"""Worker pool: processes that open runs, have a deadline, and are replaced when they are lost."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import pickle
import sys
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from typing import TYPE_CHECKING

from arena_newton.errors import ArenaError, InputError, UnknownName
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.plan.config import RunConfig
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.plan.options import RunOptions, Workers, flags_of
from arena_newton.eval.play.run_flow import Group, RunStopped
from arena_newton.eval.records.identity import differing_key, moving_versions
from arena_newton.eval.records.journal import StorageError
from arena_newton.eval.reports.progress import Progress
from arena_newton.eval.workers.backend import PoolBackend, Process, WorkerLost
from arena_newton.eval.workers.local_backend import LocalBackend
from arena_newton.eval.workers.messages import Broke, Done, EpisodeBatch, Event, Node, Opened
from arena_newton.files.text import counted, plain_text

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories


__all__ = ["Assignment", "Job", "Lost", "Worker", "WorkerPool", "backend_of"]

BEGINNING = 600.0
"""A process has at least this time to build tracker and policy, whatever a batch has [s]."""
STARTS = 5
"""A process that was lost so often before it built an environment stops the run."""
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 30.0
"""Pause before a lost process is replaced; each loss before an environment was built doubles it [s]."""
GROWTH = 5.0
"""Room for more processes is looked for so often [s]."""
POLL = 1.0
"""Deadlines and lost processes are looked at so often [s]."""
PATIENCE = 30.0
"""While no process has begun, a line says so as often [s]."""


@dataclass(eq=False)
class Job:
    """A run that processes open, to play batches of it."""

    folder: ResultsFolder
    opened: Opened | None = None
    """Message of the first process that has opened it."""
    seconds: float = 0.0
    """Time that processes were busy with it, each with its part of a GPU where they are on one [s]."""

    def configured(self) -> RunConfig:
        """The configuration, with what tracker and policy of the first process say of themselves."""
        assert self.opened is not None
        return self.folder.config.described_by(self.opened)

    def options(self) -> RunOptions:
        """The flags that a process opens it with."""
        alone = {name: getattr(RunOptions, name) for name in (*flags_of(Workers), "shard", "out")}
        return dataclasses.replace(self.folder.config.flags, **alone)


@dataclass
class Assignment:
    """A batch of a run that a process plays."""

    job: Job
    group: Group
    left: dict[int, Episode]
    """Episodes that have not ended, by number, in their order."""
    worlds: int
    level: int
    """Number of times that its episodes were running when a process was lost, up to a limit that the caller sets."""
    size: int = 0
    """Episodes at its beginning."""
    built: bool = False
    """True once its environment was built: a loss is then evidence about its episodes."""

    def __post_init__(self) -> None:
        """Count the episodes."""
        self.size = len(self.left)

    def running(self) -> list[Episode]:
        """Running episodes: the next episode starts as soon as a world is free."""
        return list(self.left.values())[: self.worlds] if self.built else []


@dataclass(frozen=True)
class Lost:
    """The process of a batch was lost, or broke."""

    cause: str
    trace: str = ""
    with_node: bool = False
    """True if its machine left the cluster, for which no episode is to blame."""


@dataclass
class Worker:
    """Process of the pool, or the gap where one was."""

    process: Process | None = None
    node: Node | None = None
    rank: int = 0
    """Its number among the processes of its node."""
    busy: bool = False
    """True until it has answered; then it waits for work."""
    since: float = 0.0
    """Monotonic time at which it was asked [s]."""
    job: Job | None = None
    """The run that it has opened, or is opening."""
    assignment: Assignment | None = None
    last: Group | None = None
    """Group that its environment is made for."""
    until: float = math.inf
    """Monotonic time at which it is stopped if it has not answered [s]."""
    starts: int = 0
    """Losses in a row before an environment was built."""
    again_at: float = 0.0
    """Monotonic time from which it is replaced when it was lost [s]."""


@contextlib.contextmanager
def backend_of(flags: Workers, device: str) -> Iterator[PoolBackend]:
    """Processes that flags ask for.

    Raises:
        InputError: No cluster answers, or it has no room.
    """
    if flags.ray is None:
        yield LocalBackend(flags.jobs, device)
        return
    os.environ["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"  # read on import: each process would be another `uv run`
    from arena_newton.eval.workers.ray_backend import RayBackend, in_cluster

    with in_cluster(flags.ray):
        yield RayBackend(flags, device)


class WorkerPool:
    """Processes that play one run, or several with the same flags on the same kind of device."""

    def __init__(self, backend: PoolBackend, most: int, factories: Factories | None):
        """Start them.

        Args:
            backend: Who starts them, and says how many.
            most: No more than so many.
            factories: What they build runs with; the real parts by default.
        """
        self.backend, self._most, self._factories = backend, most, factories
        # Ray carries parts of the program itself, but recorders are known by the file that holds their code.
        _check_importable(factories, backend.flag, None if isinstance(backend, LocalBackend) else ("recorders",))
        self.workers: list[Worker] = []
        self.shown: Progress | None = None
        """Progress that shows losses."""
        self._reported = self._grown = time.monotonic()
        self._grow()

    def opened(self, job: Job) -> RunConfig:
        """Wait until one process has built tracker and policy of a run.

        Returns:
            The configuration with what they say of themselves.

        Raises:
            InputError: They cannot be built, or a node has another version of the code or of a file.
            RunStopped: No process begins.
        """
        while job.opened is None:
            for worker in self.idle():
                if worker.job is not job:
                    self.prepare(worker, job)
            for _, _, message in self.messages():
                if isinstance(message, UnknownName):  # but known here
                    why = f"{self.backend.flag} plays in other processes than that of the program which offers it"
                    raise InputError(f"{message}; {why}: make it an entry point") from message
                if isinstance(message, ArenaError):
                    raise message
        return job.configured()

    def idle(self) -> list[Worker]:
        """Those that wait for work."""
        return [worker for worker in self.workers if worker.node is not None and not worker.busy]

    def prepare(self, worker: Worker, job: Job) -> None:
        """Let a process that waits build tracker and policy of a run, in place of those that it has."""
        assert worker.process is not None
        worker.job, worker.since, worker.busy = job, time.monotonic(), True
        worker.until = max(self._late(), worker.since + BEGINNING)
        path = os.path.abspath(job.folder.path)
        worker.process.ask("open", job.options(), path, self.backend.cores(worker.rank), self._factories)

    def assign(self, worker: Worker, assignment: Assignment) -> None:
        """Let a process that waits play a batch of the run that it has opened."""
        assert worker.process is not None and worker.job is assignment.job
        config_hash = assignment.job.folder.document["config_hash"]
        part = EpisodeBatch(" ".join(assignment.group), tuple(assignment.left), assignment.worlds, config_hash)
        worker.assignment, worker.last, worker.busy = assignment, assignment.group, True
        worker.since, worker.until = time.monotonic(), self._late()
        worker.process.ask("play", part)

    def messages(self) -> Iterator[tuple[Job, Assignment | None, Opened | Event | Done | Lost | ArenaError]]:
        """Messages of the processes; waits a little for them. Lost processes are replaced.

        Yields:
            The run, the batch of it where one is played, and its message: an error where another process could not
            go on with the run either.

        Raises:
            InputError: A node has another version of the code or of a file.
            RunStopped: No process begins.
        """
        now = time.monotonic()
        if now - self._grown >= GROWTH:
            self._grown = now
            self._grow()
        for worker in self.workers:
            if worker.process is None and now >= worker.again_at:
                self._start(worker)
            elif worker.process is not None and now >= worker.until:
                yield from self._lose(worker, Lost(f"took longer than {self.backend.minutes:g} min (--ray-minutes)"))
        self._say_if_none_begins(now)
        asked = {worker.process: worker for worker in self.workers if worker.process is not None and worker.busy}
        if not asked:
            time.sleep(FIRST_PAUSE)
            return
        for process in self.backend.wait(list(asked), POLL):
            worker = asked[process]
            try:
                message = process.take()
            except WorkerLost as lost:
                yield from self._lose(worker, Lost(str(lost), with_node=lost.with_node))
                continue
            job = worker.job
            if job is None:
                assert isinstance(message, Node)
                self._begin(worker, message)
            elif isinstance(message, Broke) and (error := _error(message)) is not None:
                assignment = worker.assignment
                self._replace(worker)
                yield job, assignment, error
            elif isinstance(message, Broke):
                yield from self._lose(worker, Lost(message.message, message.trace))
            elif isinstance(message, Done):
                assignment, worker.assignment = worker.assignment, None
                self._rest(worker)
                yield job, assignment, message
            elif isinstance(message, Opened):
                self._check(worker, job, message)
                job.opened = job.opened or message
                self._rest(worker)
                yield job, None, message
            elif not isinstance(message, Node):
                yield job, worker.assignment, message

    def dismiss(self) -> None:
        """End all processes."""
        for worker in self.workers:
            self._end(worker)
            worker.again_at = math.inf

    def _grow(self) -> None:
        """Start as many processes as there is room for now."""
        for _ in range(min(self.backend.room(), self._most) - len(self.workers)):
            self.workers.append(Worker())
            self._start(self.workers[-1])

    def _start(self, worker: Worker) -> None:
        """Start a process, which says where it is when it has begun."""
        worker.process, worker.busy = self.backend.start(), True
        worker.process.ask("node")

    def _begin(self, worker: Worker, node: Node) -> None:
        """A process has begun, and waits."""
        taken = {one.rank for one in self.workers if one.node is not None and one.node.name == node.name}
        worker.node, worker.rank = node, min(set(range(len(self.workers))) - taken)
        worker.busy = False

    def _rest(self, worker: Worker) -> None:
        """A process has done what it was asked, and waits; its time counts for the run."""
        if worker.job is not None and worker.busy:
            worker.job.seconds += (time.monotonic() - worker.since) * (self.backend.gpus or 1.0)
        worker.busy, worker.until = False, math.inf

    def _check(self, worker: Worker, job: Job, opened: Opened) -> None:
        """Hold what a process built to what is planned, and to what the first one built."""
        assert worker.node is not None
        unknown = () if job.opened is not None else ("tracker_facts", "policy_facts", "worlds", "labels")
        planned = job.folder.config.identity() if job.opened is None else job.opened.identity
        difference = differing_key(planned, opened.identity, unknown)
        difference = difference or differing_key(*map(moving_versions, (job.folder.installed, opened.versions)))
        if difference is not None:
            key, here, there = (plain_text(str(part), 80) for part in difference)
            raise InputError(
                f"{self.backend.flag}: on node {worker.node.host} {key} is {there}, here {here}; all nodes need the "
                "same code, files and libraries"
            )

    def _lose(self, worker: Worker, lost: Lost) -> Iterator[tuple[Job, Assignment | None, Lost | ArenaError]]:
        """End a process, if it has not ended, to be replaced after a pause; tells of what it did."""
        job, assignment, where = (
            worker.job,
            worker.assignment,
            f" on {worker.node.host}" if worker.node is not None else "",
        )
        worker.starts = 0 if assignment is not None and assignment.built else worker.starts + 1
        starts = worker.starts
        self._replace(worker)
        say = self.shown.say if self.shown is not None else _print
        doing = (
            f"  {' '.join(assignment.group)}, {counted(len(assignment.left), 'episode')} left"
            if assignment
            else "  it had not begun"
        )
        if starts >= STARTS:
            error = RunStopped(
                f"{self.backend.flag}: {STARTS} processes{where} ended one after the other: {lost.cause}"
            )
            if job is None:
                raise error
            worker.starts = 0
            yield job, assignment, error
            return
        say(f"{doing}: a process{where} is replaced: {lost.cause}")
        if job is not None:
            yield job, assignment, lost

    def _replace(self, worker: Worker) -> None:
        """End a process, to be replaced after a pause."""
        self._end(worker)
        worker.again_at = time.monotonic() + min(LONGEST_PAUSE, FIRST_PAUSE * 2.0**worker.starts)

    def _end(self, worker: Worker) -> None:
        self._rest(worker)
        if worker.process is not None:
            worker.process.end()
        worker.process = worker.assignment = worker.node = worker.last = worker.job = None

    def _say_if_none_begins(self, now: float) -> None:
        if any(worker.node is not None for worker in self.workers):
            self._reported = now
        elif now - self._reported >= PATIENCE:
            self._reported = now
            _print(f"  no process has begun: each {self.backend.demand()}")

    def _late(self) -> float:
        """Deadline of a process that begins something now [s]."""
        return time.monotonic() + 60.0 * self.backend.minutes


def _check_importable(factories: Factories | None, flag: str, names: Collection[str] | None) -> None:
    """Refuse parts of a run, those named or all, that another process cannot import.

    Raises:
        InputError: One is of the program that was started, or of no module.
    """
    for name, part in vars(factories).items() if factories is not None else ():
        if names is not None and name not in names:
            continue
        made = part.func if isinstance(part, functools.partial) else part
        try:
            ForkingPickler.dumps(part)
            importable = getattr(made, "__module__", type(made).__module__) != "__main__"
        except (AttributeError, TypeError, pickle.PicklingError):
            importable = False
        if not importable:
            raise InputError(f"{flag}: Factories.{name} is {made!r}; other processes import it by module and name")


def _error(message: Broke) -> ArenaError | None:
    """Error that playing again would not mend; None where it may."""
    kinds = {"unknown": UnknownName, "input": InputError, "storage": StorageError, "stop": RunStopped}
    return kinds[message.kind](message.message) if message.kind in kinds else None


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
