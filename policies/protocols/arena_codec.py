"""The original benchmark's HTTP protocol: JSON bodies of `/reset`, `/infer` and `/config` to records and back.

docs/howto/bring/policy_server.md has the fields. `world`, `seed`, `step` and `instruction` are ours; the original's
client does not send them.
Source: `lerobot/scripts/serve_lerobot_vla_http.py` of the original.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from arena_newton.files.text import plain_text
from arena_newton.pictures.settings import CAMERAS
from arena_newton.policies.protocols.handshake import ServedFacts, read_facts
from arena_newton.policies.protocols.policy_messages import (
    MAX_SEED,
    MAX_STEP,
    Begin,
    Query,
    read_actions,
    read_count,
    read_picture,
    read_state,
    read_text,
)
from arena_newton.policies.protocols.raw_arrays import MAX_FRAME, MAX_OBJECTS, checked_array
from arena_newton.policies.protocols.wire_error import WireError

__all__ = [
    "CLIENT_HEADER",
    "MAX_WORLD",
    "chunk_of",
    "pack_begin",
    "pack_begun",
    "pack_chunk",
    "pack_config",
    "pack_failure",
    "pack_query",
    "read_client",
    "unpack_begin",
    "unpack_chunk",
    "unpack_config",
    "unpack_query",
]

CLIENT_HEADER = "X-Arena-Client"
"""Header by which a client names itself: ours, the original's has none."""
MAX_WORLD = 2**31 - 1
"""Largest number of a world."""
_CLIENT = re.compile(r"[\w.-]{1,64}", re.ASCII)


def read_client(header: str | None) -> str:
    """The name of a client; empty where it has none.

    Raises:
        WireError: It is not 1 to 64 letters, digits, dots, lines and dashes.
    """
    if header is None:
        return ""
    if not _CLIENT.fullmatch(header):
        raise WireError(f"{CLIENT_HEADER}: expected 1 to 64 letters, digits, '.', '_' and '-'")
    return header


def pack_begin(begin: Begin) -> bytes:
    """Body of `/reset`; the session is the number of a world."""
    content: dict[str, object] = {"seed": begin.seed, "world": int(begin.session) if begin.session else None}
    content |= {"task": begin.task or None, "instruction": begin.instruction or None}
    return _dumped({key: value for key, value in content.items() if value is not None})


def unpack_begin(body: bytes | bytearray) -> Begin:
    """Read the body of `/reset`; an empty one begins an episode, too.

    Raises:
        WireError: It is unfit.
    """
    content = _request(body, "/reset") if body.strip() else {}
    return Begin(
        _world(content, "/reset"),
        read_count(content.get("seed"), "/reset", "seed", MAX_SEED),
        read_text(content.get("task"), "/reset", "task"),
        read_text(content.get("instruction"), "/reset", "instruction"),
    )


def pack_begun(facts: ServedFacts) -> bytes:
    """Reply to `/reset`."""
    return _dumped({"ok": True, "seeded": facts.seeded, "policy": facts.policy})


def pack_query(query: Query, files: Mapping[str, Path] | None = None) -> bytes:
    """Body of `/infer`; pictures in it, or in PNG files by the names of their cameras."""
    seen: dict[str, object] = {"state": [float(v) for v in query.state]}
    if query.images:
        seen["images"] = {name: _packed(np.asarray(image)) for name, image in query.images.items()}
    if files:
        seen["images"] = {name: {"file": str(path)} for name, path in files.items()}
    content: dict[str, object] = {"observation": seen, "robot_type": query.robot_type, "return_chunk": True}
    content |= {"task": query.task, "instruction": query.instruction}
    more = {"world": int(query.session) if query.session else None, "step": query.step, "seed": query.seed}
    return _dumped(content | {key: value for key, value in more.items() if value is not None})


def unpack_query(body: bytes | bytearray) -> tuple[Query, bool]:
    """Observation in the body of `/infer`, and whether a whole chunk is wanted.

    Raises:
        WireError: It is unfit.
    """
    where = "/infer"
    content = _request(body, where)
    seen = content.get("observation")
    if not isinstance(seen, dict):
        raise WireError(f"{where}: observation is {_kind(seen)}, expected an object")
    pictures = seen.get("images") or {}
    if not isinstance(pictures, dict):
        raise WireError(f"{where}: images is {_kind(pictures)}, expected an object")
    chunk = content.get("return_chunk", False)
    if not isinstance(chunk, bool):
        raise WireError(f"{where}: return_chunk is {_kind(chunk)}, expected true or false")
    query = Query(
        state=read_state(seen.get("state"), where),
        images={
            name: _picture(pictures[name], f"{where}: images.{name}", where)
            for name in CAMERAS
            if pictures.get(name) is not None
        },
        task=read_text(content.get("task"), where, "task"),
        instruction=read_text(content.get("instruction"), where, "instruction"),
        session=_world(content, where),
        seed=read_count(content.get("seed"), where, "seed", MAX_SEED),
        step=read_count(content.get("step"), where, "step", MAX_STEP),
        robot_type=read_text(content.get("robot_type"), where, "robot_type"),
    )
    return query, chunk


def pack_chunk(actions: np.ndarray, *, chunk: bool = True) -> bytes:
    """Reply to `/infer`: the first action, and with `chunk` all of them and their number; NaN is no JSON.

    Raises:
        WireError: An action holds a number that is not finite.
    """
    rows = [[float(v) for v in row] for row in actions]
    if not all(math.isfinite(v) for row in rows for v in row):
        raise WireError("an action holds a number that is not finite")
    more: dict[str, object] = {"action_chunk": rows, "chunk_size": len(rows)} if chunk else {}
    return _dumped({"action": rows[0], **more})


def unpack_chunk(body: bytes, where: str) -> np.ndarray:
    """The chunk of a reply, float32, shape [n, 40].

    Raises:
        WireError: It holds none.
    """
    content = _object(body, where)
    if "error" in content:
        raise WireError(f"{where}: the server says {plain_text(content['error'], 200)}")
    return chunk_of(content, where)


def chunk_of(content: Mapping[str, object], where: str) -> np.ndarray:
    """The chunk of a reply's object, float32, shape [n, 40].

    Raises:
        WireError: It holds none.
    """
    rows = content.get("action_chunk")
    rows = content.get("action") if rows is None else rows
    if not isinstance(rows, list) or not rows:
        raise WireError(f"{where}: the reply holds neither action_chunk nor action as lists of numbers")
    return read_actions(rows, where)


def pack_config(facts: ServedFacts, more: dict[str, object] | None = None) -> bytes:
    """Reply to `GET /config`: what the server declares, and how it is set."""
    return _dumped({**facts.to_json(), **(more or {})})


def unpack_config(body: bytes, where: str) -> ServedFacts:
    """Facts declared by a reply to `GET /config`; that of another server declares nothing.

    Raises:
        WireError: It is no JSON object, or damaged.
    """
    return read_facts(_object(body, where), where)


def pack_failure(sentence: str) -> bytes:
    """Reply to what could not be done."""
    return _dumped({"error": sentence})


def _dumped(content: object) -> bytes:
    return json.dumps(content, allow_nan=False).encode()


def _kind(value: object) -> str:
    return {type(None): "absent", dict: "an object", list: "a list", str: "a text"}.get(
        type(value), type(value).__name__
    )


def _refused(constant: str) -> object:
    raise ValueError(f"{constant} is no JSON")


def _request(body: bytes | bytearray, where: str) -> dict[str, object]:
    """The object of a request, which has few values; they are counted before anything is made of them."""
    if sum(body.count(mark) for mark in (b",", b"[", b"{")) > MAX_OBJECTS:
        raise WireError(f"{where}: more than {MAX_OBJECTS} values")
    return _object(body, where)


def _object(body: bytes | bytearray, where: str) -> dict[str, object]:
    if len(body) > MAX_FRAME:
        raise WireError(f"{where}: {len(body)} bytes, expected at most {MAX_FRAME}")
    try:
        content = json.loads(body, parse_constant=_refused)
    except (ValueError, RecursionError):
        raise WireError(f"{where}: the body is not JSON") from None
    if not isinstance(content, dict):
        raise WireError(f"{where}: the body is {_kind(content)}, expected an object")
    return content


def _world(content: dict[str, object], where: str) -> str:
    world = read_count(content.get("world"), where, "world", MAX_WORLD)
    return "" if world is None else str(world)


def _packed(image: np.ndarray) -> dict[str, object]:
    data = base64.b64encode(np.ascontiguousarray(image).tobytes()).decode("ascii")
    return {"shape": list(image.shape), "dtype": "uint8", "data_b64": data}


def _picture(value: object, name: str, where: str) -> np.ndarray:
    if not isinstance(value, dict):
        raise WireError(f"{name} is {_kind(value)}, expected an object")
    coded = value.get("data_b64")
    if not isinstance(coded, str) or len(coded) > MAX_FRAME:
        raise WireError(f"{name}.data_b64 is {_kind(coded)}, expected base64")
    dtype = value.get("dtype", "uint8")
    if dtype not in ("uint8", "float32"):
        raise WireError(f"{name}.dtype is {plain_text(dtype, 20)!r}, expected uint8 or float32")
    try:
        data = base64.b64decode(coded, validate=True)
    except (binascii.Error, ValueError):
        raise WireError(f"{name}.data_b64 is not base64") from None
    picture = checked_array(data, dtype, value.get("shape"), name)
    if dtype == "float32":  # the original's server divides these by 255, too
        if not ((picture >= 0.0) & (picture <= 255.0) & (picture == np.rint(picture))).all():
            raise WireError(f"{name} of float32 holds other than whole numbers from 0 to 255")
        picture = picture.astype(np.uint8)
    return read_picture(picture, where)
