"""Connection guard of all protocols: the token, no browsers, and how many connections there may be."""

from __future__ import annotations

import hmac
import os
import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from arena_newton.errors import InputError
from arena_newton.policies.protocols.ports import names_this_machine

__all__ = ["ACCESS_TOKEN_VARIABLE", "HEALTH_PATHS", "STRANGER_SECONDS", "ConnectionGuard", "same_token"]

ACCESS_TOKEN_VARIABLE = "ARENA_POLICY_TOKEN"
"""Environment variable with the token that clients must send; the same of which clients take theirs."""
STRANGERS = 64
"""Connections that have not identified themselves yet, at once; more are closed unread."""
STRANGER_SECONDS = 10.0
"""Time that a connection has to say who it is [s]."""
HEALTH_PATHS = ("/healthz", "/health")
"""Routes that answer without a token: whether the server is there, and nothing else."""
_SCHEMES = ("bearer", "api-key")
"""Words in front of a token; the second is that of openpi's client."""


class ConnectionGuard:
    """Decides about connections and requests."""

    def __init__(self, connections: int, token: str | None = None, *, local: bool = False):
        """Take the number of connections at once and the token.

        Args:
            connections: Most at once.
            token: What clients must send as `Authorization: Bearer`; empty for none, the environment's by default.
            local: The address is this machine's own: without a token, requests must name it so.

        Raises:
            InputError: A token that no HTTP header can carry; it is not printed.
        """
        self._token = os.environ.get(ACCESS_TOKEN_VARIABLE, "") if token is None else token
        if not re.fullmatch(r"[!-~]*", self._token):
            raise InputError(
                f"{ACCESS_TOKEN_VARIABLE}: holds a space, a line end or another character that no token has"
            )
        self.connections, self._local = connections, local
        self._inside = self._arrived = 0
        self._lock = threading.Lock()

    @property
    def wants_token(self) -> bool:
        """True if clients must send one."""
        return bool(self._token)

    def refusal(
        self, path: str, authorization: str | None, origin: str | None, hosts: Sequence[str]
    ) -> tuple[int, str] | None:
        """Status and sentence for a request that is not let in; None for one that is.

        Args:
            path: Its route.
            authorization: Its header of that name.
            origin: Its header of that name, which browsers send: no page of a web site may ask a policy.
            hosts: Its headers `Host`; browsers send one.
        """
        if origin is not None:
            return 403, "requests of browsers are not answered"
        if self._local and not self._token and hosts and not names_this_machine(hosts):
            return 403, "Host is another name than this machine's own (127.0.0.1, localhost)"
        if not self._token or path in HEALTH_PATHS:
            return None
        scheme, _, given = (authorization or "").partition(" ")
        if scheme.lower() in _SCHEMES and same_token(given.strip(), self._token):
            return None
        return 401, "the token is missing or wrong (Authorization: Bearer)"

    @property
    def full(self) -> bool:
        """True if no further connection is allowed."""
        return self._inside >= self.connections

    def arrives(self) -> bool:
        """Count a connection from its first moment; False where there are too many, which is not counted."""
        with self._lock:
            room = self._arrived < self.connections + STRANGERS
            self._arrived += room
        return room

    def leaves(self) -> None:
        """A connection that had arrived is over."""
        with self._lock:
            self._arrived -= 1

    @contextmanager
    def inside(self) -> Iterator[bool]:
        """Count a connection while it lasts; yields whether there is room for it."""
        with self._lock:
            room = self._inside < self.connections
            self._inside += room
        try:
            yield room
        finally:
            with self._lock:
                self._inside -= room


def same_token(given: str, token: str) -> bool:
    """Compare a token, which may be bytes that are no text, in a time that says nothing of it."""
    return hmac.compare_digest(*(text.encode(errors="surrogateescape") for text in (given, token)))
