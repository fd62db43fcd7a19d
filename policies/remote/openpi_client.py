"""The policy that runs behind openpi's websocket protocol, or RoboArena's, which adds the beginning of an episode.

A server sends its metadata first. Ours declares there what is compared before the first episode; of others a robot that
stands is asked for one chunk, and what they do not declare is assumed and reported.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from arena_newton.errors import InputError
from arena_newton.pictures.camera import CameraConfig
from arena_newton.policies.base import Json, Observation
from arena_newton.policies.protocols import arena_codec, openpi_codec
from arena_newton.policies.protocols.handshake import ServedFacts
from arena_newton.policies.protocols.packed_arrays import OPENPI_KEYS, pack, unpack
from arena_newton.policies.protocols.policy_messages import PICTURE_SIDES, Begin
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.remote.client import Images
from arena_newton.policies.remote.link import RemoteError, episode_lost
from arena_newton.policies.remote.websocket import (
    SocketClient,
    SocketLink,
    SocketRequest,
    http_page,
)

__all__ = ["ROBOARENA_IMAGE_KEY", "OpenpiPolicy", "make"]

ROBOARENA_IMAGE_KEY = "observation/exterior_image_0_left"
"""Key of the head camera's picture for RoboArena's servers: their first external camera."""
LONGEST_SAID = 2000
"""Most characters of a text frame that are looked at."""


class OpenpiLink(SocketLink):
    """One websocket of openpi's protocol."""

    def __init__(self, owner: OpenpiPolicy):
        """Take the policy whose server it is."""
        super().__init__(owner)
        self.policy = owner
        self.sessions = owner.roboarena

    def greet(self, end: float) -> ServedFacts:
        """Read the metadata that the server sends first."""
        facts, metadata = openpi_codec.unpack_metadata(self.receive(end), self.url)
        self.policy.metadata = dict(metadata)
        return facts

    def begin(self, begin: Begin, end: float) -> object:
        """Begin an episode, which RoboArena's servers answer with a text."""
        self.send(openpi_codec.pack_request(begin, roboarena=True, extras=self.policy.extras))
        answer = self.receive(end)
        if answer != openpi_codec.RESET_ANSWER:
            self.policy.text_of(answer, self.url + self.policy.reset_kind)
        return None

    def query(self, request: SocketRequest, end: float) -> object:
        """Show what a world sees, or all of a batch."""
        if request.batch is not None:
            self.send(request.batch)
        elif request.message is not None:
            roboarena, extras = self.policy.roboarena, self.policy.extras
            key = self.policy.image_key
            self.send(openpi_codec.pack_request(request.message, roboarena=roboarena, image_key=key, extras=extras))
        answer = self.receive(end)
        if isinstance(answer, str):  # an error, after which openpi's servers close
            self.close()
        return answer


class OpenpiPolicy(SocketClient):
    """Asks a server of openpi's protocol."""

    described = "a policy server of openpi's protocol"
    camera = CameraConfig()
    """224×224 with black bars, as openpi's clients prepare pictures."""

    def __init__(self, url: str, **options: object):
        """Take the server's address and the keywords of `RemoteClient`; nothing is sent yet.

        Raises:
            InputError: As `RemoteClient` says.
        """
        super().__init__(url, **options)  # type: ignore[arg-type]  # the command line's own keywords
        self.roboarena = self.address.protocol == "roboarena"
        self.metadata: Json = {}
        self.extras = False
        self.image_key = ROBOARENA_IMAGE_KEY if self.roboarena else openpi_codec.IMAGE_KEY

    def check(self) -> None:
        """Reach the server, compare what it declares, and try it where it does not declare its actions.

        Raises:
            InputError: No server of the protocol answers, or not one for this robot.
        """
        facts = self.greet()
        if self.roboarena:
            page = http_page(self, "/config")
            try:
                facts = arena_codec.unpack_config(page, f"{self.url}/config") if page else facts
            except WireError as error:
                raise InputError(f"--policy remote: {self.masked(str(error))}") from None
            if facts == ServedFacts():
                self._cameras()
        self.take(facts)
        self.extras = facts != ServedFacts()
        if facts.picture is None and facts.cameras is None:
            self._resolution()
        self.batched = not self.roboarena and self.metadata.get("batched") is True
        self.assume()
        if facts.action_names is None:
            self.probe()

    def describe(self) -> Json:
        """See `RemoteClient.describe`."""
        return super().describe() | {"protocol": "roboarena" if self.roboarena else "openpi"}

    def text_of(self, answer: bytes | str, where: str) -> None:
        """Raise what a text frame says.

        Raises:
            RemoteError: Always.
        """
        if isinstance(answer, str):
            lines = [line for line in answer[-LONGEST_SAID:].splitlines() if line.strip()]
            text = self.one_line(lines[-1]) if lines else "nothing"
            raise RemoteError(f"{where}: the server says {text}", lost=episode_lost(text))
        raise RemoteError(f"{where}: a binary frame, expected the text {openpi_codec.RESET_ANSWER!r}")

    def _cameras(self) -> None:
        """Refuse a RoboArena server that wants cameras which this robot's policies are not given.

        Raises:
            InputError: It does.
        """
        where = f"--policy remote:{self.url}: the server wants"
        for name, what in (("needs_wrist_camera", "wrist cameras"), ("needs_stereo_camera", "stereo pictures")):
            if self.metadata.get(name) is True:
                raise InputError(f"{where} {what} ({name}), this robot sends its head camera only")
        count = self.metadata.get("n_external_cameras", 1)
        if isinstance(count, bool) or not isinstance(count, int) or count > 1:
            shown = self.one_line(count)
            raise InputError(f"{where} {shown} external cameras (n_external_cameras), this robot sends its head camera")
        self.needs_image = count == 1

    def _resolution(self) -> None:
        """Follow `image_resolution`, height and width [px]; None there: the camera's own 640×480.

        Raises:
            InputError: It is no size of a picture.
        """
        if "image_resolution" not in self.metadata:
            return
        size = self.metadata["image_resolution"]
        if size is None:
            self.camera = CameraConfig(width=640, height=480, fit="native")
            return
        values = size.tolist() if isinstance(size, np.ndarray) else size
        low, high = PICTURE_SIDES
        if (
            not isinstance(values, list)
            or len(values) != 2
            or not all(isinstance(n, int) and not isinstance(n, bool) and low <= n <= high for n in values)
        ):
            shown = self.one_line(values)
            raise InputError(
                f"--policy remote:{self.url}: the server's image_resolution is {shown}, expected height and width of "
                f"{low} to {high} pixels"
            )
        self.camera = CameraConfig(width=values[1], height=values[0])

    def _connect(self) -> OpenpiLink:
        return OpenpiLink(self)

    def _beginning(self, world: int, task: str) -> SocketRequest | None:
        # Plain openpi knows no beginning: our server sees it from seed and step.
        return super()._beginning(world, task) if self.roboarena else None

    def _read(self, kind: str, reply: object) -> object:
        if isinstance(reply, str):
            self.text_of(reply, self.url + kind)
        return reply

    def _rows(self, content: object) -> np.ndarray:
        if not isinstance(content, bytes):
            raise RemoteError(f"{self.url}{self.infer_kind}: no binary frame")
        return openpi_codec.unpack_answer(content, self.url + self.infer_kind)

    def _batch(self, seen: Observation, state: np.ndarray, images: Images, worlds: Sequence[int]) -> SocketRequest:
        rows = list(worlds)
        content: dict[str, object] = {
            openpi_codec.STATE_KEY: np.ascontiguousarray(state[rows, :64], dtype=np.float32),
            openpi_codec.PROMPT_KEY: [seen.instruction] * len(rows),
        }
        for name, image in images.items():
            key = openpi_codec.camera_key(name, self.image_key)
            content[key] = np.ascontiguousarray(image[rows], dtype=np.uint8)
        if self.extras:
            content["task"] = [seen.gym_id] * len(rows)
            content["seed"] = np.array([self._seeds.get(w, 0) for w in rows], dtype=np.int64)
            content["step"] = np.array([self._steps.get(w, 0) for w in rows], dtype=np.int64)
        return SocketRequest(None, Begin(), batch=pack(content, OPENPI_KEYS))

    def _batch_rows(self, content: object, worlds: int) -> np.ndarray:
        where = self.url + self.infer_kind
        if not isinstance(content, bytes):
            raise RemoteError(f"{where}: no binary frame")
        answer = unpack(content, OPENPI_KEYS, where)
        rows = answer.get("actions", answer.get("action")) if isinstance(answer, dict) else None
        if not isinstance(rows, np.ndarray) or rows.ndim != 3 or len(rows) != worlds:
            shape = list(rows.shape) if isinstance(rows, np.ndarray) else type(rows).__name__
            raise RemoteError(f"{where}: actions of shape {shape}, expected [{worlds}, n, 40]")
        return rows


def make(url: str, **options: object) -> OpenpiPolicy:
    """The policy of an address; `remote.from_spec` calls this."""
    return OpenpiPolicy(url, **options)
