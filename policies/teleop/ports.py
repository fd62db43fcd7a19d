"""TCP ports of this machine, checked before anything heavy is loaded."""

from __future__ import annotations

import socket

from arena_newton.errors import InputError

__all__ = ["LOCAL", "bind"]

LOCAL = "127.0.0.1"
"""The only address that is served."""


def bind(port: int, flag: str) -> socket.socket:
    """A listening socket of this machine.

    Args:
        port: TCP port; 0 takes a free one.
        flag: What the message names.

    Raises:
        InputError: The port is taken or not allowed.
    """
    try:
        return socket.create_server((LOCAL, port))
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no such port"
        raise InputError(f"{flag} {port}: cannot be served at {LOCAL} ({reason}); name another port") from None
