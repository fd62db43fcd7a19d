"""Flags of a policy server, as a user gives them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from arena_newton.cli.flags import Device
from arena_newton.errors import InputError
from arena_newton.policies.chunk_flags import ChunkFlags

__all__ = ["PROTOCOLS", "ServeOptions"]

PROTOCOLS = ("openpi", "roboarena", "vla-eval", "arena")
"""Values of `--protocol`."""
MOST_SESSIONS = 4096
"""Most rows of a policy."""


@dataclass(frozen=True)
class _Served:
    """Policy, and who may ask it."""

    policy: str = ""
    """Policy: stand, learned, lerobot:<checkpoint>, replay:<file>, another package's, or remote:<url> to pass on."""
    protocol: str = "openpi"
    """Protocol of the clients: openpi roboarena vla-eval arena (the original's HTTP)."""
    host: str = "127.0.0.1"
    """Address of this machine that is served; 0.0.0.0 lets others in, who then need ARENA_POLICY_TOKEN."""
    port: int = 8000
    """TCP port; 0 takes a free one and prints it."""
    max_batch_size: int = 16
    """Most queries in one call of the policy."""
    max_wait: float = 0.02
    """Longest wait of a batch's first query for others [s]."""
    max_sessions: int = 64
    """Most episodes at once: rows of the policy. Eight connections more are taken."""
    device: Device[str | None] = None
    task: str | None = None
    """Task of the query before the first one, by which everything is loaded and compiled; one that the policy does when
    none is named."""
    tracker: str = ""
    """Tracker of the robots, for a policy that is given its name; unknown by default: no protocol says it."""


@dataclass(frozen=True)
class ServeOptions(ChunkFlags, _Served):
    """Let a policy answer over the network."""

    raw_labels: bool = False
    """Give actions of v4 as they are and declare them so; otherwise they are decoded to v3.1."""
    tls_cert: str | None = None
    """Certificate chain (PEM), for https and wss."""
    tls_key: str | None = None
    """Key of the certificate (PEM)."""

    def check(self) -> None:
        """Validate what needs no library.

        Raises:
            InputError: A flag is unfit; the message names it.
        """
        if not self.policy:
            raise InputError("--policy: name a policy, such as lerobot:<checkpoint> or stand")
        if self.protocol not in PROTOCOLS:
            raise InputError(f"--protocol {self.protocol}: unknown, choose from {', '.join(PROTOCOLS)}")
        if not self.host:
            raise InputError("--host: is empty, expected an address of this machine; 0.0.0.0 is all of them")
        if not 0 <= self.port <= 65535:
            raise InputError(f"--port {self.port}: expected 0 to 65535")
        if not 1 <= self.max_sessions <= MOST_SESSIONS:
            raise InputError(f"--max-sessions {self.max_sessions}: expected 1 to {MOST_SESSIONS}")
        if not 1 <= self.max_batch_size <= MOST_SESSIONS:
            raise InputError(f"--max-batch-size {self.max_batch_size}: expected 1 to {MOST_SESSIONS}")
        if not (math.isfinite(self.max_wait) and 0.0 <= self.max_wait <= 60.0):
            raise InputError(f"--max-wait {self.max_wait:g}: expected seconds from 0 to 60")
        self.check_chunks(self.policy)
        if (self.tls_cert is None) != (self.tls_key is None):
            raise InputError("--tls-cert and --tls-key: name both or none")
