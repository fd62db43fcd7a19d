"""openpi's websocket protocol, and RoboArena's, which adds `endpoint` and `session_id`: bytes to records and back.

A server sends its metadata first. A request is a flat map, the answer `{"actions": [n, 40], "server_timing": {...}}`; a
text frame is an error. RoboArena's requests name an endpoint, `infer` or `reset`, which is answered by a text frame.
Sources: `openpi_client/websocket_client_policy.py` and `openpi/serving/websocket_policy_server.py` of
github.com/Physical-Intelligence/openpi at 15a9616, `roboarena/policy_server.py` of github.com/robo-arena/roboarena at
06f0a82. `task`, `seed` and `step` are ours; other servers do not read them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from arena_newton.files.text import plain_text
from arena_newton.pictures.settings import CAMERAS, FRONT
from arena_newton.policies.protocols.handshake import ServedFacts, read_facts
from arena_newton.policies.protocols.packed_arrays import OPENPI_KEYS, Value, WireError, pack, unpack
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

__all__ = [
    "IMAGE_KEY",
    "IMAGE_KEYS",
    "PROMPT_KEY",
    "RESET_ANSWER",
    "STATE_KEY",
    "camera_key",
    "pack_answer",
    "pack_metadata",
    "pack_request",
    "unpack_answer",
    "unpack_metadata",
    "unpack_request",
]

IMAGE_KEY = "observation/image"
"""Key of the head camera's picture."""
IMAGE_KEYS = (IMAGE_KEY, "observation/exterior_image_1_left", "observation/exterior_image_0_left")
"""Keys under which a server looks for it, in this order; the others are RoboArena's first external camera."""
STATE_KEY = "observation/state"
"""Key of the 64 numbers of the state."""
PROMPT_KEY = "prompt"
"""Key of the instruction."""
_CAMERA_KEYS = {name: f"observation/{name}_image" for name in CAMERAS if name != FRONT}
"""Keys of the pictures of the other cameras."""
RESET_ANSWER = "reset successful"
"""Text frame with which RoboArena's server answers `reset`."""
WHERE = "request"
"""Name of a request in errors."""


def pack_metadata(facts: ServedFacts, *, roboarena: bool = False) -> bytes:
    """The first frame of a server.

    Args:
        facts: What it declares.
        roboarena: Only the fields of RoboArena's `PolicyServerConfig`, whose clients may refuse any other key.
    """
    size = facts.picture and [facts.picture.height, facts.picture.width]
    cameras = facts.cameras or [FRONT] * bool(facts.needs_picture)
    wrist = [name for name in cameras if "wrist" in name]
    content: dict[str, object] = {
        "image_resolution": size,
        "needs_wrist_camera": bool(wrist),
        "n_external_cameras": len(cameras) - len(wrist),
        "needs_stereo_camera": False,
        "needs_session_id": True,
        "action_space": f"arena_{facts.labels}",
    }
    return pack(content if roboarena else content | facts.to_json(), OPENPI_KEYS)


def unpack_metadata(data: bytes | str, where: str) -> tuple[ServedFacts, Mapping[str, Value]]:
    """Facts that the first frame of a server declares, and the whole frame.

    Raises:
        WireError: It is a text frame (an error of the server), or no map.
    """
    content = _map(data, where)
    return read_facts(content, where), content


def camera_key(name: str, front: str = IMAGE_KEY) -> str:
    """Key of a camera's picture; `front` is that of the head camera's."""
    return _CAMERA_KEYS.get(name, front)


def pack_request(
    request: Query | Begin, *, roboarena: bool = False, image_key: str = IMAGE_KEY, extras: bool = True
) -> bytes:
    """A request as the client sends it.

    Args:
        request: openpi itself knows no beginning of an episode: there `seed` and `step` 0 of a query begin one.
        roboarena: Name endpoint and session.
        image_key: Key of the head camera's picture.
        extras: Add `task`, `seed` and `step`, which servers other than ours do not read.

    Raises:
        WireError: A `Begin` without `roboarena`.
    """
    content: dict[str, object] = {}
    if isinstance(request, Query):
        for name, image in request.images.items():
            content[camera_key(name, image_key)] = np.ascontiguousarray(image)
        content[STATE_KEY] = np.ascontiguousarray(request.state, dtype=np.float32)
        content[PROMPT_KEY] = request.instruction
    elif not roboarena:
        raise WireError("openpi knows no message for the beginning of an episode")
    if roboarena:
        content["endpoint"] = "infer" if isinstance(request, Query) else "reset"
        content["session_id"] = request.session
    if extras:
        step = request.step if isinstance(request, Query) else None
        more = {"task": request.task or None, "seed": request.seed, "step": step}
        if isinstance(request, Begin):
            more[PROMPT_KEY] = request.instruction or None
        content |= {key: value for key, value in more.items() if value is not None}
    return pack(content, OPENPI_KEYS)


def unpack_request(data: bytes | str) -> tuple[Query | Begin, bool]:
    """A request, and whether it is RoboArena's.

    Raises:
        WireError: It is none.
    """
    if isinstance(data, str):
        raise WireError(f"{WHERE}: a text frame, expected MessagePack in a binary frame")
    content = _map(data, WHERE)
    endpoint = content.get("endpoint")
    if endpoint not in (None, "infer", "reset"):
        raise WireError(f"{WHERE}: endpoint {plain_text(endpoint, 40)!r}, expected infer or reset")
    session = content.get("session_id")
    if isinstance(session, np.ndarray) and session.size == 1:
        session = session.item()
    named = str(session) if isinstance(session, int) else read_text(session, WHERE, "session_id")
    seed = read_count(content.get("seed"), WHERE, "seed", MAX_SEED)
    task = read_text(content.get("task"), WHERE, "task")
    prompt = read_text(content.get(PROMPT_KEY), WHERE, PROMPT_KEY)
    if endpoint == "reset":
        return Begin(named, seed, task, prompt), True
    keys = {FRONT: next((key for key in IMAGE_KEYS if key in content), IMAGE_KEY), **_CAMERA_KEYS}
    query = Query(
        state=read_state(content.get(STATE_KEY), WHERE),
        images={name: read_picture(content[key], WHERE) for name, key in keys.items() if key in content},
        task=task,
        instruction=prompt,
        session=named,
        seed=seed,
        step=read_count(content.get("step"), WHERE, "step", MAX_STEP),
    )
    return query, endpoint is not None


def pack_answer(
    actions: np.ndarray, infer_ms: float, prev_total_ms: float | None = None, *, roboarena: bool = False
) -> bytes:
    """The answer to a query.

    Args:
        actions: The chunk, shape [n, 40].
        infer_ms: Time that the policy took, waiting for a batch included [ms].
        prev_total_ms: Time from the last request of the connection to the end of its answer [ms].
        roboarena: The chunk is named `action`, too.
    """
    timing = {"infer_ms": infer_ms} | ({} if prev_total_ms is None else {"prev_total_ms": prev_total_ms})
    chunk = np.ascontiguousarray(actions, dtype=np.float32)
    content = {"actions": chunk} | ({"action": chunk} if roboarena else {}) | {"server_timing": timing}
    return pack(content, OPENPI_KEYS)


def unpack_answer(data: bytes | str, where: str) -> np.ndarray:
    """The chunk of an answer, float32, shape [n, 40].

    Raises:
        WireError: A text frame, which is an error of the server and shown in one line, or no chunk.
    """
    content: Value = _unpacked(data, where)
    if isinstance(content, dict):
        content = content.get("actions", content.get("action"))
        if content is None:
            raise WireError(f"{where}: the answer holds no actions")
    return read_actions(content, where)


def _map(data: bytes | str, where: str) -> dict[str, Value]:
    content = _unpacked(data, where)
    if not isinstance(content, dict):
        raise WireError(f"{where}: {type(content).__name__}, expected a map")
    return content


def _unpacked(data: bytes | str, where: str) -> Value:
    if isinstance(data, str):  # the server's traceback: its last line says what happened
        lines = [line for line in data[-4000:].splitlines() if line.strip()]
        raise WireError(f"{where}: the server says {plain_text(lines[-1], 200) if lines else 'nothing'}")
    return unpack(data, OPENPI_KEYS, where)
