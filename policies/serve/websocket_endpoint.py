"""Endpoints of openpi, RoboArena and vla-eval: websockets, a thread for each connection, which is a robot or several.

Next to the socket every endpoint answers `GET /healthz`, `/health` and `/config`. A frame that is not a message gets
one line back and never a traceback.
"""

from __future__ import annotations

import http
import itertools
import socket
import ssl
import sys
import time
import traceback
from collections import deque
from functools import partial
from typing import Literal

import numpy as np
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response
from websockets.sync.server import ServerConnection

from arena_newton.errors import ArenaError
from arena_newton.files.text import plain_text
from arena_newton.policies.protocols import openpi_codec, vla_eval_codec
from arena_newton.policies.protocols.arena_codec import pack_config, pack_failure
from arena_newton.policies.protocols.policy_messages import Begin, End, Query
from arena_newton.policies.protocols.raw_arrays import MAX_FRAME
from arena_newton.policies.serve.connection_guard import HEALTH_PATHS, ConnectionGuard
from arena_newton.policies.serve.policy_server import PolicyServer
from arena_newton.policies.serve.websocket_listener import WebsocketListener, dismiss

__all__ = ["WebsocketEndpoint", "WebsocketProtocol"]

type WebsocketProtocol = Literal["openpi", "roboarena", "vla-eval"]
"""Protocol on the connection; `roboarena` is openpi with that benchmark's own metadata and nothing else in it."""

PONG_SECONDS = 300.0
"""Time that a client has to answer a ping: compiling kernels holds up a robot [s]."""
INTERNAL_ERROR, FULL = 1011, 1013
"""Codes with which a socket is closed: a request failed, as openpi's server does it; too many connections."""


class WebsocketEndpoint:
    """Listens, and translates between frames and the policy server."""

    def __init__(
        self,
        server: PolicyServer,
        listening: socket.socket,
        protocol: WebsocketProtocol,
        guard: ConnectionGuard,
        tls: ssl.SSLContext | None = None,
    ):
        """Begin to listen.

        Args:
            server: Answers; it has started.
            listening: The port, which belongs to the endpoint from now on.
            protocol: What is spoken.
            guard: Who may come in.
            tls: Certificate and key, for `wss`.
        """
        self.port = int(listening.getsockname()[1])
        self._policy, self._protocol, self._guard = server, protocol, guard
        self._numbers = itertools.count(1)
        self._listener = WebsocketListener(
            listening,
            guard,
            self._connected,
            self._answer_http,
            origins=[None],
            longest=MAX_FRAME,
            pong_seconds=PONG_SECONDS,
            tls=tls,
        )

    def close(self) -> None:
        """End the endpoint and its connections."""
        self._listener.close("the server is closing")

    def _answer_http(self, connection: ServerConnection, request: HttpRequest) -> Response | None:
        """A route; None lets the handshake of a socket go on."""
        path = request.path.partition("?")[0]
        headers = request.headers
        origin, authorization = (" ".join(headers.get_all(name)) or None for name in ("Origin", "Authorization"))
        refused = self._guard.refusal(path, authorization, origin, headers.get_all("Host"))
        if refused is not None:
            return _response(refused[0], pack_failure(refused[1]))
        if path == "/healthz":
            return _response(200, b"OK\n", "text/plain")
        if path in HEALTH_PATHS:
            return _response(200, b'{"status": "ok"}\n')
        if path == "/config":
            return _response(200, pack_config(self._policy.facts, {"protocol": self._protocol}))
        if self._guard.full:
            return _response(503, pack_failure(f"there are {self._guard.connections} connections already"))
        return None

    def _connected(self, connection: ServerConnection) -> None:
        """Serve a connection until it ends."""
        owner = f"socket {next(self._numbers)}"
        try:
            with self._guard.inside() as room:
                if not room:
                    dismiss(connection, FULL, "too many connections")
                elif self._protocol == "vla-eval":
                    self._serve_vla_eval(connection, owner)
                else:
                    self._serve_openpi(connection, owner)
        except (ConnectionClosed, OSError):
            pass  # the robot has left
        except Exception:
            print(traceback.format_exc(), file=sys.stderr, flush=True)
            dismiss(connection, INTERNAL_ERROR, "the server failed; its console says more")
        finally:
            self._policy.leave(owner)

    def _serve_openpi(self, connection: ServerConnection, owner: str) -> None:
        connection.send(openpi_codec.pack_metadata(self._policy.facts, roboarena=self._protocol == "roboarena"))
        total: float | None = None
        for data in connection:
            began = time.monotonic()
            try:
                request, roboarena = self._policy.read(len(data), partial(openpi_codec.unpack_request, data))
                del data  # its picture is unpacked
                if isinstance(request, Begin):
                    self._policy.begin(owner, request)
                    connection.send(openpi_codec.RESET_ANSWER)
                    continue
                answer = self._policy.query(owner, request)
                frame = openpi_codec.pack_answer(answer.actions, answer.infer_ms, total, roboarena=roboarena)
            except ArenaError as error:  # openpi's server says so in a text frame, too, and closes
                connection.send(plain_text(error, 300))
                dismiss(connection, INTERNAL_ERROR, "the request failed, as the last frame says")
                return
            connection.send(frame)
            total = 1000 * (time.monotonic() - began)

    def _serve_vla_eval(self, connection: ServerConnection, owner: str) -> None:
        whole = False
        kept: dict[str, deque[np.ndarray]] = {}
        """Actions of a robot that takes one at a time, by session."""
        for data in connection:
            seq = 0
            try:
                message = self._policy.read(len(data), partial(vla_eval_codec.unpack_message, data))
                del data  # its pictures are unpacked
                seq = message.seq
                if message.type == "hello":
                    _, whole = vla_eval_codec.unpack_hello(message, "hello")
                    connection.send(vla_eval_codec.pack_hello(self._policy.facts, seq, time.time()))
                    continue
                if message.type in ("error", "record"):
                    continue
                request = vla_eval_codec.unpack_request(message)
                if isinstance(request, Query):
                    rest = kept.pop(request.session, deque())
                    actions = self._actions(owner, request, rest, whole=whole)
                    if rest:
                        kept[request.session] = rest
                    connection.send(vla_eval_codec.pack_action(actions, seq, time.time()))
                    continue
                kept.pop(request.session, None)
                if isinstance(request, End):
                    self._policy.end(owner, request.session)
                else:
                    self._policy.begin(owner, request)  # answered only where it fails
            except ArenaError as error:
                connection.send(vla_eval_codec.pack_error(plain_text(error, 300), seq, time.time()))

    def _actions(self, owner: str, query: Query, kept: deque[np.ndarray], *, whole: bool) -> np.ndarray:
        """A chunk, or the next action of one, as a robot takes them."""
        if whole:
            return self._policy.query(owner, query).actions
        if not kept:
            kept.extend(self._policy.query(owner, query).actions)
        return kept.popleft()


def _response(status: int, body: bytes, kind: str = "application/json") -> Response:
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Connection": "close",
        }
    )
    return Response(status, http.HTTPStatus(status).phrase, headers, body)
