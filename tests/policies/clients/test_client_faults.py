"""Servers that fail: only the world concerned ends as an error, nothing waits forever, a run stops where it must."""

import json
import socket
import threading
import time

import numpy as np
import pytest
from foreign_servers import Gr00tServer, HttpServer, SocketServer, asking, facts, observation
from websockets.exceptions import ConnectionClosedError

from arena_newton.errors import InputError
from arena_newton.policies import PolicyUnavailable
from arena_newton.policies.remote import websocket
from arena_newton.policies.remote.address import TOKEN_VARIABLE
from arena_newton.policies.remote.client import MAX_FAILURES
from tests.patience import PLENTY, patiently

pytestmark = pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")

SOCKETS = ("openpi", "roboarena", "vla-eval")


def started(protocol, **options):
    """A server that declares itself."""
    if protocol == "gr00t":
        return Gr00tServer(declared=facts(), **options)
    return SocketServer(protocol, facts(), config=facts(), **options)


def client(server, **options):
    """Its client, checked and with episodes begun in three worlds."""
    policy = asking(server.url, **({"timeout": PLENTY, "retries": 2, "backoff": 0.01} | options))
    policy.check()
    policy.reset([7, 8, 9], ["Isaac-Football"] * 3)
    while server.url.startswith("vla-eval") and sum(kind == "reset" for kind, _ in server.seen) < 3:
        time.sleep(0.005)  # it answers no beginning
    return policy


@pytest.fixture
def running(request):
    return started(request.param)


@pytest.mark.parametrize("running", SOCKETS, indirect=True)
@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("39", "[4, 39]"),
        ("nan", "(index 20) is nan, expected a finite number"),
        ("none", "[0, 40]"),
        ("long", "[4400, 40]"),
        ("words", "[1, 3], expected [n, 40]"),
        ("flat", "[1, 160], expected [n, 40]"),
        ("text", "the server says RuntimeError: CUDA out of memory"),
        ("garbage", "not MessagePack"),
        ("oversize", "longer than 4 MiB"),
    ],
)
def test_bad_answer_ends_one_world(running, kind, text):
    """A bad answer is one line that names the address, the others are served, and the next episode is a new one."""
    policy = client(running)
    running.behave = {1.0: kind}
    chunk = policy.act(observation(3))
    assert set(chunk.errors) == {1}
    assert text in chunk.errors[1] and running.url in chunk.errors[1] and "\n" not in chunk.errors[1]
    assert "Traceback" not in chunk.errors[1] and "line 7" not in chunk.errors[1]
    assert np.isfinite(chunk.actions).all()
    running.behave = {}
    policy.reset([7, 18, 9], ["Isaac-Football"] * 3, np.array([False, True, False]))
    assert policy.act(observation(3)).errors == {}


@pytest.mark.parametrize("running", ["vla-eval"], indirect=True)
@pytest.mark.parametrize(("kind", "text"), [("late", "the answer to query"), ("hello", "type hello, expected action")])
def test_answers_to_something_else(running, kind, text):
    """An answer to another query than the last one is refused."""
    policy = client(running)
    running.behave = {1.0: kind}
    chunk = policy.act(observation(3))
    assert set(chunk.errors) == {1} and text in chunk.errors[1]


@pytest.mark.parametrize("protocol", SOCKETS)
def test_frames_that_nobody_asked_for(protocol):
    """A second frame for one query is never taken for the answer to the next one."""

    def check(pause):
        server = started(protocol)
        policy = client(server)
        server.behave = {1.0: "twice"}
        first = policy.act(observation(3))
        server.behave = {}
        time.sleep(pause)  # the frame arrives
        if protocol == "openpi":  # it keeps no episode with the connection
            second = policy.act(observation(3))
            assert first.errors == second.errors == {} and (np.asarray(second.actions)[1] != 7).any()
        else:
            with pytest.raises(PolicyUnavailable, match="what the server knew of the running episode"):
                policy.act(observation(3))

    patiently(check, (0.1, 1.0, 10.0))


@pytest.mark.parametrize("protocol", [*SOCKETS, "gr00t"])
def test_deadline(protocol):
    """A server that hangs costs one deadline; where it serves others meanwhile, one world."""

    def check(deadline):
        server = started(protocol)
        policy = client(server)
        server.behave, policy.timeout = {1.0: "slow"}, deadline
        start = time.monotonic()
        if protocol == "gr00t":  # one request for all, and one server for all requests
            with pytest.raises(PolicyUnavailable, match=f"the server is gone: .*no reply within {deadline:g} s"):
                policy.act(observation(3))
        else:
            chunk = policy.act(observation(3))
            assert set(chunk.errors) == {1} and f"no reply within {deadline:g} s" in chunk.errors[1]
        assert time.monotonic() - start < 5 * deadline

    patiently(check)


@pytest.mark.parametrize("running", [*SOCKETS, "gr00t"], indirect=True)
def test_failed_reset_ends_its_world(running):
    """An episode whose beginning fails is an error at its first query, and the next one is not."""
    policy = client(running)
    running.behave = {"reset": True}
    policy.reset([1, 2, 3], ["Isaac-Football"] * 3, np.array([False, True, False]))
    chunk = policy.act(observation(3))
    running.behave = {}  # not before: vla-eval's server answers no beginning, and may read it late
    if running.url.startswith("openpi"):  # it has no beginning
        assert chunk.errors == {}
    else:
        assert set(chunk.errors) == {1} and "the server says" in chunk.errors[1]
    policy.reset([1, 2, 3], ["Isaac-Football"] * 3)
    assert policy.act(observation(3)).errors == {}


@pytest.mark.parametrize("protocol", [*SOCKETS, "gr00t"])
@pytest.mark.parametrize("how", ["in a batch", "between two"])
def test_killed_server_stops_the_run(protocol, how):
    """A server's death is no world's error: the run stops, and its episodes stay unplayed."""
    server = started(protocol)
    policy = client(server, retries=1)
    assert policy.act(observation(3)).errors == {}
    if how == "in a batch":
        server.behave = {1.0: "dies"}
    else:
        server.kill()
    start = time.monotonic()
    with pytest.raises(PolicyUnavailable, match="the server is gone"):
        policy.act(observation(3))
    assert time.monotonic() - start < PLENTY / 2
    with pytest.raises(PolicyUnavailable, match="the server is gone"):
        policy.reset([1, 2, 3], ["Isaac-Football"] * 3) if protocol != "openpi" else policy.act(observation(3))


@pytest.mark.parametrize("protocol", [*SOCKETS, "gr00t"])
def test_restarted_server(protocol):
    """After a restart a server that keeps nothing goes on; one that lost a running episode stops the run."""
    server = started(protocol)
    policy = client(server, retries=4, backoff=0.05)
    first = np.asarray(policy.act(observation(3)).actions)
    server.close()
    server = started(protocol, port=server.port)
    if protocol in ("openpi", "gr00t"):
        second = policy.act(observation(3))
        assert second.errors == {} and (np.asarray(second.actions) != first).any()
    else:
        with pytest.raises(PolicyUnavailable, match=r"what the server knew of the running episode; .* stay unplayed"):
            policy.act(observation(3))
    policy.reset([7, 8, 9], ["Isaac-Football"] * 3)
    again = policy.act(observation(3))
    assert again.errors == {} and np.asarray(again.actions).tobytes() == first.tobytes()


@pytest.mark.parametrize("protocol", SOCKETS)
def test_restart_before_the_first_query(protocol):
    """An episode that has not received an action yet begins again on the new connection."""
    server = started(protocol)
    policy = client(server, retries=4, backoff=0.05)
    server.close()
    server = started(protocol, port=server.port)
    assert policy.act(observation(3)).errors == {}
    assert protocol == "openpi" or sorted(s.seed for kind, s in server.seen if kind == "reset") == [7, 8, 9]


def test_another_policy_after_a_restart():
    """A server that declares something else than at the beginning is not asked any more."""
    server = started("openpi")
    policy = client(server, retries=4, backoff=0.05)
    server.close()
    server = SocketServer("openpi", facts(policy="another"), port=server.port)
    with pytest.raises(PolicyUnavailable, match="declares something else"):
        policy.act(observation(3))


def test_a_server_that_greets_with_garbage_is_there():
    """Garbage is an answer of a server that is there; silence and a closed port are none."""
    server = SocketServer("openpi", metadata=b"\xc1\xff")
    link = asking(server.url)._connect()
    assert link.alive(PLENTY)
    server.close()
    assert not link.alive(1.0)


def test_greeting_that_broke_after_a_restart():
    """A connection that greeted with garbage is not asked: the next request opens another one."""
    server = started("openpi")
    policy = client(server, retries=0)
    server.close()
    server = SocketServer("openpi", metadata=b"\xc1\xff", port=server.port)
    told = []
    for _ in range(3):
        chunk = policy.act(observation(3))
        assert set(chunk.errors) == {0, 1, 2}
        told.append(chunk.errors[0])
    # Of the old connections the first request may still learn that they broke.
    assert "not MessagePack" in told[0] or "the connection broke" in told[0]
    assert all("not MessagePack" in one for one in told[1:])
    assert server.seen == []


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval", "http"])
def test_episode_that_the_server_does_not_know(protocol):
    """A server that says that it does not know the running episode stops the run."""
    server = HttpServer(facts()) if protocol == "http" else started(protocol)
    policy = client(server)
    assert policy.act(observation(3)).errors == {}
    server.behave = {"any": "unknown"}
    with pytest.raises(PolicyUnavailable, match="unknown episode"):
        policy.act(observation(3))


@pytest.mark.parametrize("running", ["openpi", "vla-eval", "gr00t"], indirect=True)
def test_server_without_a_usable_answer_stops_the_run(running):
    """A server that serves nobody stops the run after at most `MAX_FAILURES` worlds with an error."""
    policy = client(running)
    running.behave = {"any": "text"}
    errors = 0
    with pytest.raises(PolicyUnavailable, match="requests in a row brought no usable answer"):
        for _ in range(100):
            errors += len(policy.act(observation(3)).errors)
            policy.reset([7, 8, 9], ["Isaac-Football"] * 3)
    assert errors < MAX_FAILURES


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("39", "joint_pos has shape [3, 4, 28], expected [3, n, 29]"),
        ("missing", "hands has shape NoneType"),
        ("text", "the server says CUDA out of memory"),
        ("ERROR", "the server says ERROR"),
        ("garbage", "not MessagePack"),
        ("oversize", "longer than 4 MiB"),
        ("objects", "an array of type '|O'"),
    ],
)
def test_bad_answer_of_gr00t(kind, text):
    """One answer for all worlds that is bad is the error of all, in one line; the next one is served."""
    server = started("gr00t")
    policy = client(server)
    server.behave = {1.0: kind}
    chunk = policy.act(observation(3))
    assert set(chunk.errors) == {0, 1, 2} and len(set(chunk.errors.values())) == 1
    assert text in chunk.errors[0] and server.url in chunk.errors[0] and "\n" not in chunk.errors[0]
    server.behave = {}
    assert policy.act(observation(3)).errors == {}


def test_bad_row_of_gr00t():
    """One row that is bad is the error of its world alone."""
    server = started("gr00t")
    policy = client(server)
    server.behave = {1.0: "nan"}
    chunk = policy.act(observation(3))
    assert set(chunk.errors) == {1} and "(index 20) is nan" in chunk.errors[1]


def test_broken_state_is_not_sent_with_others():
    """A world whose state is not finite is an error by itself and spoils no batch."""
    server = started("gr00t")
    policy = client(server)
    server.seen.clear()
    seen = observation(3)
    seen.state[1, 5] = float("nan")
    chunk = policy.act(seen)
    assert set(chunk.errors) == {1} and "not finite" in chunk.errors[1]
    ((_, data),) = server.seen
    assert len(data["observation"]["state"]["joint_pos"]) == 2


def raw_server(reply):
    """A server that sends fixed bytes when it is asked."""
    listening = socket.create_server(("127.0.0.1", 0), backlog=64)

    def answer(connection):
        with connection:
            connection.settimeout(PLENTY)
            try:
                if connection.recv(65536):
                    connection.sendall(reply)
            except OSError:
                pass

    def run():
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            threading.Thread(target=answer, args=(connection,), daemon=True).start()

    threading.Thread(target=run, daemon=True).start()
    return listening


@pytest.mark.parametrize("protocol", ["ws", "roboarena", "vla-eval", "gr00t"])
@pytest.mark.parametrize(
    ("reply", "text"),
    [
        (b"HTTP/1.1 302 Found\r\nLocation: ws://127.0.0.1:1/\r\nContent-Length: 0\r\n\r\n", "a redirect, which is not"),
        (b"HTTP/1.1 401 No\r\nContent-Length: 0\r\n\r\n", f"status 401.* variable {TOKEN_VARIABLE}"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello", "status 200, expected a websocket"),
        (b"HTTP/1.1 503 Busy\r\nContent-Length: 0\r\n\r\n", "status 503"),
        (b"SSH-2.0-OpenSSH_9.6\r\n", "no websocket"),
    ],
)
def test_check_refuses_what_is_no_policy_server(protocol, reply, text):
    """Something else at the address, a redirect too, is one line before the first episode."""
    listening = raw_server(reply)
    address = f"{protocol}://127.0.0.1:{listening.getsockname()[1]}"
    policy = asking(address, timeout=PLENTY, retries=1, backoff=0.01)
    with pytest.raises(InputError, match="gr00t" if protocol == "gr00t" else text) as caught:
        policy.check()
    assert "\n" not in str(caught.value) and address in str(caught.value)
    listening.close()


@pytest.mark.parametrize("protocol", ["ws", "vla-eval", "gr00t"])
def test_nobody_there(protocol):
    """An address where nobody listens is one line, soon."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    policy = asking(f"{protocol}://127.0.0.1:{port}", timeout=PLENTY, retries=1, backoff=0.01)
    with pytest.raises(InputError, match="no server answers there"):
        policy.check()


@pytest.mark.parametrize("protocol", ["ws", "vla-eval", "gr00t"])
def test_silent_server(protocol):
    """A server that takes connections and never speaks is refused after one deadline."""

    def check(deadline):
        policy = asking(f"{protocol}://127.0.0.1:{listening.getsockname()[1]}", timeout=deadline, retries=3)
        start = time.monotonic()
        with pytest.raises(InputError, match=f"within {deadline:g} s"):
            policy.check()
        assert time.monotonic() - start < 3 * deadline

    with socket.create_server(("127.0.0.1", 0), backlog=64) as listening:
        patiently(check)


@pytest.mark.parametrize("running", ["openpi", "vla-eval"], indirect=True)
def test_token_is_sent_and_never_told(running, monkeypatch):
    """The token of the environment goes with every connection, and into no message or description."""
    monkeypatch.setenv(TOKEN_VARIABLE, "s3kret-token")
    policy = client(running)
    running.behave = {1.0: "escapes"}
    chunk = policy.act(observation(3))
    assert set(running.tokens) == {"Bearer s3kret-token"}
    assert "s3kret" not in str(chunk.errors) + str(policy.describe()) and "\x1b" not in str(chunk.errors)
    assert set(chunk.errors) == {1}


def test_token_of_gr00t(monkeypatch):
    """GR00T's servers read the token in the message; without it the refusal is one line."""
    server = Gr00tServer(token="s3kret")
    policy = asking(server.url, timeout=PLENTY, retries=0)
    with pytest.raises(InputError, match="Invalid API token"):
        policy.check()
    policy.close()
    monkeypatch.setenv(TOKEN_VARIABLE, "s3kret")
    policy = client(server)
    assert policy.act(observation(3)).errors == {} and "s3kret" not in json.dumps(policy.describe())


@pytest.mark.parametrize("running", [*SOCKETS, "gr00t"], indirect=True)
def test_close_breaks_off_what_waits(running):
    """Closing does not wait for the deadline of requests that are under way."""
    policy = client(running)
    running.behave = {0.0: "slow"}

    def ask():
        try:
            policy.act(observation(1))
        except PolicyUnavailable:
            pass

    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    while not any(kind in ("query", "get_action") for kind, _ in running.seen[-1:]):
        time.sleep(0.01)
    policy.close()
    asking.join(PLENTY / 2)
    assert not asking.is_alive()


def patiences(monkeypatch, fault=None):
    """Time that each handshake from now on may take [s]; the first one ends in the fault."""
    opened, connect = [], websocket.connect

    def noting(*arguments, **more):
        opened.append(more["open_timeout"])
        if fault is not None and len(opened) == 1:
            raise fault
        return connect(*arguments, **more)

    monkeypatch.setattr(websocket, "connect", noting)
    return opened


def checked(server, scheme, retries):
    """Greet a server."""
    policy = asking(f"{scheme}://127.0.0.1:{server.port}", timeout=PLENTY, retries=retries, verify_ssl=False)
    policy.check()
    policy.close()


def test_a_connection_that_breaks_while_it_opens_is_opened_again(monkeypatch):
    """A server that closes a connection before its greeting is asked once more, as one that is not there yet."""
    opened = patiences(monkeypatch, ConnectionClosedError(None, None))
    checked(SocketServer("openpi", facts()), "openpi", retries=1)
    assert len(opened) == 2


@pytest.mark.parametrize(("retries", "share"), [(1, PLENTY / 2), (60, websocket.OPENING)])
def test_a_request_that_is_lost_over_tls_is_sent_again(monkeypatch, certificate, retries, share):
    """A handshake that nobody answers is given up after its share of the time, where another may be tried."""
    opened = patiences(monkeypatch, TimeoutError("timed out while waiting for handshake response"))
    checked(SocketServer("openpi", facts(), ssl=certificate[1]), "openpi+wss", retries)
    assert opened == pytest.approx([share] * 2, rel=0.01)


@pytest.mark.parametrize(("scheme", "retries"), [("openpi+wss", 0), ("openpi", 4)])
def test_a_handshake_that_is_not_tried_again_has_all_the_time(monkeypatch, certificate, scheme, retries):
    """A server that is slow to take connections needs a longer deadline alone."""
    opened = patiences(monkeypatch)
    checked(SocketServer("openpi", facts(), ssl=certificate[1] if scheme.endswith("wss") else None), scheme, retries)
    assert opened == pytest.approx([PLENTY], rel=0.01)


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval"])
def test_wss(protocol, certificate):
    """A certificate that nobody vouches for is refused before the first episode, or taken on request."""
    server = SocketServer(protocol, facts(), ssl=certificate[1])
    url = f"{protocol}+wss://127.0.0.1:{server.port}"
    policy = asking(url, timeout=PLENTY, retries=0)
    with pytest.raises(InputError, match="--remote-insecure does without"):
        policy.check()
    policy.close()
    server.behave = {1.0: "slow"}

    def check(deadline):
        policy = asking(url, timeout=PLENTY, retries=2, verify_ssl=False)
        policy.check()
        policy.reset([7, 8, 9], ["Isaac-Football"] * 3)
        policy.timeout = deadline
        chunk = policy.act(observation(3))
        assert set(chunk.errors) == {1} and f"no reply within {deadline:g} s" in chunk.errors[1]

    patiently(check, (0.5, 5.0, 50.0))
