"""A port of websockets that strangers, clients that stop reading and a want of file descriptors do not end."""

from __future__ import annotations

import logging
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress

from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Origin

from arena_newton.policies.serve.connection_guard import STRANGER_SECONDS, ConnectionGuard

__all__ = ["WebsocketListener", "dismiss", "part"]

PING_SECONDS = 20.0
"""Time between two pings [s]."""
SEND_SECONDS = 30.0
"""Time without a byte read by a client, whose buffers are full, after which its connection is given up [s]."""
FAREWELL_SECONDS = 1.0
"""Time that clients have, all together, to answer that they are hung up on [s]."""
PAUSE = 0.05
"""Pause after a connection that could not be taken, such as for want of file descriptors [s]."""
GOING_AWAY = 1001
"""Code with which a socket is closed: the server ends."""


class WebsocketListener:
    """Takes connections, a thread for each."""

    def __init__(
        self,
        listening: socket.socket,
        guard: ConnectionGuard,
        serve_connection: Callable[[ServerConnection], None],
        answer_http: Callable[[ServerConnection, Request], Response | None],
        *,
        origins: Sequence[Origin | None],
        longest: int,
        pong_seconds: float,
        tls: ssl.SSLContext | None = None,
    ):
        """Begin to listen.

        Args:
            listening: The port, which belongs to the listener from now on.
            guard: Counts the connections.
            serve_connection: Serves one until it returns.
            answer_http: Answers a request; None lets the handshake of a socket go on.
            origins: What `Origin` a socket may have.
            longest: Most bytes of a message.
            pong_seconds: Time that a client has to answer a ping [s].
            tls: Certificate and key, for `wss`.
        """
        self._guard, self._serve_connection = guard, serve_connection
        self._lock = threading.Lock()
        self._open: set[ServerConnection] = set()
        self._closed = threading.Event()
        logger = logging.getLogger("arena_newton.websockets")
        logger.setLevel(logging.CRITICAL)  # what strangers send is no news
        self._server = serve(
            self._connected,
            sock=listening,
            ssl=tls,
            origins=origins,
            process_request=answer_http,
            compression=None,
            max_size=longest,
            max_queue=0,  # a message is read from the network when the one before it is
            open_timeout=STRANGER_SECONDS,
            ping_interval=PING_SECONDS,
            ping_timeout=pong_seconds,
            server_header=None,
            logger=logger,
        )
        self._thread = threading.Thread(target=self._listen, name="websockets", daemon=True)
        self._thread.start()

    def close(self, reason: str) -> None:
        """End the port and its connections, also those of clients that do not read."""
        self._closed.set()
        with suppress(OSError):  # which wakes who waits for a connection
            self._server.socket.shutdown(socket.SHUT_RDWR)
        self._server.shutdown()
        with self._lock:
            connections = list(self._open)
        part(connections, GOING_AWAY, reason)
        self._thread.join(timeout=2.0)

    def _listen(self) -> None:
        """Take connections until the port closes.

        The library's own loop ends at the first connection that cannot be taken, and its threads keep the process.
        """
        patience = struct.pack("ll", *divmod(round(SEND_SECONDS * 1e6), 10**6))
        while not self._closed.is_set():
            try:
                connection, address = self._server.socket.accept()
            except OSError:
                self._closed.wait(PAUSE)
                continue
            if not self._guard.arrives():
                connection.close()
                continue
            try:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, patience)
                threading.Thread(target=self._handle, args=[connection, address], daemon=True).start()
            except (OSError, RuntimeError):  # it has left, or there are no more threads
                self._guard.leaves()
                connection.close()

    def _handle(self, connection: socket.socket, address: object) -> None:
        try:
            self._server.handler(connection, address)
        finally:
            self._guard.leaves()

    def _connected(self, connection: ServerConnection) -> None:
        with self._lock:
            self._open.add(connection)
        try:
            self._serve_connection(connection)
        finally:
            with self._lock:
                self._open.discard(connection)


def part(connections: Iterable[ServerConnection], code: int, reason: str) -> None:
    """Close connections within `FAREWELL_SECONDS`; some clients never answer, or never read."""
    connections = list(connections)
    threads = [threading.Thread(target=_say_goodbye, args=[one, code, reason], daemon=True) for one in connections]
    for thread in threads:
        thread.start()
    end = time.monotonic() + FAREWELL_SECONDS
    for thread in threads:
        thread.join(max(end - time.monotonic(), 0.0))
    for connection in connections:
        with suppress(OSError):
            connection.socket.shutdown(socket.SHUT_RDWR)


def dismiss(connection: ServerConnection, code: int, reason: str) -> None:
    """Close a connection; frames that its client still sends are dropped, for its own farewell comes after them."""
    farewell = threading.Thread(target=_say_goodbye, args=[connection, code, reason], daemon=True)
    farewell.start()
    with suppress(ConnectionClosed):
        for _ in connection:
            pass
    farewell.join()


def _say_goodbye(connection: ServerConnection, code: int, reason: str) -> None:
    with suppress(OSError, ConnectionClosed):  # it was closed meanwhile
        connection.close(code, reason)
