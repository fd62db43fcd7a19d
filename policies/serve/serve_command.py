"""The work of ``policies serve``: make the policy, open an endpoint, report at the end."""

from __future__ import annotations

import contextlib
import ctypes
import ssl
import threading
from collections.abc import Callable
from pathlib import Path

import torch

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.physics.devices import torch_device
from arena_newton.policies.base import Policy, get
from arena_newton.policies.label_reader import read_by
from arena_newton.policies.protocols.ports import bind, is_local
from arena_newton.policies.remote.address import ServerAddress
from arena_newton.policies.serve.connection_guard import ACCESS_TOKEN_VARIABLE, ConnectionGuard
from arena_newton.policies.serve.http_endpoint import HttpEndpoint
from arena_newton.policies.serve.policy_server import PolicyServer
from arena_newton.policies.serve.serve_options import ServeOptions
from arena_newton.policies.serve.websocket_endpoint import WebsocketEndpoint

__all__ = ["make_policy", "make_tls", "open_endpoint", "serve_policy"]

type Say = Callable[[str], None]

USUAL_TASK = "boxing"
"""Task of the first query, where neither the flags nor the policy ask for another."""

M_MMAP_THRESHOLD, LARGE_BUFFER = -3, 2**20
"""Option of glibc's `mallopt`, and the size of buffers that get memory of their own [bytes]."""
SPARE_CONNECTIONS = 8
"""Connections beyond the sessions: for questions, and for those that come before an old one has ended."""


def serve_policy(options: ServeOptions, say: Say | None = None, stop: threading.Event | None = None) -> int:
    """Serve until Ctrl-C.

    Args:
        say: Takes the lines of the console; they are printed by default.
        stop: Ends the server, too.

    Returns:
        Exit code 0.

    Raises:
        InputError: A flag is wrong, or the policy cannot be served.
    """
    say = say or (lambda line: print(line, flush=True))
    guard = ConnectionGuard(options.max_sessions + SPARE_CONNECTIONS, local=is_local(options.host))
    tls = make_tls(options)
    if options.task is not None:
        tasks.get(options.task)
    device = torch_device(options.device)
    policy = make_policy(options, device)
    server = PolicyServer(
        policy,
        max_batch_size=options.max_batch_size,
        max_wait=options.max_wait,
        max_sessions=options.max_sessions,
        tracker=options.tracker,
        device=device,
    )
    try:
        server.start(_first_task(policy) if options.task is None else options.task)
        endpoint = open_endpoint(server, options, guard, tls)
        try:
            with contextlib.suppress(KeyboardInterrupt):
                for line in _greeting(server, options, guard, endpoint.port):
                    say(line)
                (stop or threading.Event()).wait()
        finally:
            endpoint.close()
    finally:
        server.close()
    for line in server.counts.summary():
        say(line)
    return 0


def _first_task(policy: Policy) -> str:
    """A task that the policy does, Boxing where it may be."""
    for task in sorted(tasks.names(), key=lambda name: name != USUAL_TASK):
        with contextlib.suppress(InputError):
            policy.check_task(task)
            return task
    return USUAL_TASK


def make_policy(options: ServeOptions, device: torch.device) -> Policy:
    """The policy that is served, decoded to v3.1 unless its own labels are wanted.

    Raises:
        InputError: There is no such policy, or its labels are others than the stated ones.
    """
    more = {"replan": options.replan, "ensemble": options.ensemble, "device": str(device)}
    policy = get(options.policy, **more if options.policy.partition(":")[0] == "lerobot" else {})
    labels = options.labels or getattr(policy, "labels", None) or "v3.1"
    decoded = read_by(policy, labels)
    if not options.raw_labels:
        if policy.labels is None and decoded is policy:
            policy.labels = "v3.1"
        return decoded
    policy.labels = labels
    return policy


def open_endpoint(
    server: PolicyServer, options: ServeOptions, guard: ConnectionGuard, tls: ssl.SSLContext | None = None
) -> HttpEndpoint | WebsocketEndpoint:
    """Listen at the port of the flags.

    Raises:
        InputError: The port is taken.
    """
    listening = bind(options.port, "--port", options.host)
    # glibc keeps large buffers that were freed for the thread that had them: with a picture in each of 30 threads half
    # a gigabyte. From this size on they go back at once.
    with contextlib.suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGE_BUFFER)
    match options.protocol:
        case "arena":
            return HttpEndpoint(server, listening, guard, tls)
        case "openpi" | "roboarena" | "vla-eval" as protocol:
            return WebsocketEndpoint(server, listening, protocol, guard, tls)
    raise InputError(f"--protocol {options.protocol}: unknown")


def make_tls(options: ServeOptions) -> ssl.SSLContext | None:
    """Context of `--tls-cert` and `--tls-key`; None without them.

    It sends no session tickets after the handshake: a client that reads and writes in two threads, as those of
    websockets do, can lose its request when one arrives while it sends.

    Raises:
        InputError: A file that cannot be used.
    """
    if options.tls_cert is None or options.tls_key is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.num_tickets = 0  # a ticket that a client's thread reads while another sends can lose what it sends

    def asked() -> str:  # a server that nobody watches cannot be asked on its terminal
        raise InputError(f"--tls-key {options.tls_key}: has a pass phrase, expected a key without one")

    try:
        certificate, key = (Path(name).expanduser() for name in (options.tls_cert, options.tls_key))
        context.load_cert_chain(certificate, key, asked)
    except (OSError, ssl.SSLError) as error:
        reason = "not a certificate with its key" if isinstance(error, ssl.SSLError) else error.strerror
        raise InputError(f"--tls-cert {options.tls_cert}, --tls-key {options.tls_key}: {reason}") from None
    return context


def _greeting(server: PolicyServer, options: ServeOptions, guard: ConnectionGuard, port: int) -> list[str]:
    """Lines for the console: the policy, its address and who may connect."""
    facts = server.facts
    kind = "http" if options.protocol == "arena" else "ws"
    scheme = kind + ("s" if options.tls_cert else "")
    address = ServerAddress(options.protocol, scheme, options.host, port, "").place
    picture = "no picture"
    shown = facts.cameras or ({} if facts.picture is None else {"": facts.picture})
    if shown:
        sizes = [f"{f'{name} ' if name else ''}{one.width}x{one.height} ({one.fit})" for name, one in shown.items()]
        picture = f"pictures of {', '.join(sizes)}"
    lines = [
        f"policy {facts.policy}: chunks of {facts.chunk_length} actions of {facts.labels} at {facts.rate_hz:g} Hz, "
        f"{picture}",
        f"{options.protocol} at {scheme}://{address}, up to {options.max_sessions} episodes at once on "
        f"{server.device}; Ctrl-C ends",
    ]
    asked = f"{options.protocol}+wss" if options.tls_cert else options.protocol
    lines.append(f"eval asks it by --policy remote:{scheme if kind == 'http' else asked}://{address}")
    if not guard.wants_token and not is_local(options.host):
        lines.append(f"warning: whoever reaches {address} can ask; set {ACCESS_TOKEN_VARIABLE} to a token")
    return lines
