"""Processes of a Ray cluster that play; the only module that imports Ray.

Ray restarts none by itself (`max_restarts=0`), so that the run knows of every loss and of the episodes behind it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import secrets
import signal
import socket
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, cast

import ray
from ray.exceptions import RayError

from arena_newton.errors import InputError
from arena_newton.eval.plan.options import Ray
from arena_newton.eval.play.run_flow import RunStopped
from arena_newton.eval.workers.actor import EpisodeActor
from arena_newton.eval.workers.backend import Process, WorkerLost
from arena_newton.eval.workers.messages import Done, Event, Node, Opened
from arena_newton.files.text import counted, plain_text

if TYPE_CHECKING:
    from ray import ObjectRef, ObjectRefGenerator
    from ray.actor import ActorHandle

__all__ = ["RayBackend", "in_cluster"]

OWN = "local"
"""Address that makes Ray start a cluster of its own."""
STORE_BYTES = 80 << 20
"""Object store of such a cluster, near the least that Ray takes: only numbers and lines pass through it."""
USUAL_CPUS = 4
"""Cores of a process where --ray-cpus does not say."""
CONNECTION = 10.0
"""An address answers within this time [s]."""


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


@contextlib.contextmanager
def _stopping() -> Iterator[None]:
    """Stop the run where the cluster itself fails."""
    try:
        yield
    except RayError as error:
        raise RunStopped(f"--ray: {plain_text(str(error).strip().splitlines()[0], 200)}") from None


class RayActor(EpisodeActor):
    """Process of Ray that plays episodes."""

    def __init__(self, gpu: bool):
        """Hide the GPUs from a process that was given none: Warp would make a context on each."""
        if not gpu:
            os.environ["CUDA_VISIBLE_DEVICES"] = ""
        super().__init__()

    def node(self) -> Node:
        """Machine, process and GPUs of this process."""
        return dataclasses.replace(super().node(), name=ray.get_runtime_context().get_node_id())


class RayProcess:
    """Process of the cluster, as the driver sees it."""

    def __init__(self, actor: ActorHandle[RayActor]):
        """Take an actor that was asked for."""
        self._actor = actor
        self.pending: ObjectRef[Node | Opened] | ObjectRefGenerator[Event]
        """Answer of the last call."""
        self._streams, self._node = False, cast("str | None", None)

    @_stopping()
    def ask(self, method: str, *arguments: object) -> None:
        """Call a method."""
        called, self._streams = getattr(self._actor, method), method == "play"
        self.pending = (called.options(num_returns="streaming") if self._streams else called).remote(*arguments)

    def take(self) -> Node | Opened | Event | Done:
        """The next answer, or `WorkerLost`."""
        try:
            ref = next(cast("ObjectRefGenerator[Event]", self.pending)) if self._streams else self.pending
            answer = ray.get(cast("ObjectRef[Node | Opened | Event]", ref))
        except StopIteration:
            return Done()
        except RayError:
            left = self._node is not None and self._node not in _nodes()
            raise WorkerLost(with_node=left) from None
        self._node = answer.name if isinstance(answer, Node) else self._node
        return answer

    def end(self) -> None:
        """Kill the process."""
        with contextlib.suppress(RayError, ValueError):
            ray.kill(self._actor)


class RayBackend:
    """Processes of the cluster that this one is connected with."""

    def __init__(self, flags: Ray, device: str):
        """Look for their cores and GPUs.

        Args:
            flags: How many, and what each asks for.

        Raises:
            InputError: A cluster of our own has no room for one.
        """
        self.flag, self._actors, self.minutes = (
            " ".join(("--ray", *(flags.ray or ()))),
            flags.ray_actors,
            flags.ray_minutes,
        )
        nodes = list(_nodes().values())
        self.gpus = 0.0 if device == "cpu" else flags.ray_gpus or 1.0
        fit = [node for node in nodes if node.get("GPU", 0.0) >= self.gpus] or nodes
        self._cpus = flags.ray_cpus or min([USUAL_CPUS, *(max(1, int(node.get("CPU", 1.0))) for node in fit)])
        if not flags.ray and not any(map(self._held, nodes)):
            flag = "--ray-cpus" if flags.ray_cpus else "--ray"
            raise InputError(f"{flag}: a process {self.demand()}")

    def room(self) -> int:
        """Number of processes that the cluster holds now, or that of --ray-actors."""
        return self._actors or max(1, sum(map(self._held, _nodes().values())))

    def demand(self) -> str:
        """Resources of a process, and those of the cluster."""
        cores, gpus = (sum(node.get(name, 0.0) for node in _nodes().values()) for name in ("CPU", "GPU"))
        asked = counted(self._cpus, "core") + (f" and {self.gpus:g} GPU" if self.gpus else "")
        return f"asks for {asked}, the cluster has {cores:g} cores and {gpus:g} GPUs"

    def cores(self, rank: int) -> tuple[int, int]:
        """First core of a process, and their number."""
        return rank * self._cpus, self._cpus

    @_stopping()
    def start(self) -> RayProcess:
        """Ask for a process; where there is no room the cluster answers when there is."""
        asked = ray.remote(RayActor).options(num_cpus=self._cpus, num_gpus=self.gpus, max_restarts=0)
        return RayProcess(cast("ActorHandle[RayActor]", asked.remote(self.gpus > 0)))

    @_stopping()
    def wait(self, processes: Sequence[Process], timeout: float) -> Sequence[Process]:
        """Those that have answered or ended."""
        asked = {process.pending: process for process in cast("Sequence[RayProcess]", processes)}
        answered, _ = ray.wait(list(asked), timeout=timeout)
        return [asked[pending] for pending in answered]

    def _held(self, node: dict[str, float]) -> int:
        """Processes that a node holds."""
        by_cpu = int(node.get("CPU", 0.0) / self._cpus)
        return min(by_cpu, int(node.get("GPU", 0.0) / self.gpus + 1e-9)) if self.gpus else by_cpu


@_stopping()
def _nodes() -> dict[str, dict[str, float]]:
    """Resources of each machine of the cluster, by Ray's name of it."""
    return {node["NodeID"]: node["Resources"] for node in ray.nodes() if node["Alive"]}
