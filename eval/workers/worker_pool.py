"""Worker pool: processes of a Ray cluster that open runs, have a deadline, and are replaced when they are lost.

Ray restarts none by itself (`max_restarts=0`), so that the run knows of every loss and of the episodes behind it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import os
import secrets
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import ray
from ray.exceptions import RayError

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.plan.config import RunConfig
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.plan.options import Ray, RunOptions, flags_of
from arena_newton.eval.play.run_flow import Group, RunStopped
from arena_newton.eval.records.identity import differing_key, moving_versions
from arena_newton.eval.records.journal import StorageError
from arena_newton.eval.reports.progress import Progress
from arena_newton.eval.workers.ray_actor import EpisodeActor
from arena_newton.eval.workers.slice_events import Broke, Event, Node, Opened, Slice
from arena_newton.files.text import counted, plain_text

if TYPE_CHECKING:
    from ray import ObjectRef, ObjectRefGenerator
    from ray.actor import ActorHandle

    from arena_newton.eval.play.run import Factories


__all__ = ["WorkerPool", "Done", "Job", "Assignment", "Lost", "Worker", "in_cluster"]

OWN = "local"
"""Address that makes Ray start a cluster of its own."""
STORE_BYTES = 80 << 20
"""Object store of such a cluster, near the least that Ray takes: only numbers and lines pass through it."""
USUAL_CPUS = 4
"""Cores of a process where --ray-cpus does not say."""
CONNECTION = 10.0
"""An address answers within this time [s]."""
BEGINNING = 600.0
"""A process has at least this time to build tracker and policy, whatever --ray-minutes says [s]."""
STARTS = 5
"""A process that was lost so often before it built an environment stops the run."""
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 30.0
"""Pause before a lost process is replaced; each loss before an environment was built doubles it [s]."""
GROWTH = 5.0
"""Machines that joined the cluster are looked for so often [s]."""
POLL = 1.0
"""Deadlines and lost processes are looked at so often [s]."""
PATIENCE = 30.0
"""While no process has begun, a line says so as often [s]."""


@dataclass(eq=False)
class Job:
    """A run that processes open, to play slices of it."""

    folder: ResultsFolder
    opened: Opened | None = None
    """Message of the first process that has opened it."""
    seconds: float = 0.0
    """Time that processes were busy with it, each with its part of a GPU where they are on one [s]."""

    def configured(self) -> RunConfig:
        """The configuration, with what tracker and policy of the first process say of themselves."""
        assert self.opened is not None
        described = ("labels", "worlds_matter", "tracker_facts", "policy_facts")
        return dataclasses.replace(self.folder.config, **{name: getattr(self.opened, name) for name in described})

    def options(self) -> RunOptions:
        """The flags that a process opens it with."""
        alone = {name: getattr(RunOptions, name) for name in (*flags_of(Ray), "shard", "out")}
        return dataclasses.replace(self.folder.config.flags, **alone)


@dataclass
class Assignment:
    """A slice of a run that a process plays."""

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
    """The process of a slice was lost, or broke."""

    cause: str
    trace: str = ""
    with_node: bool = False
    """True if its machine left the cluster, for which no episode is to blame."""


@dataclass(frozen=True)
class Done:
    """The process of a slice has reported all that it played, and waits."""


@dataclass
class Worker:
    """Process of the pool, or the gap where one was."""

    actor: ActorHandle[EpisodeActor] | None = None
    node: Node | None = None
    rank: int = 0
    """Its number among the processes of its node."""
    pending: ObjectRef[object] | ObjectRefGenerator[Event] | None = None
    """Pending answer; None while it waits for work."""
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
def in_cluster(address: tuple[str, ...]) -> Iterator[None]:
    """Be in the cluster of an address, or in one of our own on this machine where there is none.

    A cluster of our own asks for a token that only its processes have; Ray would leave one in the home folder. That of
    another cluster is the user's business (`RAY_AUTH_MODE`, `RAY_AUTH_TOKEN`).

    Raises:
        InputError: No cluster answers, or one of another version of Ray or Python.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # it would report to Ray's makers
    if not address and not {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & set(os.environ):
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # our processes hide GPUs themselves
    if address and address[0] != "auto":
        _knock(address[0])
    terminate = signal.getsignal(signal.SIGTERM)
    try:
        with _native_silence():
            if address:
                ray.init(address=address[0], log_to_driver=False, logging_level=logging.CRITICAL)
            else:
                ray.init(
                    address=OWN,
                    log_to_driver=False,
                    logging_level=logging.CRITICAL,
                    include_dashboard=False,
                    object_store_memory=STORE_BYTES,
                    _node_ip_address="127.0.0.1",
                )
    except Exception as error:  # Ray raises whatever is at hand
        where = f"--ray {address[0]}" if address else "--ray"
        lines = str(error).strip().splitlines()
        cause = plain_text(lines[0] if lines else type(error).__name__, 200)
        hint = " (one that asks for a token: RAY_AUTH_MODE=token)" if address else ""
        raise InputError(f"{where}: no Ray cluster to be used: {cause}{hint}") from None
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, terminate)  # Ray's own one leaves without a word
    try:
        yield
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """Refuse an address where nobody listens; Ray would try for minutes."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECTION).close()
    except (OSError, OverflowError) as error:
        cause = getattr(error, "strerror", None) or str(error)
        raise InputError(f"--ray {address}: no Ray cluster answers ({plain_text(cause, 80)})") from None


@contextlib.contextmanager
def _native_silence() -> Iterator[None]:
    """Discard messages of native code: each attempt to reach a cluster that is not there is a line."""
    sys.stderr.flush()
    kept, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(sink)


class WorkerPool:
    """Processes that play one run, or several with the same flags of --ray on the same kind of device."""

    def __init__(self, config: RunConfig, most: int, factories: Factories | None):
        """Ask the cluster for them.

        Args:
            config: A run whose flags say how many.
            most: No more than so many.
            factories: What they build runs with; the real parts by default.

        Raises:
            InputError: A cluster of our own has no room for one.
        """
        self._flags, self._most, self._factories = config.flags, most, factories
        flags = config.flags
        nodes = _resources()
        self._gpus = 0.0 if config.device == "cpu" else flags.ray_gpus or 1.0
        fit = [node for node in nodes if node.get("GPU", 0.0) >= self._gpus] or nodes
        self._cpus = flags.ray_cpus or min([USUAL_CPUS, *(max(1, int(node.get("CPU", 1.0))) for node in fit)])
        if not flags.ray and not any(map(self._room, nodes)):
            flag = "--ray-cpus" if flags.ray_cpus else "--ray"
            raise InputError(f"{flag}: a process asks for {self._asked()}, {_shown(nodes)}")
        self.workers: list[Worker] = []
        self.shown: Progress | None = None
        """Progress that shows losses."""
        self._reported = self._grown = time.monotonic()
        self._grow(nodes)

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
                if isinstance(message, ArenaError):
                    raise message
        return job.configured()

    def idle(self) -> list[Worker]:
        """Those that wait for work."""
        return [worker for worker in self.workers if worker.node is not None and worker.pending is None]

    def prepare(self, worker: Worker, job: Job) -> None:
        """Let a process that waits build tracker and policy of a run, in place of those that it has."""
        assert worker.actor is not None
        worker.job, worker.since = job, time.monotonic()
        worker.until = max(self._late(), worker.since + BEGINNING)
        path = os.path.abspath(job.folder.path)
        cores = (worker.rank * self._cpus, self._cpus)
        worker.pending = worker.actor.open.remote(job.options(), path, cores, self._factories)

    def assign(self, worker: Worker, assignment: Assignment) -> None:
        """Let a process that waits play a slice of the run that it has opened."""
        assert worker.actor is not None and worker.job is assignment.job
        config_hash = assignment.job.folder.document["config_hash"]
        part = Slice(" ".join(assignment.group), tuple(assignment.left), assignment.worlds, config_hash)
        worker.assignment, worker.last, worker.since, worker.until = (
            assignment,
            assignment.group,
            time.monotonic(),
            self._late(),
        )
        worker.pending = worker.actor.play.options(num_returns="streaming").remote(part)

    def messages(self) -> Iterator[tuple[Job, Assignment | None, Opened | Event | Done | Lost | ArenaError]]:
        """Messages of the processes; waits a little for them. Lost processes are replaced.

        Yields:
            The run, the slice of it where one is played, and its message: an error where another process could not
            go on with the run either.

        Raises:
            InputError: A node has another version of the code or of a file.
            RunStopped: No process begins.
        """
        now = time.monotonic()
        if now - self._grown >= GROWTH:
            self._grown = now
            self._grow(_resources())
        for worker in self.workers:
            if worker.actor is None and now >= worker.again_at:
                self._start(worker)
            elif worker.actor is not None and now >= worker.until:
                minutes = self._flags.ray_minutes
                yield from self._lose(worker, Lost(f"took longer than {minutes:g} min (--ray-minutes)"))
        self._say_if_none_begins(now)
        asked = {worker.pending: worker for worker in self.workers if worker.pending is not None}
        if not asked:
            time.sleep(FIRST_PAUSE)
            return
        answered, _ = ray.wait(list(asked), timeout=POLL)
        for pending in answered:
            worker = asked[pending]
            try:
                message = ray.get(
                    next(cast("ObjectRefGenerator[Event]", pending)) if worker.assignment is not None else pending
                )
            except StopIteration:
                job, assignment, worker.assignment = worker.job, worker.assignment, None
                self._rest(worker)
                assert job is not None
                yield job, assignment, Done()
                continue
            except RayError:
                gone = worker.node is not None and not _lives(worker.node)
                yield from self._lose(worker, Lost("its machine left the cluster" if gone else DIED, with_node=gone))
                continue
            job = worker.job
            if job is None:
                self._begin(worker, cast("Node", message))
            elif isinstance(message, Broke) and (error := _error(message)) is not None:
                assignment = worker.assignment
                self._replace(worker)
                yield job, assignment, error
            elif isinstance(message, Broke):
                yield from self._lose(worker, Lost(message.message, message.trace))
            elif worker.assignment is not None:
                yield job, worker.assignment, message
            else:
                assert isinstance(message, Opened)
                self._check(worker, job, message)
                job.opened = job.opened or message
                self._rest(worker)
                yield job, None, message

    def dismiss(self) -> None:
        """End all processes."""
        for worker in self.workers:
            self._end(worker)
            worker.again_at = math.inf

    def _grow(self, nodes: list[dict[str, float]]) -> None:
        """Ask for as many processes as there is room for now, or as --ray-actors says."""
        wanted = self._flags.ray_actors or max(1, sum(map(self._room, nodes)))
        for _ in range(min(wanted, self._most) - len(self.workers)):
            self.workers.append(Worker())
            self._start(self.workers[-1])

    def _start(self, worker: Worker) -> None:
        """Ask for a process; where there is no room the cluster answers when there is."""
        resources = {"num_cpus": self._cpus, "num_gpus": self._gpus}
        made = ray.remote(EpisodeActor).options(**resources, max_restarts=0).remote(self._gpus > 0)
        worker.actor = cast("ActorHandle[EpisodeActor]", made)
        worker.pending = worker.actor.node.remote()

    def _begin(self, worker: Worker, node: Node) -> None:
        """A process has begun, and waits."""
        taken = {one.rank for one in self.workers if one.node is not None and one.node.name == node.name}
        worker.node, worker.rank = node, min(set(range(len(self.workers))) - taken)
        worker.pending = None

    def _rest(self, worker: Worker) -> None:
        """A process has done what it was asked, and waits; its time counts for the run."""
        if worker.job is not None and worker.pending is not None:
            worker.job.seconds += (time.monotonic() - worker.since) * (self._gpus or 1.0)
        worker.pending, worker.until = None, math.inf

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
                f"--ray: on node {worker.node.host} {key} is {there}, here {here}; all nodes need the same code, files "
                "and libraries"
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
            error = RunStopped(f"--ray: {STARTS} processes{where} ended one after the other: {lost.cause}")
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
        if worker.actor is not None:
            with contextlib.suppress(RayError, ValueError):
                ray.kill(worker.actor)
        worker.actor = worker.assignment = worker.node = worker.last = worker.job = None

    def _say_if_none_begins(self, now: float) -> None:
        if any(worker.node is not None for worker in self.workers):
            self._reported = now
        elif now - self._reported >= PATIENCE:
            self._reported = now
            _print(f"  no process has begun: each asks for {self._asked()}, {_shown(_resources())}")

    def _late(self) -> float:
        """Deadline of a process that begins something now [s]."""
        return time.monotonic() + 60.0 * self._flags.ray_minutes

    def _room(self, node: dict[str, float]) -> int:
        """Processes that a node holds."""
        by_cpu = int(node.get("CPU", 0.0) / self._cpus)
        return min(by_cpu, int(node.get("GPU", 0.0) / self._gpus + 1e-9)) if self._gpus else by_cpu

    def _asked(self) -> str:
        return counted(self._cpus, "core") + (f" and {self._gpus:g} GPU" if self._gpus else "")


DIED = "it died"
"""Cause of a loss of which no more is known: killed, out of memory, or native code crashed."""


def _error(message: Broke) -> ArenaError | None:
    """Error that playing again would not mend; None where it may."""
    kinds = {"input": InputError, "storage": StorageError, "stop": RunStopped}
    return kinds[message.kind](message.message) if message.kind in kinds else None


def _resources() -> list[dict[str, float]]:
    """Resources of each machine of the cluster."""
    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def _shown(nodes: list[dict[str, float]]) -> str:
    cores, gpus = (sum(node.get(name, 0.0) for node in nodes) for name in ("CPU", "GPU"))
    return f"the cluster has {cores:g} cores and {gpus:g} GPUs"


def _lives(node: Node) -> bool:
    """True if a machine is in the cluster."""
    return any(one["NodeID"] == node.name and one["Alive"] for one in ray.nodes())


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
