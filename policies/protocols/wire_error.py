"""The error of every codec of policy servers, in a module that needs no other library."""

from __future__ import annotations

from arena_newton.errors import ArenaError

__all__ = ["WireError"]


class WireError(ArenaError):
    """Bytes that came from elsewhere are not a message of the protocol; one line says why."""
