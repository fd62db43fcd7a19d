"""Any program as a policy: what it is sent line by line, what becomes of its answers, and how it ends."""

import base64
import json
import shlex
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.policies import Observation, PolicyUnavailable
from arena_newton.policies.remote import process_client
from arena_newton.policies.remote.program import ProgramCommand
from tests.eval.eval_fakes import factories

PROGRAM = """
import json, os, sys, time
told = open(os.environ["TOLD"], "a")
CONFIG = {config}
for line in sys.stdin:
    print(line.strip(), file=told, flush=True)
    asked = json.loads(line)
    reply = {{"config": CONFIG, "reset": {{"seeded": True, "policy": "words"}}}}.get(asked["request"])
    if reply is None:
        action = [0.0] * 40
        action[2] = action[3] = action[6] = 1.0
        action[38] = asked["observation"]["state"][0]
        reply = {{"action_chunk": [action] * 4}}
    reply["id"] = asked["id"]
    if asked["request"] == "infer" and asked["world"] == 1:
        {fault}
    print(json.dumps(reply), flush=True)
"""


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Writes a program, and makes its policy; what the program was sent is in `told`."""
    made = []
    monkeypatch.setenv("TOLD", str(tmp_path / "told"))

    def make(fault="pass", config="{}", **options):
        script = tmp_path / "agent.py"
        script.write_text(PROGRAM.format(fault=fault, config=config))
        made.append(policies.get(f"process:{shlex.join([sys.executable, str(script)])}", **options))
        return made[-1]

    make.told = lambda: [json.loads(line) for line in (tmp_path / "told").read_text().splitlines()]
    yield make
    for policy in made:
        policy.close()


def observation(worlds, image=False):
    state = torch.zeros(worlds, 64)
    state[:, 0] = torch.arange(worlds)
    picture = torch.arange(worlds, dtype=torch.uint8)[:, None, None, None].expand(worlds, 6, 8, 3) if image else None
    return Observation(
        state=state, image=picture, mask=np.ones(worlds, bool), task="boxing", gym_id="Boxing", instruction="Strike."
    )


def test_lines_of_the_protocol(program):
    """A line for each request, with a number, and the fields of the HTTP protocol; worlds are asked in their order."""
    policy = program()
    policy.check()
    policy.reset([7, 8], ["Boxing"] * 2)
    chunk = policy.act(observation(2, image=True))
    assert chunk.errors == {} and chunk.actions.shape == (2, 4, 40) and chunk.actions[1, 0, 38] == 1.0
    told = program.told()
    assert [(one["request"], one["id"]) for one in told] == [
        *[("reset", 1), ("config", 2), ("reset", 3), ("reset", 4), ("infer", 5), ("infer", 6)]
    ]
    assert told[3] == {"request": "reset", "id": 4, "seed": 8, "world": 1, "task": "Boxing"}
    last = told[5]
    front = last["observation"].pop("images")["front"]
    assert front["shape"] == [6, 8, 3] and base64.b64decode(front["data_b64"]) == b"\1" * 144
    assert last["observation"]["state"][0] == 1.0 and (last["seed"], last["step"], last["world"]) == (8, 0, 1)
    assert last["instruction"] == "Strike." and last["task"] == "Boxing"
    assert policy.describe() == {
        "name": "process",
        "command": "python agent.py",
        "server": "words",
        "sequential": True,
        "seeding": "per_request",
        "worlds_matter": False,
    }


def test_what_it_declares_is_heeded(program):
    """A program may say that it needs no picture, or that it wants pictures as files, which hold what is shown."""
    blind = program(config='{"arena": 1, "needs_picture": False, "chunk_length": 4}')
    blind.check()
    assert not blind.needs_image and blind.chunk_size == 4
    sees = program(config='{"picture_files": True}')
    sees.check()
    sees.act(observation(2, image=True))
    files = [one["observation"]["images"]["front"]["file"] for one in program.told() if one["request"] == "infer"]
    assert [np.unique(Image.open(file)).tolist() for file in files] == [[0], [1]]
    assert Image.open(files[1]).size == (8, 6)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (
            'print("thinking ...", flush=True)',
            "(infer): wrote thinking ... to its standard output, expected a JSON",
        ),
        ('reply["id"] += 1', "expected a JSON object with the request's id"),
        ('del reply["id"]', "expected a JSON object with the request's id"),
        ('reply["error"] = "no\\nmodel"', "(infer): no model"),
        ("reply['action_chunk'][0].pop()", "39], expected [n, 40]"),
        ("reply['action_chunk'][0][5] = float('nan')", "is nan, expected a finite number"),
    ],
)
def test_a_bad_answer_ends_one_world(program, fault, says):
    """A bad answer is one line that names the program; that world alone has an error, and no answer is another's."""
    policy = program(fault)
    for _ in range(2):
        chunk = policy.act(observation(3))
        assert set(chunk.errors) == {1} and says in chunk.errors[1] and "\n" not in chunk.errors[1]
        assert chunk.errors[1].startswith("python agent.py")
        assert chunk.actions[2, 0, 38] == 2.0
        policy.reset([0, 1, 2], ["Boxing"] * 3)


def test_a_late_answer_is_nobodys(program, tmp_path):
    """A world whose answer takes too long ends; when it comes, it is not taken for the answer to the next query."""
    go = tmp_path / "go"
    policy = program(f"while not os.path.exists({str(go)!r}): time.sleep(0.01)")
    assert policy.act(observation(1)).errors == {}
    policy.timeout = 0.2
    seen = observation(3)
    seen.mask[[0, 2]] = False
    assert "no reply within 0.2 s" in policy.act(seen).errors[1]
    go.touch()
    policy.timeout = 60.0
    policy.reset([0, 1, 2], ["Boxing"] * 3)
    chunk = policy.act(observation(3))
    assert chunk.errors == {} and chunk.actions[:, 0, 38].tolist() == [0.0, 1.0, 2.0]


def test_a_long_picture_and_a_slow_reader(program):
    """A request that is longer than a pipe holds is given as the program reads it."""
    seen = observation(2)
    seen.images = {"front": torch.zeros(2, 480, 640, 3, dtype=torch.uint8)}
    assert program().act(seen).errors == {}


def test_a_program_that_ends_stops_the_run(program):
    """The run stops, and says how the program ended; nothing is asked twice."""
    with pytest.raises(PolicyUnavailable, match=r"the program is gone: python agent.py \(infer\): .*exit code 3"):
        program("sys.exit(3)").act(observation(3))
    assert [one["world"] for one in program.told()] == [0, 1]


def test_a_program_that_stays_is_ended(program, monkeypatch):
    """A program that does not end with its input is killed."""
    monkeypatch.setattr(process_client, "PATIENCE", 0.05)
    policy = program("print(json.dumps(reply), flush=True); time.sleep(600)")
    policy.act(observation(2))
    policy.close()
    assert policy._program.start().returncode == -9


def test_an_endless_line_ends_the_program(program, monkeypatch):
    """A line without an end is not kept: the program is ended at once, and the run stops."""
    monkeypatch.setattr(process_client, "MAX_REPLY", 1 << 20)
    monkeypatch.setattr(process_client, "PATIENCE", 0.05)
    policy = program("sys.stdout.write('x' * (2 << 20)); sys.stdout.flush()")
    with pytest.raises(PolicyUnavailable, match="the program is gone: .*the reply is longer than 1 MiB"):
        policy.act(observation(2))
    assert policy._program.start().stdout.closed


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (None, "--policy process: needs a command, as in 'process:python agent.py'"),
        ("no_such_program --fast", "no program no_such_program is found"),
        ("python 'agent", "No closing quotation"),
        ("python -c " + "x" * 300, "longer than 256; name a script"),
    ],
)
def test_a_command_that_is_none_is_refused(command, says):
    """A program that cannot be started is one line before the first episode."""
    with pytest.raises(InputError) as caught:
        policies.get("process" if command is None else f"process:{command}")
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_files_of_a_command_count(tmp_path, monkeypatch):
    """A program counts next to its arguments, Python's interpreter does not; a name alone is no file of this folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("agent", "python_agent", "weights.bin", "true"):
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)

    def counted(command):
        return [file.name for file in ProgramCommand.read(command).decisive]

    assert counted("./agent weights.bin") == ["agent", "weights.bin"]
    assert counted("./python_agent weights.bin") == ["python_agent", "weights.bin"]
    assert counted(f"{sys.executable} agent weights.bin") == ["agent", "weights.bin"]
    assert counted("./agent --fast") == ["agent"] and counted(f"{sys.executable} -m agents") == ["python"]
    assert ProgramCommand.read("true agent").words == ("true", str(tmp_path / "agent"))


def test_a_program_that_is_no_policy_is_refused(tmp_path):
    """One that ends at once is refused before the first episode, with its exit code."""
    with pytest.raises(InputError, match=r"--policy process: no policy program: true \(reset\): .*exit code 0"):
        policies.get("process:true").check()


def test_runs_with_a_program(program, tmp_path, monkeypatch, capsys):
    """Results know a program by its name and content: in another folder it is the same, changed it is refused."""
    policy = program()
    flags = ["--engine", "mujoco", "--task", "boxing", "--seeds", "0", "--repeats", "3"]
    run = [*flags, "--policy", f"process:{policy.command.text}", "--remote-timeout", "50"]
    assert main([*run, "--out", str(tmp_path / "a")], factories(policy=policies.get)) == 0
    monkeypatch.chdir(tmp_path)
    near = f"process:{shlex.quote(sys.executable)} agent.py"
    assert main([*run, "--policy", near, "--out", "b"], factories(policy=policies.get)) == 0
    one, other = (json.loads((tmp_path / name / "config.json").read_text()) for name in "ab")
    assert one["config_hash"] == other["config_hash"] and one["config"]["policy"] == "process:python agent.py"
    for line in (tmp_path / "b" / "episodes.jsonl").read_text().splitlines():
        assert json.loads(line)["policy"] == "process:python agent.py"

    program("if asked['seed']: sys.exit(3)")
    assert main([*run, "--out", str(tmp_path / "b")], factories(policy=policies.get)) == 2
    assert "policy_file" in capsys.readouterr().err
    assert main([*run, "--out", str(tmp_path / "c")], factories(policy=policies.get)) == 2
    assert "the program is gone" in (said := capsys.readouterr().err)
    assert f"eval resume {tmp_path / 'c'} --policy 'process:" in said
    program("open(os.environ['TOLD'] + ' again', 'w')")
    assert main(["resume", str(tmp_path / "c")], factories(policy=policies.get)) == 2
    assert "a program played it, which a folder does not start; name it by --policy" in capsys.readouterr().err
    assert not (tmp_path / "told again").exists()
    assert main([*run, "--remote-retries", "1"], factories(policy=policies.get)) == 2
    assert capsys.readouterr().err.startswith("error: --remote-retries: belongs to --policy remote:<url>, not process:")
