"""The command: flags, what it says, how it ends, and that a policy behind it is the policy itself."""

import importlib.util
import json
import signal
import socket
import ssl
import threading
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from served_policies import Remembers, TurnsV4, query, state
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from arena_newton.errors import InputError
from arena_newton.interfaces import Observation
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.protocols import openpi_codec
from arena_newton.policies.remote.arena_client import RemotePolicy
from arena_newton.policies.serve.__main__ import main
from arena_newton.policies.serve.serve_command import _first_task, make_policy, serve_policy
from arena_newton.policies.serve.serve_options import ServeOptions
from arena_newton.robot.canonical import STAND_ACTION
from tests.children import Child
from tests.patience import PLENTY


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "--policy: name a policy"),
        (["--policy", "dance"], "--policy dance: unknown policy"),
        (["--policy", "stand", "--protocol", "grpc"], "--protocol grpc: unknown, choose from openpi, roboarena"),
        (["--policy", "stand", "--port", "70000"], "--port 70000: expected a number from 0 to 65535"),
        (["--policy", "stand", "--host", "999.1.1.1", "--port", "0"], "--host 999.1.1.1: no address of this machine"),
        (["--policy", "stand", "--host", "192.0.2.1", "--port", "0"], "--host 192.0.2.1: no address of this machine"),
        (["--policy", "stand", "--host", "é" * 70, "--port", "0"], "no address of this machine"),
        (["--policy", "stand", "--host", "", "--port", "0"], "--host: is empty, expected an address of this machine"),
        (["--policy", "stand", "--max-sessions", "0"], "--max-sessions 0: expected a number from 1"),
        (["--policy", "stand", "--max-batch-size", "0"], "--max-batch-size 0: expected a number from 1"),
        (["--policy", "stand", "--max-wait", "-1"], "--max-wait -1.0: expected a number from 0 to 60"),
        (["--policy", "stand", "--max-wait", "nan"], "--max-wait nan: expected a number"),
        (["--policy", "stand", "--replan", "0"], "--replan 0: expected at least 1"),
        (["--policy", "stand", "--replan", "5", "--port", "0"], "--replan: belongs to --policy lerobot:"),
        (["--policy", "stand", "--tls-cert", "a.pem"], "--tls-cert and --tls-key: name both or none"),
        (
            ["--policy", "stand", "--tls-cert", "a.pem", "--tls-key", "b.pem", "--port", "0"],
            "--tls-key b.pem: No such file",
        ),
        (["--policy", "stand", "--device", "tpu", "--port", "0"], "--device tpu: unknown"),
        (["--policy", "stand", "--device", "cpu:7", "--port", "0"], "--device cpu:7: unknown, choose cpu"),
        (["--policy", "stand", "--task", "dance", "--port", "0"], "--task dance: unknown"),
        (["--policy", "stand", "--labels", "v9", "--port", "0"], "--labels v9: unknown"),
        (["--policy", "expert", "--port", "0"], "sees the world itself; run it in this process"),
        (["--policy", "stand", "--prot", "x"], "--prot: unknown argument, did you mean --port?"),
    ],
)
def test_bad_flags(capsys, flags, message):
    """A flag that is wrong is one line that names it, and exit code 2."""
    assert main(flags) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1


def test_the_first_query_is_of_a_task_that_the_policy_does():
    """Nobody has to name a task: Boxing where the policy does not say which it does, otherwise one of its own."""

    class Sofas(Remembers):
        def check_task(self, task, mode=None, seeds=()):
            if task != "sit_sofa":
                raise InputError(f"does sit_sofa, not {task}")

    assert (_first_task(Remembers()), _first_task(Sofas())) == ("boxing", "sit_sofa")


def test_an_address_of_the_sixth_version_can_be_used():
    """It is printed as a client takes it."""
    stop, lines = threading.Event(), []
    stop.set()
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    serve_policy(ServeOptions(policy="stand", host="::1", port=0), lines.append, stop)
    asked = next(line for line in lines if line.startswith("eval asks it by")).rpartition(" ")[2]
    assert urlsplit(asked.removeprefix("remote:")).hostname == "::1"


def test_a_taken_port(capsys):
    """A port that another program has is one line, and exit code 2, before anything is loaded."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert main(["--policy", "stand", "--port", str(port)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: --port {port}: cannot be served at 127.0.0.1 (Address already in use")
    assert error.endswith("; name another port\n") and error.count("\n") == 1


def test_a_token_that_no_header_can_carry(capsys, monkeypatch):
    """A token with a space is refused and not printed."""
    monkeypatch.setenv("ARENA_POLICY_TOKEN", "two words")
    assert main(["--policy", "stand", "--port", "0"]) == 2
    error = capsys.readouterr().err
    assert "ARENA_POLICY_TOKEN: holds a space" in error and "two words" not in error


@pytest.mark.parametrize(("stop", "protocol"), [(signal.SIGINT, "openpi"), (signal.SIGTERM, "arena")])
def test_the_command_serves_until_it_is_interrupted(stop, protocol):
    """It says where it listens, answers, and at Ctrl-C prints what it did and ends with 0."""
    flags = ["--policy", "stand", "--protocol", protocol, "--port", "0"]
    process = Child("arena_newton.__main__", ["policies", "serve", *flags])
    try:
        first, second, third, *_ = process.lines(3)
        assert "chunks of 50 actions of v3.1 at 50 Hz, no picture" in first
        port = int(second.split("127.0.0.1:")[1].split(",")[0])
        scheme = "http" if protocol == "arena" else protocol
        assert third == f"eval asks it by --policy remote:{scheme}://127.0.0.1:{port}"
        if protocol == "openpi":
            with connect(f"ws://127.0.0.1:{port}") as client:
                client.recv(timeout=PLENTY)
                for step in (0, 50):
                    client.send(openpi_codec.pack_request(query(seed=1, step=step)))
                    chunk = openpi_codec.unpack_answer(client.recv(timeout=PLENTY), "server")
                    assert np.array_equal(chunk, np.tile(STAND_ACTION, (50, 1)))
        process.send_signal(stop)
        out, errors = process.communicate(timeout=PLENTY)
    finally:
        process.kill()
    loading = [line for line in errors.splitlines() if line.startswith("loading ")]
    assert process.returncode == 0 and errors.splitlines() == loading
    if protocol == "openpi":
        assert "1 episodes, 2 queries answered" in out and "batch sizes 1: 2" in out
    else:
        assert "0 episodes, 0 queries answered" in out


def test_labels_of_what_is_served(monkeypatch):
    """v4 is decoded unless raw labels are wanted; a policy that says nothing is v3.1, or what the flag says."""
    silent = Remembers()
    silent.labels = None
    monkeypatch.setattr("arena_newton.policies.serve.serve_command.get", lambda spec, **_: made[spec])
    made = {"turns": TurnsV4(), "silent": silent}
    for spec, flags, labels in [
        ("turns", {}, "v3.1"),
        ("turns", {"raw_labels": True}, "v4"),
        ("silent", {"labels": "v4"}, "v3.1"),
        ("silent", {"labels": "v4", "raw_labels": True}, "v4"),
    ]:
        assert make_policy(ServeOptions(policy=spec, **flags), "cpu").labels == labels


def test_tls(served, certificate):
    """With a certificate the server speaks wss and https, and nothing without it."""
    cert, context = certificate
    trust = ssl.create_default_context(cafile=str(cert))
    one = served(Remembers(), tls=context)
    with connect(f"wss://127.0.0.1:{one.port}", ssl=trust) as client:
        assert openpi_codec.unpack_metadata(client.recv(timeout=PLENTY), "server")[0] == one.server.facts
        assert client.socket.session is not None and not client.socket.session.has_ticket
    with pytest.raises((OSError, WebSocketException)):
        one.socket(open_timeout=2)
    two = served(Remembers(), "arena", tls=context)
    policy = RemotePolicy(f"https://127.0.0.1:{two.port}", verify_ssl=False)
    policy.check()
    policy.close()


def test_a_key_with_a_pass_phrase(capsys, tmp_path, make_certificate):
    """A key that must be asked for is refused by name; nothing waits at a terminal."""
    cert, key = make_certificate(tmp_path, "-passout", "pass:secret")
    assert main(["--policy", "stand", "--port", "0", "--tls-cert", str(cert), "--tls-key", str(key)]) == 2
    assert capsys.readouterr().err == f"error: --tls-key {key}: has a pass phrase, expected a key without one\n"


def observation(policy, values, mask):
    states = np.stack([state(v) for v in values])
    image = None
    if policy.needs_image:
        camera = policy.camera
        rng = np.random.default_rng([int(1000 * v) for v in values])
        image = torch.from_numpy(rng.integers(0, 255, (len(values), camera.height, camera.width, 3), np.uint8))
    return Observation(torch.from_numpy(states), image, np.array(mask), "boxing", "Isaac-Move-Boxing", "Box.")


def play(policy, seeds, queries=4):
    """Chunks of several worlds that ask at different times."""
    policy.reset(seeds, ["Isaac-Move-Boxing"] * len(seeds))
    chunks = []
    for number in range(queries):
        mask = [True] * len(seeds) if number % 2 == 0 else [w % 2 == 0 for w in range(len(seeds))]
        seen = observation(policy, [0.01 * number + 0.1 * w for w in range(len(seeds))], mask)
        answer = policy.act(seen)
        assert not answer.errors
        chunks.append(np.asarray(answer.actions, dtype=np.float32)[np.array(mask)])
    return chunks


@pytest.mark.parametrize("sees", [False, True])
def test_the_http_client_of_the_evaluation(served, sees):
    """`remote:http://` gets from the server what the policy itself gives, to the last bit, world by world."""
    direct = Remembers(sees=sees)
    if sees:
        direct.camera = CameraConfig(width=640, height=480, fit="native")
    other = Remembers(sees=sees)
    other.camera = direct.camera
    one = served(other, "arena")
    remote = RemotePolicy(f"http://127.0.0.1:{one.port}")
    remote.check()
    assert not remote.depends_on_worlds and one.server.facts.policy in json.dumps(remote.describe())
    if not sees:
        remote.needs_image = False
    expected = play(direct, [5, 6, 7])
    for _ in range(2):
        got = play(remote, [5, 6, 7])
        assert all(np.array_equal(a, b) for a, b in zip(got, expected, strict=True))
    remote.close()
    assert max(one.server.counts.batches) > 1


def test_a_missing_extra(capsys, monkeypatch):
    """Without the extra `serve` the command says so in one line, with the command that installs it."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "msgpack" else find(name, *more)
    )
    assert main(["--policy", "stand", "--port", "0"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("error: policies serve: needs the extra [serve] (msgpack is not")
