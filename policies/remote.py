"""The policy that runs elsewhere: a client of the original benchmark's HTTP protocol (docs/policies.md).

A server of that protocol knows one robot only, so there is one request per world. A world whose request fails ends as
`error`; the others go on. A server that is gone, or that gives no usable answer to any world, stops the run.
"""

from __future__ import annotations

import base64
import functools
import http.client
import json
import math
import os
import re
import select
import socket
import ssl
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import torch

from arena_newton.canonical import ACTION_WIDTH, STATE_WIDTH
from arena_newton.data.label_protocols import LABELS, protocol
from arena_newton.errors import ArenaError, InputError
from arena_newton.pictures.camera import CameraConfig
from arena_newton.policies.base import Chunk, Json, Mask, Observation, Policy, PolicyUnavailable, world_mask

__all__ = ["MAX_FAILURES", "ROBOT_TYPE", "TOKEN_VARIABLE", "RemotePolicy", "from_spec"]

ROBOT_TYPE = LABELS["v3.1"].robot_type
"""Robot type that the original's server checks: actions of v3.1; those of other protocols have their own."""
TOKEN_VARIABLE = "ARENA_POLICY_TOKEN"
"""Environment variable with the token that is sent as `Authorization: Bearer`; it is neither printed nor stored."""
MAX_REPLY = 4 * 2**20
"""Longest reply that is read [bytes]."""
MAX_CHUNK = 4096
"""Longest chunk that is accepted [actions]."""
MAX_CONNECTIONS = 32
MAX_FAILURES = 10
"""Requests in a row, over all worlds, without a usable answer to any, after which the run stops."""
_RETRY_STATUS = (502, 503, 504)
_TRANSIENT = (ConnectionError, http.client.RemoteDisconnected, http.client.BadStatusLine, socket.gaierror)
_ESCAPES = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)?|.)?", re.DOTALL)
"""What a terminal interprets as a command (ECMA-48: CSI and OSC sequences, and ESC with one more)."""


class _RemoteError(ArenaError):
    """One request got no usable reply; the message names the address and what is wrong."""

    def __init__(self, message: str, *, silent: bool = False):
        """Say what is wrong; `silent`: there was no whole HTTP reply, or it was a gateway's."""
        super().__init__(message)
        self.silent = silent


class _Connection:
    """One kept-alive connection; `abort` may be called from another thread."""

    def __init__(self, url: str, context: ssl.SSLContext | None, headers: dict[str, str]):
        parts = urlsplit(url)
        self._url, self._path, self._headers = url, parts.path.rstrip("/"), headers
        kind = http.client.HTTPConnection
        self._open = kind if context is None else functools.partial(http.client.HTTPSConnection, context=context)
        self._server = (parts.hostname or "", parts.port)
        self._http: http.client.HTTPConnection | None = None
        self._busy = self._aborted = False

    def post(self, route: str, body: bytes, *, timeout: float, retries: int, backoff: float) -> tuple[int, bytes]:
        """Send JSON, return status and content of the reply.

        Raises:
            _RemoteError: No whole reply within `timeout` seconds and `retries` repeated attempts.
        """
        self._aborted, self._busy = False, True
        try:
            return self._attempts(route, body, timeout, retries, backoff)
        finally:
            self._busy = False

    def _attempts(self, route: str, body: bytes, timeout: float, retries: int, backoff: float) -> tuple[int, bytes]:
        end = time.monotonic() + timeout
        for attempt in range(retries + 1):
            try:
                status, data = self._exchange("POST", route, body, end)
                if status not in _RETRY_STATUS or attempt == retries:
                    return status, data
                reason = f"it answers with status {status}"
            except TimeoutError as error:
                self.close()
                raise _RemoteError(f"{self._url}{route}: no reply within {timeout:g} s", silent=True) from error
            except _TRANSIENT as error:
                self.close()
                reason = _cause(error)
            except (OSError, http.client.HTTPException, ValueError) as error:
                self.close()
                if self._aborted:
                    raise _RemoteError(f"{self._url}{route}: no reply within {timeout:g} s", silent=True) from error
                raise _RemoteError(f"{self._url}{route}: {_cause(error)}", silent=True) from error
            pause = backoff * 2**attempt
            if self._aborted or time.monotonic() + pause >= end:
                message = f"{self._url}{route}: no reply within {timeout:g} s, last: {reason}"
                raise _RemoteError(message, silent=True)
            if attempt < retries:
                time.sleep(pause)
        raise _RemoteError(f"{self._url}{route}: {reason} (tried {retries + 1} times)", silent=True)

    def alive(self, timeout: float) -> bool:
        """Whether the server answers a request that changes nothing; any answer counts but a gateway's."""
        try:
            status, _ = self._exchange("GET", "/health", None, time.monotonic() + timeout)
        except (OSError, http.client.HTTPException, ValueError):
            return False
        finally:
            self.close()
        return status not in _RETRY_STATUS

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
        """Whether the server has closed the kept connection, or sent data without a request."""
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
        self._aborted = True
        if not self._busy:
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


class RemotePolicy(Policy):
    """Asks a policy server, one request per world."""

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
        labels: str = "v3.1",
    ):
        """Take the server's address; nothing is sent yet.

        Args:
            url: `http://host:port` or `https://host:port`, with or without a path in front of `/reset` and `/infer`.
            timeout: Deadline of one request with all its attempts [s].
            retries: Repeated attempts after a connection error or status 502, 503, 504.
            backoff: Pause before the first repeated attempt [s]; it doubles each time.
            sequential: Ask for one world after another, in their order, for servers whose noise depends on the order.
            verify_ssl: Check the certificate of an https server.
            labels: Protocol of the server's actions; those of v4 must be decoded (`policies.label_reader`).

        Raises:
            InputError: Not a valid address, one with a user name or password, or a token that no HTTP header can carry.
        """
        host, port, secure = _address(url)
        if not (math.isfinite(timeout) and 0.0 < timeout <= 86400.0):
            raise InputError(f"--remote-timeout {timeout:g}: expected seconds above 0 and up to a day")
        if retries < 0:
            raise InputError(f"--remote-retries {retries}: expected at least 0")
        self.protocol = protocol(labels)
        self.url = url.rstrip("/")
        self.timeout, self.retries, self.backoff, self.sequential = timeout, retries, backoff, sequential
        self._address = (host, port)
        self._context = None
        if secure:
            self._context = ssl.create_default_context() if verify_ssl else ssl._create_unverified_context()
        self._token = _token()
        self._headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        self._connections: dict[int, _Connection] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._lock, self._reading = threading.Lock(), threading.Lock()
        self._seeded = False
        self._served = ""
        self._failures = 0
        # World → seed of its episode, number of actions received, actions not handed over yet.
        self._seeds: dict[int, int] = {}
        self._steps: dict[int, int] = {}
        self._queues: dict[int, np.ndarray] = {}
        self._failed_resets: dict[int, str] = {}

    @property
    def depends_on_worlds(self) -> bool:  # type: ignore[override]
        """Whether an episode may depend on the others that run: the server did not declare that it honours seeds."""
        return not self._seeded

    def check(self) -> None:
        """Reach the server, begin an episode there, and read whether it honours seeds.

        Raises:
            InputError: No server listens at the address, or it is not a policy server.
        """
        reason = ""
        for attempt in range(self.retries + 1):
            try:
                socket.create_connection(self._address, timeout=min(self.timeout, 5.0)).close()
                break
            except (OSError, ValueError) as error:
                reason = _cause(error)
                if attempt < self.retries:
                    time.sleep(self.backoff * 2**attempt)
        else:
            raise InputError(f"--policy remote:{self.url}: no server answers there ({reason})")
        replies, errors = self._gather("/reset", {0: json.dumps({"seed": 0, "world": 0}).encode()}, dict)
        if errors:
            message = str(errors[0])
            if "CERTIFICATE_VERIFY_FAILED" in message:
                message += "; --remote-insecure does without the check"
            elif re.search(r"status 40[13]", message):
                message += f"; a token is taken from the environment variable {TOKEN_VARIABLE}"
            raise InputError(f"--policy remote: no policy server: {message}")
        self._seeded = replies[0].get("seeded") is True
        served = replies[0].get("policy")
        self._served = self._one_line(served) if isinstance(served, str) else ""

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Send the seed of each beginning episode; a world whose reset fails gets that error at its next `act`.

        Raises:
            PolicyUnavailable: The server is gone.
        """
        bodies = {}
        for world in (int(w) for w in np.flatnonzero(world_mask(mask, len(seeds)))):
            self._seeds[world], self._steps[world] = int(seeds[world]), 0
            self._queues.pop(world, None)
            self._failed_resets.pop(world, None)
            bodies[world] = json.dumps({"seed": int(seeds[world]), "world": world, "task": tasks[world]}).encode()
        # Always one after the other: with a server of one random generator the last seed wins.
        _, errors = self._ask("/reset", bodies, dict, sequential=True)
        self._failed_resets.update(errors)

    def act(self, observation: Observation) -> Chunk:
        """Actions of the worlds that ask; worlds without a usable reply are named in `errors`.

        Only worlds whose last chunk is used up are asked for. Where chunks differ in length, all worlds get as many
        actions as the shortest has left, and the rest at their next `act`.

        Raises:
            PolicyUnavailable: The server is gone, or `MAX_FAILURES` requests in a row had no usable answer.
        """
        state = _host(observation.state)
        asking = [int(w) for w in np.flatnonzero(world_mask(observation.mask, len(state)))]
        errors = {w: self._failed_resets.pop(w) for w in asking if w in self._failed_resets}
        image = None if observation.image is None else _host(observation.image)
        empty = [w for w in asking if w not in errors and not len(self._queues.get(w, ()))]
        bodies = {w: self._body(observation, state, image, w) for w in empty}
        chunks, failed = self._ask("/infer", bodies, self._actions, sequential=self.sequential)
        errors.update(failed)
        for world, chunk in chunks.items():
            self._queues[world] = chunk
            self._steps[world] = self._steps.get(world, 0) + len(chunk)
        answered = [w for w in asking if w not in errors]
        length = min((len(self._queues[w]) for w in answered), default=1)
        actions = np.zeros((len(state), length, ACTION_WIDTH), dtype=np.float32)
        actions[..., [3, 6]] = 1.0  # filler rows are valid rotations
        for world in answered:
            actions[world] = self._queues[world][:length]
            self._queues[world] = self._queues[world][length:]
        return Chunk(actions, errors)

    def describe(self) -> Json:
        """Address, order of the requests, and what the server says of itself; complete after `check`."""
        return {
            "name": self.name,
            "url": self.url,
            "server": self._served,
            "sequential": self.sequential,
            "seeding": "per_request" if self._seeded else "undeclared",
            "worlds_matter": self.depends_on_worlds,
        }

    def close(self) -> None:
        """Close all connections; requests that are under way are broken off."""
        for connection in self._connections.values():
            connection.abort()
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None
        self._connections.clear()

    def _body(self, observation: Observation, state: np.ndarray, image: np.ndarray | None, world: int) -> bytes:
        seen: Json = {"state": [float(v) for v in state[world, :STATE_WIDTH]]}
        if image is not None:
            picture = np.ascontiguousarray(image[world], dtype=np.uint8)
            data = base64.b64encode(picture.tobytes()).decode("ascii")
            seen["images"] = {"front": {"shape": list(picture.shape), "dtype": "uint8", "data_b64": data}}
        body = {
            "observation": seen,
            "robot_type": self.protocol.robot_type,
            "return_chunk": True,
            "task": observation.gym_id,
            # Not sent by the original's client, and not read by its server.
            "instruction": observation.instruction,
            "world": world,
            "step": self._steps.get(world, 0),
        }
        if world in self._seeds:
            body["seed"] = self._seeds[world]
        return json.dumps(body).encode()

    def _actions(self, reply: Json) -> np.ndarray:
        where = f"{self.url}/infer"
        rows = reply.get("action_chunk")
        if rows is None and "action" in reply:
            rows = [reply["action"]]
        if not isinstance(rows, list) or not rows or not all(isinstance(r, list) for r in rows):
            raise _RemoteError(f"{where}: the reply holds neither action_chunk nor action as lists of numbers")
        if len(rows) > MAX_CHUNK:
            raise _RemoteError(f"{where}: a chunk of {len(rows)} actions, expected at most {MAX_CHUNK}")
        for row in rows:
            if len(row) != ACTION_WIDTH:
                raise _RemoteError(f"{where}: an action of {len(row)} numbers, expected {ACTION_WIDTH}")
            if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in row):
                raise _RemoteError(f"{where}: an action holds something that is not a number")
        try:
            return self.protocol.validate(rows, where)
        except InputError as error:
            raise _RemoteError(str(error)) from error
        except OverflowError as error:
            raise _RemoteError(f"{where}: an action holds a number that is too large") from error

    def _ask[T](
        self, route: str, bodies: dict[int, bytes], read: Callable[[Json], T], *, sequential: bool
    ) -> tuple[dict[int, T], dict[int, str]]:
        """Send one request per world; the replies as `read` gives them, and errors, by world.

        Raises:
            PolicyUnavailable: The server is gone.
        """
        replies: dict[int, T] = {}
        errors: dict[int, str] = {}
        for batch in [{w: body} for w, body in bodies.items()] if sequential else [bodies]:
            got, failed = self._gather(route, batch, read)
            self._judge(route, len(got), failed)
            replies.update(got)
            errors.update({w: str(error) for w, error in failed.items()})
        return replies, errors

    def _judge(self, route: str, usable: int, failed: dict[int, _RemoteError]) -> None:
        """Stop the run where failures are the server's and not one world's."""
        if usable and route == "/infer":
            self._failures = 0
        if not failed:
            return
        last = list(failed.values())[-1]
        if any(error.silent for error in failed.values()) and not self._alive():
            raise PolicyUnavailable(f"--policy remote: the server is gone: {last}")
        if not usable:
            self._failures += len(failed)
        if self._failures >= MAX_FAILURES:
            raise PolicyUnavailable(
                f"--policy remote: {self._failures} requests in a row brought no usable answer, last: {last}"
            )

    def _alive(self) -> bool:
        """Whether the server answers at all, asked over a new connection."""
        connection = _Connection(self.url, self._context, self._headers)
        answer = self._threads().submit(connection.alive, self.timeout)
        try:
            return answer.result(self.timeout + 0.05)
        except TimeoutError:
            connection.abort()
            return False

    def _threads(self) -> ThreadPoolExecutor:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(MAX_CONNECTIONS, thread_name_prefix="remote-policy")
        return self._pool

    def _gather[T](
        self, route: str, bodies: dict[int, bytes], read: Callable[[Json], T]
    ) -> tuple[dict[int, T], dict[int, _RemoteError]]:
        """Send requests at the same time; none outlives its deadline."""
        replies: dict[int, T] = {}
        errors: dict[int, _RemoteError] = {}
        started: dict[int, float] = {}
        pending: dict[Future, int] = {}
        for world, body in bodies.items():
            connection = self._connections.get(world)
            if connection is None:
                connection = self._connections[world] = _Connection(self.url, self._context, self._headers)
            pending[self._threads().submit(self._send, world, connection, route, body, read, started)] = world
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
                    errors[world] = error
            now = time.monotonic()
            for future, world in list(pending.items()):
                with self._lock:
                    late = world in started and now > started[world] + self.timeout
                if late:
                    self._connections.pop(world).abort()
                    errors[world] = _RemoteError(f"{self.url}{route}: no reply within {self.timeout:g} s", silent=True)
                    del pending[future]
        return dict(sorted(replies.items())), dict(sorted(errors.items()))

    def _send[T](
        self,
        world: int,
        connection: _Connection,
        route: str,
        body: bytes,
        read: Callable[[Json], T],
        started: dict[int, float],
    ) -> T:
        with self._lock:
            started[world] = time.monotonic()
        status, data = connection.post(route, body, timeout=self.timeout, retries=self.retries, backoff=self.backoff)
        with self._reading:  # one reply at a time: as Python objects it is many times as large
            return read(self._decode(route, status, data))

    def _decode(self, route: str, status: int, data: bytes) -> Json:
        where, silent = f"{self.url}{route}", status in _RETRY_STATUS
        try:
            content = json.loads(data)
        except (ValueError, RecursionError) as error:
            if status != 200:
                raise _RemoteError(f"{where}: status {status}", silent=silent) from error
            raise _RemoteError(f"{where}: the reply is not JSON") from error
        if status != 200 or (isinstance(content, dict) and "error" in content):
            message = content.get("error") if isinstance(content, dict) else None
            said = f", {self._one_line(message)}" if isinstance(message, str) and message else ""
            raise _RemoteError(f"{where}: status {status}{said}", silent=silent)
        if not isinstance(content, dict):
            raise _RemoteError(f"{where}: the reply is not a JSON object")
        return content

    def _one_line(self, said: str) -> str:
        """What a server said, without the token."""
        return _one_line(said.replace(self._token, "***") if self._token else said)


def _address(url: str) -> tuple[str, int, bool]:
    """Host, port and whether it is https; an address that may hold a secret is refused and not printed."""
    if "@" in url:
        raise InputError(
            "--policy remote: the address holds a user name or a password (an @), which results would publish; "
            f"give a token in the environment variable {TOKEN_VARIABLE} instead"
        )
    shown = _one_line(re.split(r"[?#]", url)[0])
    if any(c <= " " or c == "\x7f" for c in url):
        raise InputError(f"--policy remote:{shown}: the address holds white space or control characters")
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise InputError(f"--policy remote:{shown}: not an address ({_one_line(error)})") from None
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.query or parts.fragment:
        raise InputError(f"--policy remote:{shown}: expected http://host:port or https://host:port and nothing more")
    return parts.hostname, port or (443 if parts.scheme == "https" else 80), parts.scheme == "https"


def _token() -> str:
    """The token of the environment, or an empty text; one that no HTTP header can carry is refused and not printed."""
    token = os.environ.get(TOKEN_VARIABLE, "")
    if not re.fullmatch(r"[!-~]*", token):
        raise InputError(f"{TOKEN_VARIABLE}: holds a space, a line end or another character that no token has")
    return token


def _host(values: torch.Tensor | np.ndarray) -> np.ndarray:
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)


def _one_line(text: object) -> str:
    """Printable characters of a text that came from elsewhere, at most 200, on one line."""
    plain = _ESCAPES.sub("", str(text)[:4000])
    return " ".join("".join(c if c.isprintable() else " " for c in plain).split())[:200]


def _cause(error: BaseException) -> str:
    return _one_line(getattr(error, "strerror", None) or str(error) or type(error).__name__)


def from_spec(argument: str | None, **options: Any) -> RemotePolicy:
    """Make the policy for `--policy remote:<url>` with keywords of `RemotePolicy`.

    Raises:
        InputError: No address was given, or it is not valid.
    """
    if not argument:
        raise InputError("--policy remote: needs an address, as in remote:http://localhost:8443")
    return RemotePolicy(argument, **options)
