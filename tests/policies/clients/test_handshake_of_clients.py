"""Declarations of servers are compared before the first episode; absent ones are tried, assumed and reported."""

import copy
import http.client
import json
import socket
import threading
import time
from contextlib import suppress

import numpy as np
import pytest
from foreign_servers import (
    CHUNK,
    MODALITIES,
    SIZE,
    Gr00tServer,
    HttpServer,
    SocketServer,
    asking,
    facts,
    observation,
)

from arena_newton import policies
from arena_newton.data.readers.label_protocols import V4, action_names
from arena_newton.errors import InputError
from arena_newton.policies.label_reader import V4Policy
from arena_newton.policies.protocols.handshake import ServedPicture, read_facts
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.remote.address import PREFIXES, read_address
from arena_newton.policies.remote.gr00t_client import read_modalities
from arena_newton.policies.remote.websocket import http_page
from tests.patience import PLENTY

NAMES = tuple(action_names("v3.1"))


def server_of(protocol, declared, **options):
    """A server that declares itself like this."""
    if protocol == "http":
        return HttpServer(declared)
    if protocol == "gr00t":
        return Gr00tServer(declared=declared, **options)
    return SocketServer(protocol, declared, config=declared, **options)


def checked(server, **options):
    """Its client after `check`."""
    policy = asking(server.url, **({"timeout": PLENTY, "retries": 0, "backoff": 0.01} | options))
    policy.check()
    return policy


@pytest.mark.parametrize("protocol", ["http", "openpi", "roboarena", "vla-eval", "gr00t"])
@pytest.mark.parametrize(
    ("other", "text"),
    [
        ({"action_names": NAMES[::-1]}, f"number 0 of the server's action is {NAMES[-1]}, of the robot's {NAMES[0]}"),
        ({"action_names": NAMES[:7]}, "the server's action has 7 numbers, the robot's 40"),
        ({"state_names": ("a",) * 64}, "number 0 of the server's state is a, of the robot's "),
        ({"rate_hz": 30.0}, "the server's actions are for 30 Hz, the robot executes 50 Hz"),
    ],
)
def test_what_differs_is_refused(protocol, other, text):
    """A server for another robot is refused in one line that names both values."""
    with pytest.raises(InputError) as caught:
        checked(server_of(protocol, facts(**other)))
    assert text in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("cameras", [{}, {"nose": {}}, {"front": {"width": 4}}, ["front"]])
def test_unfit_cameras_of_a_handshake(cameras):
    """A declaration of cameras that no robot can send is refused with the cameras that are known."""
    with pytest.raises(WireError, match=r"declares: cameras is .*, expected width, height .* of front, left_wrist"):
        read_facts({"arena": 1, "cameras": cameras}, "server")


@pytest.mark.parametrize("protocol", ["http", "openpi", "vla-eval", "gr00t"])
def test_a_server_that_repeats_the_token(protocol, monkeypatch):
    """Declarations hold no token in results or messages, also of a server that repeats what it was sent."""
    monkeypatch.setenv("ARENA_POLICY_TOKEN", "se-cret")
    server = server_of(protocol, facts(facts={"a": [{"b se-cret": "Bearer se-cret"}]}, policy="se-cret"))
    told = json.dumps(checked(server).describe())
    assert "se-cret" not in told and "Bearer ***" in told
    with pytest.raises(InputError) as caught:
        checked(server_of(protocol, facts(action_names=("se-cret",) * 40)))
    assert "se-cret" not in str(caught.value) and "is ***, of" in str(caught.value)


@pytest.mark.parametrize("value", [b"bytes", float("nan"), np.zeros(2)])
def test_facts_that_results_cannot_hold(value):
    """Facts that are no JSON are refused before the first episode, not after the last."""
    with pytest.raises(WireError, match="declares: facts is"):
        read_facts({"arena": 1, "facts": {"weights": value}}, "server")


@pytest.mark.parametrize("scheme", ["http", "roboarena"])
def test_a_page_by_drips(scheme):
    """A page whose head never ends is given up at the deadline."""
    listening = socket.create_server(("127.0.0.1", 0))
    address = f"127.0.0.1:{listening.getsockname()[1]}"

    def drip():
        connection, _ = listening.accept()
        with connection, suppress(OSError):
            connection.sendall(b"HTTP/1.1 200 OK\r\n")
            for _ in range(10 * int(PLENTY)):
                connection.sendall(b"a: b\r\n")
                time.sleep(0.1)

    threading.Thread(target=drip, daemon=True).start()
    policy = asking(f"{scheme}://{address}", timeout=0.5)
    began = time.monotonic()
    if scheme == "http":
        with suppress(OSError, http.client.HTTPException):
            assert policy._connect().get("/config", 0.5)[1] == b"", "a head that was cut off has no page"
    else:
        assert http_page(policy, "/config") == b""
    assert time.monotonic() - began < PLENTY / 2
    listening.close()


@pytest.mark.parametrize("protocol", ["http", "openpi", "roboarena", "vla-eval"])
def test_labels_of_the_server_are_taken_over(protocol):
    """A server that gives v4 makes the policy one of v4, which is decoded; a flag that says otherwise is refused."""
    declared = facts(labels="v4", action_names=tuple(action_names("v4")))
    policy = checked(server_of(protocol, declared))
    assert policy.labels == "v4" and policy.protocol.name == "v4" and policy.describe()["declared"]["labels"] == "v4"
    assert isinstance(V4Policy(policy), V4Policy)
    with pytest.raises(InputError, match=r"label protocol v3.1, the robot takes v4"):
        checked(server_of(protocol, facts()), labels="v4")


@pytest.mark.parametrize("protocol", ["http", "openpi", "roboarena", "vla-eval", "gr00t"])
def test_declared_facts_are_followed(protocol, capsys):
    """Picture, chunk length and seeding are what the server declares, and nothing is assumed."""
    policy = checked(server_of(protocol, facts(picture=ServedPicture(96, 80, "native"))))
    assert (policy.camera.width, policy.camera.height, policy.camera.fit) == (96, 80, "native")
    assert policy.chunk_size == CHUNK and not policy.depends_on_worlds and policy.needs_image
    said = policy.describe()
    assert said["declared"]["picture"] == {"width": 96, "height": 80, "fit": "native"} and "assumed" not in said
    assert capsys.readouterr().err == ""


def test_later_version_is_refused():
    """A declaration of a later version is one line with both versions."""
    declared = facts().to_json() | {"arena": 2}
    with pytest.raises(InputError, match="version 2, expected 1"):
        checked(SocketServer("openpi", metadata=declared))
    with pytest.raises(InputError, match="version 7 of vla-eval's protocol, expected 1"):
        checked(SocketServer("vla-eval", metadata={"protocol_version": 7}))


@pytest.mark.parametrize("metadata", ["Traceback\nValueError: no model", b"\xc1", b"\x93\x01\x02\x03", b""])
def test_greeting_that_is_none(metadata):
    """A first frame that is an error, or no map, is one line."""
    with pytest.raises(InputError) as caught:
        checked(SocketServer("openpi", metadata=metadata))
    assert "no policy server of openpi's protocol: openpi://127.0.0.1" in str(caught.value)
    assert "\n" not in str(caught.value) and "Traceback" not in str(caught.value)


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval"])
def test_server_that_declares_nothing(protocol, capsys):
    """It is warned of once, tried with a robot that stands, and what is assumed is part of what results record."""
    server = SocketServer(protocol, metadata={})
    policy = asking(server.url, timeout=PLENTY, retries=0)
    policy.check()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "does not declare its label protocol (v3.1), action names" in lines[0]
    query = next(content for kind, content in server.seen if kind == "query")
    assert query.image.shape == (224, 224, 3) and (query.image == 127).all() and query.state[0] == 1.0
    assert policy.depends_on_worlds
    said = policy.describe()
    assert said["assumed"]["picture"] == "224x224 pad" and said["assumed"]["rate"] == "50 Hz"
    if protocol == "openpi":  # nothing that its servers may not know is sent
        assert query.seed is None and query.step is None and query.task == "" and query.session == ""
    policy.reset([1, 2], ["Isaac-Football"] * 2)
    assert policy.act(observation(2, size=224)).errors == {} and capsys.readouterr().err == ""


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval"])
def test_undeclared_server_for_another_robot(protocol):
    """Actions of another width are refused before the first episode."""
    server = SocketServer(protocol, metadata={})
    server.behave = {"any": "39"}
    with pytest.raises(InputError, match=r"a robot that stands: .*\[4, 39\], expected \[n, 40\]"):
        checked(server)


ROBOARENA = {
    "image_resolution": [120, 160],
    "needs_wrist_camera": False,
    "n_external_cameras": 1,
    "needs_stereo_camera": False,
    "needs_session_id": True,
    "action_space": "joint_position",
}


@pytest.mark.parametrize(
    ("other", "text"),
    [
        ({"needs_wrist_camera": True}, "wants wrist cameras"),
        ({"needs_stereo_camera": True}, "wants stereo pictures"),
        ({"n_external_cameras": 2}, "wants 2 external cameras"),
        ({"image_resolution": "big"}, "image_resolution is big, expected height and width"),
        ({"image_resolution": [0, 224]}, "image_resolution is"),
    ],
)
def test_cameras_of_roboarena(other, text):
    """A server that wants what this robot does not send is refused; its resolution is height first, or native."""
    with pytest.raises(InputError, match=text):
        checked(SocketServer("roboarena", metadata=ROBOARENA | other))


@pytest.mark.parametrize(("size", "camera"), [([120, 160], (160, 120, "pad")), (None, (640, 480, "native"))])
def test_resolution_of_roboarena(size, camera):
    """Pictures have the size that the server's configuration says."""
    policy = checked(SocketServer("roboarena", metadata=ROBOARENA | {"image_resolution": size}))
    assert (policy.camera.width, policy.camera.height, policy.camera.fit) == camera


def test_batched_server():
    """A server whose metadata says `batched` is asked once for all worlds that ask, along a leading axis."""
    import msgpack

    from arena_newton.policies.protocols.packed_arrays import OPENPI_KEYS, pack, unpack

    class Batched(SocketServer):
        def openpi(self, socket):
            socket.send(msgpack.packb({"batched": True, "image_resolution": [SIZE, SIZE]}))
            for data in socket:
                asked = unpack(data, OPENPI_KEYS, "request")
                self.note("batch", asked)
                rows = np.tile(np.arange(40, dtype=np.float32), (len(asked["observation/state"]), CHUNK, 1))
                rows[..., 3:9] = [1, 0, 0, 1, 0, 0]
                rows[..., 38] = asked["observation/state"][:, :1]
                if self.behave.get("any") == "nan":
                    rows[-1, 0, 20] = np.nan
                socket.send(pack({"actions": rows}, OPENPI_KEYS))

    server = Batched("openpi")
    policy = asking(server.url, timeout=PLENTY, retries=0)
    policy.check()
    server.seen.clear()
    policy.reset([1, 2, 3], ["Isaac-Football"] * 3)
    chunk = policy.act(observation(3, [True, False, True]))
    assert chunk.errors == {} and np.asarray(chunk.actions)[[0, 2], 0, 38].tolist() == [0.0, 2.0]
    ((_, asked),) = server.seen
    assert asked["observation/image"].shape == (2, SIZE, SIZE, 3) and asked["prompt"] == ["Kick the ball."] * 2
    server.behave = {"any": "nan"}
    assert set(policy.act(observation(3)).errors) == {2}


def modalities(**other):
    """The answer to `get_modality_config`, one modality changed."""
    made = copy.deepcopy(MODALITIES)
    for name, change in other.items():
        made[name] |= change
    return made


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {"video": {"modality_keys": ["top", "wrist"]}},
            "wants pictures top, wrist, this robot sends front, left_wrist, right_wrist, world, ego_view, head_camera",
        ),
        ({"video": {"delta_indices": [-1, 0]}}, "wants video at ticks -1, 0"),
        ({"state": {"modality_keys": ["single_arm", "gripper"]}}, "states are single_arm, gripper, expected one name"),
        ({"action": {"modality_keys": ["single_arm", "gripper"]}}, "actions are single_arm, gripper, expected one"),
        ({"action": {"delta_indices": [0, 2, 4]}}, "actions are of ticks 0, 2, 4"),
        ({"action": {"modality_keys": "all"}}, "has no list modality_keys"),
        ({"language": {"modality_keys": ["a", "b"]}}, "wants sentences a, b"),
    ],
)
def test_modalities_that_this_robot_does_not_have(change, text):
    """A GR00T server of another robot is refused in one line with its names."""
    with pytest.raises(InputError, match=text) as caught:
        checked(Gr00tServer(modalities(**change)))
    assert "\n" not in str(caught.value)


def test_modalities():
    """Names of slices split state and action, one name is all of it, and those of v4 say so."""
    names = read_modalities(modalities(), "server")
    assert names.video == {"ego_view": "front"} and names.chunk == CHUNK and names.labels == "v3.1"
    assert names.to_json()["video"] == "ego_view"
    several = {"modality_keys": ["video.right_wrist", "video.ego_view"], "delta_indices": [0]}
    seen = read_modalities(modalities(video=several), "server").video
    assert seen == {"video.right_wrist": "right_wrist", "video.ego_view": "front"}
    assert {name: (part.start, part.stop) for name, part in names.state.items()} == {
        "root_rot6d": (0, 6),
        "joint_pos": (6, 35),
        "joint_vel": (35, 64),
    }
    whole = read_modalities(modalities(state={"modality_keys": ["s"]}, action={"modality_keys": ["a"]}), "server")
    assert whole.state == {"s": slice(0, 64)} and whole.action == {"a": slice(0, 40)} and whole.labels is None
    v4 = read_modalities(modalities(action={"modality_keys": [f"action.{name}" for name in V4]}), "server")
    assert v4.labels == "v4"


@pytest.mark.parametrize("keys", [["action"], None])
def test_gr00t_without_a_declaration(keys, capsys):
    """A GR00T server is asked under its own names, for all worlds that ask at once, and its options stay empty."""
    made = modalities(action={"modality_keys": keys}) if keys else modalities()
    server = Gr00tServer(made)
    policy = asking(server.url, timeout=PLENTY, retries=0)
    policy.check()
    assert "does not declare" in capsys.readouterr().err and policy.depends_on_worlds
    server.seen.clear()
    policy.reset([1, 2, 3], ["Isaac-Football"] * 3)
    chunk = policy.act(observation(3, [True, False, True]))
    assert chunk.errors == {} and chunk.actions.shape == (3, CHUNK, 40)
    (reset, options), (asked, data) = server.seen
    assert (reset, options, asked, data["options"]) == ("reset", {"options": None}, "get_action", None)
    seen = data["observation"]
    assert seen["video"]["ego_view"].shape == (2, 1, SIZE, SIZE, 3) and seen["state"]["joint_vel"].shape == (2, 1, 29)
    assert seen["language"] == {"annotation.human.task_description": [["Kick the ball."]] * 2}
    assert policy.describe()["modalities"]["video"] == "ego_view"


@pytest.mark.parametrize("prefix", PREFIXES)
def test_addresses(prefix):
    """Every protocol has its name, its transport and a usual port."""
    address = read_address(f"{prefix}://host/")
    assert (address.protocol, address.transport, address.port) == PREFIXES[prefix] and address.host == "host"
    assert read_address(f"{prefix}://[::1]:99").url.endswith("//[::1]:99")


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("ftp://host", "unknown protocol ftp://, choose from http://, https://, ws://"),
        ("openpi+tcp://host", r"unknown protocol openpi\+tcp://"),
        ("gr00t://host/path", "expected gr00t://host:port and nothing more"),
        ("ws://user:sekret@host", "holds a user name or a password"),
        ("ws://host?token=sekret", "nothing more"),
        ("gr00t://ho st", "white space"),
        ("vla-eval://host:99999", "not an address"),
        ("ws://", "expected http"),
    ],
)
def test_unfit_addresses(url, text):
    """Addresses of unknown protocols, or with secrets, are refused by name in one line."""
    with pytest.raises(InputError, match=text) as caught:
        policies.get(f"remote:{url}")
    assert "sekret" not in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("url", "extra"), [("ws://host", "serve"), ("vla-eval://host", "serve"), ("gr00t://h", "gr00t")]
)
def test_missing_extra(monkeypatch, url, extra):
    """A protocol whose libraries are not installed is one line that names the extra."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=rf"--policy remote:{url}: needs the extra \[{extra}\]"):
        policies.get(f"remote:{url}")
