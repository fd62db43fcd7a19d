"""Damaged replies of each protocol: one line about one world, never a crash, a hang or a filled memory."""

import random
import resource

import msgpack
import numpy as np
import pytest
from foreign_servers import (
    CHUNK,
    MODALITIES,
    Gr00tServer,
    SocketServer,
    answer,
    asking,
    facts,
    gr00t_packed,
    npy,
    observation,
)

from arena_newton.errors import ArenaError, InputError
from arena_newton.policies.protocols import openpi_codec, vla_eval_codec
from arena_newton.policies.protocols.packed_arrays import OPENPI_KEYS, pack
from arena_newton.policies.remote.gr00t_client import pack_gr00t, read_modalities, unpack_gr00t
from arena_newton.robot.canonical import ACTION, validate_action
from tests.fuzz.mutants import damaged
from tests.patience import PLENTY

pytestmark = pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")

ROWS = answer(np.zeros(64), None, 1, 0)
PARTS = {name: ROWS[None][..., part] for name, part in ACTION.items()}


def broken(good, count, seed):
    """Damaged copies of a message."""
    rng = random.Random(seed)
    return [damaged(good, rng) for _ in range(count)]


def hand_made():
    """Damage that no random bytes find: other types in every place of an answer."""
    odd = [None, True, 7, -1.5, "text", b"bytes", [], {}, [[1.0] * 40], [[1] * 40, None], {"actions": 3}]
    odd += [np.zeros((0, 40)), np.zeros((40, 40, 40)), np.full((2, 40), np.inf), np.zeros((2, 40), bool)]
    odd += [np.zeros((3, 40), np.int64), np.zeros(40, np.float16), np.zeros((1, 0), np.float32)]
    bombs = [b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\x91" * 5000 + b"\xc0"]
    bombs += [b"\xdc\xff\xff" + b"\xc0" * 65535, b"\x81\xc4\x0b__ndarray__\xc3", b"\xd4\x01\x00", b""]
    shapes = [[10**9, 10**9], [-1, 40], [2**63, 0], [1] * 60, "4x40", [4, 40.0], None]
    for shape in shapes:
        bad = {b"__ndarray__": True, b"data": b"\0" * 640, b"dtype": "<f4", b"shape": shape}
        bombs.append(pack({"actions": 1}, OPENPI_KEYS)[:-1] + msgpack.packb(bad))
    for kind in ("|O", "|V8", "<c8", "<M8[s]", "f4,f4", "<U3", "x" * 999, 5, None):
        bad = {b"__ndarray__": True, b"data": b"\0" * 640, b"dtype": kind, b"shape": [4, 40]}
        bombs.append(pack({"actions": 1}, OPENPI_KEYS)[:-1] + msgpack.packb(bad))
    return (
        [pack({"actions": value}, OPENPI_KEYS) for value in odd] + [pack(value, OPENPI_KEYS) for value in odd] + bombs
    )


class Answering(SocketServer):
    """A server whose answers are taken from a list."""

    replies: list

    def __init__(self, protocol, replies):
        self.replies = replies
        super().__init__(protocol, facts(needs_picture=False, picture=None))

    def fail(self, socket, query):
        with self.lock:
            reply = self.replies.pop()
        socket.send(reply)
        return True

    def fault(self, query):
        return "39"  # sends vla-eval's queries to `fail`, too


def drive(server, policy, count):
    """Ask until the replies are used up; how many were refused."""
    refused = 0
    while server.replies:
        policy._failures = 0  # the run would stop after ten in a row
        policy.reset([1, 2, 3], ["Isaac-Football"] * 3)
        asks = np.arange(3) < len(server.replies)
        chunk = policy.act(observation(3, asks))
        refused += len(chunk.errors)
        for message in chunk.errors.values():
            assert "\n" not in message and server.url in message and len(message) < 600
            assert not any(ord(c) < 32 for c in message)
        good = [w for w in np.flatnonzero(asks) if w not in chunk.errors]
        validate_action(np.asarray(chunk.actions)[good], "served")
    assert count // 4 < refused <= count
    return refused


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval"])
def test_broken_replies_are_an_error_of_their_world(protocol, mutants):
    """Damaged frames through real sockets: each is the error of one world, and the next episode is served."""
    if protocol == "openpi":
        good = openpi_codec.pack_answer(ROWS, 1.0)
        replies = [
            *broken(good, mutants, 1),
            *hand_made(),
            "text",
            "",
            "Traceback\n" * 500 + "\x1b[31mValueError: no\x07",
        ]
    else:
        good = vla_eval_codec.pack_action(ROWS, 3, 1.0)
        replies = [*broken(good, mutants, 2), *hand_made(), "text", vla_eval_codec.pack_error("no\n\x1b[2J", 3, 0.0)]
    server = Answering(protocol, list(replies))
    policy = asking(server.url, timeout=PLENTY, retries=0, backoff=0.01)
    policy.check()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    drive(server, policy, len(replies))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024


def gr00t_cases(mutants):
    """Answers of GR00T's server that are none."""
    sound = gr00t_packed([PARTS, {}])
    arrays = [npy(np.zeros((1, 4, 29)))["as_npy"]]
    heads = [b"{'descr': '|O', 'fortran_order': False, 'shape': (1, 4, 29)}", b"{", b"()", b"1+1", b"[" * 900]
    heads += [b"{'descr': '<f4', 'fortran_order': False, 'shape': (10**9, 4, 29)}", b"__import__('os').getcwd()"]
    heads += [b"{'descr': '<f4', 'fortran_order': True, 'shape': (1000000000, 40)}", b"{'descr': [('a', '<f4')]}"]
    for head in heads:
        arrays.append(b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + b"\0" * 464)
    arrays += [b"\x93NUMPY\x01\x00\xff\xff", b"\x93NUMPY\x09\x00ab", b"PK\x03\x04", b"", b"\x80\x04\x95"]
    cases = [
        gr00t_packed([PARTS | {"joint_pos": {"__ndarray_class__": True, "as_npy": data}}, {}]) for data in arrays[1:]
    ]
    cases += [
        gr00t_packed(value) for value in (None, [], {}, [[]], [{}], "text", 5, [PARTS["joint_pos"]], [None, PARTS])
    ]
    return [*broken(sound, mutants, 3), *cases]


def test_broken_replies_of_gr00t(mutants):
    """Damaged answers are refused in one line, or hold actions; nothing is unpickled and no memory filled."""
    server = Gr00tServer(declared=facts())
    policy = asking(server.url, timeout=PLENTY, retries=0)
    policy.check()
    before, refused = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, 0
    cases = gr00t_cases(mutants)
    for case in cases:
        try:
            policy.checked(policy._batch_rows(policy._read(" (infer)", case), 1)[0])
        except ArenaError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > len(cases) // 4
    replies = cases[:60]
    server.actions = lambda data: replies.pop() if replies else [{}, {}]
    while replies:
        policy._failures = 0
        chunk = policy.act(observation(1))
        assert all("\n" not in message and server.url in message for message in chunk.errors.values())
        policy.reset([1], ["Isaac-Football"])
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024


def test_arrays_of_gr00t_come_back():
    """Arrays of every order and type are what NumPy's own format says."""
    arrays = [
        np.arange(24, dtype=np.float32).reshape(2, 3, 4),
        np.asfortranarray(np.arange(24.0).reshape(2, 3, 4)),
        np.arange(4, dtype=">i2"),
        np.array(3.5),
        np.zeros((0, 3), np.uint8),
    ]
    for array in arrays:
        for message in (pack_gr00t({"a": array}), gr00t_packed({"a": array})):
            back = unpack_gr00t(message, "message")["a"]
            assert back.shape == array.shape and (back == array).all() and back.dtype == array.dtype.newbyteorder("=")
    assert ROWS.shape == (CHUNK, 40)


def test_broken_modalities():
    """Other types anywhere in the answer to `get_modality_config` are one line."""
    odd = [None, True, 5, "x", [], {}, [1], {"modality_keys": [1]}, {"modality_keys": ["a"], "delta_indices": ["0"]}]
    for value in odd:
        for name in MODALITIES:
            for made in (value, MODALITIES | {name: value}, MODALITIES | {name: {"as_json": value}}):
                try:
                    read_modalities(made, "server")
                except InputError as error:
                    assert "\n" not in str(error)
