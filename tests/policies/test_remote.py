"""The client of the original's HTTP protocol: what it sends, what it accepts, how long it waits."""

import base64
import socket
import threading
import time

import numpy as np
import pytest
import torch
from json_server import JsonHandler, JsonServer

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.policies import Observation, PolicyUnavailable
from arena_newton.policies.protocols.policy_messages import LONGEST_CHUNK
from arena_newton.policies.remote.arena_client import MAX_FAILURES, TOKEN_VARIABLE, RemotePolicy
from tests.patience import PLENTY, patiently

CHUNK = 4


def good_action(tag: float = 0.0) -> list[float]:
    action = [0.0] * 40
    action[2], action[3], action[6], action[38] = 0.8, 1.0, 1.0, tag
    return action


class Handler(JsonHandler):
    """Answers as the original's server; `server.behave` decides by the first number of the state."""

    def do_POST(self):  # noqa: N802 (the name that http.server calls)
        server = self.server
        body = self.asked()
        with server.lock:
            server.seen.append((self.path, body, self.client_address))
            server.tokens.append(self.headers["Authorization"])
            server.count += 1
            count = server.count
        if self.path.endswith("/reset"):
            good = body["seed"] >= 0 and "reset" not in server.behave
            self.answer(200 if good else 500, {"ok": True, **server.says} if good else {"error": "bad seed"})
            return
        tag = body["observation"]["state"][0]
        kind = server.behave.get(tag, "good")
        if kind == "slow":
            server.release.wait(600.0)
        if kind == "drip":
            self.send_response(200)
            self.send_header("Content-Length", "100000")
            self.end_headers()
            for _ in range(2000):
                if server.release.wait(0.05):
                    break
                try:
                    self.wfile.write(b" ")
                except OSError:
                    return
            return
        if kind == "hangs up" or (kind == "hangs up once" and count == server.count_at_start + 1):
            self.close_connection = True
            return
        if kind == "dies":
            server.shutdown()
            server.server_close()
            self.close_connection = True
            return
        if kind == "echo":
            self.answer(500, {"error": f"no access with {self.headers['Authorization']}"})
            return
        if kind == "escapes":
            self.answer(500, {"error": "\x1b[31mred\x1b[0m\x1b]0;title\x07\a\u202eback\ud800\x9b2J" + "x" * 5000})
            return
        if kind == "gateway":
            self.answer(502, {"error": "no upstream"})
            return
        if kind == "busy once" and count == server.count_at_start + 1:
            self.answer(503, {"error": "starting"})
            return
        if kind == "500":
            self.answer(500, {"error": "CUDA out of\nmemory"})
            return
        if kind == "text":
            self.answer(200, b"<html>hello</html>")
            return
        rows = [good_action(tag) for _ in range(CHUNK)]
        if kind == "39":
            rows = [row[:39] for row in rows]
        if kind == "nan":
            rows[2][20] = float("nan")
        if kind == "words":
            rows[1][5] = "left"
        if kind == "short":
            rows = rows[:2]
        if kind == "long":
            rows = rows * (LONGEST_CHUNK // CHUNK + 1)
        reply = {"action": rows[0], "action_chunk": rows, "chunk_size": len(rows)}
        if kind == "empty":
            reply = {"action_chunk": []}
        if kind == "single":
            reply = {"action": rows[0]}
        self.answer(200, reply)

    def answer(self, status, content):
        super().answer(status, content)
        if self.server.drops:  # as servers do that keep no idle connection
            self.close_connection = True

    def do_GET(self):  # noqa: N802 (the name that http.server calls)
        self.answer(502 if "gateway" in self.server.behave.values() else 404, {"error": "no such route"})


@pytest.fixture
def server():
    given = {"seen": [], "behave": {}, "count": 0, "count_at_start": 0, "tokens": [], "says": {}, "drops": False}
    running = JsonServer(Handler, release=threading.Event(), **given)
    yield running
    running.release.set()
    running.close()


@pytest.fixture
def policy(server):
    made = RemotePolicy(server.url, timeout=PLENTY, retries=2, backoff=0.01)
    yield made
    made.close()


def observation(worlds: int, mask=None, image: bool = False) -> Observation:
    state = torch.zeros(worlds, 64)
    state[:, 0] = torch.arange(worlds)
    picture = None
    if image:
        picture = torch.arange(worlds, dtype=torch.uint8)[:, None, None, None].expand(worlds, 6, 8, 3)
    return Observation(
        state=state, image=picture, mask=mask, task="football", gym_id="Isaac-Football", instruction="Kick the ball."
    )


def test_protocol(server, policy):
    """Requests carry seed, image, state, robot type and gym id as the original's client sends them."""
    policy.check()
    assert [(path, body) for path, body, _ in server.seen] == [("/reset", {"seed": 0, "world": 0})]
    server.seen.clear()
    policy.reset([7, 8, 9], ["Isaac-Football"] * 3, np.array([True, False, True]))
    assert [body for _, body, _ in server.seen] == [
        {"seed": 7, "world": 0, "task": "Isaac-Football"},
        {"seed": 9, "world": 2, "task": "Isaac-Football"},
    ]
    server.seen.clear()
    chunk = policy.act(observation(3, np.array([True, True, False]), image=True))
    assert chunk.errors == {} and chunk.actions.shape == (3, CHUNK, 40) and chunk.actions.dtype == np.float32
    assert chunk.actions[1, 0, 38] == 1.0 and chunk.actions[0, 3, 2] == np.float32(0.8)
    bodies = {body["observation"]["state"][0]: (path, body) for path, body, _ in server.seen}
    assert set(bodies) == {0.0, 1.0}
    path, body = bodies[1.0]
    assert path == "/infer" and body["robot_type"] == "unitree_g1_refpose_v3_1" and body["return_chunk"] is True
    assert body["task"] == "Isaac-Football" and body["instruction"] == "Kick the ball."
    assert len(body["observation"]["state"]) == 64
    front = body["observation"]["images"]["front"]
    assert front["shape"] == [6, 8, 3] and front["dtype"] == "uint8"
    pixels = np.frombuffer(base64.b64decode(front["data_b64"]), np.uint8).reshape(front["shape"])
    assert (pixels == 1).all()


def test_connections_are_kept(server, policy):
    """A world's requests share one connection."""
    for _ in range(3):
        policy.act(observation(2))
    assert len({address for _, _, address in server.seen}) == 2


def test_single_action(server, policy):
    """A reply with one action only is a chunk of one."""
    server.behave = {0.0: "single", 1.0: "single"}
    assert policy.act(observation(2)).actions.shape == (2, 1, 40)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("nan", "is nan, expected a finite number"),
        ("39", "39], expected [n, 40]"),
        ("words", "not a number"),
        ("500", "status 500, CUDA out of memory"),
        ("text", "not JSON"),
        ("empty", "neither action_chunk nor action"),
        ("long", "[4100, 40], expected [n, 40] with n of 1 to 4096"),
        ("escapes", "/infer: status 500, red back "),
        ("hangs up", "tried 3 times"),
    ],
)
def test_bad_reply_ends_one_world(server, policy, kind, text):
    """A bad reply is one line that names the address, and only that world has an error."""
    server.behave = {1.0: kind}
    chunk = policy.act(observation(3))
    assert set(chunk.errors) == {1}
    assert text in chunk.errors[1] and server.url in chunk.errors[1] and "\n" not in chunk.errors[1]
    assert chunk.actions[2, 0, 38] == 2.0 and np.isfinite(chunk.actions).all()
    server.behave = {}
    assert policy.act(observation(3)).errors == {}


@pytest.mark.parametrize("kind", ["slow", "drip"])
@pytest.mark.parametrize("sequential", [False, True])
def test_deadline(server, kind, sequential):
    """A server that hangs or drips bytes costs one deadline and one world."""
    server.behave = {1.0: kind}

    def check(deadline):
        policy = RemotePolicy(server.url, timeout=deadline, retries=2, backoff=0.01, sequential=sequential)
        start = time.monotonic()
        chunk = policy.act(observation(3))
        policy.close()
        assert time.monotonic() - start < 5 * deadline
        assert set(chunk.errors) == {1} and f"no reply within {deadline:g} s" in chunk.errors[1]
        assert chunk.actions[2, 0, 38] == 2.0

    patiently(check)


@pytest.mark.parametrize("kind", ["hangs up once", "busy once"])
def test_retries(server, policy, kind):
    """A connection that breaks or a server that is not ready yet is asked again."""
    server.behave = {0.0: kind}
    server.count_at_start = server.count
    chunk = policy.act(observation(1))
    assert chunk.errors == {} and server.count == 2


def test_failed_reset_ends_its_world(server, policy):
    """A world whose reset failed has that error at its next act; a new reset clears it."""
    policy.reset([1, -1], ["Isaac-Football"] * 2)
    chunk = policy.act(observation(2))
    assert set(chunk.errors) == {1} and "/reset: status 500, bad seed" in chunk.errors[1]
    policy.reset([1, -1], ["Isaac-Football"] * 2)
    policy.reset([1, 5], ["Isaac-Football"] * 2)
    assert policy.act(observation(2)).errors == {}


def test_nobody_there(server):
    """An address where nobody listens is reported before the first episode, and stops a run that is under way."""
    server.shutdown()
    server.server_close()
    policy = RemotePolicy(server.url, timeout=PLENTY, retries=1, backoff=0.01)
    with pytest.raises(InputError, match="no server answers there") as caught:
        policy.check()
    assert server.url in str(caught.value)
    with pytest.raises(PolicyUnavailable, match=r"the server is gone: .*tried 2 times"):
        policy.act(observation(2))
    with pytest.raises(PolicyUnavailable, match="the server is gone"):
        policy.reset([1, 2], ["Isaac-Football"] * 2)
    policy.close()


def test_seed_and_step_go_with_each_request(server, policy):
    """Every request names the episode's seed and the ticks since its first action."""
    policy.reset([7, 8], ["Isaac-Football"] * 2)
    for _ in range(3):
        policy.act(observation(2))
    policy.reset([0, 9], ["Isaac-Football"] * 2, np.array([False, True]))
    policy.act(observation(2))
    asked = [(b["world"], b["seed"], b["step"]) for path, b, _ in server.seen if path == "/infer"]
    assert sorted(asked[:6]) == [(0, 7, 0), (0, 7, 4), (0, 7, 8), (1, 8, 0), (1, 8, 4), (1, 8, 8)]
    assert sorted(asked[6:]) == [(0, 7, 12), (1, 9, 0)]


@pytest.mark.parametrize("declares", [False, True])
def test_server_declares_that_it_honours_seeds(server, policy, declares):
    """Without the declaration the number of worlds counts; what the server calls itself is kept as one plain line."""
    server.says = {"seeded": True, "policy": "pi\x1b[31m0.5\n20k"} if declares else {"seeded": "yes", "policy": 5}
    assert policy.depends_on_worlds
    policy.check()
    assert policy.depends_on_worlds is not declares
    assert policy.describe() == {
        "name": "remote",
        "url": server.url,
        "server": "pi0.5 20k" if declares else "",
        "sequential": False,
        "seeding": "per_request" if declares else "undeclared",
        "worlds_matter": not declares,
    }


def test_chunks_of_different_length_are_queued(server, policy):
    """Chunks of any length are played to their end; a world is asked for when its own chunk is used up."""
    server.behave = {1.0: "short", 2.0: "single"}
    played = {0: [], 1: [], 2: []}
    for number in range(6):
        chunk = policy.act(observation(3))
        assert chunk.errors == {}
        for world, rows in played.items():
            rows.extend(chunk.actions[world, :, 38])
        if number == 1:
            server.behave = {1.0: "short"}
    assert all(len(rows) == len(played[0]) and set(rows) == {float(w)} for w, rows in played.items())
    ticks = len(played[0])
    asked = [(b["world"], b["step"]) for _, b, _ in server.seen]
    assert [s for w, s in asked if w == 0] == list(range(0, ticks, 4))
    assert [s for w, s in asked if w == 1] == list(range(0, ticks, 2))
    assert [s for w, s in asked if w == 2] == [0, 1, *range(2, ticks, 4)]
    policy.reset([1, 2, 3], ["Isaac-Football"] * 3)
    server.seen.clear()
    policy.act(observation(3))
    assert len(server.seen) == 3  # nothing of the episode before is left


def test_kept_connections_that_the_server_closed(server):
    """A server that closes idle connections costs no attempt."""
    server.drops = True
    policy = RemotePolicy(server.url, timeout=PLENTY, retries=0)
    for _ in range(3):
        assert policy.act(observation(1)).errors == {}
        end = time.monotonic() + PLENTY
        while not policy._connections[0]._dropped() and time.monotonic() < end:
            time.sleep(0.01)
    policy.close()


@pytest.mark.parametrize("sequential", [False, True])
def test_server_that_dies_in_a_batch_stops_the_run(server, sequential):
    """A server's death while it answers a batch is no world's error."""
    policy = RemotePolicy(server.url, timeout=PLENTY, retries=1, backoff=0.01, sequential=sequential)
    assert policy.act(observation(4)).errors == {}
    server.behave = {1.0: "dies"}
    with pytest.raises(PolicyUnavailable, match="the server is gone"):
        policy.act(observation(4))
    policy.close()


def test_gateway_without_a_server_stops_the_run(server, policy):
    """A gateway that answers for a dead server is no answer."""
    server.behave = {1.0: "gateway"}
    with pytest.raises(PolicyUnavailable, match="the server is gone: .*status 502, no upstream"):
        policy.act(observation(2))


@pytest.mark.parametrize("call", ["act", "reset", "check"])
def test_server_that_hangs_stops_the_run(call):
    """A server that takes connections and never answers costs two deadlines, however many worlds wait."""

    def check(deadline):
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        policy = RemotePolicy(url, timeout=deadline, retries=3, backoff=0.01)
        start, kind = time.monotonic(), InputError if call == "check" else PolicyUnavailable
        with pytest.raises(kind, match=f"no reply within {deadline:g} s"):
            if call == "act":
                policy.act(observation(20))
            elif call == "reset":
                policy.reset(range(20), ["Isaac-Football"] * 20)
            else:
                policy.check()
        policy.close()
        assert time.monotonic() - start < 10 * deadline  # not 20

    with socket.create_server(("127.0.0.1", 0), backlog=256) as listening:
        patiently(check, (0.2, 2.0, 20.0))


@pytest.mark.parametrize("worlds", [1, 4, 20])
@pytest.mark.parametrize("kind", ["500", "nan", "hangs up"])
def test_server_without_a_usable_answer_stops_the_run(server, policy, worlds, kind):
    """A server that serves nobody stops the run after at most `MAX_FAILURES` worlds with an error."""
    server.behave = dict.fromkeys(map(float, range(worlds)), kind)
    errors = 0
    with pytest.raises(PolicyUnavailable, match="requests in a row brought no usable answer"):
        for _ in range(100):
            errors += len(policy.act(observation(worlds)).errors)
    assert errors < MAX_FAILURES


def test_failures_in_a_row(server, policy):
    """An answer in between starts the count again; failed resets count as well."""
    for _ in range(3):
        server.behave = {0.0: "500"}
        for _ in range(MAX_FAILURES - 1):
            assert set(policy.act(observation(1)).errors) == {0}
        server.behave = {}
        assert policy.act(observation(1)).errors == {}
    server.behave = {"reset": ""}
    with pytest.raises(PolicyUnavailable, match="/reset: status 500"):
        policy.reset(range(20), ["Isaac-Football"] * 20)


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", "/reset: status 404"),
        (b"HTTP/1.1 401 No\r\nContent-Length: 0\r\n\r\n", f"status 401; a token .* variable {TOKEN_VARIABLE}"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 6\r\n\r\n<html>", "the reply is not JSON"),
        (b"SSH-2.0-OpenSSH_9.6\r\n", "SSH-2.0"),
    ],
)
def test_check_refuses_what_is_no_policy_server(answer, text):
    """Something else at the address is reported before the first episode."""

    def serve(listening):
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            with connection:
                connection.settimeout(PLENTY)
                if connection.recv(65536):
                    connection.sendall(answer)

    listening = socket.create_server(("127.0.0.1", 0))
    threading.Thread(target=serve, args=(listening,), daemon=True).start()
    policy = RemotePolicy(f"http://127.0.0.1:{listening.getsockname()[1]}", timeout=PLENTY, retries=1, backoff=0.01)
    with pytest.raises(InputError, match=text):
        policy.check()
    policy.close()
    listening.shutdown(socket.SHUT_RDWR)
    listening.close()


def test_token_is_sent_and_never_told(server, monkeypatch):
    """The token of the environment goes with every request, and into no message or description."""
    monkeypatch.setenv(TOKEN_VARIABLE, "s3kret-token")
    server.behave = {0.0: "echo"}
    server.says = {"policy": "for s3kret-token"}
    policy = RemotePolicy(server.url, timeout=PLENTY, retries=0)
    policy.check()
    policy.reset([1], ["Isaac-Football"])
    chunk = policy.act(observation(1))
    assert server.tokens == ["Bearer s3kret-token"] * 3
    assert chunk.errors[0].endswith("status 500, no access with Bearer ***")
    assert policy.describe()["server"] == "for ***" and "s3kret" not in str(policy.describe())
    policy.close()
    monkeypatch.delenv(TOKEN_VARIABLE)
    policy = RemotePolicy(server.url, timeout=PLENTY, retries=0)
    policy.check()
    assert server.tokens[-1] is None
    policy.close()


@pytest.mark.parametrize("token", ["a\nHost: other", "a b", "\x00", "t\u00e9l\u00e9", "a\x7f"])
def test_unfit_tokens_are_refused(monkeypatch, token):
    """A token with characters that no header carries is refused without being printed."""
    monkeypatch.setattr("os.environ", {TOKEN_VARIABLE: token})
    with pytest.raises(InputError, match=f"^{TOKEN_VARIABLE}: holds a space") as caught:
        RemotePolicy("http://localhost:8443")
    assert token not in str(caught.value).removeprefix(TOKEN_VARIABLE)


@pytest.mark.parametrize(
    "url",
    [
        "http://user:sekret@host:8443",
        "https://sekret@host",
        "HTTP://:sekret@host/",
        "user:sekret@host:8443",
        "http:/user:sekret@host",
        "http:///user:sekret@host",
        "http://user:sekret@[bad",
        "http://user:se/kret@host",
        "http://user:se?sekret@host",
        "http://user:se#sekret@host",
        "http://host/?token=sekret",
        "http://host/#sekret",
        "http://host:bad/?token=sekret",
        "http://user:sekret%40@host",
        "http://user\n:sekret@host",
    ],
)
def test_secrets_in_the_address_are_refused(url):
    """A password in the address is refused in one line that does not print it."""
    with pytest.raises(InputError) as caught:
        policies.get(f"remote:{url}")
    message = str(caught.value)
    assert message.startswith("--policy remote") and "kret" not in message and "\n" not in message
    if "@" in url:
        assert TOKEN_VARIABLE in message
    with pytest.raises(InputError) as caught:
        RemotePolicy(url)
    assert "kret" not in str(caught.value)


@pytest.mark.parametrize(
    ("url", "options", "text"),
    [
        ("http://host\n:80", {}, "white space or control"),
        ("http://ho st", {}, "white space or control"),
        ("http://host:99999", {}, "not an address"),
        ("http://[::1", {}, "not an address"),
        ("http://host", {"timeout": 0.0}, "--remote-timeout 0"),
        ("http://host", {"timeout": float("nan")}, "--remote-timeout nan"),
        ("http://host", {"timeout": float("inf")}, "--remote-timeout inf"),
        ("http://host", {"retries": -1}, "--remote-retries -1"),
    ],
)
def test_unfit_addresses_and_options(url, options, text):
    """Addresses and options that cannot work are refused in one line."""
    with pytest.raises(InputError, match=text) as caught:
        policies.get(f"remote:{url}", **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("host", ["a" * 64 + ".invalid", "nobody.invalid", "..", "m\u00fcller.invalid"])
def test_names_that_do_not_resolve(host):
    """A host that does not exist is one line before the first episode."""
    policy = RemotePolicy(f"http://{host}:8443", timeout=PLENTY, retries=0)
    with pytest.raises(InputError, match="no server answers there"):
        policy.check()
    policy.close()


def test_close_breaks_off_what_waits(server):
    """Closing does not wait for the deadline of requests that are under way."""
    server.behave = {0.0: "slow"}
    policy = RemotePolicy(server.url, timeout=PLENTY, retries=4, backoff=0.01)
    asking = threading.Thread(target=lambda: policy.act(observation(1)), daemon=True)
    asking.start()
    while not server.seen:
        time.sleep(0.01)
    policy.close()
    asking.join(PLENTY / 2)
    assert not asking.is_alive()


def test_https(server, certificate):
    """A certificate that nobody vouches for is refused before the first episode, or taken on request."""
    server.socket = certificate[1].wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
    url = server.url.replace("http:", "https:")
    policy = RemotePolicy(url, timeout=PLENTY, retries=0)
    with pytest.raises(InputError, match="--remote-insecure does without"):
        policy.check()
    policy.close()
    server.behave = {1.0: "slow"}

    def check(deadline):
        policy = RemotePolicy(url, timeout=PLENTY, retries=0, verify_ssl=False)
        policy.check()
        policy.timeout = deadline
        for _ in range(2):
            start = time.monotonic()
            chunk = policy.act(observation(3))
            assert set(chunk.errors) == {1} and chunk.actions[2, 0, 38] == 2.0
            assert time.monotonic() - start < 5 * deadline
        policy.close()

    patiently(check, (0.5, 5.0, 50.0))
