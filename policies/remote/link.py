"""One connection to a policy server: a deadline for each request, repeated attempts, and what went wrong."""

from __future__ import annotations

import socket
import time
from typing import ClassVar

from arena_newton.errors import ArenaError
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.remote.address import cause

__all__ = ["AskAgain", "RemoteError", "ServerLink", "episode_lost"]

NOT_KNOWN = ("episode that the server does not know", "unknown episode", "the server is closing")
"""Messages of our servers that cannot continue a running episode, which is no fault of the episode."""


class RemoteError(ArenaError):
    """One request got no usable reply; the message names the address and what is wrong."""

    def __init__(self, message: str, *, silent: bool = False, lost: bool = False):
        """Say what is wrong.

        Args:
            message: One line.
            silent: There was no whole reply, or it was a gateway's.
            lost: The server no longer knows the episode that is running.
        """
        super().__init__(message)
        self.silent = silent
        self.lost = lost


class AskAgain(Exception):
    """An exchange failed in a way that may pass; the text says how."""


class ServerLink[Q, R]:
    """One connection to a server, of one world; `abort` may be called from another thread."""

    transient: ClassVar[tuple[type[Exception], ...]] = (AskAgain, ConnectionError, socket.gaierror)
    """Errors that a repeated attempt may cure."""
    final: ClassVar[tuple[type[Exception], ...]] = (OSError, ValueError)
    """Errors that it does not cure."""
    gone: ClassVar[tuple[type[Exception], ...]] = (OSError, AskAgain)
    """Errors of an absent server."""

    def __init__(self, url: str):
        """Name the server; nothing is sent yet."""
        self.url = url
        self.aborted = False
        self.busy = False

    def ask(self, kind: str, request: Q, *, timeout: float, retries: int, backoff: float) -> R:
        """Send a request and return its reply.

        Args:
            kind: What is asked, as errors name it behind the address.
            timeout: Deadline of all attempts together [s].
            backoff: Pause before the first of them [s]; it doubles each time.

        Raises:
            RemoteError: No whole reply in that time and number of attempts.
        """
        self.aborted, self.busy = False, True
        try:
            return self._attempts(kind, request, timeout, retries, backoff)
        finally:
            self.busy = False

    def _attempts(self, kind: str, request: Q, timeout: float, retries: int, backoff: float) -> R:
        end, where = time.monotonic() + timeout, self.url + kind
        for attempt in range(retries + 1):
            try:
                reply = self.exchange(kind, request, end)
                reason = self.busy_signal(reply)
                if not reason or attempt == retries:
                    return reply
            except TimeoutError as error:
                self.close()
                raise RemoteError(f"{where}: no reply within {timeout:g} s", silent=True) from error
            except self.transient as error:
                self.close()
                reason = cause(error)
            except self.final as error:
                self.close()
                if self.aborted:
                    raise RemoteError(f"{where}: no reply within {timeout:g} s", silent=True) from error
                raise RemoteError(f"{where}: {cause(error)}", silent=True) from error
            pause = backoff * 2**attempt
            if self.aborted or time.monotonic() + pause >= end:
                raise RemoteError(f"{where}: no reply within {timeout:g} s, last: {reason}", silent=True)
            if attempt < retries:
                time.sleep(pause)
        raise RemoteError(f"{where}: {reason} (tried {retries + 1} times)", silent=True)

    def exchange(self, kind: str, request: Q, end: float) -> R:
        """One attempt, until `end` of the monotonic clock [s]; connects where there is no connection."""
        raise TypeError(f"{type(self).__name__} defines no exchange()")

    def busy_signal(self, reply: R) -> str:
        """Reason to send the same request again later; an empty text where the reply is an answer."""
        return ""

    def probe(self, end: float) -> object:
        """Ask something that changes nothing, until `end` of the monotonic clock [s]."""
        raise TypeError(f"{type(self).__name__} defines no probe()")

    def alive(self, timeout: float) -> bool:
        """True if the server answers a request that changes nothing; one that answers something else is there, too."""
        try:
            self.probe(time.monotonic() + timeout)
        except self.gone:
            return False
        except (ValueError, WireError):
            return True
        finally:
            self.close()
        return True

    def abort(self) -> None:
        """Break off the exchange that another thread waits for, or close an idle connection."""
        raise TypeError(f"{type(self).__name__} defines no abort()")

    def close(self) -> None:
        """Close the connection; the next exchange opens a new one."""
        raise TypeError(f"{type(self).__name__} defines no close()")


def episode_lost(message: str) -> bool:
    """True if a server reports that it no longer knows the episode that is running, or is about to forget it."""
    return any(text in message for text in NOT_KNOWN)
