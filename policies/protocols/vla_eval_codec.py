"""vla-eval's websocket protocol: every frame is a map of `type`, `payload`, `seq` and `timestamp`.

The robot says `hello` and is answered by one; then `episode_start`, `observation` (each answered by an `action` or an
`error` of the same `seq`) and `episode_end`. Pictures are PNG, JPEG or raw. A server of that harness answers one action
per query and keeps the rest of its chunk; ours gives whole ones to a robot whose `hello` names the capability `chunks`.
Sources: `vla_eval/protocol/{messages,numpy_codec,image_codec}.py`, `vla_eval/model_servers/serve.py` of
github.com/allenai/vla-evaluation-harness at e1ee9ad. `task`, `seed`, `step` and `session` are ours.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from PIL import Image

from arena_newton import __version__
from arena_newton.files.text import plain_text
from arena_newton.pictures.settings import CAMERAS, FRONT
from arena_newton.policies.protocols.handshake import ServedFacts, read_facts
from arena_newton.policies.protocols.packed_arrays import TEXT_KEYS, Value, WireError, checked_array, pack, unpack
from arena_newton.policies.protocols.packed_picture import PICTURE_FORMATS, PackedPicture
from arena_newton.policies.protocols.policy_messages import (
    MAX_SEED,
    MAX_STEP,
    Begin,
    End,
    Query,
    Request,
    read_actions,
    read_count,
    read_picture,
    read_state,
    read_text,
)

__all__ = [
    "CHUNKS",
    "PROTOCOL_VERSION",
    "TYPES",
    "VlaEvalMessage",
    "pack_action",
    "pack_error",
    "pack_hello",
    "pack_message",
    "pack_request",
    "unpack_action",
    "unpack_hello",
    "unpack_message",
    "unpack_request",
]

PROTOCOL_VERSION = 1
"""Version of the protocol that `hello` names."""
TYPES = ("hello", "observation", "action", "episode_start", "episode_end", "error", "record")
"""Types of messages."""
CHUNKS = "chunks"
"""Capability of a robot that executes whole chunks, and of a server that gives them."""
WHERE = "message"
"""Name of a message in errors."""
LARGEST_SEQ = 2**63 - 1

type ImageFormat = Literal["png", "jpeg", "raw"]
"""Encodings of pictures; `jpeg` changes them."""


@dataclass(frozen=True)
class VlaEvalMessage:
    """One frame."""

    type: str
    """One of `TYPES`."""
    payload: Mapping[str, Value]
    seq: int = 0
    """Number of the request, which its answer repeats."""
    timestamp: float = 0.0
    """Time of sending [s since 1970]."""


def pack_message(
    kind: str, payload: Mapping[str, object], seq: int, timestamp: float, images: ImageFormat = "png"
) -> bytes:
    """A frame; pictures in the payload are written as `images` says."""
    content = {"type": kind, "payload": dict(payload), "seq": seq, "timestamp": timestamp}
    return pack(content, TEXT_KEYS, lambda array: _packed_picture(array, images))


def unpack_message(data: bytes | str) -> VlaEvalMessage:
    """Content of a frame; packed pictures in it are left packed.

    Raises:
        WireError: It is none.
    """
    if isinstance(data, str):
        raise WireError(f"{WHERE}: a text frame, expected MessagePack in a binary frame")
    content = unpack(data, TEXT_KEYS, WHERE, _picture)
    if not isinstance(content, dict):
        raise WireError(f"{WHERE}: {type(content).__name__}, expected a map")
    missing = [name for name in ("type", "payload", "seq", "timestamp") if name not in content]
    if missing:
        raise WireError(f"{WHERE}: without {' '.join(missing)}")
    kind, payload, timestamp = content["type"], content["payload"], content["timestamp"]
    if not isinstance(kind, str) or kind not in TYPES:
        raise WireError(f"{WHERE}: type {plain_text(kind, 40)!r}, expected one of {' '.join(TYPES)}")
    if not isinstance(payload, dict):
        raise WireError(f"{WHERE}: payload is {type(payload).__name__}, expected a map")
    if isinstance(timestamp, bool) or not isinstance(timestamp, int | float):
        raise WireError(f"{WHERE}: timestamp is {type(timestamp).__name__}, expected a number")
    seq = read_count(content["seq"], WHERE, "seq", LARGEST_SEQ)
    return VlaEvalMessage(kind, payload, seq or 0, float(timestamp))


def pack_hello(facts: ServedFacts | None, seq: int, timestamp: float) -> bytes:
    """The greeting: of a server with what it declares, of a robot without."""
    payload: dict[str, object] = {
        "harness_version": f"arena-newton {__version__}",
        "protocol_version": PROTOCOL_VERSION,
        "capabilities": {CHUNKS: True},
    }
    if facts is not None:
        payload["model_server"] = facts.policy
        payload["observation_params"] = {"send_state": True}
        payload["arena"] = facts.to_json()
    return pack_message("hello", payload, seq, timestamp)


def unpack_hello(message: VlaEvalMessage, where: str) -> tuple[ServedFacts, bool]:
    """Facts that a greeting declares, and whether its sender knows chunks.

    Raises:
        WireError: It is none, or of another version of the protocol.
    """
    if message.type != "hello":
        raise WireError(f"{where}: a message of type {message.type}, expected hello")
    version = message.payload.get("protocol_version", PROTOCOL_VERSION)
    if version != PROTOCOL_VERSION:
        shown = plain_text(version, 40)
        raise WireError(f"{where}: version {shown} of vla-eval's protocol, expected {PROTOCOL_VERSION}")
    capabilities = message.payload.get("capabilities")
    chunks = isinstance(capabilities, dict) and capabilities.get(CHUNKS) is True
    return read_facts(message.payload.get("arena", {}), where), chunks


def pack_request(request: Request, seq: int, timestamp: float, images: ImageFormat = "png") -> bytes:
    """A request as the robot sends it."""
    payload: dict[str, object]
    match request:
        case Query():
            payload = {"task_description": request.instruction, "states": request.state.astype(np.float32)}
            payload["images"] = {name: np.ascontiguousarray(image) for name, image in request.images.items()}
            more = {"step": request.step, "seed": request.seed, "task": request.task or None}
            kind = "observation"
        case Begin():
            payload, kind = {"task_description": request.instruction}, "episode_start"
            more = {"seed": request.seed, "task": request.task or None}
        case End():
            payload, kind, more = dict(request.result), "episode_end", {}
    payload |= {key: value for key, value in (more | {"session": request.session or None}).items() if value is not None}
    return pack_message(kind, payload, seq, timestamp, images)


def unpack_request(message: VlaEvalMessage) -> Request:
    """Request of a robot.

    Raises:
        WireError: The message is no request, or a number or picture in it unfit.
    """
    payload = message.payload
    session = read_text(payload.get("session"), WHERE, "session")
    if message.type == "episode_end":
        return End(session, dict(payload))
    task = payload.get("task")
    if isinstance(task, dict):  # the harness passes the benchmark's own record of a task
        task = task.get("name")
    task = read_text(task, WHERE, "task")
    instruction = read_text(payload.get("task_description"), WHERE, "task_description")
    seed = read_count(payload.get("seed"), WHERE, "seed", MAX_SEED)
    if message.type == "episode_start":
        return Begin(session, seed, task, instruction)
    if message.type != "observation":
        raise WireError(f"{WHERE}: type {message.type}, expected episode_start, observation or episode_end")
    pictures = payload.get("images", {})
    if not isinstance(pictures, dict):
        raise WireError(f"{WHERE}: images is {type(pictures).__name__}, expected a map")
    known = {name: pictures[name] for name in CAMERAS if name in pictures}
    if not known and len(pictures) > 1:
        raise WireError(f"{WHERE}: several pictures, and none is named {FRONT}")
    known = known or {FRONT: next(iter(pictures.values()), None)}
    return Query(
        state=read_state(payload.get("states"), WHERE),
        images={
            name: one if isinstance(one, PackedPicture) else read_picture(one, WHERE)
            for name, one in known.items()
            if one is not None
        },
        task=task,
        instruction=instruction,
        session=session,
        seed=seed,
        step=read_count(payload.get("step"), WHERE, "step", MAX_STEP),
    )


def pack_action(actions: np.ndarray, seq: int, timestamp: float) -> bytes:
    """The answer to a query: a chunk [n, 40], or one action [40] for a robot that knows no chunks."""
    return pack_message("action", {"actions": actions.astype(np.float32)}, seq, timestamp, "raw")


def pack_error(sentence: str, seq: int, timestamp: float) -> bytes:
    """The answer to what could not be done."""
    return pack_message("error", {"error": sentence}, seq, timestamp)


def unpack_action(message: VlaEvalMessage, seq: int, where: str) -> np.ndarray:
    """The chunk of an answer, float32, shape [n, 40].

    Args:
        seq: Of the query that it must answer.
        where: What errors name as the origin.

    Raises:
        WireError: An error of the server, shown in one line, or not the answer to this query, or no chunk.
    """
    if message.type == "error":
        raise WireError(f"{where}: the server says {plain_text(message.payload.get('error', 'nothing'), 200)}")
    if message.type != "action":
        raise WireError(f"{where}: a message of type {message.type}, expected action")
    if message.seq != seq:
        raise WireError(f"{where}: the answer to query {message.seq}, expected that to {seq}")
    return read_actions(message.payload.get("actions", message.payload.get("action")), where)


def _packed_picture(array: np.ndarray, images: ImageFormat) -> Mapping[str, object] | None:
    """A picture as the protocol writes it; None for other arrays."""
    if images == "raw" or array.ndim != 3 or array.dtype != np.uint8 or array.shape[2] != 3:
        return None
    file = io.BytesIO()
    more = {"quality": 95} if images == "jpeg" else {"compress_level": 1}
    Image.fromarray(array).save(file, images, **more)
    return {"__image__": True, "format": images, "data": file.getvalue(), "shape": list(array.shape)}


def _picture(content: Mapping[str, object], where: str) -> np.ndarray | PackedPicture | None:
    """The picture that a map stands for; None where it is another map."""
    if content.get("__image__") is not True:
        return None
    form, data = content.get("format"), content.get("data")
    if form == "raw":
        return checked_array(data, content.get("dtype"), content.get("shape"), where)
    if form not in PICTURE_FORMATS or not isinstance(data, bytes):
        raise WireError(f"{where}: a picture of format {plain_text(form, 20)!r}, expected png, jpeg or raw")
    return PackedPicture.read(data, str(form), where)
