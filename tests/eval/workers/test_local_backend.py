"""`eval run --jobs`: processes of this machine, their cores and GPUs, and what becomes of them when one dies."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from eval_fakes import factories
from made_folders import configuration, contents

from arena_newton.eval.__main__ import main
from arena_newton.eval.workers.backend import WorkerLost
from arena_newton.eval.workers.local_backend import LocalBackend
from arena_newton.eval.workers.shard_merge import merge
from arena_newton.physics import devices
from tests.patience import wait_for

FAKES = Path(__file__).parents[1] / "fakes_by_name.py"
STARTED = 400.0
"""Time in which a process has loaded its libraries, however busy the machine is [s]."""


@pytest.fixture
def started(monkeypatch, tmp_path):
    """Starts processes on a machine with three GPUs, and gives where they are."""
    for number in range(3):
        (tmp_path / "gpus" / str(number)).mkdir(parents=True)
    monkeypatch.setattr(devices, "NVIDIA_DEVICES", tmp_path / "gpus")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    with contextlib.ExitStack() as ended:

        def start(backend):
            process = backend.start()
            ended.callback(process.end)
            process.ask("node")
            assert backend.wait([process], STARTED) == [process]
            return process, process.take()

        yield start


def test_cores_are_divided_and_gpus_taken_in_turn(started, monkeypatch, capsys):
    """All cores have their process; of three GPUs each new process has the one with the fewest, none on the CPU."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)))
    for jobs, parts in ((2, [(0, 4), (4, 4)]), (3, [(0, 2), (2, 3), (5, 3)]), (8, [(rank, 1) for rank in range(8)])):
        assert [LocalBackend(jobs, "cpu").cores(rank) for rank in range(jobs)] == parts
    assert capsys.readouterr().err == ""
    many = LocalBackend(9, "cpu")
    assert {many.cores(rank)[1] for rank in range(9)} == {1}
    assert capsys.readouterr().err == "  --jobs 9: processes share 8 cores\n"
    backend = LocalBackend(4, "cuda:0")
    assert backend.gpus == 0.75
    (first, node), *others = [started(backend) for _ in range(2)]
    assert [node.gpus, *(there.gpus for _, there in others)] == ["0", "1"]
    first.end()
    assert started(backend)[1].gpus == "0"
    assert started(LocalBackend(2, "cpu"))[1].gpus == ""


def test_a_killed_process_is_told_of(started):
    """It is lost, whether an answer is waited for or it is asked for more; Ctrl-C at a terminal does not reach it."""
    backend = LocalBackend(1, "cpu")
    process, node = started(backend)
    assert os.getpgid(node.pid) != os.getpgid(0)
    os.kill(node.pid, signal.SIGKILL)
    for _ in range(2):
        with pytest.raises(WorkerLost, match="it died"):
            process.take()
        process.ask("node")


STARTS = """
import sys, time
from arena_newton.eval.workers.local_backend import LocalBackend
process = LocalBackend(1, "cpu").start()
process.ask("node")
print(process.take().pid, flush=True)
time.sleep(600)
"""
"""A program that starts a process, says its number and waits."""


def ended(pid):
    """True once a process that is no child of this one has ended."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return True
    return state.rpartition(")")[2].split()[0] == "Z"


def test_processes_end_with_who_started_them():
    """None of its processes stays when a run ends, even by `kill -9`."""
    program = subprocess.Popen([sys.executable, "-c", STARTS], stdout=subprocess.PIPE, text=True)
    pid = int(program.stdout.readline())
    assert not ended(pid)
    program.kill()
    program.communicate()
    wait_for(lambda: ended(pid), "end of the process", STARTED)


def playing(pid):
    """Processes that a process started and that have begun to play or load for it."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in children if b"local_backend" in Path(f"/proc/{child}/cmdline").read_bytes()]


@pytest.mark.release
def test_a_run_of_which_a_process_is_killed(tmp_path):
    """Two processes play a plan, one of them is killed: all files are those that one process writes."""
    plan = ["run", "--task", "football", "boxing", "--engine", "mujoco", "--seeds", "0", "--repeats", "4", "--actions"]
    assert main([*plan, "--out", str(tmp_path / "one")], factories()) == 0
    out, slow = tmp_path / "two", os.environ | {"FAKE_TICK_S": "0.1"}
    command = [sys.executable, str(FAKES), *plan, "--worlds", "1", "--jobs", "2", "--out", str(out)]
    with open(tmp_path / "said.txt", "w+") as said:
        run = subprocess.Popen(command, env=slow, stdout=said, stderr=said)
        journal = out / "episodes.jsonl"
        while run.poll() is None and not (journal.exists() and journal.read_text()):
            time.sleep(0.05)
        os.kill(playing(run.pid)[0], signal.SIGKILL)
        code = run.wait(STARTED)
        said.seek(0)
        text = said.read()
    assert code == 0, text
    assert "is replaced: it died" in text
    assert sorted(json.loads(line)["index"] for line in journal.read_text().splitlines()) == list(range(8))
    for name in ("one", "two"):
        merge([tmp_path / name], tmp_path / f"{name}_merged")
    assert contents(tmp_path / "two_merged") == contents(tmp_path / "one_merged")
    assert configuration(tmp_path / "two_merged") == configuration(tmp_path / "one_merged")
