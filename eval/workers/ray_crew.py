"""Processes of a Ray cluster: asked for, given runs to open, held to a deadline, and replaced when they are lost.

Ray restarts none by itself (`max_restarts=0`), so that who deals out knows of every loss and what was running.
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
from arena_newton.eval.play.whole_run import Group, RunStopped
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


__all__ = ["Crew", "Done", "Job", "Lease", "Lost", "Member", "in_cluster"]

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
        told = ("labels", "worlds_matter", "tracker_facts", "policy_facts")
        return dataclasses.replace(self.folder.config, **{name: getattr(self.opened, name) for name in told})

    def options(self) -> RunOptions:
        """The flags that a process opens it with."""
        alone = {name: getattr(RunOptions, name) for name in (*flags_of(Ray), "shard", "out")}
        return dataclasses.replace(self.folder.config.flags, **alone)


@dataclass
class Lease:
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
    """The process of a slice has told of all that it played, and waits."""


@dataclass
class Member:
    """A process of the crew, or the gap where one was."""

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
    lease: Lease | None = None
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


class Crew:
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
        self.members: list[Member] = []
        self.shown: Progress | None = None
        """Progress that shows losses."""
        self._said = self._grown = time.monotonic()
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
            for member in self.idle():
                if member.job is not job:
                    self.prepare(member, job)
            for _, _, said in self.heard():
                if isinstance(said, ArenaError):
                    raise said
        return job.configured()

    def idle(self) -> list[Member]:
        """Those that wait for work."""
        return [member for member in self.members if member.node is not None and member.pending is None]

    def prepare(self, member: Member, job: Job) -> None:
        """Let a process that waits build tracker and policy of a run, in place of those that it has."""
        assert member.actor is not None
        member.job, member.since = job, time.monotonic()
        member.until = max(self._late(), member.since + BEGINNING)
        path = os.path.abspath(job.folder.path)
        cores = (member.rank * self._cpus, self._cpus)
        member.pending = member.actor.open.remote(job.options(), path, cores, self._factories)

    def lend(self, member: Member, lease: Lease) -> None:
        """Let a process that waits play a slice of the run that it has opened."""
        assert member.actor is not None and member.job is lease.job
        config_hash = lease.job.folder.document["config_hash"]
        part = Slice(" ".join(lease.group), tuple(lease.left), lease.worlds, config_hash)
        member.lease, member.last, member.since, member.until = lease, lease.group, time.monotonic(), self._late()
        member.pending = member.actor.play.options(num_returns="streaming").remote(part)

    def heard(self) -> Iterator[tuple[Job, Lease | None, Opened | Event | Done | Lost | ArenaError]]:
        """Messages of the processes; waits a little for them. Lost processes are replaced.

        Yields:
            The run, the slice of it where one is played, and what is told: an error where another process could not
            go on with the run either.

        Raises:
            InputError: A node has another version of the code or of a file.
            RunStopped: No process begins.
        """
        now = time.monotonic()
        if now - self._grown >= GROWTH:
            self._grown = now
            self._grow(_resources())
        for member in self.members:
            if member.actor is None and now >= member.again_at:
                self._hire(member)
            elif member.actor is not None and now >= member.until:
                minutes = self._flags.ray_minutes
                yield from self._lose(member, Lost(f"took longer than {minutes:g} min (--ray-minutes)"))
        self._say_if_none_begins(now)
        asked = {member.pending: member for member in self.members if member.pending is not None}
        if not asked:
            time.sleep(FIRST_PAUSE)
            return
        answered, _ = ray.wait(list(asked), timeout=POLL)
        for pending in answered:
            member = asked[pending]
            try:
                said = ray.get(
                    next(cast("ObjectRefGenerator[Event]", pending)) if member.lease is not None else pending
                )
            except StopIteration:
                job, lease, member.lease = member.job, member.lease, None
                self._rest(member)
                assert job is not None
                yield job, lease, Done()
                continue
            except RayError:
                gone = member.node is not None and not _lives(member.node)
                yield from self._lose(member, Lost("its machine left the cluster" if gone else DIED, with_node=gone))
                continue
            job = member.job
            if job is None:
                self._begin(member, cast("Node", said))
            elif isinstance(said, Broke) and (error := _error(said)) is not None:
                lease = member.lease
                self._replace(member)
                yield job, lease, error
            elif isinstance(said, Broke):
                yield from self._lose(member, Lost(said.message, said.trace))
            elif member.lease is not None:
                yield job, member.lease, said
            else:
                assert isinstance(said, Opened)
                self._check(member, job, said)
                job.opened = job.opened or said
                self._rest(member)
                yield job, None, said

    def dismiss(self) -> None:
        """End all processes."""
        for member in self.members:
            self._end(member)
            member.again_at = math.inf

    def _grow(self, nodes: list[dict[str, float]]) -> None:
        """Ask for as many processes as there is room for now, or as --ray-actors says."""
        wanted = self._flags.ray_actors or max(1, sum(map(self._room, nodes)))
        for _ in range(min(wanted, self._most) - len(self.members)):
            self.members.append(Member())
            self._hire(self.members[-1])

    def _hire(self, member: Member) -> None:
        """Ask for a process; where there is no room the cluster answers when there is."""
        resources = {"num_cpus": self._cpus, "num_gpus": self._gpus}
        made = ray.remote(EpisodeActor).options(**resources, max_restarts=0).remote(self._gpus > 0)
        member.actor = cast("ActorHandle[EpisodeActor]", made)
        member.pending = member.actor.node.remote()

    def _begin(self, member: Member, node: Node) -> None:
        """A process has begun, and waits."""
        taken = {one.rank for one in self.members if one.node is not None and one.node.name == node.name}
        member.node, member.rank = node, min(set(range(len(self.members))) - taken)
        member.pending = None

    def _rest(self, member: Member) -> None:
        """A process has done what it was asked, and waits; its time counts for the run."""
        if member.job is not None and member.pending is not None:
            member.job.seconds += (time.monotonic() - member.since) * (self._gpus or 1.0)
        member.pending, member.until = None, math.inf

    def _check(self, member: Member, job: Job, opened: Opened) -> None:
        """Hold what a process built to what is planned, and to what the first one built."""
        assert member.node is not None
        unknown = () if job.opened is not None else ("tracker_facts", "policy_facts", "worlds", "labels")
        planned = job.folder.config.identity() if job.opened is None else job.opened.identity
        difference = differing_key(planned, opened.identity, unknown)
        difference = difference or differing_key(*map(moving_versions, (job.folder.installed, opened.versions)))
        if difference is not None:
            key, here, there = (plain_text(str(part), 80) for part in difference)
            raise InputError(
                f"--ray: on node {member.node.host} {key} is {there}, here {here}; all nodes need the same code, files "
                "and libraries"
            )

    def _lose(self, member: Member, lost: Lost) -> Iterator[tuple[Job, Lease | None, Lost | ArenaError]]:
        """End a process, if it has not ended, to be replaced after a pause; tells of what it did."""
        job, lease, where = member.job, member.lease, f" on {member.node.host}" if member.node is not None else ""
        member.starts = 0 if lease is not None and lease.built else member.starts + 1
        starts = member.starts
        self._replace(member)
        say = self.shown.say if self.shown is not None else _print
        doing = (
            f"  {' '.join(lease.group)}, {counted(len(lease.left), 'episode')} left" if lease else "  it had not begun"
        )
        if starts >= STARTS:
            error = RunStopped(f"--ray: {STARTS} processes{where} ended one after the other: {lost.cause}")
            if job is None:
                raise error
            member.starts = 0
            yield job, lease, error
            return
        say(f"{doing}: a process{where} is replaced: {lost.cause}")
        if job is not None:
            yield job, lease, lost

    def _replace(self, member: Member) -> None:
        """End a process, to be replaced after a pause."""
        self._end(member)
        member.again_at = time.monotonic() + min(LONGEST_PAUSE, FIRST_PAUSE * 2.0**member.starts)

    def _end(self, member: Member) -> None:
        self._rest(member)
        if member.actor is not None:
            with contextlib.suppress(RayError, ValueError):
                ray.kill(member.actor)
        member.actor = member.lease = member.node = member.last = member.job = None

    def _say_if_none_begins(self, now: float) -> None:
        if any(member.node is not None for member in self.members):
            self._said = now
        elif now - self._said >= PATIENCE:
            self._said = now
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


def _error(said: Broke) -> ArenaError | None:
    """Error that playing again would not mend; None where it may."""
    kinds = {"input": InputError, "storage": StorageError, "stop": RunStopped}
    return kinds[said.kind](said.message) if said.kind in kinds else None


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
