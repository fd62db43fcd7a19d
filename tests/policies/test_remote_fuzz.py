"""Broken and hostile HTTP replies: none of them crashes the client, holds it up, or fills the memory."""

import itertools
import json
import random
import resource
import socket
import threading
import time

import numpy as np
import pytest

from arena_newton.errors import InputError
from arena_newton.policies import Observation
from arena_newton.policies.remote.arena_client import RemotePolicy
from arena_newton.robot.canonical import validate_action
from tests.patience import PLENTY, patiently

pytestmark = pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")

BATCH = 16
ACTION = [0.0, 0.0, 0.8, 1.0, 0.0, 0.0, 1.0, *[0.0] * 33]
HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
BODY = json.dumps({"action_chunk": [ACTION] * 4}).encode()


def reply(body=BODY, head=HEAD):
    return head + b"Content-Length: %d\r\n\r\n" % len(body) + body


def chunked(*pieces, end=b"0\r\n\r\n"):
    coded = b"".join(b"%x\r\n%s\r\n" % (len(p), p) for p in pieces)
    return HEAD + b"Transfer-Encoding: chunked\r\n\r\n" + coded + end


def endless(start, again):
    """Bytes without an end, from their start at each call."""
    return lambda: itertools.chain([start], itertools.repeat(again))


def status_lines():
    lines = ["", "HTTP/1.1", "HTTP/1.1 abc OK", "HTTP/9.9 200 OK", "HTTP/1.1 -200 OK", "HTTP/1.1 99999 OK", "\0" * 40]
    lines += ["HTTP/1.1 200 " + "x" * 70000, "SSH-2.0-OpenSSH", "HTTP/0.9 200 OK", "ICY 200 OK", " HTTP/1.1 200 OK"]
    lines += [
        f"HTTP/1.1 {code} Text" for code in (101, 199, 201, 204, 206, 301, 304, 400, 401, 404, 500, 502, 503, 999)
    ]
    lines += ["HTTP/1.1 100 Continue\r\n\r\n" * n + "HTTP/1.1 200 OK" for n in (1, 1000)]
    lines += ["HTTP/1.1 302 Found\r\nLocation: http://127.0.0.1:1/infer", "HTTP/1.0 200 OK", "\x1b[2J\x1b]0;title\x07"]
    return [line.encode() + b"\r\nContent-Length: %d\r\n\r\n" % len(BODY) + BODY for line in lines]


def headers():
    lengths = [b"-1", b"", b"abc", b"1e3", b"9223372036854775808", b"9" * 400, b"5, 7", b"0", b"10", b"99999999", b"+8"]
    lengths += [b"4294967296", b"0x10", b"\xff", b"%d\r\nContent-Length: 3" % len(BODY)]
    cases = [HEAD + b"Content-Length: " + n + b"\r\n\r\n" + BODY for n in lengths]
    lines = [
        b"",
        b"no colon",
        b" folded",
        b": nameless",
        b"X: " + b"y" * 70000,
        b"X: \0\xff\x1b[31m",
        b"X: y\r\n" * 200,
    ]
    lines += [
        b"Content-Encoding: gzip",
        b"Transfer-Encoding: gzip",
        b"Transfer-Encoding: chunked",
        b"Connection: upgrade",
    ]
    cases += [HEAD + line + b"\r\n\r\n" + BODY for line in lines]
    return cases + [reply(head=HEAD + line + b"\r\n") for line in lines]


def chunk_codings():
    cases = [chunked(BODY), chunked(*[BODY[i : i + 1] for i in range(len(BODY))]), chunked(BODY, end=b""), chunked()]
    cases += [chunked(BODY, end=b"0\r\n" + b"X: y\r\n" * 5000 + b"\r\n"), chunked(BODY, end=b"0;" + b"e" * 70000)]
    start = chunked(end=b"")
    sizes = [b"zz", b"-5", b"", b"F" * 16, b"1" * 70000, b"\xff", b"5;x=y", b"ffffffff", b"0x5", b" 5 ", b"5\r"]
    return cases + [start + size + b"\r\n" + BODY + b"\r\n0\r\n\r\n" for size in sizes]


def bodies():
    odd = [None, True, False, 0, 1.5, "text", [], {}, [[]], [{}], [None], {"a": 1}, [[None] * 40], [["1"] * 40]]
    odd += [[[True] * 40], [[[0.0]] * 40], [ACTION[:39]], [[*ACTION, 0.0]], [ACTION, ACTION[:1]], [ACTION, None]]
    odd += [[[0.0] * 40], [ACTION, [*ACTION[:3], 0, 0, 0, 0, 0, 0, *ACTION[9:]]], [ACTION] * 5000, ACTION, [ACTION]]
    odd += [[[*ACTION[:20], 10**400, *ACTION[21:]]], [[*ACTION[:20], 1e300, *ACTION[21:]]], [[*ACTION[:39], "NaN"]]]
    cases = [json.dumps(value) for value in odd]
    cases += [json.dumps({key: value}) for value in odd for key in ("action_chunk", "action", "error")]
    text = json.dumps({"action_chunk": [ACTION]})
    numbers = ["NaN", "Infinity", "-Infinity", "1e999", "1" * 5000, "0x10", "01", "-", "1e-999", "-0.0", "1" * 300]
    cases += [text.replace("0.8", number) for number in numbers]
    cases += [open_ * n for open_ in ("[", '{"a":', '{"action_chunk":[', '{"error":[') for n in (900, 500_000)]
    cases += ["[" * n + "]" * n for n in (500, 1200, 100_000)]
    cases += [
        "[" + "[]," * 1_300_000 + "[]]",
        '{"action_chunk":[' + "{}," * 1_300_000 + "{}]}",
        " " * (5 << 20),
        "1" * (4 << 20),
    ]
    cases += [
        '{"error":"' + "\\u001b[31m\\ud800" * 100_000 + '"}',
        '{"error":"a\\nb\\u0000\\u202e"}',
        "",
        "{}",
        "\ufeff{}",
    ]
    return [reply(c.encode()) for c in cases] + [
        reply(text.encode("utf-16")),
        reply(b"\xff\xfe\xfd"),
        reply(b"\x80" * 99),
    ]


def flips(count):
    """A good reply with bytes changed, taken out, doubled, or cut off."""
    rng = random.Random(5)
    good = [reply(), chunked(BODY[:700], BODY[700:])]
    for number in range(count):
        data = bytearray(good[number % 2])
        for _ in range(rng.randint(1, 6)):
            at = rng.randrange(min(len(data), 120) if rng.random() < 0.5 else len(data))
            kind = rng.randrange(4)
            if kind == 0:
                data[at] = rng.randrange(256)
            elif kind == 1:
                del data[at : at + rng.randint(1, 20)]
            elif kind == 2:
                data[at:at] = data[at : at + rng.randint(1, 20)]
            elif rng.random() < 0.4:
                del data[at:]
            if not data:
                break
        yield bytes(data)


def streams():
    """Replies without an end, and none at all."""
    yield endless(HEAD + b"\r\n", b" " * 65536)
    yield endless(HEAD, b"X: y\r\n")
    yield endless(b"HTTP/1.1 200 OK", b"x" * 4096)
    yield endless(b"", b"HTTP/1.1 100 Continue\r\n\r\n")
    yield endless(b"", b"HTTP/1.1 100 Continue\r\nX: y\r\n\r\n" * 100)
    yield endless(chunked(end=b""), b"1\r\n \r\n")
    yield endless(chunked(BODY, end=b"0\r\n"), b"X: y\r\n")
    yield lambda: ()


class Server:
    """Sends prepared bytes to the world that asks; a GET gets a proper answer."""

    def __init__(self):
        self.listening = socket.create_server(("127.0.0.1", 0), backlog=128)
        self.url = f"http://127.0.0.1:{self.listening.getsockname()[1]}"
        self.answers, self.stopped = {}, threading.Event()
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self):
        while True:
            try:
                connection, _ = self.listening.accept()
            except OSError:
                return
            threading.Thread(target=self.serve, args=(connection,), daemon=True).start()

    def serve(self, connection):
        with connection, connection.makefile("rb") as asked:
            try:
                line, length = asked.readline(), 0
                while (header := asked.readline()) not in (b"\r\n", b""):
                    if header.lower().startswith(b"content-length:"):
                        length = int(header.split(b":")[1])
                if not line:
                    return
                if line.startswith(b"GET"):
                    connection.sendall(b"HTTP/1.1 404 No\r\nContent-Length: 0\r\n\r\n")
                    return
                answer = self.answers[json.loads(asked.read(length))["world"]]
                if isinstance(answer, bytes):
                    connection.sendall(answer)
                    return
                for piece in answer():
                    connection.sendall(piece)
                self.stopped.wait(600.0)
            except OSError:
                pass  # the client has hung up

    def close(self):
        self.stopped.set()
        self.listening.shutdown(socket.SHUT_RDWR)
        self.listening.close()


def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def test_broken_replies_are_an_error_of_their_world(mutants):
    """Every reply gives a chunk that is fit, or one plain line of its world; in time, and in less than 512 MiB."""
    cases = [*status_lines(), *headers(), *chunk_codings(), *bodies(), *flips(mutants)]
    server, before = Server(), peak()

    def fit(batch, deadline):
        server.answers = {0: reply(), **{1 + i: case for i, case in enumerate(batch)}}
        policy = RemotePolicy(server.url, timeout=deadline, retries=0)
        mask = np.arange(BATCH) <= len(batch)
        began = time.monotonic()
        chunk = policy.act(
            Observation(np.zeros((BATCH, 64), np.float32), None, mask, "boxing", "Isaac-Boxing", "Strike.")
        )
        assert time.monotonic() - began < 5 * deadline
        assert 0 not in chunk.errors and chunk.actions.shape[0] == BATCH and chunk.actions.shape[2] == 40
        validate_action(chunk.actions, "answer")
        for message in chunk.errors.values():
            assert message.startswith(server.url) and message.isprintable() and len(message) < 400
        policy.close()
        return len(batch) - len(chunk.errors)

    found = sum(fit(cases[start : start + BATCH - 1], PLENTY) for start in range(0, len(cases), BATCH - 1))
    assert 20 < found < len(cases) // 2
    patiently(lambda deadline: fit([*streams()], deadline), (1.5, 15.0, 60.0))
    server.close()
    assert peak() - before < 512
    print(f"{len(cases)} replies, {found} of them fit, {peak() - before:.0f} MiB")


def test_broken_replies_to_the_first_request_are_refused(mutants):
    """An answer to the first request is a policy server's, or one line."""
    cases = [
        *status_lines(),
        *headers(),
        *chunk_codings(),
        *flips(mutants),
        reply(b'{"seeded": [1]}'),
        reply(b'{"policy": {}}'),
    ]
    server, passed = Server(), 0
    policy = RemotePolicy(server.url, timeout=PLENTY, retries=0)
    for case in cases:
        server.answers = {0: case}
        try:
            policy.check()
            passed += 1
        except InputError as error:
            assert str(error).startswith("--policy remote: no policy server: ") and str(error).isprintable()
        assert policy.describe()["seeding"] == "undeclared"
    assert 5 < passed < len(cases)
    policy.close()
    server.close()
    print(f"{len(cases)} first replies, {passed} of them taken")
