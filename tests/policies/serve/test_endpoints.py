"""Endpoints: each protocol as its clients speak it, who is let in, and what hostile or slow clients can do."""

import http.client
import json
import socket
import threading
import time
from contextlib import ExitStack, suppress

import msgpack
import numpy as np
import pytest
from served_policies import Fails, Remembers, TurnsV4, query, state, together
from websockets.exceptions import ConnectionClosed, InvalidStatus

from arena_newton.policies.label_reader import read_by
from arena_newton.policies.protocols import arena_codec, openpi_codec, vla_eval_codec
from arena_newton.policies.protocols.policy_messages import Begin, End
from arena_newton.policies.protocols.raw_arrays import MAX_FRAME
from arena_newton.policies.serve import policy_server
from arena_newton.policies.serve.policy_server import Refused
from tests.patience import PLENTY, wait_for

pytestmark = pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")

VALUES = [0.1, 0.2, 0.3]


def expected(served, seed):
    """The chunks of an episode as the server object gives them."""
    served.server.begin("direct", Begin("", seed, "boxing"))
    chunks = [served.server.query("direct", query(v, seed=seed, step=4 * i)).actions for i, v in enumerate(VALUES)]
    served.server.leave("direct")
    return chunks


def ask(socket, request, **more):
    """The answer of openpi's server, or RoboArena's."""
    socket.send(openpi_codec.pack_request(request, **more))
    return openpi_codec.unpack_answer(socket.recv(timeout=PLENTY), "server")


def say(socket, request, seq=1):
    """Send a message of vla-eval."""
    socket.send(vla_eval_codec.pack_request(request, seq, 0.0))


def heard(socket):
    """The next message of vla-eval."""
    return vla_eval_codec.unpack_message(socket.recv(timeout=PLENTY))


def test_openpi(served):
    """Openpi's client is sent the metadata, and each query its chunk; seed and step 0 begin an episode."""
    one = served(Remembers())
    with one.socket() as client:
        facts, frame = openpi_codec.unpack_metadata(client.recv(timeout=PLENTY), "server")
        assert facts == one.server.facts and facts.chunk_length == 4 and frame["action_space"] == "arena_v3.1"
        for seed in (3, 4, 3):
            chunks = [ask(client, query(v, seed=seed, step=4 * i)) for i, v in enumerate(VALUES)]
            assert np.array_equal(chunks, expected(one, seed))


def test_openpi_client_that_knows_only_openpi(served):
    """A client without seeds and steps is one episode from its connection to its end."""
    one = served(Remembers())
    for number in range(2):
        with one.socket() as client:
            client.recv(timeout=PLENTY)
            chunks = []
            for value in VALUES:
                frame = {"observation/state": state(value), "prompt": "Box."}
                client.send(openpi_codec.pack(frame, openpi_codec.OPENPI_KEYS))
                answer = openpi_codec.unpack(client.recv(timeout=PLENTY), openpi_codec.OPENPI_KEYS, "server")
                chunks.append(answer["actions"])
            assert set(answer["server_timing"]) == {"infer_ms", "prev_total_ms"}
        assert np.array_equal(chunks, expected(one, number))  # the server numbers the seeds that nobody names


def test_roboarena(served):
    """RoboArena's reset is answered by its text; sessions of one connection are robots of their own."""
    one = served(Remembers(), "roboarena")
    with one.socket() as client:
        facts, frame = openpi_codec.unpack_metadata(client.recv(timeout=PLENTY), "server")
        assert facts.action_names is None and len(frame) == 6
        assert arena_codec.read_facts(one.http("GET", "/config")[1], "server") == one.server.facts
        chunks = {"a": [], "b": []}
        for session, seed in (("a", 3), ("b", 4)):
            client.send(openpi_codec.pack_request(Begin(session, seed, "boxing"), roboarena=True))
            assert client.recv(timeout=PLENTY) == "reset successful"
        for i, value in enumerate(VALUES):
            for session, seed in (("a", 3), ("b", 4)):
                seen = query(value, seed=seed, step=4 * i, session=session)
                chunks[session].append(ask(client, seen, roboarena=True, image_key="observation/exterior_image_1_left"))
    assert np.array_equal(chunks["a"], expected(one, 3)) and np.array_equal(chunks["b"], expected(one, 4))


def test_vla_eval(served):
    """A robot that says it knows chunks is given whole ones; an error answers its query and the connection goes on."""
    one = served(Remembers(), "vla-eval")
    with one.socket() as client:
        client.send(vla_eval_codec.pack_hello(None, 1, 0.0))
        facts, chunks = vla_eval_codec.unpack_hello(heard(client), "server")
        assert facts == one.server.facts and chunks
        for seed in (3, 4):
            say(client, Begin("", seed, "boxing"))
            got = []
            for i, value in enumerate(VALUES):
                say(client, query(value, seed=seed, step=4 * i), seq=10 + i)
                got.append(vla_eval_codec.unpack_action(heard(client), 10 + i, "server"))
            assert np.array_equal(got, expected(one, seed))
            say(client, End())
        say(client, query(seed=3, step=8), seq=77)
        error = heard(client)
        assert error.type == "error" and error.seq == 77 and "does not know" in error.payload["error"]
        client.send(b"\xff\xff")
        assert heard(client).type == "error"
        say(client, query(seed=3, step=0), seq=78)
        assert heard(client).type == "action"


def test_vla_eval_harness_takes_one_action_a_query(served):
    """A robot that does not know chunks is given one action of 40 numbers a query, and a new chunk after the last."""
    one = served(Remembers(), "vla-eval")
    with one.socket() as client:
        say(client, Begin("", 3, "boxing"))
        actions = []
        for i in range(8):
            say(client, query(VALUES[i // 4]), seq=i)
            actions.append(heard(client).payload["actions"])
        assert actions[0].shape == (40,)
        assert np.array_equal(np.reshape(actions, (2, 4, 40)), expected(one, 3)[:2])
        say(client, query(VALUES[2]), seq=9)
        heard(client)
        say(client, Begin("", 4, "boxing"))  # what is left of the chunk is not the new episode's
        say(client, query(VALUES[0]), seq=1)
        assert np.array_equal(heard(client).payload["actions"], expected(one, 4)[0][0])


def post(served, route, body):
    return served.http("POST", route, body, {"Content-Type": "application/json"})


def test_arena(served):
    """The original's protocol: worlds are robots of their own, over any connection; `/config` says what is served."""
    one = served(Remembers(), "arena")
    chunks = {0: [], 1: []}
    for world, seed in ((0, 3), (1, 4)):
        status, reply = post(one, "/reset", arena_codec.pack_begin(Begin(str(world), seed, "boxing")))
        assert status == 200 and reply == {"ok": True, "seeded": True, "policy": one.server.facts.policy}
    for i, value in enumerate(VALUES):
        for world, seed in ((0, 3), (1, 4)):
            body = arena_codec.pack_query(query(value, seed=seed, step=4 * i, session=str(world)))
            status, reply = post(one, "/infer", body)
            assert status == 200 and reply["chunk_size"] == 4
            chunks[world].append(np.float32(reply["action_chunk"]))
    assert np.array_equal(chunks[0], expected(one, 3)) and np.array_equal(chunks[1], expected(one, 4))
    assert arena_codec.read_facts(one.http("GET", "/config")[1], "server") == one.server.facts
    status, reply = post(one, "/infer", arena_codec.pack_query(query(seed=9, step=4, session="0")))
    assert status == 409 and "does not know" in reply["error"]


def test_arena_as_the_original_asks(served):
    """A client that names no world, seed or step is one robot; one action is given where no chunk is wanted."""
    one = served(Remembers(), "arena")
    assert post(one, "/reset", b'{"seed": 3}')[0] == 200
    got = []
    for value in VALUES:
        seen = {"observation": {"state": [float(v) for v in state(value)]}, "return_chunk": True, "task": "boxing"}
        got.append(np.float32(post(one, "/infer", json.dumps(seen).encode())[1]["action_chunk"]))
    assert np.array_equal(got, expected(one, 3))
    assert list(post(one, "/infer", json.dumps({**seen, "return_chunk": False}).encode())[1]) == ["action"]


def test_two_evaluations_at_one_address(served):
    """Worlds of one number and two seeds, from two clients of one machine, do not disturb each other."""
    one = served(Remembers(), "arena")
    for seed in (3, 4):
        post(one, "/reset", arena_codec.pack_begin(Begin("0", seed, "boxing")))
    got = {3: [], 4: []}
    for i, value in enumerate(VALUES):
        for seed in (3, 4):
            reply = post(one, "/infer", arena_codec.pack_query(query(value, seed=seed, step=4 * i, session="0")))[1]
            got[seed].append(np.float32(reply["action_chunk"]))
    assert np.array_equal(got[3], expected(one, 3)) and np.array_equal(got[4], expected(one, 4))


class Robot:
    """A client of the original's protocol: its body, its headers, and whether it keeps its connection."""

    def __init__(self, port, *, name="", keeps=True, chunk=True, **fields):
        self.port, self.keeps, self.chunk, self.fields = port, keeps, chunk, fields
        self.headers = {"X-Arena-Client": name} if name else {}
        self.connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PLENTY)

    def ask(self, route, content):
        self.connection.request("POST", route, json.dumps(content | self.fields), self.headers)
        reply = self.connection.getresponse()
        content = json.loads(reply.read())
        if not self.keeps:
            self.connection.close()
        return reply.status, content

    def begin(self, seed):
        assert self.ask("/reset", {"seed": seed})[0] == 200

    def query(self, value):
        seen = {"observation": {"state": [float(v) for v in state(value)]}, "task": "boxing"}
        status, reply = self.ask("/infer", {**seen, "return_chunk": self.chunk})
        assert status == 200, reply
        return np.float32(reply["action_chunk" if self.chunk else "action"])


@pytest.mark.parametrize("labels", ["v3.1", "v4"])
@pytest.mark.parametrize(
    "clients",
    [
        pytest.param([{}, {}], id="each keeps its connection"),
        pytest.param([{"chunk": False}, {"chunk": False}], id="one action a query"),
        pytest.param([{"world": 0, "seed": 3}, {"world": 0, "seed": 3}], id="the same world and seed"),
        pytest.param([{"name": "a", "keeps": False}, {"name": "b", "keeps": False}], id="named, over any connection"),
        pytest.param(
            [{"name": n, "keeps": False, "world": 1, "seed": 3} for n in "ab"], id="named, the same world and seed"
        ),
        pytest.param([{}, {"keeps": False}], id="one keeps its connection"),
    ],
)
def test_two_clients_at_one_address_in_lockstep(served, clients, labels):
    """Two clients whose queries alternate have two memories: each is given, bit for bit, what it is given alone."""
    values = [[0.1, -0.7, 0.3, 0.9, 0.2, -0.4], [0.8, 0.5, -0.6, 0.4, -0.3, 0.7]]

    def played(*chosen):
        policy = Remembers() if labels == "v3.1" else read_by(Turns(), "v4")
        one = served(policy, "arena")
        robots = [Robot(one.port, **clients[number]) for number in chosen]
        for robot in robots:
            robot.begin(3)
        got = [[] for _ in robots]
        for turn in range(6):
            for robot, of, number in zip(robots, got, chosen, strict=True):
                of.append(robot.query(values[number][turn]))
        return got

    first, second = played(0, 1)
    assert np.array_equal(first, played(0)[0]) and np.array_equal(second, played(1)[0])
    assert not np.array_equal(first, second)


class Turns(TurnsV4):
    """A yaw rate that follows from the state: what is decoded remembers the heading."""

    def act(self, observation):
        chunk = super().act(observation)
        chunk.actions[..., 5] = observation.state[:, 6:7]
        return chunk


def test_a_client_goes_on_over_another_connection(served):
    """A client without a name whose connection broke goes on over a new one; where two could be meant, none is."""
    one = served(Remembers(), "arena")
    robot = Robot(one.port)
    robot.begin(3)
    got = [robot.query(VALUES[0])]
    robot.connection.close()
    got += [robot.query(value) for value in VALUES[1:]]
    assert np.array_equal(got, expected(one, 3))
    pool = [Robot(one.port, world=0, seed=5) for _ in range(3)]
    for client in pool[:2]:
        client.begin(5)
    status, reply = pool[2].ask("/infer", {"observation": {"state": [0.0] * 64}, "step": 4})
    assert status == 409 and "X-Arena-Client" in reply["error"]


def test_a_client_with_several_connections(served):
    """A client without a name may ask for the world of an episode over another connection than it began it on."""
    one = served(Remembers(), "arena")
    first, other = (Robot(one.port, world=0, seed=3) for _ in range(2))
    first.begin(3)
    got = [client.query(value) for client, value in zip([first, other, first, other], VALUES, strict=False)]
    assert np.array_equal(got, expected(one, 3)[: len(got)])


def test_an_unfit_name_is_refused(served):
    """A client's name is a word; anything else is one line and status 400."""
    one = served(Remembers(), "arena")
    for name in ("", "a b", "x" * 65, "\u00e9"):
        status, reply = one.http("POST", "/reset", b"{}", {"X-Arena-Client": name.encode("latin-1")})
        assert status == 400 and "X-Arena-Client" in reply["error"]


def test_a_client_that_left_gives_its_rows_away(served, monkeypatch):
    """Rows of a client whose connections have closed are given to the next one sooner than those of one that stays."""
    monkeypatch.setattr(policy_server, "ABANDONED", 0.0)
    one = served(Remembers(), "arena", max_sessions=2)
    staying, leaving, coming = (Robot(one.port, name=name) for name in "abc")
    staying.begin(3)
    leaving.begin(4)
    assert coming.ask("/reset", {"seed": 5})[0] == 503
    leaving.connection.close()
    wait_for(lambda: coming.ask("/reset", {"seed": 5})[0] != 503, "free row")
    assert np.array_equal([staying.query(value) for value in VALUES], expected(served(Remembers()), 3))


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval", "arena"])
def test_routes(served, protocol):
    """Every endpoint answers /healthz, /health and /config; a browser and another route get nothing."""
    one = served(Remembers(), protocol)
    assert one.http("GET", "/healthz") == (200, b"OK\n")
    assert one.http("GET", "/health") == (200, {"status": "ok"})
    status, config = one.http("GET", "/config?max_batch_size=1")
    assert status == 200 and config["protocol"] == protocol and config["rate_hz"] == 50
    assert one.server.max_batch_size == 16, "a question changed the server"
    assert one.http("GET", "/config", headers={"Origin": "http://evil.example"})[0] == 403
    if protocol == "arena":
        assert one.http("GET", "/secret")[0] == 404 and one.http("POST", "/secret", b"{}")[0] == 404
        assert one.http("PUT", "/reset", b"{}")[0] == 501
        assert post(one, "/reset", b"{}")[0] == 200
        assert one.http("POST", "/reset", b"{}", {"Origin": "null"})[0] == 403
    else:
        with pytest.raises(InvalidStatus, match="403"):
            one.socket(origin="http://127.0.0.1")


@pytest.mark.parametrize("protocol", ["openpi", "arena"])
def test_token(served, protocol):
    """With a token only who sends it is let in; everybody learns whether the server is there."""
    one = served(Remembers(), protocol, token="s3cret")
    right, wrong = {"Authorization": "Bearer s3cret"}, {"Authorization": "Bearer s3cre"}
    assert one.http("GET", "/healthz")[0] == 200
    for headers in ({}, wrong, {"Authorization": "s3cret"}, {"Authorization": "Basic s3cret"}):
        status, reply = one.http("GET", "/config", headers=headers)
        assert status == 401 and "s3cret" not in str(reply)
    assert one.http("GET", "/config", headers=right)[0] == 200
    assert one.http("GET", "/config", headers={"Authorization": "Api-Key s3cret"})[0] == 200
    if protocol == "openpi":
        with pytest.raises(InvalidStatus, match="401"):
            one.socket(additional_headers=wrong)
        with one.socket(additional_headers=right) as client:
            client.recv(timeout=PLENTY)
    else:
        assert one.http("POST", "/reset", b"{}", wrong)[0] == 401 and one.http("POST", "/reset", b"{}", right)[0] == 200


def test_one_connection_too_many(served):
    """Connections beyond the limit are refused, and let in when another has left."""
    one = served(Remembers(), connections=2)
    first, second = one.socket(), one.socket()
    for connection in (first, second):  # greeted, so counted
        connection.recv(timeout=PLENTY)
    with pytest.raises(InvalidStatus, match="503"):
        one.socket()
    assert one.http("GET", "/healthz")[0] == 200
    second.close()

    def room():
        with suppress(InvalidStatus):
            one.socket().close()
            return True

    wait_for(room, "room after one has left")
    first.close()
    two = served(Remembers(), "arena", connections=1)
    kept = http.client.HTTPConnection("127.0.0.1", two.port, timeout=PLENTY)
    kept.request("GET", "/config")
    assert kept.getresponse().read()
    assert two.http("POST", "/reset", b"{}")[0] == 503
    kept.close()


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval", "arena"])
def test_errors_are_one_line(served, protocol):
    """A failing policy, an unfit action or message is reported in one line without paths; the server goes on."""
    one = served(Fails(), protocol)

    def told(kind, **more):
        seen = query(kind=kind, step=0, **more)
        if protocol == "arena":
            status, reply = post(one, "/infer", arena_codec.pack_query(seen))
            assert status == (500 if kind else 400)
            return reply["error"]
        with one.socket() as client:
            if protocol == "vla-eval":
                say(client, seen)
                return heard(client).payload["error"]
            client.recv(timeout=PLENTY)
            client.send(openpi_codec.pack_request(seen))
            text = client.recv(timeout=PLENTY)
            with pytest.raises(ConnectionClosed) as closed:
                client.recv(timeout=PLENTY)
            assert closed.value.rcvd.code == 1011
            return text

    assert told(1) == "the policy failed (RuntimeError); the server's console says more"
    assert "is nan, expected a finite number" in told(2)
    assert told(3) == "no plan for this world"
    assert told(0, task="sit_sofa") == "policy fails: does not know sit_sofa"


def test_a_session_that_closes_frees_its_row(served):
    """Any number of robots may come one after the other, also those whose connection is cut off."""
    one = served(Remembers(), max_sessions=2, connections=8)
    for number in range(6):
        client = one.socket()
        client.recv(timeout=PLENTY)
        ask(client, query(seed=1, step=0))
        if number % 2:
            client.close()
        else:
            client.socket.shutdown(socket.SHUT_RDWR)
        wait_for(lambda: not one.server._sessions, "free row")


def test_a_slow_client_holds_up_nobody(served):
    """Clients that send a request by drips, never read, or stop in the middle do not delay another one's answers."""
    one = served(Remembers(), "arena", connections=16)
    body = arena_codec.pack_query(query(seed=1, step=0, image=np.zeros((480, 640, 3), np.uint8)))
    head = b"POST /infer HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: %d\r\n\r\n" % len(body)
    slow = [socket.create_connection(("127.0.0.1", one.port)) for _ in range(6)]
    for n, connection in enumerate(slow):
        connection.sendall((head + body)[: 10 + 40 * n])
    began = time.monotonic()
    for i in range(5):
        assert post(one, "/infer", arena_codec.pack_query(query(seed=1, step=0, session=str(i))))[0] == 200
    assert time.monotonic() - began < 30.0, "half a body is waited for 60 s"
    for connection in slow:
        connection.close()
    two = served(Remembers(), connections=16)
    silent = [socket.create_connection(("127.0.0.1", two.port)) for _ in range(4)]
    deaf = two.socket(max_queue=1)
    with two.socket() as client:
        for _ in range(300):
            deaf.send(openpi_codec.pack_request(query(seed=1, step=0)))  # and never reads
        client.recv(timeout=PLENTY)
        assert ask(client, query(seed=2, step=0)).shape == (4, 40)
    for connection in silent:
        connection.close()
    deaf.socket.close()


@pytest.mark.parametrize(
    ("head", "status"),
    [
        ("POST /infer HTTP/1.1\r\n\r\n", 411),
        ("POST /infer HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n", 411),
        ("POST /infer HTTP/1.1\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\n", 411),
        ("POST /infer HTTP/1.1\r\nContent-Length: -5\r\n\r\n", 400),
        ("POST /infer HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n", 413),
        ("POST /infer HTTP/1.1\r\nContent-Length: 2\r\n\r\n[]", 400),
        ("GET / HTTP/9.9\r\n\r\n", 505),
        ("nonsense\r\n\r\n", 400),
        ("GET /" + "a" * 70000 + " HTTP/1.1\r\n\r\n", 414),
        ("GET / HTTP/1.1\r\n" + "a: b\r\n" * 200 + "\r\n", 431),
    ],
)
def test_unfit_http(served, head, status):
    """Other requests than the protocol's are refused as JSON, without pages or tracebacks, and the server goes on."""
    one = served(Remembers(), "arena")
    with socket.create_connection(("127.0.0.1", one.port), timeout=PLENTY) as connection:
        connection.sendall(head.encode())
        connection.shutdown(socket.SHUT_WR)
        reply = b""
        while piece := connection.recv(65536):
            reply += piece
    assert reply.startswith(b"HTTP/1.1 %d " % status), reply[:200]
    assert b"Traceback" not in reply and b"<html" not in reply.lower() and b'{"error": "' in reply
    assert one.http("GET", "/health")[0] == 200


def test_body_too_long_is_told(served):
    """A client that sends all of a body before it reads hears why it is refused, not of a broken pipe."""
    one = served(Remembers(), "arena")
    status, reply = one.http("POST", "/infer", b"a" * (MAX_FRAME + (1 << 20)))
    assert status == 413 and "expected at most" in reply["error"]
    assert one.http("GET", "/health")[0] == 200


def test_many_robots_at_once(served):
    """Eight robots over all of two protocols' connections are answered together, each as if it were alone."""
    one, results = served(Remembers(), "openpi", max_wait=0.0), {}
    with ExitStack() as connected:
        clients = [connected.enter_context(one.socket()) for _ in range(8)]
        for seed, client in enumerate(clients):
            client.recv(timeout=PLENTY)
            results[seed] = [ask(client, query(VALUES[0], seed=seed, step=0))]
        one.server.max_wait = PLENTY
        for i, value in enumerate(VALUES[1:], start=1):
            asked = [query(value, seed=seed, step=4 * i) for seed in range(8)]
            pairs = zip(clients, asked, strict=True)
            for seed, chunk in enumerate(together(*[lambda one=one: ask(*one) for one in pairs])):
                results[seed].append(chunk)
    assert one.server.counts.batches == {1: 8, 8: len(VALUES) - 1}
    for seed, chunks in results.items():
        assert np.array_equal(chunks, expected(one, seed))


def test_too_large_a_frame(served):
    """A frame beyond the limit closes its connection, and no other."""
    one = served(Remembers())
    with one.socket() as other:
        other.recv(timeout=PLENTY)
        with one.socket() as client:
            client.recv(timeout=PLENTY)
            with pytest.raises(ConnectionClosed) as closed:
                client.send(bytes(17 * 2**20))
                client.recv(timeout=PLENTY)
            assert closed.value.rcvd is None or closed.value.rcvd.code == 1009
        assert ask(other, query(seed=2, step=0)).shape == (4, 40)


def test_closing_ends_the_connections(served):
    """A server that closes says goodbye to who is connected, soon."""
    one = served(Remembers())
    client = one.socket()
    client.recv(timeout=PLENTY)
    began = time.monotonic()
    one.close()
    with pytest.raises(ConnectionClosed):
        client.recv(timeout=PLENTY)
    assert time.monotonic() - began < 8.0, "the library waits 10 s for a farewell"
    assert not [t for t in threading.enumerate() if t.name == "policy" and t.is_alive()]


def test_a_text_frame_and_a_wrong_type(served):
    """A text frame is recognised in openpi and vla-eval; a message of the server's own types is refused."""
    one = served(Remembers())
    with one.socket() as client:
        client.recv(timeout=PLENTY)
        client.send("hello")
        assert "a text frame, expected MessagePack" in client.recv(timeout=PLENTY)
    two = served(Remembers(), "vla-eval")
    with two.socket() as client:
        frame = {"type": "action", "payload": {}, "seq": 5, "timestamp": 0.0}
        client.send(msgpack.packb(frame))
        message = heard(client)
        assert message.seq == 5 and message.payload["error"].startswith("message: type action, expected episode_start")


def test_a_closing_http_server_hangs_up(served):
    """A connection that a client keeps is closed with the server, so that the client sees that it is gone."""
    one = served(Remembers(), "arena")
    kept = http.client.HTTPConnection("127.0.0.1", one.port, timeout=PLENTY)
    kept.request("GET", "/config")
    assert kept.getresponse().read()
    one.close()
    with pytest.raises((OSError, http.client.HTTPException)):
        kept.request("GET", "/config")
        kept.getresponse()
    with pytest.raises(Refused, match="^the server is closing$") as caught:
        one.server.query("a", query(step=0))
    assert caught.value.reason == "closing"


@pytest.mark.parametrize("protocol", ["openpi", "arena"])
def test_strangers_are_no_news(served, protocol, capfd, caplog):
    """A stranger that sends nothing, nonsense or half a request leaves no traceback on the console."""
    one = served(Remembers(), protocol)
    for data in (
        b"",
        b"garbage\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
    ):
        with socket.create_connection(("127.0.0.1", one.port)) as connection:
            connection.sendall(data)
    assert one.http("GET", "/health")[0] == 200
    time.sleep(0.2)
    printed = capfd.readouterr()
    assert not printed.out + printed.err and not caplog.records


@pytest.mark.parametrize("protocol", ["openpi", "arena"])
def test_an_error_of_our_own_is_on_the_console(served, protocol, capfd, monkeypatch):
    """A fault of the server itself is printed there, and the client is hung up on without it."""
    one = served(Remembers(), protocol)

    def broken(*_, **__):
        raise ZeroDivisionError("inside the server")

    monkeypatch.setattr(one.server, "query", broken)
    if protocol == "arena":
        with pytest.raises((OSError, http.client.HTTPException)):
            one.http("POST", "/infer", arena_codec.pack_query(query(step=0)))
    else:
        with one.socket() as client:
            client.recv(timeout=PLENTY)
            client.send(openpi_codec.pack_request(query(step=0)))
            with pytest.raises(ConnectionClosed) as closed:
                client.recv(timeout=PLENTY)
            assert "inside the server" not in str(closed.value)
    printed = []

    def told():
        printed.append(capfd.readouterr().err)
        return "ZeroDivisionError: inside the server" in "".join(printed)

    wait_for(told, "line on the console")
