"""``python -m benchmarks server``: answers of a policy server while some of its clients send the largest pictures."""

from __future__ import annotations

import multiprocessing
import random
import statistics
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from websockets.sync.client import connect

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.interfaces import Chunk, Observation
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.base import Policy
from arena_newton.policies.protocols import openpi_codec, vla_eval_codec
from arena_newton.policies.protocols.policy_messages import Query
from arena_newton.policies.serve.connection_guard import ConnectionGuard
from arena_newton.policies.serve.policy_server import PolicyServer
from arena_newton.policies.serve.serve_command import open_endpoint
from arena_newton.policies.serve.serve_options import ServeOptions
from arena_newton.robot.canonical import STAND_ACTION, STATE_WIDTH
from benchmarks.bench_options import ServerBenchOptions

__all__ = ["load_figures"]

CALL_S = 0.01
"""Time that a call of the policy takes [s]."""
NORMAL, LARGEST = (224, 224, 3), (1200, 1920, 3)
"""Shapes of pictures: what policies look at, and the largest that a server accepts."""
START_S = 120.0
"""Longest start of the server [s]."""
PERIOD_S = 2.0
"""A normal client asks once in this time [s]; the others ask again as soon as they are answered."""
SLOWER_BAR, MEMORY_BAR = 3.0, 1.5
"""Times longer that a median answer may take, and the server's largest memory [GiB]."""


class StandingPolicy(Policy):
    """A policy that sees, takes its time and stands."""

    name, labels, needs_image, chunk_size = "standing", "v3.1", True, 20
    camera = CameraConfig(width=224, height=224)

    def act(self, observation: Observation) -> Chunk:
        """Chunks of the standing action."""
        time.sleep(CALL_S)
        return Chunk(np.tile(STAND_ACTION, (len(observation.state), self.chunk_size, 1)))


def load_figures(options: ServerBenchOptions) -> Iterator[BenchFigure]:
    """Median answer of normal clients beside clients with the largest pictures, over that without them.

    Raises:
        InputError: A flag is out of range.
    """
    if options.protocol not in ("openpi", "vla-eval"):
        raise InputError(f"--protocol {options.protocol}: measured are openpi vla-eval")
    if min(options.normal, options.large) < 1 or not options.seconds > 0:
        raise InputError("--normal, --large and --seconds: expected at least 1, and more than 0 s")
    processes = multiprocessing.get_context("fork")
    ours, theirs = processes.Pipe()
    server = processes.Process(target=_serve, args=(options.protocol, options.normal + options.large, theirs))
    server.start()
    try:
        if not ours.poll(START_S):
            raise ArenaError("the server did not start")
        port = ours.recv()
        alone, beside, after = (_median(options, port, large) for large in (0, options.large, 0))
        ours.send("end")
        peak = ours.recv()
    finally:
        server.kill()
    label = f"{options.protocol}: {options.normal} clients beside {options.large} with 1920x1200"
    note = f"{1000 * alone:.0f}, {1000 * beside:.0f}, then {1000 * after:.0f} ms"
    yield BenchFigure(f"{label}: median answer / without them", SLOWER_BAR, "times", True, beside / alone, note)
    yield BenchFigure(f"{label}: largest memory of the server", MEMORY_BAR, "GiB", True, peak)


def _serve(protocol: str, clients: int, parent: Connection) -> None:
    """Serve until the parent says so; then answer with the largest memory [GiB]."""
    server = PolicyServer(StandingPolicy(), max_sessions=clients + 4)
    server.start()
    endpoint = open_endpoint(
        server, ServeOptions(policy="stand", protocol=protocol, port=0), ConnectionGuard(clients + 8, "")
    )
    parent.send(endpoint.port)
    parent.recv()
    status = Path("/proc/self/status").read_text()
    parent.send(next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 2**20)


def _median(options: ServerBenchOptions, port: int, large: int) -> float:
    """Median time until a normal client is answered [s]."""
    processes = multiprocessing.get_context("fork")
    ours, theirs = processes.Pipe()
    groups = [(options.normal, NORMAL, PERIOD_S)] + [(large, LARGEST, 0.0)] * (large > 0)
    started = [
        processes.Process(target=_ask, args=(options.protocol, port, *group, options.seconds, theirs))
        for group in groups
    ]
    for process in started:
        process.start()
    found = [ours.recv() for _ in started]
    for process in started:
        process.join()
    return statistics.median(next(times for shape, times in found if shape == NORMAL))


def _ask(
    protocol: str, port: int, clients: int, shape: tuple[int, ...], period: float, seconds: float, parent: Connection
) -> None:
    """Play clients, each in a thread, and send the times of their answers."""
    state = np.zeros(STATE_WIDTH, np.float32)
    state[[0, 3]] = 1.0
    query = Query(state, {"front": np.zeros(shape, np.uint8)}, task="boxing", instruction="Box.")
    openpi = protocol == "openpi"
    body = openpi_codec.pack_request(query) if openpi else vla_eval_codec.pack_request(query, 1, 0.0)
    times: list[float] = []

    def client() -> None:
        time.sleep(random.random() * period)
        with connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None, open_timeout=120) as socket:
            if not openpi:
                socket.send(vla_eval_codec.pack_hello(None, 1, 0.0))
            socket.recv()
            while not times or time.monotonic() < end:
                began = time.monotonic()
                socket.send(body)
                if isinstance(socket.recv(timeout=120), str):
                    return
                times.append(time.monotonic() - began)
                time.sleep(max(0.0, period - times[-1]))

    end = time.monotonic() + seconds
    threads = [threading.Thread(target=client, daemon=True) for _ in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    parent.send((shape, times))
