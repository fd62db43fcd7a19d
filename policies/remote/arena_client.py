"""The policy that runs elsewhere: a client of the original benchmark's HTTP protocol.

docs/howto/bring/policy_server.md has its fields. A server of that protocol knows one robot only, so there is one
request per world. `from_spec` also knows the protocols of other servers (docs/howto/bring/asking_servers.md), each in
its own module `remote_*`.
"""

from __future__ import annotations

import functools
import http.client
import importlib
import json
import secrets
import select
import socket
import ssl
import threading
import time
from typing import Any, cast

import numpy as np

from arena_newton.cli.extras import require
from arena_newton.data.readers.label_protocols import LABELS
from arena_newton.errors import InputError
from arena_newton.pictures.camera import CameraConfig
from arena_newton.policies.base import Json, Observation
from arena_newton.policies.protocols import arena_codec
from arena_newton.policies.protocols.handshake import ServedFacts, read_facts
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.remote.address import TOKEN_VARIABLE, read_address
from arena_newton.policies.remote.client import MAX_FAILURES, MAX_REPLY, Images, RemoteClient
from arena_newton.policies.remote.link import AskAgain, RemoteError, ServerLink, episode_lost

__all__ = ["MAX_FAILURES", "MAX_REPLY", "ROBOT_TYPE", "TOKEN_VARIABLE", "RemotePolicy", "from_spec"]

ROBOT_TYPE = LABELS["v3.1"].robot_type
"""Robot type that the original's server checks: actions of v3.1; those of other protocols have their own."""
_RETRY_STATUS = (502, 503, 504)
_OTHERS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "openpi": ("openpi_client", "serve", ("websockets", "msgpack")),
    "roboarena": ("openpi_client", "serve", ("websockets", "msgpack")),
    "vla-eval": ("vla_eval_client", "serve", ("websockets", "msgpack")),
    "simple": ("simple_client", "", ()),
    "gr00t": ("gr00t_client", "gr00t", ("zmq", "msgpack")),
}
"""Protocol of an address → its module, and the extra with the libraries that it needs."""
type _Reply = tuple[int, bytes]
"""Status and content."""


class _Connection(ServerLink[bytes, _Reply]):
    """One kept-alive connection."""

    transient = (AskAgain, ConnectionError, http.client.RemoteDisconnected, http.client.BadStatusLine, socket.gaierror)
    final = (OSError, http.client.HTTPException, ValueError)

    def __init__(
        self, url: str, server: tuple[str, int], path: str, context: ssl.SSLContext | None, headers: dict[str, str]
    ):
        super().__init__(url)
        self._path, self._headers = path, headers
        kind = http.client.HTTPConnection
        self._open = kind if context is None else functools.partial(http.client.HTTPSConnection, context=context)
        self._server = server
        self._http: http.client.HTTPConnection | None = None

    def exchange(self, kind: str, request: bytes, end: float) -> _Reply:
        """Send JSON, return status and content of the reply."""
        return self._exchange("POST", kind, request, end)

    def busy_signal(self, reply: _Reply) -> str:
        """A gateway's status is no answer of the server."""
        return f"it answers with status {reply[0]}" if reply[0] in _RETRY_STATUS else ""

    def alive(self, timeout: float) -> bool:
        """True if the server answers a request that changes nothing; any answer counts but a gateway's."""
        try:
            status, _ = self.get("/health", timeout)
        except (OSError, http.client.HTTPException, ValueError):
            return False
        finally:
            self.close()
        return status not in _RETRY_STATUS

    def get(self, route: str, timeout: float) -> _Reply:
        """Status and content of a page that the server may have."""
        self.busy = True
        late = threading.Timer(timeout, self.abort)  # a head by drips never meets the socket's own time limit
        late.daemon = True
        late.start()
        try:
            return self._exchange("GET", route, None, time.monotonic() + timeout)
        finally:
            late.cancel()
            self.busy = False

    def _exchange(self, method: str, route: str, body: bytes | None, end: float) -> tuple[int, bytes]:
        if self._http is not None and self._dropped():
            self.close()
        if self._http is None:
            self._http = self._open(*self._server, timeout=max(end - time.monotonic(), 0.001))
            self._http.connect()
            self._http.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._limit(end)
        headers = {"Content-Type": "application/json", "Accept": "application/json", **self._headers}
        self._http.request(method, self._path + route, body, headers)
        reply = self._http.getresponse()
        data = bytearray()
        while True:
            self._limit(end)
            piece = reply.read1(1 << 16)
            if not piece:
                break
            data += piece
            if len(data) > MAX_REPLY:
                raise ValueError(f"the reply is longer than {MAX_REPLY >> 20} MiB")
        if reply.length:
            raise ConnectionError("the reply broke off")
        reply.close()  # all of it is read; without this the kept connection takes no further request
        if reply.will_close:
            self.close()
        return reply.status, bytes(data)

    def _dropped(self) -> bool:
        """True if the server has closed the kept connection, or sent data without a request."""
        if self._http is None or self._http.sock is None:
            return True
        poll = select.poll()
        poll.register(self._http.sock, select.POLLIN)
        return bool(poll.poll(0))

    def _limit(self, end: float) -> None:
        left = end - time.monotonic()
        if left <= 0:
            raise TimeoutError
        if self._http is not None and self._http.sock is not None:
            self._http.sock.settimeout(left)

    def abort(self) -> None:
        """Break off the exchange that another thread waits for, or close an idle connection."""
        self.aborted = True
        if not self.busy:
            self.close()
        connection = self._http
        if connection is not None and connection.sock is not None:
            try:
                connection.sock.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # it was closed meanwhile

    def close(self) -> None:
        """Close the connection; the next exchange opens a new one."""
        if self._http is not None:
            self._http.close()
            self._http = None


class RemotePolicy(RemoteClient[bytes, _Reply]):
    """Asks a policy server, one request per world."""

    reset_kind, infer_kind = "/reset", "/infer"
    camera = CameraConfig(width=640, height=480, fit="native")
    """The original's client sends the head camera as it is, 640×480; resizing is the server's work."""

    def __init__(self, url: str, **options: Any):
        """Make a client with the options of `RemoteClient`."""
        super().__init__(url, **options)
        self._name = secrets.token_hex(8)

    @property
    def headers(self) -> dict[str, str]:
        """Headers with a name that keeps this client's worlds apart from those of others on this machine."""
        return {**super().headers, arena_codec.CLIENT_HEADER: self._name}

    def check(self) -> None:
        """Reach the server, begin an episode there, and read what it declares.

        Raises:
            InputError: No server listens at the address, it is not a policy server, or not one for this robot.
        """
        self.reach()
        replies, errors = self._gather(self.reset_kind, {0: json.dumps({"seed": 0, "world": 0}).encode()}, _object)
        if errors:
            raise self.refusal(errors[0])
        declared = self._declared()
        if declared != ServedFacts():
            self.take(declared)
        self._seeded = replies[0].get("seeded") is True
        served = replies[0].get("policy")
        self._served = self.one_line(served) if isinstance(served, str) else ""

    def _declared(self) -> ServedFacts:
        """Facts in the reply to `GET /config`. The original's server does not know it, and its protocol fixes the rest.

        Raises:
            InputError: The record is damaged, or of a later version.
        """
        connection = self._connect()
        try:
            status, data = connection.get("/config", self.timeout)
            content = json.loads(data) if status == 200 else {}
        except (OSError, http.client.HTTPException, ValueError, RecursionError):
            content = {}
        finally:
            connection.close()
        try:
            return read_facts(content if isinstance(content, dict) else {}, f"{self.url}/config")
        except WireError as error:
            raise InputError(f"--policy {self.name}: {self.masked(str(error))}") from None

    def _connect(self) -> _Connection:
        server = (self.address.host, self.address.port)
        return _Connection(self.url, server, self.address.path, self.context, self.headers)

    def _beginning(self, world: int, task: str) -> bytes | None:
        return arena_codec.pack_begin(self._begin(world, task))

    def _request(self, seen: Observation, state: np.ndarray, images: Images, world: int) -> bytes:
        return arena_codec.pack_query(self._query(seen, state, images, world))

    def _rows(self, content: object) -> np.ndarray:
        return self.checked(arena_codec.chunk_of(_object(content), f"{self.url}/infer"))

    def _read(self, kind: str, reply: _Reply) -> Json:
        status, data = reply
        where, silent = f"{self.url}{kind}", status in _RETRY_STATUS
        try:
            content = json.loads(data)
        except (ValueError, RecursionError) as error:
            if status != 200:
                raise RemoteError(f"{where}: status {status}", silent=silent) from error
            raise RemoteError(f"{where}: the reply is not JSON") from error
        if status != 200 or (isinstance(content, dict) and "error" in content):
            message = content.get("error") if isinstance(content, dict) else None
            text = self.one_line(message) if isinstance(message, str) else ""
            known = ", ".join(filter(None, [f"status {status}" if status != 200 or not text else "", text]))
            raise RemoteError(f"{where}: {known}", silent=silent, lost=episode_lost(text))
        if not isinstance(content, dict):
            raise RemoteError(f"{where}: the reply is not a JSON object")
        return content


def _object(content: object) -> Json:
    """A JSON object that `_read` has checked."""
    return cast(Json, content)


def from_spec(argument: str | None, **options: Any) -> RemoteClient[Any, Any]:
    """Make the policy for `--policy remote:<url>` with keywords of `RemoteClient`.

    Raises:
        InputError: No address was given, it is not valid, or the libraries of its protocol are not installed.
    """
    if not argument:
        raise InputError("--policy remote: needs an address, as in remote:http://localhost:8443")
    spoken = read_address(argument).protocol
    if spoken == "arena":
        return RemotePolicy(argument, **options)
    module, extra, libraries = _OTHERS[spoken]
    if libraries:
        require(extra, f"--policy remote:{argument}", libraries)
    client = importlib.import_module(f"arena_newton.policies.remote.{module}")
    made: RemoteClient[Any, Any] = client.make(argument, **options)
    return made
