"""Endpoint of the original benchmark's HTTP protocol: a thread for each connection, JSON in and out.

`policies.serve.http_robots` finds the robot of a request.
"""

from __future__ import annotations

import math
import socket
import ssl
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from arena_newton.errors import ArenaError
from arena_newton.files.text import plain_text
from arena_newton.policies.protocols.arena_codec import (
    CLIENT_HEADER,
    pack_begun,
    pack_chunk,
    pack_config,
    pack_failure,
    read_client,
    unpack_begin,
    unpack_query,
)
from arena_newton.policies.protocols.policy_messages import Begin, Query
from arena_newton.policies.protocols.raw_arrays import MAX_FRAME
from arena_newton.policies.serve.connection_guard import HEALTH_PATHS, STRANGER_SECONDS, ConnectionGuard
from arena_newton.policies.serve.http_robots import HttpRobot, HttpRobots
from arena_newton.policies.serve.policy_server import PolicyServer, Refused

__all__ = ["HttpEndpoint"]

IDLE_CONNECTION = 600.0
"""Time without a request after which a connection is closed [s]."""
BODY_SECONDS = 60.0
"""Time that a client has to send the body of a request [s]."""
DRAIN_SECONDS, DRAIN_FRAMES = 5.0, 4
"""Time [s] and largest bodies' worth of bytes that are read and dropped so that a client whose body is too long, which
looks for an answer only when it has sent all of it, gets one."""
POLL = 0.05
"""Time after which an endpoint notices that it is closed [s]."""
_STATUS = {"unfit": 400, "unknown_episode": 409, "full": 503, "policy": 500, "closing": 503}
"""Reason of a refusal → HTTP status; clients ask again after 503."""


type _Taken = socket.socket | tuple[bytes, socket.socket]
"""Request of the base class: for TCP the connection."""


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    protocol_version, disable_nagle_algorithm = "HTTP/1.1", True
    server_version, sys_version = "arena-newton", ""
    timeout = STRANGER_SECONDS
    wbufsize = 1 << 16  # head and body of a reply leave together
    server: _Listener

    def handle(self) -> None:
        """Serve until the client leaves; a connection beyond the limit is refused with a message."""
        self.room = False
        with self.server.listed(self.connection), ExitStack() as self.visit:
            super().handle()

    def do_GET(self) -> None:  # noqa: N802 (the name that http.server calls)
        """Routes that change nothing."""
        path = self.path.partition("?")[0]
        if self._refused(path):
            return
        self.close_connection = self.close_connection or path in HEALTH_PATHS
        if path == "/healthz":
            self._send(200, b"OK\n", "text/plain")
        elif path in HEALTH_PATHS:
            self._send(200, b'{"status": "ok"}\n')
        elif path == "/config":
            self._send(200, pack_config(self.server.policy.facts, {"protocol": "arena"}))
        else:
            self._send(404, pack_failure("no such route; there are /reset, /infer, /config, /health"))

    def do_POST(self) -> None:  # noqa: N802 (the name that http.server calls)
        """Begin an episode, or answer a query."""
        path = self.path.partition("?")[0]
        if self._refused(path):
            return
        body = self._body()
        if body is None:
            return
        policy, address = self.server.policy, self.client_address[0]
        try:
            client = read_client(self.headers.get(CLIENT_HEADER))
            if path == "/reset":
                self.server.begin(address, client, self.connection, unpack_begin(body))
                self._send(200, pack_begun(policy.facts))
            elif path == "/infer":
                query, chunk = policy.read(len(body), partial(unpack_query, body))
                del body  # its picture is unpacked
                actions = self.server.query(address, client, self.connection, query, chunk=chunk)
                self._send(200, pack_chunk(actions, chunk=chunk))
            else:
                self._send(404, pack_failure("no such route; there are /reset, /infer, /config, /health"))
        except Refused as error:
            self._send(_STATUS[error.reason], pack_failure(plain_text(error, 300)))
        except ArenaError as error:
            self._send(400, pack_failure(plain_text(error, 300)))

    def _refused(self, path: str) -> bool:
        headers = self.headers
        names = headers.get("Authorization"), headers.get("Origin"), headers.get_all("Host") or []
        refusal = self.server.guard.refusal(path, *names)
        if refusal is None and path not in HEALTH_PATHS and not self._let_in():
            refusal = 503, f"there are {self.server.guard.connections} connections already"
        if refusal is not None:
            self.close_connection = True
            self._send(refusal[0], pack_failure(refusal[1]))
        return refusal is not None

    def _let_in(self) -> bool:
        """True if there is room for this connection, which counts from its first authorised request."""
        if not self.room and self.visit.enter_context(self.server.guard.inside()):
            self.room = True
            self.server.known(self.connection)
            self.connection.settimeout(IDLE_CONNECTION)
        return self.room

    def _body(self) -> bytearray | None:
        """The body of a request; None where it cannot be read and the client has got an error."""
        lengths = self.headers.get_all("Content-Length") or []
        if self.headers.get("Transfer-Encoding") or len(lengths) != 1 or not lengths[0].isascii():
            self._hang_up(411, "a body needs one Content-Length")
            return None
        if not lengths[0].isdecimal() or len(lengths[0]) > 12:
            self._hang_up(400, "Content-Length is not a number")
            return None
        left = int(lengths[0])
        if left > MAX_FRAME:
            self._hang_up(413, f"a body of {left} bytes, expected at most {MAX_FRAME}")
            self._drain(min(left, DRAIN_FRAMES * MAX_FRAME))
            return None
        end, body, got = time.monotonic() + BODY_SECONDS, bytearray(left), 0
        while got < left:
            self.connection.settimeout(max(end - time.monotonic(), 0.01))
            read = self.rfile.readinto1(memoryview(body)[got : got + (1 << 16)])
            if not read:
                self.close_connection = True
                return None
            got += read
        self.connection.settimeout(IDLE_CONNECTION)
        return body

    def _drain(self, left: int) -> None:
        """Read and drop what a client goes on sending."""
        end = time.monotonic() + DRAIN_SECONDS
        with suppress(OSError):
            while left > 0 and (time_left := end - time.monotonic()) > 0:
                self.connection.settimeout(time_left)
                piece = self.rfile.read1(min(left, 1 << 16))
                if not piece:
                    return
                left -= len(piece)

    def _hang_up(self, status: int, sentence: str) -> None:
        self.close_connection = True
        self._send(status, pack_failure(sentence))

    def _send(self, status: int, body: bytes, kind: str = "application/json") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        if self.close_connection:
            self.server.leaves(self.connection)  # before the client, which knows now, asks over another
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)
        self.wfile.flush()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Send errors of http.server itself as JSON."""
        self.close_connection = True
        if not hasattr(self, "request_version") or self.request_version == "HTTP/0.9":
            self.request_version = "HTTP/1.1"
        self._send(code, pack_failure(plain_text(message or HTTPStatus(code).phrase, 200)))

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: what strangers send is no news."""


class _Listener(ThreadingHTTPServer):
    """A thread for each connection; the queue holds the connections of all worlds, which come at once."""

    request_queue_size, daemon_threads, allow_reuse_address = 128, True, True

    def __init__(
        self, listening: socket.socket, policy: PolicyServer, guard: ConnectionGuard, tls: ssl.SSLContext | None
    ) -> None:
        super().__init__(listening.getsockname()[:2], _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening
        self.policy, self.guard, self.tls = policy, guard, tls
        self._robots = HttpRobots()
        self._open: dict[socket.socket, float] = {}
        """Connection → when it must have identified itself [s]."""
        self._lock = threading.Lock()

    def get_request(self) -> tuple[socket.socket, tuple[str, int]]:
        """Take a connection; TLS shakes hands at its first read, in its own thread."""
        connection, address = self.socket.accept()
        if self.tls is not None:
            connection = self.tls.wrap_socket(connection, server_side=True, do_handshake_on_connect=False)
        return connection, address

    def handle_error(self, request: object, client_address: object) -> None:
        """A connection broke off, which is no news; anything else is."""
        error = sys.exception()
        if not isinstance(error, OSError):
            print("".join(traceback.format_exception(error)), file=sys.stderr, flush=True)

    @contextmanager
    def listed(self, connection: socket.socket) -> Iterator[None]:
        """Remember a connection while it lasts."""
        with self._lock:
            self._open[connection] = time.monotonic() + STRANGER_SECONDS
        try:
            yield
        finally:
            with self._lock:
                self._open.pop(connection, None)
            self.leaves(connection)

    def leaves(self, connection: socket.socket) -> None:
        """No more requests come over a connection: its robots may ask over another, or never again."""
        for robot in self._robots.left(connection):
            self.policy.abandon(robot.owner, robot.session)

    def known(self, connection: socket.socket) -> None:
        """A connection has been let in."""
        with self._lock:
            self._open[connection] = math.inf

    def service_actions(self) -> None:
        """Hang up on who sends the first request's head by drips; the base class calls this many times a second."""
        now = time.monotonic()
        with self._lock:
            late = [connection for connection, end in self._open.items() if end < now]
        for connection in late:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def verify_request(self, request: object, client_address: object) -> bool:
        """True if a connection is read at all."""
        return self.guard.arrives()

    def process_request(self, request: _Taken, client_address: object) -> None:
        """Give a connection its thread."""
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no more threads
            self.guard.leaves()
            self.shutdown_request(request)

    def process_request_thread(self, request: _Taken, client_address: object) -> None:
        """Serve a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.guard.leaves()

    def hang_up(self) -> None:
        """Close all connections: clients that keep one would go on asking."""
        with self._lock:
            for connection in self._open:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def begin(self, address: str, client: str, connection: socket.socket, begin: Begin) -> None:
        """Begin an episode of a robot, and end the one that it had before."""
        robot, before = self._robots.beginning(address, client, connection, begin.session, begin.seed)
        if before is not None:
            self.policy.end(robot.owner, before)
        self.policy.begin(robot.owner, replace(begin, session=robot.session), held=False)
        robot.kept.clear()

    def query(
        self, address: str, client: str, connection: socket.socket, query: Query, *, chunk: bool = True
    ) -> np.ndarray:
        """The chunk of a robot; without `chunk` one action, shape [1, 40]: of its last chunk while some are left."""
        robot = self._robots.querying(address, client, connection, query.session, query.seed, begins=query.step == 0)
        if not chunk and query.step is None:
            with suppress(IndexError):
                return robot.kept.popleft()[None]
        return self._asked(robot, query, chunk=chunk)

    def _asked(self, robot: HttpRobot, query: Query, *, chunk: bool) -> np.ndarray:
        actions = self.policy.query(robot.owner, replace(query, session=robot.session), held=False).actions
        robot.kept = deque() if chunk else deque(actions[1:])
        return actions if chunk else actions[:1]


class HttpEndpoint:
    """Listens, and translates between JSON and the policy server."""

    def __init__(
        self, server: PolicyServer, listening: socket.socket, guard: ConnectionGuard, tls: ssl.SSLContext | None = None
    ):
        """Begin to listen.

        Args:
            server: Answers; it has started.
            listening: The port, which belongs to the endpoint from now on.
            guard: Who may come in.
            tls: Certificate and key, for `https`.
        """
        self.port = int(listening.getsockname()[1])
        listening.listen(_Listener.request_queue_size)
        self._listener = _Listener(listening, server, guard, tls)
        self._thread = threading.Thread(target=self._listener.serve_forever, args=[POLL], name="endpoint", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the endpoint and its connections."""
        with suppress(OSError):  # which wakes who waits for a connection
            self._listener.socket.shutdown(socket.SHUT_RDWR)
        self._listener.shutdown()
        self._listener.hang_up()
        self._listener.server_close()
        self._thread.join(timeout=2.0)
