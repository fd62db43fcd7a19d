"""Websocket connections to policy servers: opened where needed, one request and one reply at a time, never compressed.

Redirects are not followed, proxies of the environment not used, and no pings are sent: a server that compiles its model
answers none for a while.
"""

from __future__ import annotations

import http.client
import logging
import socket
import threading
import time
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI, PayloadTooBig
from websockets.sync.client import ClientConnection, connect

from arena_newton.errors import InputError
from arena_newton.policies.base import Observation
from arena_newton.policies.protocols.handshake import ServedFacts
from arena_newton.policies.protocols.policy_messages import Begin, Query
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.remote.address import cause
from arena_newton.policies.remote.client import MAX_REPLY, Images, RemoteClient
from arena_newton.policies.remote.link import AskAgain, RemoteError, ServerLink

__all__ = ["GATEWAY_STATUS", "SocketClient", "SocketLink", "SocketRequest", "http_page"]

GATEWAY_STATUS = (502, 503, 504)
"""Status of a gateway whose server is not there."""
OPENING = 10.0
"""Least time of an opening handshake over TLS before another connection is tried, where several may be [s].

A session ticket that one thread reads while another sends can lose the request for good.
"""
CLOSING = 0.5
"""Longest closing handshake [s]."""
MOST_PAGE = 2**20
"""Longest page that is read [bytes]."""
_SILENT = logging.Logger("arena_newton.websockets")
_SILENT.addHandler(logging.NullHandler())


@dataclass(frozen=True)
class SocketRequest:
    """Request of a world; links make it the bytes of their protocol."""

    message: Begin | Query | None
    """None: `batch` says it."""
    begin: Begin
    """Beginning of the episode, for connections that do not know it."""
    step: int = 0
    """Actions that the episode has received so far."""
    batch: bytes | None = None
    """A request for several worlds, packed."""


class SocketLink(ServerLink[SocketRequest, object]):
    """One websocket; a subclass greets, begins episodes and asks."""

    final = (OSError, ValueError, InvalidURI)
    sessions = False
    """True if the server keeps an episode with its connection."""

    def __init__(self, owner: SocketClient):
        """Take the policy whose server it is."""
        super().__init__(owner.url)
        self.owner = owner
        self.begun = False
        self._socket: ClientConnection | None = None

    # What a protocol defines.

    def greet(self, end: float) -> ServedFacts:
        """Exchange greetings on a new connection; what the server declares."""
        raise TypeError(f"{type(self).__name__} defines no greet()")

    def begin(self, begin: Begin, end: float) -> object:
        """Begin an episode; the reply, or None where the protocol has none."""
        raise TypeError(f"{type(self).__name__} defines no begin()")

    def query(self, request: SocketRequest, end: float) -> object:
        """Show what a world sees; the reply."""
        raise TypeError(f"{type(self).__name__} defines no query()")

    def unasked(self, frame: bytes | str) -> object:
        """The reply that a frame is for which nobody asked; None: it is none, and the connection is given up."""
        return None

    # What all have in common.

    def exchange(self, kind: str, request: SocketRequest, end: float) -> object:
        """Begin an episode or ask for actions, on the connection that there is or a new one.

        Raises:
            RemoteError: The connection that knew the episode is gone, or another policy answers than the one checked.
        """
        if self._socket is not None:
            idle, unasked = self._waiting()
            reply = None if unasked is None or isinstance(request.message, Begin) else self.unasked(unasked)
            if not idle:
                self.close()
            if reply is not None:
                return reply
        if self._socket is None:
            facts = self.open(end, self.owner.retries + 1)
            reason = self.owner.refused(facts)
            if reason:
                self.close()
                raise RemoteError(f"{self.url}: {reason}", lost=True)
        if isinstance(request.message, Begin):
            reply = self.begin(request.message, end)
            self.begun = True
            return reply
        if self.sessions and not self.begun:
            if request.step:
                self.close()
                raise RemoteError(
                    f"{self.url}: the connection broke, and with it what the server knew of the running episode",
                    lost=True,
                )
            self.begin(request.begin, end)
            self.begun = True
        return self.query(request, end)

    def open(self, end: float, attempts: int = 1) -> ServedFacts:
        """Connect and greet.

        Args:
            end: Deadline on the monotonic clock [s].
            attempts: Connections that may be tried until then; over TLS one of several does not take all the time.

        Raises:
            AskAgain: Nobody is there yet.
            ValueError: Something else is there.
        """
        left = end - time.monotonic()
        if left <= 0:
            raise TimeoutError
        patience = left if self.owner.context is None or attempts == 1 else min(left, max(left / attempts, OPENING))
        try:
            self._socket = connect(
                self.owner.address.url,
                additional_headers=self.owner.headers,
                ssl=self.owner.context,
                compression=None,
                proxy=None,
                open_timeout=patience,
                ping_interval=None,
                close_timeout=CLOSING,
                max_size=MAX_REPLY,
                logger=_SILENT,
            )
        except InvalidStatus as error:
            status = error.response.status_code
            if status in GATEWAY_STATUS:
                raise AskAgain(f"it answers with status {status}") from error
            more = ", a redirect, which is not followed" if 300 <= status < 400 else ""
            raise ValueError(f"status {status}{more}, expected a websocket") from error
        except InvalidHandshake as error:
            if isinstance(error.__cause__, EOFError):
                raise AskAgain("the connection was closed before it was open") from error
            raise ValueError(f"no websocket ({cause(error)})") from error
        except ConnectionClosed as error:  # while the opening request was sent
            raise AskAgain("the connection was closed before it was open") from error
        except TimeoutError as error:
            if patience == left:
                raise
            raise AskAgain(f"the connection was not open within {patience:.1f} s") from error
        try:
            return self.greet(end)
        except Exception:  # without its greeting a connection is of no use
            self.close()
            raise

    def send(self, data: bytes) -> None:
        """Send a frame.

        Raises:
            AskAgain: The connection is closed.
        """
        try:
            self._open_socket().send(data)
        except ConnectionClosed as error:
            raise AskAgain(_closed(error)) from error

    def receive(self, end: float) -> bytes | str:
        """The next frame.

        Raises:
            AskAgain: The connection is closed.
            TimeoutError: None has come until `end`.
            ValueError: It is too long.
        """
        try:
            return self._open_socket().recv(timeout=max(end - time.monotonic(), 0.0))
        except ConnectionClosed as error:
            if isinstance(error.__cause__, PayloadTooBig) or (error.sent is not None and error.sent.code == 1009):
                raise ValueError(f"the reply is longer than {MAX_REPLY >> 20} MiB") from error
            raise AskAgain(_closed(error)) from error

    def probe(self, end: float) -> object:
        """Open a websocket and be greeted."""
        return self.open(end)

    def abort(self) -> None:
        """Break off the exchange that another thread waits for, or close an idle connection."""
        self.aborted = True
        if not self.busy:
            self.close()
        connection = self._socket
        if connection is not None:
            try:
                connection.socket.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # it was closed meanwhile

    def close(self) -> None:
        """Close the connection; the server forgets what it kept with it."""
        connection, self._socket, self.begun = self._socket, None, False
        if connection is None:
            return
        if self.aborted:
            try:
                connection.socket.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # it was closed meanwhile
        connection.close()

    def _open_socket(self) -> ClientConnection:
        if self._socket is None:
            raise AskAgain("the connection is closed")
        return self._socket

    def _waiting(self) -> tuple[bool, bytes | str | None]:
        """True if the connection is open without a frame that nobody asked for, which would answer the next request.

        Returns:
            That, and the frame.
        """
        try:
            return False, self._open_socket().recv(timeout=0)
        except TimeoutError:
            return True, None
        except ConnectionClosed:
            return False, None


class SocketClient(RemoteClient[SocketRequest, object]):
    """A client of a protocol over websockets."""

    def refused(self, facts: ServedFacts) -> str:
        """Reason for which a server with this greeting is not the one that was checked; an empty text where it is."""
        if not self._checked or facts == self.greeting:
            return ""
        return "the server that answers now declares something else than the one that was there at the beginning"

    _checked = False
    greeting = ServedFacts()
    """Facts that the server declared when it was checked."""

    def _connect(self) -> SocketLink:
        """A link that is not connected yet."""
        raise TypeError(f"{type(self).__name__} defines no _connect()")

    def greet(self) -> ServedFacts:
        """Connect world 0 and read the server's greeting.

        Raises:
            InputError: No server of the protocol answers.
        """
        link = self._connections[0] = self._connect()
        for attempt in range(self.retries + 1):
            try:
                self.greeting = link.open(time.monotonic() + self.timeout, self.retries + 1)
                break
            except TimeoutError:
                link.close()
                raise self.refusal(RemoteError(f"{self.url}: no greeting within {self.timeout:g} s")) from None
            except (ConnectionError, socket.gaierror, AskAgain) as error:
                link.close()
                reason = self.one_line(cause(error))
                if attempt == self.retries:
                    message = f"--policy remote:{self.url}: no server answers there ({reason})"
                    raise InputError(message) from None
                time.sleep(self.backoff * 2**attempt)
            except (*link.final, WireError) as error:
                link.close()
                text = self.masked(str(error) if isinstance(error, WireError) else cause(error))
                raise self.refusal(RemoteError(text if self.url in text else f"{self.url}: {text}")) from None
        self._checked = True
        return self.greeting

    def _request(self, seen: Observation, state: np.ndarray, images: Images, world: int) -> SocketRequest:
        query = self._query(seen, state, images, world)
        return SocketRequest(query, self._begin(world, seen.gym_id), query.step or 0)

    def _beginning(self, world: int, task: str) -> SocketRequest | None:
        begin = self._begin(world, task)
        return SocketRequest(begin, begin)


def http_page(owner: SocketClient, route: str) -> bytes:
    """Content of a page at a websocket server's port; empty where it has none."""
    address = owner.address
    connection = http.client.HTTPConnection(address.host, address.port, timeout=owner.timeout)
    if owner.context is not None:
        connection = http.client.HTTPSConnection(
            address.host, address.port, timeout=owner.timeout, context=owner.context
        )
    late: threading.Timer | None = None
    try:
        connection.connect()
        late = threading.Timer(owner.timeout, _cut, [connection.sock])  # also of one that drips
        late.daemon = True
        late.start()
        connection.request("GET", address.path + route, headers=owner.headers)
        reply = connection.getresponse()
        data = reply.read(MOST_PAGE)
        return data if reply.status == 200 else b""
    except (OSError, http.client.HTTPException, ValueError):
        return b""
    finally:
        if late is not None:
            late.cancel()
        connection.close()


def _cut(connection: socket.socket) -> None:
    """End what another thread waits for."""
    with suppress(OSError):  # it was closed meanwhile
        connection.shutdown(socket.SHUT_RDWR)


def _closed(error: ConnectionClosed) -> str:
    """Reason for which a connection was closed."""
    if error.rcvd is None:
        return "the connection broke"
    return f"the server closed the connection ({error.rcvd.code}{f' {cause(error)}' if error.rcvd.reason else ''})"
