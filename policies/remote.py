"""The policy that runs elsewhere: a client of the original benchmark's HTTP protocol.

`POST /reset {"seed": int}` begins an episode, `POST /infer` sends image and state and returns a chunk of actions. A
server of that protocol knows one robot only, so every world that asks is one request. A world whose request fails ends
as `error`; the others go on.
"""

from __future__ import annotations

import base64
import http.client
import json
import socket
import ssl
import threading
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from arena_newton.camera import CameraConfig
from arena_newton.canonical import ACTION_WIDTH, STATE_WIDTH, validate_action
from arena_newton.errors import ArenaError, InputError
from arena_newton.policies.base import Chunk, Observation, Policy, PolicyError, world_mask

__all__ = ["ROBOT_TYPE", "RemotePolicy", "from_spec"]

ROBOT_TYPE = "unitree_g1_refpose_v3_1"
"""Robot type that the original's server checks: action schema v3.1."""
MAX_REPLY = 32 * 2**20
"""Longest reply that is read [bytes]."""
MAX_CONNECTIONS = 32
_RETRY_STATUS = (502, 503, 504)
_TRANSIENT = (ConnectionError, http.client.RemoteDisconnected, http.client.BadStatusLine, socket.gaierror)


class _RemoteError(ArenaError):
    """One request got no usable reply; the message names the address and what is wrong."""


class _Connection:
    """One kept-alive connection; `abort` may be called from another thread."""

    def __init__(self, url: str, context: ssl.SSLContext | None):
        parts = urlsplit(url)
        self._url, self._path = url, parts.path.rstrip("/")
        self._host, self._port, self._context = parts.hostname or "", parts.port, context
        self._http: http.client.HTTPConnection | None = None
        self._aborted = False

    def post(self, route: str, body: bytes, *, timeout: float, retries: int, backoff: float) -> dict[str, Any]:
        """Send JSON, return the JSON object of the reply.

        Raises:
            _RemoteError: No usable reply within `timeout` seconds and `retries` repeated attempts.
        """
        self._aborted = False
        end = time.monotonic() + timeout
        for attempt in range(retries + 1):
            try:
                status, data = self._exchange(route, body, end)
                if status not in _RETRY_STATUS or attempt == retries:
                    return self._decode(route, status, data)
                reason = f"it answers with status {status}"
            except TimeoutError as error:
                self.close()
                raise _RemoteError(f"{self._url}{route}: no reply within {timeout:g} s") from error
            except _TRANSIENT as error:
                self.close()
                reason = _cause(error)
            except (OSError, http.client.HTTPException, ValueError) as error:
                self.close()
                if self._aborted:
                    raise _RemoteError(f"{self._url}{route}: no reply within {timeout:g} s") from error
                raise _RemoteError(f"{self._url}{route}: {_cause(error)}") from error
            pause = backoff * 2**attempt
            if self._aborted or time.monotonic() + pause >= end:
                raise _RemoteError(f"{self._url}{route}: no reply within {timeout:g} s, last: {reason}")
            if attempt < retries:
                time.sleep(pause)
        raise _RemoteError(f"{self._url}{route}: {reason} (tried {retries + 1} times)")

    def _exchange(self, route: str, body: bytes, end: float) -> tuple[int, bytes]:
        if self._http is None:
            left = max(end - time.monotonic(), 0.001)
            if self._context is not None:
                self._http = http.client.HTTPSConnection(self._host, self._port, timeout=left, context=self._context)
            else:
                self._http = http.client.HTTPConnection(self._host, self._port, timeout=left)
            self._http.connect()
            self._http.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._limit(end)
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        self._http.request("POST", self._path + route, body, headers)
        reply = self._http.getresponse()
        data = bytearray()
        while True:
            self._limit(end)
            piece = reply.read1(1 << 20)
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

    def _limit(self, end: float) -> None:
        left = end - time.monotonic()
        if left <= 0:
            raise TimeoutError
        if self._http is not None and self._http.sock is not None:
            self._http.sock.settimeout(left)

    def _decode(self, route: str, status: int, data: bytes) -> dict[str, Any]:
        where = f"{self._url}{route}"
        try:
            content = json.loads(data)
        except (ValueError, RecursionError) as error:
            if status != 200:
                raise _RemoteError(f"{where}: status {status}") from error
            raise _RemoteError(f"{where}: the reply is no JSON") from error
        if status != 200 or (isinstance(content, dict) and "error" in content):
            message = content.get("error") if isinstance(content, dict) else None
            raise _RemoteError(f"{where}: status {status}" + (f", {_one_line(message)}" if message else ""))
        if not isinstance(content, dict):
            raise _RemoteError(f"{where}: the reply is no JSON object")
        return content

    def abort(self) -> None:
        """Break off the exchange that another thread waits for."""
        self._aborted = True
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


class RemotePolicy(Policy):
    """Asks a policy server, one request a world."""

    name = "remote"
    needs_image = True
    camera = CameraConfig(width=640, height=480, fit="native")
    """The original's client sends the head camera as it is, 640×480; resizing is the server's work."""

    def __init__(
        self,
        url: str,
        *,
        timeout: float = 60.0,
        retries: int = 4,
        backoff: float = 0.25,
        sequential: bool = False,
        verify_ssl: bool = True,
    ):
        """Take the server's address; nothing is sent yet.

        Args:
            url: `http://host:port` or `https://host:port`, with or without a path before `/reset` and `/infer`.
            timeout: Deadline of one request with all its attempts [s].
            retries: Repeated attempts after a connection error or status 502, 503, 504.
            backoff: Pause before the first repeated attempt [s]; it doubles each time.
            sequential: Ask for one world after the other, in their order, for servers whose noise depends on the order.
            verify_ssl: Check the certificate of an https server.

        Raises:
            InputError: The address is none.
        """
        try:
            parts = urlsplit(url)
            port = parts.port
        except ValueError as error:
            raise InputError(f"--policy remote:{url}: not an address ({error})") from error
        if parts.scheme not in ("http", "https") or not parts.hostname or parts.query or parts.fragment:
            raise InputError(f"--policy remote:{url}: expected http://host:port or https://host:port")
        self.url = url.rstrip("/")
        self.timeout, self.retries, self.backoff, self.sequential = timeout, retries, backoff, sequential
        self._address = (parts.hostname, port or (443 if parts.scheme == "https" else 80))
        self._context = None
        if parts.scheme == "https":
            self._context = ssl.create_default_context() if verify_ssl else ssl._create_unverified_context()
        self._connections: dict[int, _Connection] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._lock = threading.Lock()
        self._failed_resets: dict[int, str] = {}
        self._length: int | None = None

    def check(self) -> None:
        """Try to reach the server.

        Raises:
            InputError: Nobody listens at the address.
        """
        reason = ""
        for attempt in range(self.retries + 1):
            try:
                socket.create_connection(self._address, timeout=min(self.timeout, 5.0)).close()
                return
            except OSError as error:
                reason = _cause(error)
                if attempt < self.retries:
                    time.sleep(self.backoff * 2**attempt)
        raise InputError(f"--policy remote:{self.url}: no server answers there ({reason})")

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Any = None) -> None:
        """Send the seed of each beginning episode; a world whose reset fails gets that error at its next `act`."""
        worlds = np.flatnonzero(world_mask(mask, len(seeds)))
        for world in worlds:
            self._failed_resets.pop(int(world), None)
        bodies = {int(w): json.dumps({"seed": int(seeds[w])}).encode() for w in worlds}
        # Always one after the other: the server has one random generator, and the last seed wins.
        _, errors = self._ask("/reset", bodies, sequential=True)
        self._failed_resets.update(errors)

    def act(self, observation: Observation) -> Chunk:
        """Chunks of the worlds that ask; worlds without a usable reply are named in `errors`."""
        state = _host(observation.state)
        asking = np.flatnonzero(world_mask(observation.mask, len(state)))
        errors = {int(w): self._failed_resets.pop(int(w)) for w in asking if int(w) in self._failed_resets}
        image = None if observation.image is None else _host(observation.image)
        bodies = {int(w): self._body(observation, state, image, int(w)) for w in asking if int(w) not in errors}
        replies, failed = self._ask("/infer", bodies, sequential=self.sequential)
        errors.update(failed)
        chunks: dict[int, np.ndarray] = {}
        for world in sorted(replies):
            try:
                chunks[world] = self._actions(world, replies[world])
            except PolicyError as error:
                errors[world] = error.message
        length = self._length or 1
        actions = np.zeros((len(state), length, ACTION_WIDTH), dtype=np.float32)
        actions[..., [3, 6]] = 1.0  # filler rows are valid rotations
        for world, chunk in chunks.items():
            actions[world] = chunk
        return Chunk(actions, errors)

    def describe(self) -> dict[str, Any]:
        """Name and address."""
        return {"name": self.name, "url": self.url, "sequential": self.sequential}

    def close(self) -> None:
        """Close all connections."""
        for connection in self._connections.values():
            connection.close()
        self._connections.clear()
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None

    def _body(self, observation: Observation, state: np.ndarray, image: np.ndarray | None, world: int) -> bytes:
        seen: dict[str, Any] = {"state": [float(v) for v in state[world, :STATE_WIDTH]]}
        if image is not None:
            picture = np.ascontiguousarray(image[world], dtype=np.uint8)
            data = base64.b64encode(picture.tobytes()).decode("ascii")
            seen["images"] = {"front": {"shape": list(picture.shape), "dtype": "uint8", "data_b64": data}}
        return json.dumps(
            {"observation": seen, "robot_type": ROBOT_TYPE, "return_chunk": True, "task": observation.gym_id}
        ).encode()

    def _actions(self, world: int, reply: dict[str, Any]) -> np.ndarray:
        where = f"{self.url}/infer"
        rows = reply.get("action_chunk")
        if rows is None and "action" in reply:
            rows = [reply["action"]]
        if not isinstance(rows, list) or not rows or not all(isinstance(r, list) for r in rows):
            raise PolicyError(world, f"{where}: the reply holds neither action_chunk nor action as lists of numbers")
        for row in rows:
            if len(row) != ACTION_WIDTH:
                raise PolicyError(world, f"{where}: an action of {len(row)} numbers, expected {ACTION_WIDTH}")
            if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in row):
                raise PolicyError(world, f"{where}: an action holds something that is no number")
        try:
            chunk = validate_action(rows, where)
        except (InputError, OverflowError) as error:
            raise PolicyError(world, str(error)) from error
        if self._length is None:
            self._length = len(chunk)
        if len(chunk) != self._length:
            raise PolicyError(world, f"{where}: a chunk of {len(chunk)} actions, but the first had {self._length}")
        return chunk

    def _ask(
        self, route: str, bodies: dict[int, bytes], *, sequential: bool
    ) -> tuple[dict[int, dict[str, Any]], dict[int, str]]:
        """Send one request a world; replies and errors by world. No request outlives its deadline."""
        replies: dict[int, dict[str, Any]] = {}
        errors: dict[int, str] = {}
        if sequential:
            for world, body in bodies.items():
                self._gather({world: body}, route, replies, errors)
        else:
            self._gather(bodies, route, replies, errors)
        return replies, errors

    def _gather(self, bodies: dict[int, bytes], route: str, replies: dict, errors: dict) -> None:
        if not bodies:
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(MAX_CONNECTIONS, thread_name_prefix="remote-policy")
        started: dict[int, float] = {}
        pending: dict[Future, int] = {}
        for world, body in bodies.items():
            connection = self._connections.setdefault(world, _Connection(self.url, self._context))
            pending[self._pool.submit(self._send, world, connection, route, body, started)] = world
        while pending:
            with self._lock:
                ends = [started[w] + self.timeout for w in pending.values() if w in started]
            left = min(ends) - time.monotonic() if ends else self.timeout
            # The socket's own time limit comes first; this one also stops a server that drips bytes.
            done, _ = wait(pending, timeout=max(left + 0.05, 0.01), return_when=FIRST_COMPLETED)
            for future in done:
                world = pending.pop(future)
                try:
                    replies[world] = future.result()
                except _RemoteError as error:
                    errors[world] = str(error)
            now = time.monotonic()
            for future, world in list(pending.items()):
                with self._lock:
                    late = world in started and now > started[world] + self.timeout
                if late:
                    self._connections.pop(world).abort()
                    errors[world] = f"{self.url}{route}: no reply within {self.timeout:g} s"
                    del pending[future]

    def _send(self, world: int, connection: _Connection, route: str, body: bytes, started: dict) -> dict[str, Any]:
        with self._lock:
            started[world] = time.monotonic()
        return connection.post(route, body, timeout=self.timeout, retries=self.retries, backoff=self.backoff)


def _host(values: Any) -> np.ndarray:
    return values.detach().cpu().numpy() if hasattr(values, "detach") else np.asarray(values)


def _one_line(text: Any) -> str:
    return " ".join(str(text).split())[:200]


def _cause(error: BaseException) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return _one_line(text)


def from_spec(argument: str | None) -> RemotePolicy:
    """Make the policy for `--policy remote:<url>`.

    Raises:
        InputError: No address was given, or it is none.
    """
    if not argument:
        raise InputError("--policy remote: needs an address, as in remote:http://localhost:8443")
    return RemotePolicy(argument)
