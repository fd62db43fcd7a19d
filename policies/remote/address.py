"""Addresses and tokens of policy servers in `--policy remote:<url>`, and text of a server that is safe to print."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from urllib.parse import urlsplit

from arena_newton.errors import InputError

__all__ = [
    "PREFIXES",
    "TOKEN_VARIABLE",
    "ServerAddress",
    "cause",
    "one_line",
    "read_address",
    "read_token",
]

TOKEN_VARIABLE = "ARENA_POLICY_TOKEN"
"""Environment variable with the token that is sent as `Authorization: Bearer`; it is neither printed nor stored."""
PREFIXES: dict[str, tuple[str, str, int]] = {
    "http": ("arena", "http", 80),
    "https": ("arena", "https", 443),
    "ws": ("openpi", "ws", 80),
    "wss": ("openpi", "wss", 443),
    "openpi": ("openpi", "ws", 8000),
    "openpi+ws": ("openpi", "ws", 8000),
    "openpi+wss": ("openpi", "wss", 443),
    "roboarena": ("roboarena", "ws", 8000),
    "roboarena+ws": ("roboarena", "ws", 8000),
    "roboarena+wss": ("roboarena", "wss", 443),
    "vla-eval": ("vla-eval", "ws", 8000),
    "vla-eval+ws": ("vla-eval", "ws", 8000),
    "vla-eval+wss": ("vla-eval", "wss", 443),
    "simple": ("simple", "http", 22085),
    "simple+http": ("simple", "http", 22085),
    "simple+https": ("simple", "https", 443),
    "gr00t": ("gr00t", "tcp", 5555),
    "gr00t+tcp": ("gr00t", "tcp", 5555),
}
"""Prefix before `://` → protocol, transport and usual port. A web address has its scheme's, the others have the default
of the servers themselves (openpi, RoboArena and vla-eval 8000, SIMPLE 22085, GR00T 5555)."""
_ESCAPES = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)?|.)?", re.DOTALL)
"""Commands to a terminal (ECMA-48: CSI and OSC sequences, and ESC with one more)."""


@dataclass(frozen=True)
class ServerAddress:
    """An address of a policy server, taken apart."""

    protocol: str
    """`arena`, `openpi`, `roboarena`, `vla-eval`, `simple` or `gr00t`."""
    transport: str
    """`http`, `https`, `ws`, `wss` or `tcp`."""
    host: str
    port: int
    path: str
    """Path in front of the protocol's own routes, without a slash at its end."""

    @property
    def secure(self) -> bool:
        """True if the connection is encrypted."""
        return self.transport in ("https", "wss")

    @property
    def place(self) -> str:
        """Host and port as they stand in an address."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"

    @property
    def url(self) -> str:
        """The address as a library of the transport reads it."""
        return f"{self.transport}://{self.place}{self.path}"


def read_address(url: str) -> ServerAddress:
    """Take an address apart.

    Raises:
        InputError: It is none, of a protocol that is not known, or may hold a secret, which is not printed then.
    """
    if "@" in url:
        raise InputError(
            "--policy remote: the address holds a user name or a password (an @), which results would publish; "
            f"give a token in the environment variable {TOKEN_VARIABLE} instead"
        )
    shown = one_line(re.split(r"[?#]", url)[0])
    if any(c <= " " or c == "\x7f" for c in url):
        raise InputError(f"--policy remote:{shown}: the address holds white space or control characters")
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise InputError(f"--policy remote:{shown}: not an address ({one_line(error)})") from None
    if "://" in url and parts.scheme and parts.scheme not in PREFIXES:
        known = ", ".join(f"{prefix}://" for prefix in PREFIXES if "+" not in prefix)
        raise InputError(f"--policy remote:{shown}: unknown protocol {parts.scheme}://, choose from {known}")
    if parts.scheme not in PREFIXES or not parts.hostname or parts.query or parts.fragment or port == 0:
        raise InputError(
            f"--policy remote:{shown}: expected http://host:port, https://, ws:// or another known protocol, and "
            "nothing more"
        )
    spoken, transport, usual = PREFIXES[parts.scheme]
    if transport == "tcp" and parts.path.strip("/"):
        raise InputError(f"--policy remote:{shown}: expected {parts.scheme}://host:port and nothing more")
    return ServerAddress(spoken, transport, parts.hostname, port or usual, parts.path.rstrip("/"))


def read_token() -> str:
    """The token of the environment, or an empty text; one that no HTTP header can carry is refused and not printed.

    Raises:
        InputError: It has a character that no token has.
    """
    token = os.environ.get(TOKEN_VARIABLE, "")
    if not re.fullmatch(r"[!-~]*", token):
        raise InputError(f"{TOKEN_VARIABLE}: holds a space, a line end or another character that no token has")
    return token


def one_line(text: object) -> str:
    """Printable characters of a text that came from elsewhere, at most 200, on one line."""
    plain = _ESCAPES.sub("", str(text)[:4000])
    return " ".join("".join(c if c.isprintable() else " " for c in plain).split())[:200]


def cause(error: BaseException) -> str:
    """Cause of a failure, on one line."""
    return one_line(getattr(error, "strerror", None) or str(error) or type(error).__name__)
