"""The policy that runs behind GR00T's ZMQ server: `gr00t://host:5555` (github.com/NVIDIA/Isaac-GR00T).

A request holds all worlds that ask, along a leading axis. Which names its pictures, states, actions and sentences have
is what the server's `get_modality_config` says; what has no counterpart in this robot is refused before the first
episode.
"""

from __future__ import annotations

import ast
import io
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import zmq
from zmq.utils.monitor import recv_monitor_message

from arena_newton.data.readers.label_protocols import V4
from arena_newton.data.recording.layouts import LAYOUTS
from arena_newton.errors import InputError
from arena_newton.pictures.settings import FRONT, CameraConfig, policy_cameras
from arena_newton.policies.base import Json, Mask, Observation, world_mask
from arena_newton.policies.protocols.handshake import ServedFacts, read_facts
from arena_newton.policies.protocols.packed_arrays import TEXT_KEYS, pack, unpack
from arena_newton.policies.protocols.raw_arrays import MAX_FRAME, checked_array
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.remote.client import MAX_REPLY, Images, RemoteClient
from arena_newton.policies.remote.link import AskAgain, RemoteError, ServerLink, episode_lost
from arena_newton.robot.canonical import ACTION, ACTION_WIDTH, STATE, STATE_WIDTH

__all__ = ["Gr00tPolicy", "ModalityNames", "make", "pack_gr00t", "read_modalities", "unpack_gr00t"]

ARRAY_KEY = "__ndarray_class__"
"""Key of the map that stands for an array, its content `as_npy` (`gr00t/policy/server_client.py` at 38624df)."""
LONGEST_HEADER = 1024
"""Longest head of an array in NumPy's format that is read [bytes]."""
SLICE = 0.05
"""Interval at which a waiting exchange checks whether it was interrupted [s]."""
_BROKEN = (
    zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_CONNECT_DELAYED
    | zmq.EVENT_CONNECT_RETRIED
    | zmq.EVENT_CONNECTED
)
_STARTS = {b"\x01\x00": 2, b"\x02\x00": 4, b"\x03\x00": 4}
"""Version of NumPy's format → bytes of the length of its head."""


def pack_gr00t(content: object) -> bytes:
    """A message of GR00T's protocol.

    Raises:
        WireError: It holds something that no message can.
    """

    def npy(array: np.ndarray) -> Mapping[str, object]:
        file = io.BytesIO()
        np.save(file, array, allow_pickle=False)
        return {ARRAY_KEY: True, "as_npy": file.getvalue()}

    return pack(content, TEXT_KEYS, npy)


def unpack_gr00t(data: bytes, where: str) -> object:
    """Values of a message in GR00T's protocol; nothing is ever unpickled.

    Raises:
        WireError: It is none, or larger than a robot needs.
    """
    return unpack(data, TEXT_KEYS, where, _array)


def _array(content: Mapping[str, object], where: str) -> np.ndarray | None:
    """The array that a map stands for; None where it is another map."""
    if ARRAY_KEY not in content:
        return None
    data = content.get("as_npy")
    size = _STARTS.get(data[6:8]) if isinstance(data, bytes) and data[:6] == b"\x93NUMPY" else None
    if not isinstance(data, bytes) or size is None:
        raise WireError(f"{where}: an array that is not in NumPy's format")
    length = int.from_bytes(data[8 : 8 + size], "little")
    if length > LONGEST_HEADER:
        raise WireError(f"{where}: an array with a head of {length} bytes, expected at most {LONGEST_HEADER}")
    try:
        head = ast.literal_eval(data[8 + size : 8 + size + length].decode().strip())
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as error:
        raise WireError(f"{where}: an array whose head is not readable ({type(error).__name__})") from None
    if not isinstance(head, dict) or head.get("fortran_order") not in (True, False):
        raise WireError(f"{where}: an array whose head is not NumPy's")
    shape = head.get("shape")
    order = list(shape)[::-1] if head["fortran_order"] and isinstance(shape, tuple) else shape
    array = checked_array(data[8 + size + length :], head.get("descr"), order, where)
    return np.ascontiguousarray(array.T) if head["fortran_order"] else array


@dataclass(frozen=True)
class ModalityNames:
    """Names of observations and actions on a server."""

    video: Mapping[str, str] = field(default_factory=lambda: {FRONT: FRONT})
    """Name → camera; none: it looks at no picture."""
    state: Mapping[str, slice] = field(default_factory=lambda: {"state": slice(0, STATE_WIDTH)})
    """Name → its numbers of the canonical state."""
    action: Mapping[str, slice] = field(default_factory=lambda: {"action": slice(0, ACTION_WIDTH)})
    """Name → its numbers of the action."""
    language: str | None = "annotation.human.task_description"
    """The sentence; None: it reads none."""
    labels: str | None = None
    """Label protocol that the names of the actions are of; None: they do not say."""
    chunk: int = 0
    """Actions per chunk; 0: not given."""

    def to_json(self) -> dict[str, object]:
        """The names as JSON."""
        return {
            "video": dict(self.video) if {*self.video.values()} - {FRONT} else next(iter(self.video), None),
            "state": list(self.state),
            "action": list(self.action),
            "language": self.language,
            "chunk": self.chunk,
        }


def read_modalities(content: object, where: str) -> ModalityNames:
    """Names from the answer to `get_modality_config`.

    Args:
        content: Modality (`video`, `state`, `action`, `language`) → its `ModalityConfig` as a map.
        where: What errors name as the origin.

    Raises:
        InputError: The server wants what this robot does not have, or answers no actions of it.
    """
    if not isinstance(content, Mapping) or not content:
        raise InputError(f"{where}: the answer to get_modality_config is no map of modalities")
    keys = {name: _keys(content.get(name), name, where) for name in ("video", "state", "action", "language")}
    for name, (_, indices) in keys.items():
        if name != "action" and indices not in ((), (0,)):
            raise InputError(
                f"{where}: the server wants {name} at ticks {_shown(indices)}, this robot sends that of the present (0)"
            )
    videos = keys["video"][0]
    known = {name: camera for one in LAYOUTS.values() for camera, name in one.cameras.items()}
    cameras = {name: known.get(name.removeprefix("video."), FRONT if len(videos) == 1 else "") for name in videos}
    if "" in cameras.values() or len({*cameras.values()}) < len(videos):
        raise InputError(f"{where}: the server wants pictures {_shown(videos)}, this robot sends {_shown([*known])}")
    actions, indices = keys["action"]
    found = _slices(actions, {"v3.1": ACTION, "v4": V4}, ACTION_WIDTH, f"{where}: actions")
    states = _slices(keys["state"][0], {"": STATE}, STATE_WIDTH, f"{where}: states")
    sentences = keys["language"][0]
    if len(sentences) > 1:
        raise InputError(f"{where}: the server wants sentences {_shown(sentences)}, this robot sends one")
    if indices and indices != tuple(range(len(indices))):
        raise InputError(f"{where}: the server's actions are of ticks {_shown(indices)}, expected 0, 1, 2 ...")
    return ModalityNames(
        video=cameras,
        state=states[1],
        action=found[1],
        language=sentences[0] if sentences else None,
        labels=found[0] or None,
        chunk=len(indices),
    )


def _keys(config: object, name: str, where: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names and ticks of one modality."""
    if config is None:
        return (), ()
    if isinstance(config, Mapping) and "as_json" in config:  # {"__ModalityConfig_class__": true, "as_json": {...}}
        config = config["as_json"]
    names = config.get("modality_keys") if isinstance(config, Mapping) else None
    ticks = config.get("delta_indices", []) if isinstance(config, Mapping) else None
    if not isinstance(names, list) or not all(isinstance(one, str) for one in names):
        raise InputError(f"{where}: modality {name} of get_modality_config has no list modality_keys")
    if not isinstance(ticks, list) or not all(isinstance(one, int) and not isinstance(one, bool) for one in ticks):
        raise InputError(f"{where}: modality {name} of get_modality_config has no list delta_indices")
    return tuple(names), tuple(ticks)


def _slices(
    names: Sequence[str], known: Mapping[str, Mapping[str, slice]], width: int, where: str
) -> tuple[str, dict[str, slice]]:
    """Numbers of each name: one name for all, or the names of the slices."""
    plain = {name: name.removeprefix("state.").removeprefix("action.") for name in names}
    for title, slices in known.items():
        if set(plain.values()) == set(slices) and len(names) == len(slices):
            return title, {name: slices[part] for name, part in plain.items()}
    if len(names) == 1:
        return "", {names[0]: slice(0, width)}
    choices = " or ".join(", ".join(slices) for slices in known.values())
    raise InputError(f"{where} are {_shown(names)}, expected one name for all {width} numbers, or {choices}")


def _shown(values: Sequence[object]) -> str:
    return ", ".join(str(value)[:60] for value in values[:12]) or "none"


class Gr00tLink(ServerLink[bytes, bytes]):
    """One ZMQ socket that asks and waits for the answer; it is used by one thread at a time."""

    final = (OSError, ValueError, zmq.ZMQError)
    gone = (OSError, AskAgain, zmq.ZMQError)

    def __init__(self, url: str, address: str):
        """Name the server, for messages and for ZMQ."""
        super().__init__(url)
        self._address = address
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._connected = False

    def exchange(self, kind: str, request: bytes, end: float) -> bytes:
        """Send a request and wait for its answer."""
        if self._socket is None:
            self._open()
        connection, monitor = self._socket, self._monitor
        if connection is None or monitor is None:
            raise AskAgain("the connection is closed")
        connection.send(request)
        poller = zmq.Poller()
        poller.register(connection, zmq.POLLIN)
        poller.register(monitor, zmq.POLLIN)
        while True:
            left = end - time.monotonic()
            if left <= 0 or self.aborted:
                raise TimeoutError
            ready = dict(poller.poll(math.ceil(1000.0 * min(left, SLICE))))
            if connection in ready:
                data = connection.recv()
                if len(data) > MAX_REPLY:
                    raise ValueError(f"the reply is longer than {MAX_REPLY >> 20} MiB")
                return data
            if monitor in ready:
                self._watch(int(recv_monitor_message(monitor)["event"]))

    def _watch(self, event: int) -> None:
        """Follow what happens to the connection underneath.

        Raises:
            AskAgain: It broke, or nobody listens: no answer will come over it.
        """
        if event == zmq.EVENT_CONNECTED:
            self._connected = True
        elif event == zmq.EVENT_CONNECT_RETRIED:
            raise AskAgain("the connection broke" if self._connected else "Connection refused")
        elif event != zmq.EVENT_CONNECT_DELAYED:
            raise AskAgain("the connection broke")

    def _open(self) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REQ)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_FRAME)
        self._socket.setsockopt(zmq.IPV6, 1)
        self._monitor = self._socket.get_monitor_socket(_BROKEN)
        self._connected = False
        self._socket.connect(self._address)

    def probe(self, end: float) -> object:
        """A ping."""
        return self.exchange("", pack_gr00t({"endpoint": "ping"}), end)

    def abort(self) -> None:
        """Break off the exchange that another thread waits for, which then closes; or close an idle connection."""
        self.aborted = True
        if not self.busy:
            self.close()

    def close(self) -> None:
        """Close the connection; the next exchange opens a new one."""
        if self._socket is not None:
            self._socket.disable_monitor()
            self._socket.close(linger=0)
        if self._monitor is not None:
            self._monitor.close(linger=0)
        if self._context is not None:
            self._context.term()
        self._socket = self._monitor = self._context = None


class Gr00tPolicy(RemoteClient[bytes, bytes]):
    """Asks a server of GR00T's protocol for all worlds at once."""

    described = "a policy server of GR00T's protocol"
    camera = CameraConfig(width=640, height=480, fit="native")
    """The head camera as it is: GR00T's processors cut and resize by themselves."""

    def __init__(self, url: str, **options: object):
        """Take the server's address and the keywords of `RemoteClient`; nothing is sent yet.

        Raises:
            InputError: As `RemoteClient` says.
        """
        super().__init__(url, **options)  # type: ignore[arg-type]  # the command line's own keywords
        self.batched = True
        self.names = ModalityNames()

    def check(self) -> None:
        """Reach the server, take over its names, compare what it declares, and try it.

        Raises:
            InputError: No server of the protocol answers, or not one for this robot.
        """
        self.reach()
        self._connections[0] = self._connect()
        text, errors = self._gather(" (ping)", {0: self._packed("ping")}, lambda content: content)
        if errors:
            raise self.refusal(errors[0])
        where = f"--policy remote:{self.url}"
        try:
            facts = read_facts(text[0] if isinstance(text[0], Mapping) else {}, where)
        except WireError as error:
            raise InputError(self.masked(str(error))) from None
        names, errors = self._gather(" (get_modality_config)", {0: self._packed("get_modality_config")}, lambda c: c)
        if errors:
            raise self.refusal(errors[0])
        self.names = read_modalities(self.without_token(names[0]), where)
        self.take(self._completed(facts))
        self.batched = True
        self.needs_image, cameras = bool(self.names.video), policy_cameras(self)
        if {*self.names.video.values()} - {FRONT}:
            size = self.camera or CameraConfig()
            self.cameras = {name: cameras.get(name, size) for name in self.names.video.values()}
        self.assume()
        self.probe()

    def _completed(self, facts: ServedFacts) -> ServedFacts:
        """Facts that the server declares, completed by the names of its modalities."""
        if facts != ServedFacts():
            return facts
        return ServedFacts(
            labels=self.names.labels, chunk_length=self.names.chunk or None, needs_picture=bool(self.names.video)
        )

    def describe(self) -> Json:
        """See `RemoteClient.describe`."""
        return super().describe() | {"protocol": "gr00t", "modalities": self.names.to_json()}

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Tell the server once that episodes begin; it does not know which rows they are.

        Raises:
            PolicyUnavailable: The server is gone.
        """
        super().reset(seeds, tasks, mask)
        request = self._packed("reset", {"options": None})
        _, errors = self._ask(self.reset_kind, {0: request}, lambda content: content, sequential=True)
        if errors:
            beginning = np.flatnonzero(world_mask(mask, len(seeds)))
            self._failed_resets.update({int(world): errors[0] for world in beginning})

    def _connect(self) -> Gr00tLink:
        return Gr00tLink(self.url, self.address.url)

    def _packed(self, endpoint: str, data: Mapping[str, object] | None = None) -> bytes:
        content: dict[str, object] = {"endpoint": endpoint}
        if data is not None:
            content["data"] = data
        if self.token:
            content["api_token"] = self.token
        return pack_gr00t(content)

    def _beginning(self, world: int, task: str) -> bytes | None:
        return None

    def _batch(self, seen: Observation, state: np.ndarray, images: Images, worlds: Sequence[int]) -> bytes:
        rows, numbers = list(worlds), np.ascontiguousarray(state, dtype=np.float32)
        shown: dict[str, object] = {
            "video": {
                name: np.ascontiguousarray(images[camera][rows, None], dtype=np.uint8)
                for name, camera in self.names.video.items()
                if camera in images
            },
            "state": {name: numbers[rows, None, part] for name, part in self.names.state.items()},
            "language": {},
        }
        if self.names.language is not None:
            shown["language"] = {self.names.language: [[seen.instruction]] * len(rows)}
        options: dict[str, object] | None = None
        if self.declared.seeded:
            options = {
                "seed": [self._seeds.get(w, 0) for w in rows],
                "step": [self._steps.get(w, 0) for w in rows],
                "task": seen.gym_id,
            }
        return self._packed("get_action", {"observation": shown, "options": options})

    def _read(self, kind: str, reply: bytes) -> object:
        where = self.url + kind
        if reply == b"ERROR":
            raise RemoteError(f"{where}: the server says ERROR")
        content = unpack_gr00t(reply, where)
        if isinstance(content, dict) and "error" in content:
            declared = self.one_line(content["error"])
            raise RemoteError(f"{where}: the server says {declared}", lost=episode_lost(declared))
        return content

    def _rows(self, content: object) -> np.ndarray:
        return self._batch_rows(content, 1)[0]

    def _batch_rows(self, content: object, worlds: int) -> np.ndarray:
        where = self.url + self.infer_kind
        parts = content[0] if isinstance(content, list) and content else content
        if not isinstance(parts, dict):
            raise RemoteError(f"{where}: the answer holds no map of actions")
        plain = {str(key).removeprefix("action."): value for key, value in parts.items()}
        length, rows = -1, np.zeros((worlds, 0, ACTION_WIDTH))
        for name, part in self.names.action.items():
            value = parts.get(name, plain.get(name.removeprefix("action.")))
            width = part.stop - part.start
            if not isinstance(value, np.ndarray) or value.ndim != 3 or value.shape[::2] != (worlds, width):
                shape = list(value.shape) if isinstance(value, np.ndarray) else type(value).__name__
                raise RemoteError(f"{where}: {name} has shape {shape}, expected [{worlds}, n, {width}]")
            if length < 0:
                length = value.shape[1]
                rows = np.zeros((worlds, length, ACTION_WIDTH), dtype=np.float64)
            if value.shape[1] != length:
                raise RemoteError(f"{where}: {name} has {value.shape[1]} actions, others {length}")
            rows[..., part] = value
        return rows


def make(url: str, **options: object) -> Gr00tPolicy:
    """The policy of an address; `remote.from_spec` calls this."""
    return Gr00tPolicy(url, **options)
