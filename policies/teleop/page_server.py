"""The page's own small server: three files and one socket, for this machine and for who knows the token.

A web site that a person has open in another tab can send requests to 127.0.0.1 too: page and socket need the token of
the address, and the socket also the page's own `Origin`. What is held comes in through the socket, state and pictures
go back; a slow or stalled browser is given the newest of both and never makes the world wait.
"""

from __future__ import annotations

import contextlib
import http
import json
import secrets
import socket
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection
from websockets.typing import Origin

from arena_newton.errors import InputError
from arena_newton.policies.protocols.ports import LOCAL, names_this_machine
from arena_newton.policies.serve.connection_guard import ConnectionGuard, same_token
from arena_newton.policies.serve.websocket_listener import WebsocketListener, part
from arena_newton.policies.teleop.driving import Held, read_held

__all__ = ["PageServer", "new_token"]

FILES = {
    "": ("page.html", "text/html; charset=utf-8"),
    "page.css": ("page.css", "text/css; charset=utf-8"),
    "page.js": ("page.js", "text/javascript; charset=utf-8"),
}
"""Path after the token → file of the folder `page` and its type."""
FOLDER = Path(__file__).resolve().parent / "page"
"""Files of the page."""
SOCKET = "socket"
"""Path of the socket after the token."""
LONGEST_MESSAGE = 4096
"""Bytes of a message from the page."""
STATUS_PERIOD = 0.1
"""Time between two messages of state to the page [s]."""
JPEG_QUALITY = 80
"""Quality of the head camera's pictures, in percent."""
PAGES = 8
"""Most pages at once, all but one of which have been taken over."""
PONG_SECONDS = 20.0
"""Time that a page has to answer a ping [s]."""
TAKEN_OVER, UNFIT = 4001, 1008
"""Codes with which a socket is closed: another page drives now, a message cannot be read."""


def new_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(16)


class PageServer:
    """Serves the page, keeps what is held, and sends back what is to be seen."""

    def __init__(self, listening: socket.socket, token: str, facts: Mapping[str, object], frame: str | None = None):
        """Begin to serve.

        Args:
            listening: The port, from `ports.bind`; it belongs to the server from now on.
            token: What every address must name; `new_token` makes one.
            facts: Facts that the page gets once, as JSON.
            frame: Address of the page that shows the world; None: none.
        """
        self._token = token
        self.port = int(listening.getsockname()[1])
        self._facts = {"kind": "facts", **facts, "frame": frame}
        hosts = [f"{name}:{self.port}" for name in (LOCAL, "localhost")]
        origin = frame.split("/", 3)[:3] if frame else None
        frames = "/".join(origin) if origin else "'none'"
        self._policy = (
            f"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
            f"connect-src {' '.join(f'ws://{host}' for host in hosts)}; frame-src {frames}; frame-ancestors 'none'; "
            "base-uri 'none'; form-action 'none'"
        )
        self._lock = threading.Condition()
        self._held = Held()
        self._held_at = -float("inf")
        self._events: list[str] = []
        self._driver: ServerConnection | None = None
        self._status: dict[str, object] = {}
        self._image: np.ndarray | None = None
        self._closed = False
        self._listener = WebsocketListener(
            listening,
            ConnectionGuard(PAGES, ""),
            self._connected,
            self._answer,
            origins=[Origin(f"http://{host}") for host in hosts],
            longest=LONGEST_MESSAGE,
            pong_seconds=PONG_SECONDS,
        )

    @property
    def url(self) -> str:
        """Address of the page with its token."""
        return f"http://{LOCAL}:{self.port}/{self._token}/"

    @property
    def connected(self) -> bool:
        """True if a page drives."""
        with self._lock:
            return self._driver is not None

    def held(self) -> tuple[Held, float]:
        """Controls held now, and the age of the message with them [s]; infinite without a page."""
        with self._lock:
            return self._held, time.monotonic() - self._held_at

    def events(self) -> list[str]:
        """Events requested since the last call."""
        with self._lock:
            events, self._events = self._events, []
        return events

    def publish(self, status: Mapping[str, object], image: np.ndarray | None) -> None:
        """Give the page state and picture; neither waits for it.

        Args:
            status: JSON.
            image: Head camera, uint8, shape [H, W, 3], not changed afterwards; None: none yet.
        """
        with self._lock:
            self._status, self._image = dict(status), image
            self._lock.notify_all()

    def close(self) -> None:
        """End server and connections."""
        with self._lock:
            self._closed, self._driver = True, None
            self._lock.notify_all()
        self._listener.close("the session is over")

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """A file; None lets the socket's handshake go on; whatever does not name the token gets nothing."""
        token, _, path = request.path.partition("?")[0].removeprefix("/").partition("/")
        if not same_token(token, self._token) or not names_this_machine(request.headers.get_all("Host")):
            return _response(http.HTTPStatus.NOT_FOUND, b"", "text/plain")
        if path == SOCKET:
            return None
        if path not in FILES:
            return _response(http.HTTPStatus.NOT_FOUND, b"", "text/plain")
        name, kind = FILES[path]
        body = (FOLDER / name).read_bytes()
        return _response(http.HTTPStatus.OK, body, kind, {"Content-Security-Policy": self._policy})

    def _connected(self, connection: ServerConnection) -> None:
        """Receive what a page holds until it leaves, or another one takes over."""
        with self._lock:
            before, self._driver = self._driver, connection
            self._held, self._held_at = Held(), -float("inf")
            self._lock.notify_all()
        if before is not None:  # which may have stopped reading
            farewell = [before], TAKEN_OVER, "another page drives now"
            threading.Thread(target=part, args=farewell, name="teleop farewell", daemon=True).start()
        sender = threading.Thread(target=self._send, args=[connection], name="teleop sender", daemon=True)
        sender.start()
        try:
            for message in connection:
                self._take(connection, read_held(message))
        except InputError as error:
            connection.close(UNFIT, str(error)[:120])
        except ConnectionClosed:
            pass
        finally:
            with self._lock:
                if self._driver is connection:
                    self._driver, self._held_at = None, -float("inf")
                self._lock.notify_all()
            sender.join(timeout=2.0)

    def _take(self, connection: ServerConnection, held: Held) -> None:
        with self._lock:
            if self._driver is connection:
                self._held, self._held_at = replace(held, events=()), time.monotonic()
                self._events += held.events

    def _send(self, connection: ServerConnection) -> None:
        """Send the newest state ten times a second, and each new picture once."""
        shown: np.ndarray | None = None

        def mine() -> bool:
            return self._driver is connection and not self._closed

        with contextlib.suppress(OSError, ConnectionClosed):
            connection.send(json.dumps(self._facts))
            while True:
                with self._lock:
                    self._lock.wait_for(lambda: not mine() or bool(self._status), timeout=1.0)
                    if not mine():
                        return
                    status, image = dict(self._status), self._image
                if status:
                    connection.send(json.dumps({"kind": "state", **status}))
                if image is not None and image is not shown:
                    connection.send(_jpeg(image))
                    shown = image
                time.sleep(STATUS_PERIOD)


def _jpeg(image: np.ndarray) -> bytes:
    """A picture [H, W, 3], red first, as JPEG."""
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(data)


def _response(status: http.HTTPStatus, body: bytes, kind: str, more: Mapping[str, str] | None = None) -> Response:
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            **(more or {}),
        }
    )
    return Response(status.value, status.phrase, headers, body)
