"""TCP ports of this machine, checked before anything heavy is loaded."""

from __future__ import annotations

import errno
import ipaddress
import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

from arena_newton.errors import InputError

__all__ = ["LOCAL", "bind", "is_local", "names_this_machine"]

LOCAL = "127.0.0.1"
"""The address that is served where no other is asked for: this machine's own."""


def bind(port: int, flag: str, host: str = LOCAL) -> socket.socket:
    """A listening socket of this machine.

    Args:
        port: TCP port; 0 takes a free one.
        flag: What the message names.

    Raises:
        InputError: The port is taken or not allowed.
    """
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError, TypeError, UnicodeError) as error:
        number = error.errno if isinstance(error, OSError) else None
        unnamed = isinstance(error, TypeError | UnicodeError)  # a name that no address can have
        if unnamed or number == errno.EADDRNOTAVAIL or (number is not None and number < 0):  # below 0: looking it up
            raise InputError(f"--host {host}: no address of this machine") from None
        reason = error.strerror if isinstance(error, OSError) else "no such port"
        raise InputError(f"{flag} {port}: cannot be served at {host} ({reason}); name another port") from None


def is_local(name: str) -> bool:
    """An address or name is this machine's own and no other machine's."""
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return name == "localhost"


def names_this_machine(hosts: Sequence[str]) -> bool:
    """A request was sent to this machine by its own name.

    A browser sends the name of the web site, also where that name has been made to point here.

    Args:
        hosts: All headers `Host` of the request.
    """
    try:
        return len(hosts) == 1 and is_local(urlsplit(f"//{hosts[0]}").hostname or "")
    except ValueError:
        return False
