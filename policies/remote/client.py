"""Base of the clients of a policy server: one link per world, deadlines, repeated attempts, and when a run stops.

A world whose request fails ends as `error`; the others go on. A server that is gone, that gives no usable answer to any
world, or that lost what it remembered of a running episode, stops the run: its unfinished episodes stay unplayed.
"""

from __future__ import annotations

import math
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import ClassVar, cast

import numpy as np
import torch

from arena_newton.data.readers.label_protocols import LABELS, protocol
from arena_newton.errors import InputError
from arena_newton.pictures.settings import CameraConfig, policy_cameras
from arena_newton.policies.base import Chunk, Json, Mask, Observation, Policy, PolicyUnavailable, world_mask
from arena_newton.policies.protocols.handshake import RATE, ServedFacts, compare_facts, expected_facts
from arena_newton.policies.protocols.policy_messages import LONGEST_CHUNK, Begin, Query
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.remote.address import (
    TOKEN_VARIABLE,
    ServerAddress,
    cause,
    one_line,
    read_address,
    read_token,
)
from arena_newton.policies.remote.link import RemoteError, ServerLink
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION, STATE, STATE_WIDTH

__all__ = [
    "MAX_FAILURES",
    "MAX_REPLY",
    "Images",
    "RemoteClient",
    "standing_state",
]

MAX_REPLY = 4 * 2**20
"""Longest reply for one world that is read [bytes]."""
MAX_CONNECTIONS = 32
"""Requests that are under way at once."""
MAX_FAILURES = 10
"""Requests in a row, over all worlds, without a usable answer to any, after which the run stops."""


type Images = Mapping[str, np.ndarray]
"""Pictures of all worlds, by camera: uint8, shape [worlds, H, W, 3]."""


class RemoteClient[Q, R](Policy):
    """Asks a policy server: requests of all worlds at the same time, each on its own link.

    A subclass makes links (`_connect`) and requests (`_beginning`, `_request`), and reads replies (`_read`, `_rows`).
    """

    name = "remote"
    needs_image = True
    reset_kind: ClassVar[str] = " (reset)"
    """Name of an episode's beginning in errors."""
    infer_kind: ClassVar[str] = " (infer)"
    """Name of a request for actions in errors."""
    described: ClassVar[str] = "a policy server"
    """Name of the expected server in errors."""

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
            url: Address, as `remote_address.read_address` takes it.
            timeout: Deadline of one request with all its attempts [s].
            retries: Repeated attempts after a connection error or a gateway's status (502, 503, 504).
            backoff: Pause before the first repeated attempt [s]; it doubles each time.
            sequential: Ask for one world after another, in their order, for servers whose noise depends on the order.
            verify_ssl: Check the certificate of a server whose connection is encrypted.
            labels: Protocol of the server's actions; those of v4 must be decoded (`policies.label_reader`).

        Raises:
            InputError: Not a valid address, one with a user name or password, or a token that no HTTP header can carry.
        """
        self.address = self._address(url)
        if not (math.isfinite(timeout) and 0.0 < timeout <= 86400.0):
            raise InputError(f"--remote-timeout {timeout:g}: expected seconds above 0 and up to a day")
        if retries < 0:
            raise InputError(f"--remote-retries {retries}: expected at least 0")
        self.protocol = protocol(labels)
        self.url = url.rstrip("/")
        self.timeout, self.retries, self.backoff, self.sequential = timeout, retries, backoff, sequential
        self.context: ssl.SSLContext | None = None
        if self.address.secure:
            self.context = ssl.create_default_context() if verify_ssl else ssl._create_unverified_context()
        self.token = read_token()
        self._connections: dict[int, ServerLink[Q, R]] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._lock, self._reading = threading.Lock(), threading.Lock()
        self.batched = False
        self.stateful = False
        self.declared = ServedFacts()
        self._seeded = False
        self._served = ""
        self._assumed: Json = {}
        self._failures = 0
        self._closing = False
        # World → seed of its episode, number of actions received, actions not handed over yet.
        self._seeds: dict[int, int] = {}
        self._steps: dict[int, int] = {}
        self._queues: dict[int, np.ndarray] = {}
        self._failed_resets: dict[int, str] = {}

    @property
    def headers(self) -> dict[str, str]:
        """Headers of every request, which authorise the client."""
        return {"Authorization": f"Bearer {self.token}"} if self.token else {}

    @property
    def depends_on_worlds(self) -> bool:  # type: ignore[override]
        """True if an episode may depend on the others that run: the server did not declare that it honours seeds."""
        return not self._seeded

    # What a protocol defines.

    def _address(self, url: str) -> ServerAddress:
        return read_address(url)

    def _connect(self) -> ServerLink[Q, R]:
        """A link that is not connected yet."""
        raise TypeError(f"{type(self).__name__} defines no _connect()")

    def _beginning(self, world: int, task: str) -> Q | None:
        """Request that begins an episode, where the protocol has one."""
        raise TypeError(f"{type(self).__name__} defines no _beginning()")

    def _request(self, seen: Observation, state: np.ndarray, images: Images, world: int) -> Q:
        """Request for a world's actions."""
        raise TypeError(f"{type(self).__name__} defines no _request()")

    def _read(self, kind: str, reply: R) -> object:
        """Content of a reply.

        Raises:
            RemoteError: It is none of the protocol, or says that the server failed.
        """
        raise TypeError(f"{type(self).__name__} defines no _read()")

    def _rows(self, content: object) -> np.ndarray:
        """Actions of a reply's content, shape [n, 40].

        Raises:
            RemoteError: It holds none.
        """
        raise TypeError(f"{type(self).__name__} defines no _rows()")

    def _batch(self, seen: Observation, state: np.ndarray, images: Images, worlds: Sequence[int]) -> Q:
        """Request for the actions of several worlds, along a leading axis."""
        raise TypeError(f"{type(self).__name__} defines no _batch()")

    def _batch_rows(self, content: object, worlds: int) -> np.ndarray:
        """Actions of the answer to `_batch`, shape [worlds, n, 40].

        Raises:
            RemoteError: It holds none.
        """
        raise TypeError(f"{type(self).__name__} defines no _batch_rows()")

    # What all have in common.

    def reach(self) -> None:
        """Wait until somebody listens at the address.

        Raises:
            InputError: Nobody does, after `retries` repeated attempts.
        """
        reason = ""
        for attempt in range(self.retries + 1):
            try:
                address = (self.address.host, self.address.port)
                socket.create_connection(address, timeout=min(self.timeout, 5.0)).close()
                return
            except (OSError, ValueError) as error:
                reason = cause(error)
                if attempt < self.retries:
                    time.sleep(self.backoff * 2**attempt)
        raise InputError(f"--policy {self.name}:{self.url}: no server answers there ({reason})")

    def refusal(self, error: RemoteError) -> InputError:
        """Error of `check` for an address where the first request failed."""
        message = str(error)
        if "CERTIFICATE_VERIFY_FAILED" in message:
            message += "; --remote-insecure does without the check"
        elif "status 401" in message or "status 403" in message:
            message += f"; a token is taken from the environment variable {TOKEN_VARIABLE}"
        return InputError(f"--policy {self.name}: no {self.described.removeprefix('a ')}: {message}")

    def take(self, facts: ServedFacts) -> None:
        """Compare what a server declares with what this robot takes, and follow it where either is possible.

        Raises:
            InputError: They differ; the message names both values.
        """
        where = f"--policy {self.name}:{self.url}"
        # `--labels v4` is a statement; v3.1 is also the default.
        asked = self.protocol.name if self.protocol is not LABELS["v3.1"] else None
        try:
            compare_facts(facts, expected_facts(asked or facts.labels or self.protocol.name), where)
        except InputError as error:
            raise InputError(self.masked(str(error))) from None
        self.declared = replace(facts, facts=cast(Json, self.without_token(facts.facts)))
        if facts.labels is not None:
            self.protocol, self.labels = LABELS[facts.labels], facts.labels
        if facts.needs_picture is not None:
            self.needs_image = facts.needs_picture
        if facts.picture is not None:
            self.camera = facts.picture.camera
        if facts.cameras is not None:
            self.cameras = {name: one.camera for name, one in facts.cameras.items()}
        self.chunk_size = facts.chunk_length or self.chunk_size
        self.realign = facts.realign or 0.0
        self.batched, self._seeded = facts.batched, facts.seeded
        self._served = self.one_line(facts.policy)

    def assume(self) -> None:
        """Say once, on stderr, what the server does not declare, and keep for `describe` what is taken instead."""
        missing = self.declared.undeclared()
        if not missing:
            return
        camera = self.camera or CameraConfig()
        taken: Json = {
            "label protocol": self.protocol.name,
            "action names": f"the {ACTION_WIDTH} of {self.protocol.name}",
            "state names": f"the canonical {STATE_WIDTH}",
            "chunk length": "as it comes",
            "rate": f"{RATE:g} Hz",
            "picture": f"{camera.width}x{camera.height} {camera.fit}",
        }
        self._assumed = {name: taken[name] for name in missing}
        text = ", ".join(f"{name} ({value})" for name, value in self._assumed.items())
        print(
            f"--policy remote:{self.url}: the server does not declare its {text}: what stands in brackets is assumed",
            file=sys.stderr,
            flush=True,
        )

    def probe(self) -> None:
        """Ask for one chunk, for a robot that stands before a grey picture, where the server declares no actions.

        Raises:
            InputError: The answer is none for this robot.
        """
        images = {
            name: np.full((1, camera.height, camera.width, 3), 127, dtype=np.uint8)
            for name, camera in policy_cameras(self).items()
        }
        seen = Observation(
            torch.from_numpy(standing_state()[None]), None, np.ones(1, dtype=bool), "", "", "Stand still."
        )
        self._seeds[0], self._steps[0] = 0, 0
        errors: dict[int, RemoteError] = {}
        begin = self._beginning(0, "")
        if begin is not None:
            _, errors = self._gather(self.reset_kind, {0: begin}, lambda content: content)
        if not errors:
            if self.batched:
                request = self._batch(seen, host(seen.state), images, [0])
            else:
                request = self._request(seen, host(seen.state), images, 0)
            _, errors = self._gather(self.infer_kind, {0: request}, self._probed)
        self._seeds.clear()
        self._steps.clear()
        if errors:
            raise InputError(f"--policy {self.name}: the server's answer to a robot that stands: {errors[0]}")

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Send the seed of each beginning episode; a world whose reset fails gets that error at its next `act`.

        Raises:
            PolicyUnavailable: The server is gone.
        """
        requests: dict[int, Q] = {}
        for world in (int(w) for w in np.flatnonzero(world_mask(mask, len(seeds)))):
            self._seeds[world], self._steps[world] = int(seeds[world]), 0
            self._queues.pop(world, None)
            self._failed_resets.pop(world, None)
            request = self._beginning(world, tasks[world])
            if request is not None:
                requests[world] = request
        # Always one after the other: with a server of one random generator the last seed wins.
        _, errors = self._ask(self.reset_kind, requests, lambda content: content, sequential=True)
        self._failed_resets.update(errors)

    def act(self, observation: Observation) -> Chunk:
        """Actions of the worlds that ask; worlds without a usable reply are named in `errors`.

        Only worlds whose last chunk is used up are asked for. Where chunks differ in length, all worlds get as many
        actions as the shortest has left, and the rest at their next `act`.

        Raises:
            PolicyUnavailable: The server is gone, or `MAX_FAILURES` requests in a row had no usable answer.
        """
        state = host(observation.state)
        asking = [int(w) for w in np.flatnonzero(world_mask(observation.mask, len(state)))]
        errors = {w: self._failed_resets.pop(w) for w in asking if w in self._failed_resets}
        images = {name: host(image) for name, image in observation.images.items()}
        empty = [w for w in asking if w not in errors and not len(self._queues.get(w, ()))]
        chunks, failed = self._infer(observation, state, images, empty)
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

    def _probed(self, content: object) -> object:
        """Check the answer to `probe`."""
        if not self.batched:
            return self._actions(content)
        chunk = self._batch_rows(content, 1)
        return self.checked(chunk[0])

    def _infer(
        self, seen: Observation, state: np.ndarray, images: Images, worlds: Sequence[int]
    ) -> tuple[dict[int, np.ndarray], dict[int, str]]:
        """Chunks and errors of the worlds that need a new one."""
        # A server may refuse a batch for one row of it, and JSON has no such numbers.
        broken = [world for world in worlds if not np.isfinite(state[world]).all()]
        errors = dict.fromkeys(broken, "the state holds a number that is not finite")
        worlds = [world for world in worlds if world not in errors]
        if not worlds:
            return {}, errors
        if not self.batched:
            requests = {world: self._request(seen, state, images, world) for world in worlds}
            got, failed = self._ask(self.infer_kind, requests, self._actions, sequential=self.sequential)
            return got, errors | failed
        request = self._batch(seen, state, images, worlds)
        got, failed = self._ask(
            self.infer_kind,
            {0: request},
            lambda content: self._batch_rows(content, len(worlds)),
            sequential=True,
            weight=len(worlds),
        )
        if failed:
            return {}, errors | dict.fromkeys(worlds, failed[0])
        chunks = {}
        for world, rows in zip(worlds, got[0], strict=True):
            try:
                chunks[world] = self.checked(rows)
            except RemoteError as error:
                errors[world] = str(error)
        return chunks, errors

    def _begin(self, world: int, task: str = "") -> Begin:
        return Begin(session=str(world), seed=self._seeds.get(world), task=task)

    def _query(self, seen: Observation, state: np.ndarray, images: Images, world: int) -> Query:
        return Query(
            state=np.ascontiguousarray(state[world, :STATE_WIDTH], dtype=np.float32),
            images={name: np.ascontiguousarray(image[world], dtype=np.uint8) for name, image in images.items()},
            task=seen.gym_id,
            instruction=seen.instruction,
            session=str(world),
            seed=self._seeds.get(world),
            step=self._steps.get(world, 0),
            robot_type=self.protocol.robot_type,
        )

    def describe(self) -> Json:
        """Address, order of the requests, and what the server says of itself; complete after `check`."""
        facts: Json = {
            "name": self.name,
            "url": self.url,
            "server": self._served,
            "sequential": self.sequential,
            "seeding": "per_request" if self._seeded else "undeclared",
            "worlds_matter": self.depends_on_worlds,
        }
        declared = self.declared.to_json() if self.declared != ServedFacts() else {}
        shown = ("labels", "realign", "chunk_length", "rate_hz", "picture", "cameras", "batched", "facts")
        more = {"declared": {name: declared[name] for name in shown if name in declared}, "assumed": self._assumed}
        return facts | {name: value for name, value in more.items() if value}

    def close(self) -> None:
        """Close all connections; requests that are under way are broken off."""
        self._closing = True
        for connection in self._connections.values():
            connection.abort()
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None
        self._connections.clear()

    def _actions(self, content: object) -> np.ndarray:
        """Checked actions of a reply's content, float32, shape [n, 40]."""
        return self.checked(self._rows(content))

    def checked(self, rows: object) -> np.ndarray:
        """A chunk of the server's label protocol, float32, shape [n, 40].

        Raises:
            RemoteError: It is none, or is too long.
        """
        where = self.url + self.infer_kind
        try:
            actions = self.protocol.validate(rows, where)
        except InputError as error:
            raise RemoteError(str(error)) from error
        except OverflowError as error:
            raise RemoteError(f"{where}: an action holds a number that is too large") from error
        if actions.ndim != 2 or not len(actions):
            raise RemoteError(f"{where}: actions of shape {list(actions.shape)}, expected [n, {ACTION_WIDTH}]")
        if len(actions) > LONGEST_CHUNK:
            raise RemoteError(f"{where}: a chunk of {len(actions)} actions, expected at most {LONGEST_CHUNK}")
        return actions

    def _ask[T](
        self, kind: str, requests: dict[int, Q], read: Callable[[object], T], *, sequential: bool, weight: int = 1
    ) -> tuple[dict[int, T], dict[int, str]]:
        """Send one request per world; the replies as `read` gives them, and errors, by world.

        Args:
            kind: What is asked.
            requests: By world.
            read: Reads the content of a reply.
            sequential: One after another.
            weight: Worlds that a request speaks for.

        Raises:
            PolicyUnavailable: The server is gone.
        """
        replies: dict[int, T] = {}
        errors: dict[int, str] = {}
        self._closing = False
        for batch in [{w: request} for w, request in requests.items()] if sequential else [requests]:
            got, failed = self._gather(kind, batch, read)
            self._judge(kind, len(got), failed, weight)
            replies.update(got)
            errors.update({w: str(error) for w, error in failed.items()})
        return replies, errors

    def _judge(self, kind: str, usable: int, failed: dict[int, RemoteError], weight: int) -> None:
        """Stop the run where failures are the server's and not one world's."""
        if usable and kind == self.infer_kind:
            self._failures = 0
        if not failed:
            return
        last = list(failed.values())[-1]
        if any(error.silent for error in failed.values()) and not self._alive():
            raise PolicyUnavailable(f"--policy {self.name}: the {self.described.split()[2]} is gone: {last}")
        for error in failed.values():
            if error.lost:
                raise PolicyUnavailable(f"--policy {self.name}: {error}; the episodes that were running stay unplayed")
        if not usable:
            self._failures += len(failed) * weight
        if self._failures >= MAX_FAILURES:
            raise PolicyUnavailable(
                f"--policy {self.name}: {self._failures} requests in a row brought no usable answer, last: {last}"
            )

    def _alive(self) -> bool:
        """True if the server answers at all, asked over a new connection."""
        if self._closing:  # nobody waits for the answer any more
            return True
        connection = self._connect()
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
        self, kind: str, requests: dict[int, Q], read: Callable[[object], T]
    ) -> tuple[dict[int, T], dict[int, RemoteError]]:
        """Send requests at the same time; none outlives its deadline."""
        replies: dict[int, T] = {}
        errors: dict[int, RemoteError] = {}
        started: dict[int, float] = {}
        pending: dict[Future[T], int] = {}
        for world, request in requests.items():
            connection = self._connections.get(world)
            if connection is None:
                connection = self._connections[world] = self._connect()
            pending[self._threads().submit(self._send, world, connection, kind, request, read, started)] = world
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
                except RemoteError as error:
                    errors[world] = error
            now = time.monotonic()
            for future, world in list(pending.items()):
                with self._lock:
                    late = world in started and now > started[world] + self.timeout
                if late:
                    self._connections.pop(world).abort()
                    errors[world] = RemoteError(f"{self.url}{kind}: no reply within {self.timeout:g} s", silent=True)
                    del pending[future]
        return dict(sorted(replies.items())), dict(sorted(errors.items()))

    def _send[T](
        self,
        world: int,
        connection: ServerLink[Q, R],
        kind: str,
        request: Q,
        read: Callable[[object], T],
        started: dict[int, float],
    ) -> T:
        with self._lock:
            started[world] = time.monotonic()
        try:
            reply = connection.ask(kind, request, timeout=self.timeout, retries=self.retries, backoff=self.backoff)
            with self._reading:  # one reply at a time: as Python objects it is many times as large
                return read(self._read(kind, reply))
        except WireError as error:  # from a codec; it names the address
            text = self.masked(str(error))
            raise RemoteError(text if text.startswith(self.url) else f"{self.url}{kind}: {text}") from error

    def one_line(self, text: object) -> str:
        """Message of a server, on one line and without the token."""
        return one_line(self.masked(str(text)))

    def without_token(self, value: object) -> object:
        """JSON of a server without the token, which one that repeats what it is sent would put into the results."""
        match value:
            case str():
                return self.masked(value)
            case Mapping():
                return {self.masked(str(key)): self.without_token(one) for key, one in value.items()}
            case list():
                return [self.without_token(one) for one in value]
        return value

    def masked(self, text: str) -> str:
        """A text without the token."""
        return text.replace(self.token, "***") if self.token else text


def standing_state() -> np.ndarray:
    """State of the robot that stands still, float32, shape [64]."""
    state = np.zeros(STATE_WIDTH, dtype=np.float32)
    state[STATE["root_rot6d"]] = STAND_ACTION[3:9]
    state[STATE["joint_pos"]] = STAND_ACTION[9:38]
    return state


def host(values: torch.Tensor | np.ndarray) -> np.ndarray:
    """An array in the machine's own memory."""
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)
