"""The client of SIMPLE's `/act`: what it sends, what it takes, and servers that are of another robot or broken."""

import base64
import json
import random

import numpy as np
import pytest
from foreign_servers import observation
from json_server import JsonHandler, JsonServer

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.policies.remote.address import read_address
from arena_newton.robot.canonical import STAND_ACTION, validate_action
from tests.fuzz.mutants import damaged
from tests.patience import PLENTY


def decoded(value):
    """An array as SIMPLE's own code reads it."""
    if isinstance(value, dict) and "__numpy__" in value:
        return np.frombuffer(base64.b64decode(value["__numpy__"]), np.dtype(value["dtype"])).reshape(value["shape"])
    return {key: decoded(one) for key, one in value.items()} if isinstance(value, dict) else value


def coded(array):
    """An array as SIMPLE's own code writes it."""
    return {"__numpy__": base64.b64encode(array.tobytes()).decode(), "dtype": array.dtype.str, "shape": array.shape}


def rows(state, count=5):
    """Actions that follow from a state."""
    actions = np.tile(STAND_ACTION, (count, 1)).astype(np.float64)
    actions[:, 9:12] += 0.01 * state[6] + 0.001 * np.arange(count)[:, None]
    return actions


class SimpleServer:
    """A server of the protocol; `answer` makes the body, or status and body, of a request's reply."""

    def __init__(self, answer=None):
        self.seen, outer = [], self
        self.answer = answer or (
            lambda asked: {"action": coded(rows(asked["state"]["states"][0])), "err": 0.0, "traj_image": []}
        )

        class Handler(JsonHandler):
            def do_POST(self):  # noqa: N802
                asked = decoded(self.asked())
                outer.seen.append((self.path, asked))
                reply = outer.answer(asked) if self.path == "/act" else (404, b"{}")
                self.answer(*reply if isinstance(reply, tuple) else (200, reply))

            def do_GET(self):  # noqa: N802
                self.answer(200 if self.path == "/health" else 404, {"detail": "Not Found"})

        self.http = JsonServer(Handler)
        self.url = self.http.url.replace("http", "simple")


@pytest.fixture
def simple():
    """Makes servers, which are closed at the end."""
    made = []

    def make(answer=None):
        made.append(SimpleServer(answer))
        return made[-1]

    yield make
    for one in made:
        one.http.close()


def client(server):
    """The policy that asks it."""
    return policies.get(f"remote:{server.url}", timeout=PLENTY, retries=0, backoff=0.01)


def test_what_is_asked_is_the_protocols(simple, capsys):
    """Fields, arrays and the beginning of an episode are those that SIMPLE's own code reads."""
    server = simple()
    policy = client(server)
    policy.check()
    assert "does not declare its label protocol" in capsys.readouterr().err
    assert policy.depends_on_worlds and policy.describe()["protocol"] == "simple"
    server.seen.clear()
    policy.reset([3, 4], ["Isaac-Football"] * 2)
    seen = observation(2)
    for query in range(2):
        chunk = policy.act(seen)
        assert not chunk.errors and chunk.actions.shape == (2, 5, 40)
        for world in range(2):
            wanted = rows(np.asarray(seen.state)[world]).astype(np.float32)
            assert np.allclose(chunk.actions[world], wanted, atol=1e-6)
        asked = [request for path, request in server.seen[2 * query :] if path == "/act"]
        assert len(asked) == 2 and all(one["history"] == ({} if query else {"reset": True}) for one in asked)
    names = ["image", "instruction", "history", "state", "condition", "gt_action", "dataset_name", "timestamp"]
    assert list(asked[0]) == names and list(asked[0]["image"]) == ["rgb_head_stereo_left"]
    picture, numbers = asked[0]["image"]["rgb_head_stereo_left"], asked[0]["state"]["states"]
    assert picture.dtype == np.uint8 and picture.shape == tuple(seen.image.shape[1:])
    assert numbers.dtype == np.float32 and numbers.shape == (1, 64) and asked[0]["instruction"] == seen.instruction
    policy.close()


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (lambda asked: {"action": coded(np.zeros((30, 36), np.float32)), "err": 0.0}, "36"),
        (lambda asked: {"action": [], "err": "CUDA error"}, "the server says CUDA error"),
        (lambda asked: {"err": 0.0}, "holds no action"),
        (lambda asked: (500, b"Internal Server Error"), "status 500"),
        (lambda asked: {"action": {"__numpy__": "gA==", "dtype": "|O", "shape": [1]}}, "expected bool, integers"),
    ],
    ids=["another robot", "error", "empty", "status", "objects"],
)
def test_a_server_of_another_robot_is_refused_first(simple, answer, says):
    """Before the first episode a standing robot asks; an answer that is none for it is one error with the address."""
    server = simple(answer)
    with pytest.raises(InputError, match=says) as error:
        client(server).check()
    assert server.url in str(error.value) and "\n" not in str(error.value)


def test_one_action_and_lists_are_chunks(simple):
    """A server that answers one action, or plain lists, is understood."""
    for make in (lambda one: coded(one[0]), lambda one: one[0].tolist(), lambda one: one.tolist()):
        policy = client(simple(lambda asked, make=make: {"action": make(rows(asked["state"]["states"][0]))}))
        policy.check()
        policy.reset([3], ["Isaac-Football"])
        assert np.allclose(policy.act(observation(1)).actions[0, 0], rows(np.asarray(observation(1).state)[0])[0])
        policy.close()


def test_broken_replies_are_an_error_of_their_world(simple, mutants):
    """Damaged replies are one plain line each, or a chunk that is fit."""
    sound = json.dumps({"action": coded(rows(np.zeros(64), 2)), "err": 0.0}).encode()
    rng = random.Random(7)
    replies = [damaged(sound, rng, text=True) for _ in range(mutants)]
    server = simple()
    policy = client(server)
    policy.check()
    server.answer = lambda asked: (200, replies.pop())
    refused, count = 0, len(replies)
    for _ in range(count):
        policy._failures = 0  # the run would stop after ten in a row
        policy.reset([1], ["Isaac-Football"])
        chunk = policy.act(observation(1))
        for message in chunk.errors.values():
            refused += 1
            assert "\n" not in message and server.url in message and len(message) < 600
        if not chunk.errors:
            validate_action(np.asarray(chunk.actions), "served")
    assert count // 4 < refused <= count
    policy.close()


def test_addresses():
    """The usual port is that of SIMPLE's servers; https is encrypted."""
    found = read_address("simple://gpu")
    assert (found.protocol, found.transport, found.port, found.secure) == ("simple", "http", 22085, False)
    found = read_address("simple+https://gpu/psi0")
    assert (found.protocol, found.port, found.path, found.secure) == ("simple", 443, "/psi0", True)
