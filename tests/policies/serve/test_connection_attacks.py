"""Hostile, deaf and half-open clients do nothing to the endpoints that another client notices."""

import base64
import json
import os
import resource
import socket
import struct
import threading
import time
import warnings
import zlib
from concurrent.futures import CancelledError
from contextlib import ExitStack, suppress

import msgpack
import numpy as np
import pytest
from served_policies import Remembers, query, state, together

from arena_newton.policies.protocols import openpi_codec, vla_eval_codec
from arena_newton.policies.protocols.arena_codec import unpack_query
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.serve import connection_guard, message_readers, websocket_listener
from tests.patience import PLENTY, wait_for

pytestmark = pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")

RESET = b"POST /reset HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer abc\r\nContent-Length: 2\r\n\r\n{}"


def plain_socket(port, more=b""):
    """A websocket made by hand, which answers nothing by itself, and the status that it got."""
    connection = socket.create_connection(("127.0.0.1", port), timeout=PLENTY)
    key = base64.b64encode(os.urandom(16))
    connection.sendall(
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: "
        + key
        + b"\r\n"
        b"Sec-WebSocket-Version: 13\r\n" + more + b"\r\n"
    )
    return connection, int(connection.recv(4096).split()[1])


@pytest.mark.parametrize("protocol", ["openpi", "arena"])
def test_a_connection_that_cannot_be_taken_ends_no_endpoint(served, protocol):
    """An endpoint whose process has no file descriptors left goes on when there are some again."""
    one = served(Remembers(), protocol)
    client = socket.socket()
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as filled:
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 8, limits[1]))
            with suppress(OSError):
                while True:
                    filled.enter_context(open(os.devnull))
            client.connect(("127.0.0.1", one.port))
            time.sleep(0.1)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert one.http("GET", "/healthz") == (200, b"OK\n")
    client.close()


def talkative():
    """A policy with answers of 320 kB."""
    policy = Remembers()
    policy.chunk_size = 2000
    return policy


def stuff(connection):
    """Send queries until neither side's buffer takes any more, and return one."""
    frame = openpi_codec.pack_request(query(seed=1, step=0))
    frame = b"\x82\xfe" + struct.pack(">H", len(frame)) + bytes(4) + frame
    connection.settimeout(0.2)
    with suppress(TimeoutError):
        for _ in range(20000):
            connection.sendall(frame)
    return frame


def test_a_client_that_reads_nothing_is_hung_up_on(served, monkeypatch):
    """A client that reads no answer for a time is left, so that its thread and its row are free."""
    monkeypatch.setattr(websocket_listener, "SEND_SECONDS", 0.2)
    one = served(talkative())
    deaf, _ = plain_socket(one.port)
    with pytest.raises(ConnectionError):
        frame = stuff(deaf)
        deaf.settimeout(PLENTY)
        while True:
            deaf.sendall(frame)
    deaf.close()


def test_deaf_clients_do_not_hold_up_the_end(served, monkeypatch):
    """An endpoint closes at once, however many clients neither answer nor read."""
    monkeypatch.setattr(websocket_listener, "FAREWELL_SECONDS", 0.2)
    one = served(talkative(), connections=8)
    deaf = [plain_socket(one.port)[0] for _ in range(4)]
    stuff(deaf[0])
    began = time.monotonic()
    one.endpoint.close()
    assert time.monotonic() - began < 8.0, "the library waits 10 s for a farewell"
    for client in deaf:
        client.close()


@pytest.mark.parametrize("protocol", ["openpi", "arena"])
def test_strangers_take_no_room(served, protocol):
    """Connections that have not shown a token do not count; beyond a number they are closed unread."""
    one = served(Remembers(), protocol, token="abc", connections=2)
    silent = [socket.create_connection(("127.0.0.1", one.port)) for _ in range(10)]
    time.sleep(0.05)
    if protocol == "arena":
        with socket.create_connection(("127.0.0.1", one.port), timeout=PLENTY) as client:
            client.sendall(RESET)
            assert client.recv(4096).startswith(b"HTTP/1.1 200 ")
    else:
        client, status = plain_socket(one.port, b"Authorization: Bearer abc\r\n")
        assert status == 101
        client.close()
    more = [
        socket.create_connection(("127.0.0.1", one.port), timeout=PLENTY) for _ in range(connection_guard.STRANGERS)
    ]
    assert more[-1].recv(1) == b""
    for connection in silent + more:
        connection.close()

    def room():
        with suppress(OSError, ValueError):
            return one.http("GET", "/health")[0] == 200

    wait_for(room, "room after strangers have left")


def test_a_head_by_drips_is_hung_up_on(served, monkeypatch):
    """A client that sends the first request's head for ever is closed, so that strangers do not gather."""
    monkeypatch.setattr("arena_newton.policies.serve.http_endpoint.STRANGER_SECONDS", 0.2)
    one = served(Remembers(), "arena")
    began = time.monotonic()
    with socket.create_connection(("127.0.0.1", one.port), timeout=PLENTY) as drips, pytest.raises(OSError, match="."):
        while time.monotonic() - began < PLENTY:
            drips.sendall(b"G")
            time.sleep(0.02)


@pytest.mark.parametrize("protocol", ["openpi", "arena"])
def test_a_token_that_is_no_text(served, protocol):
    """A token of bytes that are no characters is a wrong token, and no fault of the server."""
    one = served(Remembers(), protocol, token="abc")
    connection, status = plain_socket(one.port, b"Authorization: Bearer \xff\xfe\r\n")
    assert status == 401
    connection.close()


def picture(width, height):
    """A black PNG, which is a thousandth of what it unpacks to."""

    def part(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    lines = zlib.compress(bytes(height * (1 + 3 * width)), 9)
    data = b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", lines) + part(b"IEND", b"")
    return {"__image__": True, "format": "png", "data": data, "shape": [height, width, 3]}


LARGEST = 1920, 1200
"""Width and height of the largest picture."""


def asked_with(**images):
    """A frame of vla-eval that shows pictures."""
    payload = {"images": images, "states": [float(v) for v in state(0.1)], "task": "boxing"}
    return msgpack.packb({"type": "observation", "payload": payload, "seq": 1, "timestamp": 0.0})


def test_pictures_stay_packed():
    """Pictures of our cameras alone are ever unpacked from a message, and none before its turn."""
    frame = asked_with(wrist=picture(*LARGEST), front=picture(32, 24))
    seen = vla_eval_codec.unpack_request(vla_eval_codec.unpack_message(frame))
    assert [*seen.images] == ["front"] and seen.image.unpacked().shape == (24, 32, 3)
    with pytest.raises(WireError, match="^message: a picture of 1920x1201, expected 16 to 2048 pixels a side and at m"):
        vla_eval_codec.unpack_message(asked_with(front=picture(1920, 1201)))


def test_large_messages_are_read_one_by_one(monkeypatch):
    """One of thirty large messages is read at a time, and the others go past those that wait."""
    monkeypatch.setattr(message_readers, "LONGEST_PAUSE", 0.0)
    readers, begun, go_on = message_readers.MessageReaders(), threading.Event(), threading.Event()
    large, usual = message_readers.LARGE + 1, 10**6
    threads = [
        threading.Thread(target=readers.run, args=[large, lambda: (begun.set(), go_on.wait(PLENTY))]) for _ in range(30)
    ]
    try:
        for thread in threads:
            thread.start()
        assert begun.wait(PLENTY)
        assert readers.run(usual, lambda: readers.inside) == large + usual, "while a large one is being read"
        with pytest.raises(WireError, match="^damaged$"):
            readers.run(usual, raise_damaged)
        go_on.set()
        for thread in threads:
            thread.join(PLENTY)
        assert readers.most_inside == large + usual and readers.inside == 0
    finally:
        go_on.set()
        readers.close()
    with pytest.raises(CancelledError):
        readers.run(usual, int)


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval"])
def test_robots_with_the_largest_pictures_are_read_one_by_one(served, monkeypatch, protocol):
    """Robots that send the largest pictures at once are all answered, and never are two of these read together."""
    monkeypatch.setattr(message_readers, "LONGEST_PAUSE", 0.0)
    one = served(Remembers(sees=True), protocol)
    openpi = protocol == "openpi"
    raw = openpi_codec.pack_request(query(image=np.zeros((*LARGEST[::-1], 3), np.uint8)))
    frame = raw if openpi else asked_with(front=picture(*LARGEST))

    def ask():
        with one.socket() as robot:
            if openpi:
                robot.recv(timeout=PLENTY)
            robot.send(frame)
            answer = robot.recv(timeout=PLENTY)
            return "actions" in (msgpack.unpackb(answer) if openpi else vla_eval_codec.unpack_message(answer).payload)

    assert together(*[ask] * 4) == [True] * 4
    assert message_readers.LARGE < one.server.readers.most_inside < 2 * message_readers.LARGE


def raise_damaged():
    raise WireError("damaged")


def test_unpacking_leaves_warnings_alone(served):
    """Two robots send pictures while the policy warns: a warning stays one, and the process's filters as they were."""

    class Warns(Remembers):
        def act(self, observation):
            warnings.warn("an old argument", UserWarning, stacklevel=1)
            return super().act(observation)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        before = list(warnings.filters)
        one = served(Warns(sees=True), "vla-eval")

        def play():
            with one.socket() as robot:
                robot.send(vla_eval_codec.pack_hello(None, 1, 0.0))
                robot.recv(timeout=PLENTY)
                kinds = []
                for _ in range(8):
                    robot.send(asked_with(front=picture(640, 480)))
                    kinds.append(vla_eval_codec.unpack_message(robot.recv(timeout=PLENTY)).type)
            return kinds

        assert together(*[play] * 3) == [["action"] * 8] * 3
        assert warnings.filters == before


@pytest.mark.parametrize("protocol", ["openpi", "arena"])
def test_another_name_for_this_machine_is_refused(served, protocol):
    """A web site whose name was made to point here asks nothing, by GET neither, unless it knows a token."""
    one = served(Remembers(), protocol)
    for host, status in (
        ("evil.example", 403),
        (f"evil.example:{one.port}", 403),
        ("127.0.0.1.evil.example", 403),
        ("localhost", 200),
        ("127.0.0.1:9", 200),
        ("[::1]:8000", 200),
    ):
        assert one.http("GET", "/config", headers={"Host": host})[0] == status, host
    two = served(Remembers(), protocol, token="abc")
    headers = {"Host": "policies.example", "Authorization": "Bearer abc"}
    assert two.http("GET", "/config", headers=headers)[0] == 200, "a proxy passes names on"


def test_values_of_json_are_counted():
    """A body that would become millions of Python objects is refused before it is read."""
    body = b'{"observation": {"state": [' + b"[]," * 100_000 + b"1]}}"
    with pytest.raises(WireError, match="^/infer: more than 65536 values$"):
        unpack_query(body)


def test_one_action_at_a_time(served):
    """Without `return_chunk` a chunk is given one by one, as the original's server does; a reset ends it."""
    one = served(Remembers(), "arena")
    seen = {"observation": {"state": [float(v) for v in state(0.1)]}, "return_chunk": False, "task": "boxing"}

    def asked():
        status, reply = one.http("POST", "/infer", json.dumps(seen).encode())
        assert status == 200 and list(reply) == ["action"]
        return reply["action"]

    one.http("POST", "/reset", b'{"seed": 3}')
    one.policy.calls.clear()
    first = [asked() for _ in range(5)]
    assert len(one.policy.calls) == 2, "a chunk of four holds four actions"
    one.http("POST", "/reset", b'{"seed": 3}')
    assert [asked() for _ in range(5)] == first
    chunk = json.loads(json.dumps(seen)) | {"return_chunk": True}
    one.http("POST", "/reset", b'{"seed": 3}')
    whole = one.http("POST", "/infer", json.dumps(chunk).encode())[1]["action_chunk"]
    assert whole == first[:4]
