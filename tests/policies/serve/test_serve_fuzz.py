"""Damaged frames: each codec refuses them in one line, and each server goes on answering."""

import http.client
import random
from contextlib import suppress

import numpy as np
import pytest
from served_policies import Remembers, query
from websockets.exceptions import ConnectionClosed

from arena_newton.policies.protocols import arena_codec, openpi_codec, vla_eval_codec
from arena_newton.policies.protocols.handshake import expected_facts
from arena_newton.policies.protocols.policy_messages import Begin, End
from arena_newton.policies.protocols.wire_error import WireError
from tests.fuzz.mutants import damaged
from tests.patience import PLENTY

pytestmark = pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")

IMAGE = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)
QUERY = query(0.1, image=IMAGE, session="1", seed=3, step=0)
BEGIN = Begin("1", 3, "boxing", "Box.")
ACTIONS = np.zeros((2, 40), dtype=np.float32)


def read_vla(data):
    message = vla_eval_codec.unpack_message(data)
    match message.type:
        case "hello":
            vla_eval_codec.unpack_hello(message, "x")
        case "action" | "error":
            vla_eval_codec.unpack_action(message, 1, "x")
        case _:
            vla_eval_codec.unpack_request(message)


def read_answer(data):
    return openpi_codec.unpack_answer(data, "x")


FRAMES = {
    "openpi request": (openpi_codec.pack_request(QUERY, roboarena=True), openpi_codec.unpack_request, False),
    "openpi reset": (openpi_codec.pack_request(BEGIN, roboarena=True), openpi_codec.unpack_request, False),
    "openpi metadata": (
        openpi_codec.pack_metadata(expected_facts()),
        lambda data: openpi_codec.unpack_metadata(data, "x"),
        False,
    ),
    "openpi answer": (
        openpi_codec.pack_answer(ACTIONS, 1.0),
        lambda data: openpi_codec.unpack_answer(data, "x"),
        False,
    ),
    "vla query": (vla_eval_codec.pack_request(QUERY, 1, 0.0), read_vla, False),
    "vla start": (vla_eval_codec.pack_request(BEGIN, 1, 0.0), read_vla, False),
    "vla end": (vla_eval_codec.pack_request(End("1"), 1, 0.0), read_vla, False),
    "vla hello": (vla_eval_codec.pack_hello(expected_facts(), 1, 0.0), read_vla, False),
    "vla action": (vla_eval_codec.pack_action(ACTIONS, 1, 0.0), read_vla, False),
    "arena query": (arena_codec.pack_query(QUERY), arena_codec.unpack_query, True),
    "arena begin": (arena_codec.pack_begin(BEGIN), arena_codec.unpack_begin, True),
    "arena chunk": (arena_codec.pack_chunk(ACTIONS), lambda data: arena_codec.unpack_chunk(data, "x"), True),
    "arena config": (
        arena_codec.pack_config(expected_facts()),
        lambda data: arena_codec.unpack_config(data, "x"),
        True,
    ),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_codecs_read_damaged_frames(kind, mutants):
    """A damaged frame is read or refused with one short line; nothing else is raised."""
    data, read, text = FRAMES[kind]
    read(data)
    rng = random.Random(kind)
    refused = 0
    for _ in range(5 * mutants):
        mutant = damaged(data, rng, text=text and rng.random() < 0.7)
        try:
            read(mutant)
        except WireError as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 400 and str(error).isprintable(), mutant
    assert refused > mutants // 2


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval"])
def test_sockets_survive_damaged_frames(served, protocol, mutants):
    """After damaged frames, answered in one line or by a closed connection, a robot is served as ever."""
    one = served(Remembers(sees=True), protocol, max_wait=0.0)
    rng = random.Random(protocol)
    sound = [data for kind, (data, _, _) in FRAMES.items() if kind.startswith(protocol[:3])]
    lines, client = 0, None
    for _ in range(mutants):
        if client is None:
            client = one.socket()
            if protocol == "openpi":
                client.recv(timeout=PLENTY)
        try:
            client.send(damaged(rng.choice(sound), rng))
            reply = client.recv(timeout=0.2 if protocol == "vla-eval" else PLENTY)
            if isinstance(reply, str):
                lines += 1
                assert "\n" not in reply and "Traceback" not in reply and len(reply) <= 300
                if reply != openpi_codec.RESET_ANSWER:
                    # The server hangs up; one more frame, sent before that is seen, would hold up its farewell by 10 s.
                    client.close()
                    client = None
            elif protocol == "vla-eval":
                message = vla_eval_codec.unpack_message(reply)
                lines += message.type == "error"
                assert "Traceback" not in str(message.payload)
        except TimeoutError:
            pass  # the beginning or end of an episode is not answered
        except ConnectionClosed:
            client = None
    assert lines > mutants // 10
    with one.socket() as sane:
        if protocol == "openpi":
            sane.recv(timeout=PLENTY)
            sane.send(openpi_codec.pack_request(QUERY))
            assert openpi_codec.unpack_answer(sane.recv(timeout=PLENTY), "x").shape == (4, 40)
        else:
            sane.send(vla_eval_codec.pack_hello(None, 1, 0.0))
            sane.recv(timeout=PLENTY)
            sane.send(vla_eval_codec.pack_request(QUERY, 5, 0.0))
            message = vla_eval_codec.unpack_message(sane.recv(timeout=PLENTY))
            assert vla_eval_codec.unpack_action(message, 5, "x").shape == (4, 40)
    if client is not None:
        client.close()


def test_a_client_that_sends_on_after_a_failure_is_let_go(served):
    """Frames that follow a failed request do not keep its connection: it ends before the library gives up waiting."""
    one = served(Remembers(), "openpi")
    client = one.socket()
    client.recv(timeout=PLENTY)
    client.send(b"\xc1")
    with suppress(ConnectionClosed):  # the server may be quicker than the second frame
        client.send(b"\xc1")
        client.send(b"\xc1")
    assert isinstance(client.recv(timeout=PLENTY), str)
    with pytest.raises(ConnectionClosed):
        client.recv(timeout=9)


def test_http_survives_damaged_bodies(served, mutants):
    """Damaged bodies and heads are answered with a status and one line of JSON, or hung up on; the server goes on."""
    one = served(Remembers(sees=True), "arena", max_wait=0.0)
    rng = random.Random("arena")
    bodies = {"/infer": arena_codec.pack_query(QUERY), "/reset": arena_codec.pack_begin(BEGIN)}
    statuses = set()
    connection = http.client.HTTPConnection("127.0.0.1", one.port, timeout=PLENTY)
    for _ in range(mutants):
        route = rng.choice(list(bodies))
        connection.request("POST", route, damaged(bodies[route], rng, text=rng.random() < 0.7))
        reply = connection.getresponse()
        data = reply.read()
        statuses.add(reply.status)
        assert data[:1] == b"{" and b"Traceback" not in data and b"\\n" not in data
    connection.close()
    assert {200, 400} <= statuses <= {200, 400, 409}
    reply = one.http("POST", "/infer", arena_codec.pack_query(query(0.1, image=IMAGE, session="7", seed=8, step=0)))
    assert reply[0] == 200
