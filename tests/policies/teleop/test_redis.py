"""Teleoperation through a real Redis server: a sender as the original's, and what none must be able to do."""

import functools
import io
import json
import shutil
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import redis
import torch
from PIL import Image
from redis.backoff import NoBackoff
from redis.retry import Retry

from arena_newton import trackers
from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.policies.teleop import redis_keys as keys
from arena_newton.policies.teleop.__main__ import main
from arena_newton.policies.teleop.pace import Pace
from arena_newton.policies.teleop.redis_reference import GmrReference, Limits, MimicReference, references
from arena_newton.policies.teleop.redis_source import MOST_LINES, STALE, RedisSource, connect
from arena_newton.policies.teleop.source import Telemetry
from arena_newton.policies.teleop.teleop_session import TeleopSession
from arena_newton.robot.canonical import ACTION, MIMIC
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, DEFAULT_POSE, HAND_CLOSE_LEFT, HAND_CLOSE_RIGHT, TICK
from arena_newton.robot.rotations import heading, quat_apply, quat_from_rot6d, quat_from_yaw, quat_multiply, roll_pitch
from arena_newton.trackers.motions.commands import COLUMNS, neutral_row
from arena_newton.trackers.motions.generator import ReferenceGenerator

START, TICKS = 25, 160


def free_port() -> int:
    """A port that nobody serves now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Server:
    """A Redis server of the tests' own, that keeps nothing."""

    def __init__(self, program: str):
        self.program, self.port = program, free_port()
        self.start()

    def start(self) -> None:
        flags = ["--port", str(self.port), "--bind", "127.0.0.1", "--save", "", "--appendonly", "no"]
        self.process = subprocess.Popen([self.program, *flags], stdout=subprocess.DEVNULL)
        self.client = redis.Redis(port=self.port, retry=Retry(NoBackoff(), 0))
        for _ in range(200):
            try:
                self.client.ping()
                return
            except redis.ConnectionError:
                time.sleep(0.05)
        raise RuntimeError("redis-server does not answer")

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(20)


@pytest.fixture(scope="module")
def server():
    """A running server."""
    program = shutil.which("redis-server")
    if program is None:
        pytest.skip("needs redis-server, Debian's package redis-server")
    running = Server(program)
    yield running
    running.stop()


@pytest.fixture
def client(server):
    """The server, empty."""
    server.client.flushall()
    return server.client


class Clock:
    """A time that passes when a test says so."""

    def __init__(self):
        self.now = 50.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@functools.cache
def walk() -> np.ndarray:
    """Canonical actions: stand, walk while turning left, with the right hand closing."""
    generator, rows = ReferenceGenerator(1), []
    for tick in range(TICKS):
        row = np.array(neutral_row(), dtype=np.float32)
        if tick >= START:
            row[COLUMNS["velocity"]] = 0.5, 0.0, 0.4
        generator.step(torch.from_numpy(row)[None])
        rows.append(generator.action()[0].numpy().copy())
    actions = np.stack(rows)
    actions[:, ACTION["hands"]] = 0.0
    actions[80:, 39] = 1.0
    actions[0, ACTION["root_xy_delta"]] = 0.0
    return actions


class Sender:
    """Writes what the original's teleoperation server writes for given actions, at the pace of who calls it."""

    def __init__(self, client, heading0: float = 2.0):
        self.client, self.t = client, 1_700_000_000_000
        self.sequence = 0
        quats = quat_from_rot6d(torch.from_numpy(walk()[:, ACTION["root_rot6d"]]).double())
        joints = np.empty((TICKS, 29))
        joints[:, list(CANONICAL_TO_MUJOCO)] = walk()[:, ACTION["joint_pos"]]
        yaw = np.unwrap(heading(quats).numpy())
        rate = np.diff(yaw, prepend=yaw[0]) / TICK
        self.mimic = np.zeros((TICKS, 35))
        self.mimic[:, MIMIC["velocity_xy"]] = walk()[:, ACTION["root_xy_delta"]] / TICK
        self.mimic[:, MIMIC["root_z"]] = walk()[:, ACTION["root_z"]]
        self.mimic[:, MIMIC["roll_pitch"]] = roll_pitch(quats).numpy()
        self.mimic[:, MIMIC["yaw_rate"]] = rate[:, None]
        self.mimic[:, MIMIC["joint_pos"]] = joints
        # The person's room has another origin and heading than the episode.
        turned = quat_from_yaw(torch.tensor(heading0, dtype=torch.float64)).expand(TICKS, 4)
        self.quats = quat_multiply(turned, quats)
        position, self.positions = np.array([3.0, -7.0]), []
        for tick in range(TICKS):
            dx, dy = walk()[tick, ACTION["root_xy_delta"]].astype(float)
            rise = walk()[tick, 2] - walk()[max(tick - 1, 0), 2]
            axes = [quat_apply(self.quats[tick], torch.eye(3, dtype=torch.float64)[i]).numpy() for i in range(3)]
            local_z = (rise - axes[0][2] * dx - axes[1][2] * dy) / axes[2][2]
            position = position + (axes[0] * dx + axes[1] * dy + axes[2] * local_z)[:2]
            self.positions.append([*position, float(walk()[tick, 2])])

    def write(self, frame: int, *, hands: str = "controller", step: int = 20, **changed) -> None:
        """One frame; `changed` replaces values of keys by name, None leaves one out."""
        self.t += step
        closed = bool(walk()[frame, 39])
        values = {
            keys.ACTION_BODY: json.dumps(self.mimic[frame].tolist()),
            keys.ACTION_HANDS[0]: json.dumps([0.0] * 7),
            keys.ACTION_HANDS[1]: json.dumps(list(HAND_CLOSE_RIGHT if closed else [0.0] * 7)),
            keys.GMR_JOINT_POS: json.dumps(walk()[frame, ACTION["joint_pos"]].tolist()),
            keys.GMR_BODY_POS: json.dumps(self.positions[frame]),
            keys.GMR_BODY_QUAT: json.dumps(self.quats[frame].tolist()),
            keys.GMR_FRAME_INDEX: frame,
            keys.T_ACTION: self.t,
        }
        if hands == "controller":
            grips = {"LeftController": {"grip_binary": False}, "RightController": {"grip_binary": closed}}
            values[keys.CONTROLLERS] = json.dumps(grips)
        values.update({getattr(keys, name): value for name, value in changed.items()})
        with self.client.pipeline(transaction=True) as pipe:
            for key, value in values.items():
                if value is not None:
                    pipe.set(key, value)
            pipe.execute()

    def command(self, command: str, sequence: int | None = None) -> None:
        """A press of a button; it stays to be seen."""
        self.sequence = self.sequence + 1 if sequence is None else sequence
        said = {"active": True, "command": command, "sequence": self.sequence, "timestamp_ms": self.t, "source": "test"}
        self.client.set(keys.RECORDING_CONTROL, json.dumps(said))


def view(tick: int = 0, image: np.ndarray | None = None) -> Telemetry:
    """A robot that stands at the origin."""
    zero = np.array([0.1, 0.2, 0.3], np.float32)
    quat = np.array([1, 0, 0, 0], np.float32)
    joints = np.array(DEFAULT_POSE, np.float32)
    return Telemetry(tick, np.zeros(64, np.float32), zero, quat, zero, joints, np.zeros(29, np.float32), image, "idle")


def source_of(server, tracker: str = "twist2"):
    """A source with a clock of its own, and what it says."""
    said, clock = [], Clock()
    source = RedisSource(
        connect("127.0.0.1", server.port, 0), references(tracker), clock=clock, say=lambda line: said.append(line)
    )
    source.begin(view())
    return source, clock, said


@pytest.mark.parametrize("tracker", ["twist2", "sonic"])
@pytest.mark.parametrize("hands", ["controller", "targets"])
def test_a_sender_drives_as_in_the_original(server, client, tracker, hands):
    """The actions that come out are those that the sender's frames were made of: headings, displacements and hands."""
    source, clock, said = source_of(server, tracker)
    sender = Sender(client)
    actions = []
    for frame in range(TICKS):
        sender.write(frame, hands=hands)
        actions.append(source.wish(view(frame)).action)
        clock.now += TICK
    np.testing.assert_allclose(np.stack(actions), walk(), atol=2e-5)
    assert said == []


def test_the_handshake_is_the_originals(server, client):
    """Each episode begins with a new epoch and without anything old; a reset is reported as complete."""
    client.set(keys.ACTION_BODY, "[1]")
    client.set(keys.RESET_TRIGGER, "{}")
    source, _, _ = source_of(server)
    first = json.loads(client.get("isaac_input_ready_twist2_unitree_g1_with_hands"))
    assert first["backend"] == "twist2" and abs(first["epoch_id"] / 1e6 - time.time()) < 60
    assert set(first) == set(
        "backend source epoch_id ready_timestamp_ms ready_timestamp_realtime ready_timestamp_monotonic".split()
    )
    assert not client.exists(keys.ACTION_BODY, keys.RESET_TRIGGER, keys.RESET_COMPLETE)
    Sender(client).write(0)
    assert source.wish(view()).action is not None
    source.begin(view())
    assert json.loads(client.get(source.backend.ready))["epoch_id"] > first["epoch_id"]
    assert json.loads(client.get(keys.RESET_COMPLETE))["status"] == "complete"
    assert 0 < client.ttl(keys.RESET_COMPLETE) <= keys.RESET_TTL
    assert source.wish(view()).action is None, "what was sent before the epoch is gone"
    source.close()
    assert not client.exists(source.backend.ready)
    other, _, _ = source_of(server, "sonic")
    assert client.exists("isaac_input_ready_sonic_joint29_unitree_g1_with_hands")
    assert keys.GMR_BODY_POS in other.backend.stream


@pytest.mark.parametrize("tracker", ["twist2", "sonic"])
def test_a_sender_that_stalls_or_repeats_is_silent(server, client, tracker):
    """A time that does not change for 0.3 s of our clock is silence, whatever the sender's clock says."""
    source, clock, said = source_of(server, tracker)
    sender = Sender(client)
    sender.write(40)
    given = [source.wish(view()).action]
    for _ in range(14):
        clock.now += TICK
        sender.write(40, step=0)  # the same frame at the same time
        given.append(source.wish(view()).action)
    assert all(action is not None for action in given)
    clock.now = 50.0 + STALE + 0.01
    assert source.wish(view()).action is None
    sender.write(41, step=-5_000)  # the sender's clock was set back: it is a new frame all the same
    assert source.wish(view()).action is not None
    assert said == []
    if tracker == "sonic":
        assert np.allclose(np.stack(given)[1:, ACTION["root_xy_delta"]], 0.0), "a frame is walked once"


BAD = {
    "34 numbers": json.dumps([0.0] * 34),
    "NaN": json.dumps([float("nan")] * 35),
    "infinite": "[" + ",".join(["1e999"] * 35) + "]",
    "too large": "[" + ",".join(["1" + "0" * 400] * 35) + "]",
    "text": '"walk"',
    "nothing": "null",
    "booleans": json.dumps([True] * 35),
    "nested": "[" * 5_000,
    "huge": "[" + "0.0," * 5_000_000 + "0]",
    "no JSON": b"\xff\xfe\x00",
    "no height": json.dumps([0.0] * 35),
    "a joint out of range": json.dumps([0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 7.0] + [0.0] * 28),
}


def test_unfit_input_is_refused_once_and_the_robot_stands(server, client):
    """Each kind is reported in one line, is never an action, and the next fit frame counts again."""
    source, clock, said = source_of(server)
    sender = Sender(client)
    for name, value in BAD.items():
        sender.write(30)
        assert source.wish(view()).action is not None, name
        for _ in range(18):
            clock.now += TICK
            sender.write(30, ACTION_BODY=value)
            wish = source.wish(view())
        assert wish.action is None, name
    assert 5 <= len(said) == len(set(said)) <= len(BAD)
    assert all(len(line) < 200 and keys.ACTION_BODY in line for line in said)
    client.delete(keys.ACTION_BODY)
    client.lpush(keys.ACTION_BODY, 1)
    sender.write(30, ACTION_BODY=None)
    assert source.wish(view()).action is None and "is not a text" in said[-1]


@pytest.mark.parametrize("key", ["T_ACTION", "CONTROLLERS", "RECORDING_CONTROL", "GMR_BODY_QUAT", "GMR_FRAME_INDEX"])
def test_no_value_of_another_key_stops_the_session(server, client, key):
    """Any text in any key leaves an action that is finite, or none."""
    source, _, said = source_of(server, "sonic")
    sender = Sender(client)
    fuzz = ["", "{", "[]", "{}", "1e999", "-1", "NaN", "[0,0,0,0]", '{"LeftController":3}', '{"command":"start"}']
    fuzz += [
        '{"command":[],"sequence":1}',
        '{"command":"quit","sequence":5}',
        "9" * 3000,
        '{"sequence":1e300}',
        "[]" * 9,
    ]
    for frame, value in enumerate(fuzz):
        sender.write(frame, **{key: value})
        wish = source.wish(view())
        assert wish.control == "none"
        assert wish.action is None or np.isfinite(wish.action).all()
    assert len(said) <= len(fuzz)
    for n in range(3 * MOST_LINES):
        sender.command("x" * n, n)
        source.wish(view())
    assert len(said) <= MOST_LINES


@pytest.mark.parametrize("tracker", ["twist2", "sonic"])
def test_a_sender_that_jumps_is_limited(server, client, tracker):
    """Root and joints go towards a jump at limited rates; a leap of the root's position moves nothing."""
    source, _, said = source_of(server, tracker)
    sender = Sender(client)
    sender.write(0)
    before = source.wish(view()).action
    pose = sender.mimic[0].copy()
    pose[MIMIC["velocity_xy"]], pose[MIMIC["yaw_rate"]], pose[MIMIC["joint_pos"]] = (40.0, 0.0), 500.0, 1.5
    turned = quat_multiply(quat_from_yaw(torch.tensor(2.5, dtype=torch.float64)), sender.quats[0])
    jump = {
        "ACTION_BODY": json.dumps(pose.tolist()),
        "GMR_BODY_POS": json.dumps([9.0, 9.0, 0.8]),
        "GMR_BODY_QUAT": json.dumps(turned.tolist()),
        "GMR_JOINT_POS": json.dumps([1.5] * 29),
    }
    turn = 0.0
    for _ in range(3):
        sender.write(1, **jump)
        action = source.wish(view()).action
        assert np.allclose(action[ACTION["root_xy_delta"]], 0.0)
        assert np.abs(action - before)[ACTION["joint_pos"]].max() <= Limits.JOINT + 1e-6
        now = float(heading(quat_from_rot6d(torch.from_numpy(action[ACTION["root_rot6d"]]))))
        assert now - turn == pytest.approx(Limits.TURN, abs=1e-4)
        before, turn = action, now
    assert 1 <= len(said) <= 3 and all("limited" in line for line in said)


def test_a_command_counts_once_for_each_sequence(server, client):
    """It may stay in its key for long; the sender's stream goes on after its own start, and a reset is asked for."""
    source, _, _ = source_of(server)
    sender = Sender(client)
    sender.write(0)
    sender.command("start")
    assert [source.wish(view()).control for _ in range(3)] == ["start", "none", "none"]
    sender.command("start")
    epoch = client.get(source.backend.ready)
    assert source.wish(view(40)).control == "start"
    source.begin(view())  # the session began another episode for it
    assert client.get(source.backend.ready) == epoch, "a new epoch would put the sender back to idle"
    assert source.wish(view()).control == "none"
    sender.command("save_and_reset")
    assert source.wish(view(60)).control == "save_and_reset"
    source.begin(view())
    assert client.get(source.backend.ready) != epoch
    sender.command("save_and_reset", sender.sequence)
    assert source.wish(view()).control == "none", "the sender shows it for thirty loops"
    client.set(keys.RESET_TRIGGER, json.dumps({"reset_category": "2", "timestamp": 1}), ex=5)
    assert source.wish(view()).control == "discard_and_reset"
    assert not client.exists(keys.RESET_TRIGGER) and source.wish(view()).control == "none"
    sender.command("save")
    client.set(keys.RESET_TRIGGER, "{}", ex=5)
    assert source.wish(view()).control == "save_and_reset"


def test_state_and_camera_go_back(server, client):
    """The original's keys with angular velocity, roll, pitch and joints; a picture as JPEG, written once."""
    source, _, _ = source_of(server)
    image = np.full((24, 32, 3), 128, np.uint8)
    source.show(view(7, image))
    body = json.loads(client.get("state_body_unitree_g1_with_hands"))
    np.testing.assert_allclose(body, [0.1, 0.2, 0.3, 0.0, 0.0, *DEFAULT_POSE], atol=1e-5)
    assert json.loads(client.get("state_hand_left_unitree_g1_with_hands")) == [0.0] * 7
    assert json.loads(client.get("state_neck_unitree_g1_with_hands")) == [0.0, 0.0]
    assert abs(int(client.get("t_state")) / 1e3 - time.time()) < 60
    assert json.loads(client.get(keys.STATUS)) == {
        "tick": 7, "recording": "idle", "outcome": None, "note": "", "factor": 1.0,
    }  # fmt: skip
    picture = Image.open(io.BytesIO(client.get(keys.CAMERA)))
    assert picture.size == (32, 24) and abs(int(np.asarray(picture).mean()) - 128) < 3
    client.delete(keys.CAMERA)
    source.show(view(8, image))
    assert not client.exists(keys.CAMERA), "the same picture again"
    grips = {"LeftController": {"grip_binary": True}, "RightController": {"grip_binary": False}}
    Sender(client).write(0, CONTROLLERS=json.dumps(grips))
    source.wish(view())
    source.show(view(9))
    assert json.loads(client.get(keys.STATE_HANDS[0])) == list(HAND_CLOSE_LEFT)


def test_a_server_that_goes_and_comes_back(server):
    """The robot stands meanwhile, nothing is raised, and the sender gets a new epoch when the server is back."""
    own = Server(server.program)
    try:
        source, clock, said = source_of(own)
        Sender(own.client).write(0)
        assert source.wish(view()).action is not None
        own.stop()
        for _ in range(60):
            assert source.wish(view()).action is None
            source.show(view())
            clock.now += TICK
        assert len(said) == 1 and "the robot stands" in said[0]
        own.start()
        clock.now += 2.0
        assert source.wish(view()).action is None
        assert own.client.exists(source.backend.ready) and len(said) == 2
        Sender(own.client).write(1)
        assert source.wish(view()).action is not None
        source.close()
    finally:
        own.stop()


PROCESS = """
import json, sys, time
import redis
client, mimic = redis.Redis(port=int(sys.argv[1])), json.loads(sys.stdin.read())
while not client.exists(sys.argv[2]):
    time.sleep(0.01)
for n in range(int(sys.argv[3])):
    pipe = client.pipeline(transaction=True)
    pipe.set(sys.argv[4], json.dumps([float(n), *mimic[1:]]))
    pipe.set("t_action", int(time.time() * 1e3))
    pipe.execute()
    time.sleep(0.01)
"""


def test_a_sender_in_another_process_is_heard_and_its_end_noticed(server, client):
    """At 100 Hz of its own; when it ends the source is silent within the dead-man's time, by real clocks."""
    source = RedisSource(connect("127.0.0.1", server.port, 0), MimicReference())
    source.begin(view())
    sender = Sender(client)
    process = subprocess.Popen(
        [sys.executable, "-c", PROCESS, str(server.port), source.backend.ready, "100", keys.ACTION_BODY],
        stdin=subprocess.PIPE,
        text=True,
    )
    writer = threading.Thread(target=process.communicate, args=(json.dumps(sender.mimic[0].tolist()),))
    writer.start()
    heard, silent, until = 0, False, time.monotonic() + 60.0
    while time.monotonic() < until and not (heard and silent):
        action = source.wish(view()).action
        heard += action is not None
        silent = heard > 0 and action is None and process.poll() is not None
        time.sleep(TICK)
    writer.join()
    assert heard > 5 and silent and process.returncode == 0
    source.close()


@pytest.fixture(scope="module", params=["twist2", "sonic"])
def env(request):
    """One football world for a person, through both trackers."""
    env = ArenaEnv("football", tracker=trackers.get(request.param), worlds=1, engine="mujoco", device="cpu")
    yield env
    env.close()


def test_a_session_is_driven_recorded_and_saved(server, client, env, tmp_path):
    """The robot walks by the sender's frames, stands when it stalls, and its buttons save what was driven."""
    sender, clock = Sender(client), Clock()
    places = []

    class Driven(RedisSource):
        """The sender writes before each tick: both have one time."""

        calls = 0

        def wish(self, seen):
            frame = self.calls
            if frame < TICKS:
                if frame == 0:
                    sender.command("start")
                sender.write(frame)
            if frame == TICKS + 60:
                sender.command("save")
            places.append(seen.root_position[:2].copy())
            self.calls += 1
            return super().wish(seen)

    said = []
    source = Driven(connect("127.0.0.1", server.port, 0), references(env.tracker.name), clock=clock, say=said.append)
    session = TeleopSession(env, source, folder=tmp_path, seed=11, pace=Pace(clock, clock.sleep), say=said.append)
    report = session.run(ticks=env.startup_ticks + TICKS + 64)
    (file,) = report.saved
    episode = EpisodeFile(file)
    assert episode.rows == TICKS + 60
    np.testing.assert_allclose(episode.array("arena_action")[:TICKS], walk(), atol=2e-5)
    walked = np.linalg.norm(places[TICKS] - places[START])
    assert walked > 0.5, walked
    assert np.linalg.norm(places[-1] - places[-10]) < 0.05
    assert json.loads(client.get(keys.STATUS))["recording"] == "saved"
    assert episode.text("arena_policy") == "teleop-redis" and not [line for line in said if line.startswith("Redis")]


def test_the_reference_follows_the_tracker():
    """SONIC takes the retargeted person as in the original; every other tracker TWIST2's command."""
    assert isinstance(references("sonic"), GmrReference) and references("sonic").backend == "sonic_joint29"
    assert isinstance(references("twist2"), MimicReference) and isinstance(references("pd"), MimicReference)


def test_no_server_is_one_clear_error(capsys):
    """The command names host and port, exit code 2, before anything heavy is built."""
    port = free_port()
    with pytest.raises(InputError, match=f"--port {port} --db 0: no Redis server"):
        connect("127.0.0.1", port, 0)
    assert main(["redis", "--port", str(port)]) == 2
    assert f"--port {port}" in capsys.readouterr().err


CLOSED_LEFT, OPEN = json.dumps(list(HAND_CLOSE_LEFT)).encode(), json.dumps([0.0] * 7).encode()


@pytest.mark.parametrize(
    ("left", "right", "hands", "expected"),
    [
        ({"grip_binary": True}, {"grip_binary": False}, (b"", b""), [1, 0]),
        ({"grip_binary": True}, {}, (b"", b""), [1, 0]),
        ({"grip_binary": False}, {"index_trig": 0.6}, (b"", b""), [0, 1]),
        ({"grip_binary": False, "index_trig": 1.0}, {"grip_binary": True, "grip": 1.0}, (b"", b""), [0, 1]),
        ({"index_trig": 0.6, "grip": 1.0}, {"index_trig": 0.5, "grip": 0.0}, (b"", b""), [1, 0]),
        ({"grip": 0.6}, {"grip_binary": None}, (CLOSED_LEFT, b""), [0, 0]),
        ({"grip": 0.4}, {"grip_binary": True}, (CLOSED_LEFT, OPEN), [1, 1]),
        ({"grip_binary": "true", "index_trig": True}, None, (b"", OPEN), [0, 0]),
        ({"grip_binary": 1, "index_trig": float("nan")}, "broken", (b"", b""), None),
        ({}, {}, (b"", b""), None),
    ],
)
def test_each_hand_is_decided_by_what_is_said_of_it(left, right, hands, expected):
    """Its grip_binary, else its trigger and grip as in the original's sender, else its targets, else it is open."""
    said = json.dumps({"LeftController": left, "RightController": right}).encode()
    found = keys.closed_hands(said, hands)
    assert (None if found is None else found.tolist()) == expected


def test_hands_without_controllers():
    """A hand's targets alone decide for it, and 6 numbers are refused by name."""
    assert keys.closed_hands(b"", (CLOSED_LEFT, b"")).tolist() == [1, 0]
    assert keys.closed_hands(b"", (b"", b"")) is None
    with pytest.raises(InputError, match=r"action_hand_left.*6 numbers, expected 7"):
        keys.closed_hands(b"", (json.dumps([0.0] * 6).encode(), OPEN))
