"""Statements of policies.md and policy_server.md in docs/howto/bring/ hold: tables, server, policy in Python."""

import re
import threading
from http.server import ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch
from json_server import JsonHandler, JsonServer

from arena_newton import policies, tasks
from arena_newton.env import STAND_ACTION
from arena_newton.policies import Observation
from arena_newton.policies.protocols.policy_messages import LONGEST_CHUNK
from arena_newton.policies.remote.arena_client import (
    MAX_FAILURES,
    MAX_REPLY,
    ROBOT_TYPE,
    TOKEN_VARIABLE,
    RemotePolicy,
)
from arena_newton.robot import canonical, g1

ROOT = Path(__file__).parents[2]
TEXT = "".join((ROOT / "docs" / "howto" / "bring" / page).read_text() for page in ("policies.md", "policy_server.md"))
PLAIN = " ".join(TEXT.split())
SQUAT, *_, SERVER = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def table(title):
    """Rows of the table whose first header cell is `title`, without its head."""
    lines = TEXT[TEXT.index(f"| {title} |") :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in lines]


def observation(worlds):
    return Observation(
        torch.zeros(worlds, 64),
        torch.full((worlds, 480, 640, 3), 7, dtype=torch.uint8),
        np.ones(worlds, bool),
        "boxing",
        "Isaac-Boxing",
        "Strike.",
    )


def test_joint_table():
    """Every joint stands at its index in state and action, with its angle in the standing action."""
    rows = table("joint")
    assert [row[0] for row in rows] == list(g1.CANONICAL_JOINTS)
    for k, (_, position, velocity, action, standing) in enumerate(rows):
        assert int(position) == canonical.STATE["joint_pos"].start + k
        assert int(velocity) == canonical.STATE["joint_vel"].start + k
        assert int(action) == canonical.ACTION["joint_pos"].start + k
        assert np.float32(standing) == STAND_ACTION[int(action)]
        assert canonical.element_name(int(action)) == f"joint_pos[{g1.CANONICAL_JOINTS[k]}]"


def test_state_and_action_tables():
    """The slices are those of the canonical vectors, and the standing values those of the standing action."""
    state, action = [
        [row for row in map(str.split, re.findall(r"^\| (\d+(?:–\d+)?) \|", part, re.M))]
        for part in (TEXT.split("### State, 64")[1].split("###")[0], TEXT.split("### Action, 40")[1].split("###")[0])
    ]
    for rows, parts in ((state, canonical.STATE), (action, canonical.ACTION)):
        spans = [tuple(map(int, row[0].split("–"))) for row in rows]
        assert [(span[0], span[-1] + 1) for span in spans] == [(p.start, p.stop) for p in parts.values()]
    for row in re.findall(r"^\| (\d+)[–\d]* \|.*\| ([-\d., ]+) \|$", TEXT.split("### Action, 40")[1], re.M)[:4]:
        values = [np.float32(v) for v in row[1].split(",")]
        assert values == STAND_ACTION[int(row[0]) : int(row[0]) + len(values)].tolist()
    assert str(list(map(int, canonical.IDENTITY_ROT6D))) in TEXT


def test_task_table():
    """Gym ids and instructions are the tasks' own."""
    assert table("task") == [[name, tasks.get(name).gym_id, tasks.get(name).instruction] for name in tasks.OWN]


def test_numbers_in_the_text():
    """Limits, names and defaults are those of the code."""
    assert (
        f"1 to {LONGEST_CHUNK} actions" in PLAIN
        and f"at most {MAX_REPLY >> 20} MiB" in PLAIN
        and TOKEN_VARIABLE in PLAIN
    )
    assert f"| {MAX_FAILURES} requests in a row" in PLAIN and f'`"{ROBOT_TYPE}"`' in PLAIN
    policy = RemotePolicy("http://host")
    assert f"`--remote-retries` times ({policy.retries})" in PLAIN and f"seconds ({policy.timeout:g})" in PLAIN
    assert (policy.camera.width, policy.camera.height, policy.camera.fit) == (640, 480, "native")
    assert f"{ThreadingHTTPServer.request_queue_size} in Python's" in PLAIN
    assert set(re.findall(r"^\| `(\w+)(?::<\w+>)?` \| ", TEXT.split("## What a policy sees")[0], re.M)) == {
        name for name in policies.names() if name in policies.base.POLICIES.built_in
    }


def test_request_tables():
    """Requests have the keys of the tables, and no others."""
    seen = {}

    class Listen(JsonHandler):
        def do_POST(self):  # noqa: N802 (the name that http.server calls)
            seen[self.path] = self.asked()
            self.answer(200, {"action": STAND_ACTION.tolist()})

    server = JsonServer(Listen)
    policy = RemotePolicy(server.url, timeout=120.0)
    policy.reset([3], ["Isaac-Boxing"])
    assert policy.act(observation(1)).errors == {}
    policy.close()
    server.close()
    for route, body in seen.items():
        assert sorted(row[0] for row in table(f"`{route}`")) == sorted(body)
    picture = seen["/infer"]["observation"]["images"]["front"]
    assert picture["shape"] == [480, 640, 3] and len(picture["data_b64"]) == 480 * 640 * 4
    assert list(picture) == ["shape", "dtype", "data_b64"]


def test_server_of_the_text(monkeypatch):
    """The server is the file that it names, explains itself, and its noise follows from seed and step alone."""
    assert (ROOT / "policies" / "serve_example.py").read_text().endswith(SERVER)
    monkeypatch.setattr("sys.argv", ["serve_example", "--help"])
    with pytest.raises(SystemExit, match="0"):
        exec(compile(SERVER, "docs/howto/bring/policy_server.md", "exec"), {"__name__": "__main__"})
    names = {"__name__": "server"}
    exec(compile(SERVER, "docs/howto/bring/policy_server.md", "exec"), names)
    names["Handler"].log_message = lambda *_: None
    server = names["Server"](("127.0.0.1", 0), names["Handler"])
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
    played = {}
    for order in ([5, 6, 7], [7, 5, 6]):
        policy = policies.get(f"remote:http://127.0.0.1:{server.server_port}")
        policy.check()
        assert policy.describe()["seeding"] == "per_request" and policy.describe()["server"] == "standing with noise"
        policy.reset(order, ["Isaac-Boxing"] * 3)
        for step in range(2):
            chunk = policy.act(observation(3))
            assert chunk.errors == {} and chunk.actions.shape == (3, 20, 40)
            for world, seed in enumerate(order):
                bits = chunk.actions[world].tobytes()
                assert played.setdefault((seed, step), bits) == bits
        policy.close()
    assert len(set(played.values())) == 6
    server.shutdown()
    server.server_close()


def test_policy_in_python(monkeypatch):
    """The policy of the text runs, found by its name."""
    names = {}
    exec(compile(SQUAT, "docs/howto/bring/policies.md", "exec"), names)
    monkeypatch.setattr(policies.base.POLICIES, "_registered", {})
    policies.register("squat", names["Squat"])
    policy = policies.get("squat:0.2")
    policy.reset([1, 2], ["Isaac-Boxing"] * 2)
    heights = np.concatenate([policy.act(observation(2)).actions[0, :, 2] for _ in range(20)])
    canonical.validate_action(policy.act(observation(2)).actions, "squat")
    assert heights[0] == np.float32(0.8) and heights.min() == pytest.approx(0.6, abs=1e-3)
    policy.reset([1, 2], ["Isaac-Boxing"] * 2, np.array([False, True]))
    chunk = policy.act(observation(2)).actions
    assert chunk[1, 0, 2] == np.float32(0.8) and chunk[0, 0, 2] < 0.8
