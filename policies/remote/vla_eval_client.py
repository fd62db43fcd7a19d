"""The policy that runs behind vla-eval's websocket protocol (github.com/allenai/vla-evaluation-harness).

Both sides greet, then every message carries a number that its answer repeats. A server of that harness answers a query
with one action and keeps the rest of its chunk; ours gives whole chunks, since our greeting says that we take them.
"""

from __future__ import annotations

import time

import numpy as np

from arena_newton.pictures.camera import CameraConfig
from arena_newton.policies.base import Json
from arena_newton.policies.protocols import vla_eval_codec
from arena_newton.policies.protocols.handshake import ServedFacts
from arena_newton.policies.protocols.policy_messages import Begin, End
from arena_newton.policies.protocols.vla_eval_codec import VlaEvalMessage
from arena_newton.policies.remote.link import RemoteError, episode_lost
from arena_newton.policies.remote.websocket import SocketClient, SocketLink, SocketRequest

__all__ = ["VlaEvalPolicy", "make"]


class VlaEvalLink(SocketLink):
    """One websocket of vla-eval's protocol, which is one session of its server."""

    sessions = True

    def __init__(self, owner: VlaEvalPolicy):
        """Take the policy whose server it is."""
        super().__init__(owner)
        self.seq = 0

    def greet(self, end: float) -> ServedFacts:
        """Say hello and read what the server answers."""
        self.seq = 1
        self.send(vla_eval_codec.pack_hello(None, self.seq, time.time()))
        message = self._message(end)
        if message.type == "error":
            vla_eval_codec.unpack_action(message, self.seq, self.url)
        facts, _ = vla_eval_codec.unpack_hello(message, self.url)
        return facts

    def begin(self, begin: Begin, end: float) -> object:
        """Begin an episode; nobody answers that, and an error is reported with the first query."""
        if self.begun:
            self._number()
            self.send(vla_eval_codec.pack_request(End(begin.session), self.seq, time.time()))
        self._number()
        self.send(vla_eval_codec.pack_request(begin, self.seq, time.time()))
        return None

    def query(self, request: SocketRequest, end: float) -> object:
        """Show what a world sees; the message that answers, and the number that it must repeat."""
        if request.message is not None:
            self._number()
            self.send(vla_eval_codec.pack_request(request.message, self.seq, time.time()))
        answer, seq = self._message(end), self.seq
        if answer.seq != seq:  # what was sent for this query would answer the next one
            self.close()
        return answer, seq

    def unasked(self, frame: bytes | str) -> object:
        """Fault at the beginning of the episode, which arrives as the answer to its first query."""
        message = vla_eval_codec.unpack_message(frame)
        return (message, message.seq) if message.type == "error" else None

    def _number(self) -> None:
        self.seq += 1

    def _message(self, end: float) -> VlaEvalMessage:
        return vla_eval_codec.unpack_message(self.receive(end))


class VlaEvalPolicy(SocketClient):
    """Asks a server of vla-eval's protocol."""

    described = "a policy server of vla-eval's protocol"
    camera = CameraConfig()
    """224×224 with black bars."""

    def check(self) -> None:
        """Reach the server, compare what it declares, and try it where it does not declare its actions.

        Raises:
            InputError: No server of the protocol answers, or not one for this robot.
        """
        facts = self.greet()
        self.take(facts)
        self.batched = False  # a connection is one session
        self.assume()
        if facts.action_names is None:
            self.probe()

    def describe(self) -> Json:
        """See `RemoteClient.describe`."""
        return super().describe() | {"protocol": "vla-eval"}

    def _connect(self) -> VlaEvalLink:
        return VlaEvalLink(self)

    def _read(self, kind: str, reply: object) -> object:
        if not isinstance(reply, tuple):
            return reply
        message, seq = reply
        if isinstance(message, VlaEvalMessage) and message.type == "error":
            declared = self.one_line(message.payload.get("error", "nothing"))
            raise RemoteError(f"{self.url}{kind}: the server says {declared}", lost=episode_lost(declared))
        return message, seq

    def _rows(self, content: object) -> np.ndarray:
        match content:
            case (VlaEvalMessage() as message, int() as seq):
                return vla_eval_codec.unpack_action(message, seq, self.url + self.infer_kind)
        raise RemoteError(f"{self.url}{self.infer_kind}: no message")


def make(url: str, **options: object) -> VlaEvalPolicy:
    """The policy of an address; `remote.from_spec` calls this."""
    return VlaEvalPolicy(url, **options)  # type: ignore[arg-type]  # the command line's own keywords
