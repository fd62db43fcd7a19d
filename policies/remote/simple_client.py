"""The policy that runs behind SIMPLE's and Ψ₀'s HTTP protocol, `POST /act` (github.com/physical-superintelligence-lab).

One JSON request for each query, with arrays as base64 of their bytes, type and shape; whatever a server remembers is
begun anew by `history: {"reset": true}` of an episode's first query. The protocol names neither robot nor episode.
Source: `src/simple/baselines/client.py` and `psi0_decoupled_wbc.py` of SIMPLE.
"""

from __future__ import annotations

import base64
import binascii
import json
import time

import numpy as np

from arena_newton.pictures.settings import FRONT, CameraConfig
from arena_newton.policies.base import Json, Observation
from arena_newton.policies.protocols.handshake import ServedFacts
from arena_newton.policies.protocols.raw_arrays import checked_array
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.remote.arena_client import RemotePolicy
from arena_newton.policies.remote.client import MAX_REPLY, Images
from arena_newton.policies.remote.link import RemoteError
from arena_newton.robot.canonical import STATE_WIDTH

__all__ = ["PICTURE_KEY", "SimplePolicy", "make", "pack_array", "unpack_array"]

PICTURE_KEY = "rgb_head_stereo_left"
"""Name of the head camera's picture."""
DATASET_NAME = "simple"
"""Name of the data set that SIMPLE's client gives as the observation's origin."""


def pack_array(array: np.ndarray) -> Json:
    """An array as JSON."""
    solid = np.ascontiguousarray(array)
    data = base64.b64encode(solid.tobytes()).decode("ascii")
    return {"__numpy__": data, "dtype": solid.dtype.str, "shape": list(solid.shape)}


def unpack_array(value: object, where: str) -> object:
    """The array that JSON holds; what is none, such as lists of numbers, as it is.

    Raises:
        WireError: Bytes, type and shape do not fit, or the type is none of numbers.
    """
    if not isinstance(value, dict) or "__numpy__" not in value:
        return value
    coded = value["__numpy__"]
    if not isinstance(coded, str) or len(coded) > MAX_REPLY:
        raise WireError(f"{where}: an array without base64")
    try:
        data = base64.b64decode(coded, validate=True)
    except (binascii.Error, ValueError):
        raise WireError(f"{where}: an array that is not base64") from None
    return checked_array(data, value.get("dtype"), value.get("shape"), where)


class SimplePolicy(RemotePolicy):
    """Asks a server of SIMPLE's protocol, one request per world."""

    infer_kind = "/act"
    described = "a policy server of SIMPLE's protocol"
    camera = CameraConfig(width=640, height=480, fit="native")
    """640×480: its servers cut and resize."""

    def check(self) -> None:
        """Reach the server, and ask it for a chunk for a robot that stands, as the protocol declares nothing.

        Raises:
            InputError: No server listens, or it is not one for this robot.
        """
        self.reach()
        declared = self._declared()
        if declared != ServedFacts():
            self.take(declared)
        self.assume()
        self.probe()

    def describe(self) -> Json:
        """See `RemoteClient.describe`."""
        return super().describe() | {"protocol": "simple"}

    def _beginning(self, world: int, task: str) -> bytes | None:
        """None: the first query says that an episode begins."""
        return None

    def _request(self, seen: Observation, state: np.ndarray, images: Images, world: int) -> bytes:
        keys = {name: PICTURE_KEY if name == FRONT else f"rgb_{name}" for name in images}
        pictures = {keys[name]: pack_array(np.asarray(image[world], np.uint8)) for name, image in images.items()}
        return json.dumps(
            {
                "image": pictures,
                "instruction": seen.instruction,
                "history": {} if self._steps.get(world, 0) else {"reset": True},
                "state": {"states": pack_array(np.asarray(state[world : world + 1, :STATE_WIDTH], "<f4"))},
                "condition": {},
                "gt_action": [],
                "dataset_name": DATASET_NAME,
                "timestamp": time.strftime("%Y-%m-%d_%H-%M-%S"),
            }
        ).encode()

    def _rows(self, content: object) -> np.ndarray:
        where = self.url + self.infer_kind
        reply = content if isinstance(content, dict) else {}
        error = reply.get("err")
        if isinstance(error, str) and error:  # else a number, which is of its training data
            raise RemoteError(f"{where}: the server says {self.one_line(error)}")
        if "action" not in reply:
            raise RemoteError(f"{where}: the reply holds no action")
        rows = unpack_array(reply["action"], where)
        if isinstance(rows, np.ndarray):
            return self.checked(rows[None] if rows.ndim == 1 else rows)
        single = isinstance(rows, list) and not any(isinstance(row, list) for row in rows)
        return super()._rows({"action_chunk": [rows] if single else rows})


def make(url: str, **options: object) -> SimplePolicy:
    """The policy of an address; `remote.from_spec` calls this."""
    return SimplePolicy(url, **options)
