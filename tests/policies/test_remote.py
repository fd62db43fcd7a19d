"""The client of the original's HTTP protocol: what it sends, what it accepts, how long it waits."""

import base64
import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import torch

from arena_newton.errors import InputError
from arena_newton.policies import Observation
from arena_newton.policies.remote import RemotePolicy

CHUNK = 4


def good_action(tag: float = 0.0) -> list[float]:
    action = [0.0] * 40
    action[2], action[3], action[6], action[38] = 0.8, 1.0, 1.0, tag
    return action


class Handler(BaseHTTPRequestHandler):
    """Answers as the original's server; `server.behave` decides by the first number of the state."""

    protocol_version = "HTTP/1.1"

    def do_POST(self):  # noqa: N802 (the name that http.server calls)
        server = self.server
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        with server.lock:
            server.seen.append((self.path, body, self.client_address))
            server.count += 1
            count = server.count
        if self.path.endswith("/reset"):
            self.answer(200 if body["seed"] >= 0 else 500, {"ok": True} if body["seed"] >= 0 else {"error": "bad seed"})
            return
        tag = body["observation"]["state"][0]
        kind = server.behave.get(tag, "good")
        if kind == "slow":
            server.release.wait(20.0)
        if kind == "drip":
            self.send_response(200)
            self.send_header("Content-Length", "100000")
            self.end_headers()
            for _ in range(200):
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
        if kind == "busy once" and count == server.count_at_start + 1:
            self.answer(503, {"error": "starting"})
            return
        if kind == "500":
            self.answer(500, {"error": "CUDA out of\nmemory"})
            return
        if kind == "text":
            self.answer(200, None, raw=b"<html>hello</html>")
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
        reply = {"action": rows[0], "action_chunk": rows, "chunk_size": len(rows)}
        if kind == "empty":
            reply = {"action_chunk": []}
        if kind == "single":
            reply = {"action": rows[0]}
        self.answer(200, reply)

    def answer(self, status, content, raw=None):
        data = json.dumps(content).encode() if raw is None else raw
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    running = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    running.daemon_threads = True
    running.lock, running.release = threading.Lock(), threading.Event()
    running.seen, running.behave, running.count, running.count_at_start = [], {}, 0, 0
    thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    running.url = f"http://127.0.0.1:{running.server_port}"
    yield running
    running.release.set()
    running.shutdown()
    running.server_close()


@pytest.fixture
def policy(server):
    made = RemotePolicy(server.url, timeout=5.0, retries=2, backoff=0.01)
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
    policy.reset([7, 8, 9], ["Isaac-Football"] * 3, np.array([True, False, True]))
    assert [body for path, body, _ in server.seen if path == "/reset"] == [{"seed": 7}, {"seed": 9}]
    server.seen.clear()
    chunk = policy.act(observation(3, np.array([True, True, False]), image=True))
    assert chunk.errors == {} and chunk.actions.shape == (3, CHUNK, 40) and chunk.actions.dtype == np.float32
    assert chunk.actions[1, 0, 38] == 1.0 and chunk.actions[0, 3, 2] == np.float32(0.8)
    bodies = {body["observation"]["state"][0]: (path, body) for path, body, _ in server.seen}
    assert set(bodies) == {0.0, 1.0}
    path, body = bodies[1.0]
    assert path == "/infer" and body["robot_type"] == "unitree_g1_refpose_v3_1" and body["return_chunk"] is True
    assert body["task"] == "Isaac-Football" and len(body["observation"]["state"]) == 64
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
        ("39", "39 numbers, expected 40"),
        ("words", "no number"),
        ("500", "status 500, CUDA out of memory"),
        ("text", "no JSON"),
        ("empty", "neither action_chunk nor action"),
        ("short", "a chunk of 2 actions, but the first had 4"),
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
    policy = RemotePolicy(server.url, timeout=0.5, retries=2, backoff=0.01, sequential=sequential)
    start = time.monotonic()
    chunk = policy.act(observation(3))
    assert time.monotonic() - start < 3.0
    assert set(chunk.errors) == {1} and "no reply within 0.5 s" in chunk.errors[1]
    assert chunk.actions[2, 0, 38] == 2.0
    policy.close()


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
    """An address where nobody listens is told before the first episode, and is an error of every world later."""
    server.shutdown()
    server.server_close()
    policy = RemotePolicy(server.url, timeout=2.0, retries=1, backoff=0.01)
    with pytest.raises(InputError, match="no server answers there") as caught:
        policy.check()
    assert server.url in str(caught.value)
    chunk = policy.act(observation(2))
    assert set(chunk.errors) == {0, 1} and "tried 2 times" in chunk.errors[0]
    policy.close()
