"""Flags of a policy server, as a user gives them."""

from __future__ import annotations

from dataclasses import dataclass, field

from arena_newton.cli.flags import Device, bounds, check_bounds
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
    port: int = field(default=8000, metadata=bounds(0, 65535))
    """TCP port; 0 takes a free one and prints it."""
    max_batch_size: int = field(default=16, metadata=bounds(1, MOST_SESSIONS))
    """Most queries in one call of the policy."""
    max_wait: float = field(default=0.02, metadata=bounds(0.0, 60.0))
    """Longest wait of a batch's first query for others [s]."""
    max_sessions: int = field(default=64, metadata=bounds(1, MOST_SESSIONS))
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
        check_bounds(self)
        self.check_chunks(self.policy)
        if (self.tls_cert is None) != (self.tls_key is None):
            raise InputError("--tls-cert and --tls-key: name both or none")
