"""A real Ray cluster of two machines on this one: processes and machines that die lose nothing and repeat nothing."""

import json
import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from eval_fakes import factories
from made_folders import SUITE, contents, journals

from arena_newton.eval.__main__ import main
from arena_newton.eval.workers.shard_merge import merge
from tests.patience import wait_for

ray = pytest.importorskip("ray", reason="needs the extra [ray]")
from ray_nodes import RAY, Nodes, actors, descendants, free_port, kill_all  # noqa: E402  # its psutil comes with Ray

ROOT = Path(__file__).resolve().parents[3]
FAKES = Path(__file__).parents[1] / "fakes_by_name.py"
PLAN = ["--task", "football", "boxing", "--engine", "mujoco", "--seeds", "0", "1", "--repeats", "3", "--actions"]
PLAN += ["--worlds", "2"]


@pytest.fixture(scope="module")
def poison(tmp_path_factory):
    """File that names the episodes which end their process, and how."""
    return tmp_path_factory.mktemp("poison") / "poison.txt"


@pytest.fixture(scope="module")
def nodes(tmp_path_factory, poison):
    """A cluster of two machines with a core each."""
    found = Nodes(tmp_path_factory.mktemp("ray") / "log.txt", {"FAKE_TICK_S": "0.05", "FAKE_POISON": str(poison)})
    try:
        found.add()
        yield found
    finally:
        found.stop()


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Files of one process without Ray."""
    folder = tmp_path_factory.mktemp("alone")
    assert main(["run", *PLAN, "--out", str(folder / "run")], factories()) == 0
    merge([folder / "run"], folder / "merged")
    return folder / "merged"


def start(nodes, folder, *flags):
    """A run by the cluster, in a process of its own."""
    command = [sys.executable, str(FAKES), "run", *PLAN, "--ray", nodes.address, *flags, "--out", str(folder)]
    environment = os.environ | nodes.token
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def lines(folder):
    """Journal lines so far."""
    path = folder / "episodes.jsonl"
    return path.read_text().splitlines() if path.exists() else []


@pytest.mark.release
def test_kill_9_in_a_job_of_two_machines(alone, tmp_path):
    """The batch file makes a cluster; a process and a machine are killed, and all files are those of one process.

    The scheduler starts its tasks on this machine.
    """
    (tmp_path / "bin").mkdir()
    programs = {
        "python": f'[ "$1 $2" = "-m arena_newton.eval" ] && shift 2\nexec {sys.executable} {FAKES} "$@"',
        "ray": f'exec {RAY} "$@"',
        "scontrol": "echo one; sleep 0.5; echo two",
        "hostname": "echo 127.0.0.1",
        "srun": 'while [[ $1 == --* ]]; do shift; done\nexec "$@"',
    }
    for name, text in programs.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    slurm = {"SLURM_JOB_NODELIST": "n[1-2]", "SLURM_JOB_NUM_NODES": "2", "SLURM_CPUS_PER_TASK": "1"}
    slurm |= {"RAY_PORT": str(free_port()), "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "FAKE_TICK_S": "0.1"}
    command = ["bash", str(ROOT / "examples" / "ray.sbatch"), "out", *PLAN]
    with open(tmp_path / "said.txt", "wb") as said:
        job = subprocess.Popen(
            command, env=os.environ | slurm, cwd=tmp_path, stdout=said, stderr=said, start_new_session=True
        )
    out = tmp_path / "out"
    try:
        wait_for(lambda: len(actors(job.pid)) == 2 and len(lines(out)) >= 2 or job.poll() is not None, "episodes", 300)
        assert job.poll() is None, (tmp_path / "said.txt").read_text()
        # Of the machines that the job began the one that is not the head, which began first.
        machines = [process for process in descendants(job.pid) if process.name() == "raylet"]
        machine = max(machines, key=lambda process: process.create_time())
        other = next(pid for pid in actors(job.pid) if pid not in actors(machine.pid))
        kill_all(machine)
        os.kill(other, 9)
        assert job.wait(300) == 0, (tmp_path / "said.txt").read_text()
    finally:
        kill_all(psutil.Process(job.pid)) if job.poll() is None else None
    assert sorted(json.loads(line)["index"] for line in lines(out)) == list(range(12))
    assert "is replaced: it" in (tmp_path / "said.txt").read_text()
    merge([out], tmp_path / "merged")
    assert contents(tmp_path / "merged") == contents(alone)


@pytest.mark.slow
def test_poison_and_a_deadline(nodes, alone, poison, tmp_path):
    """An episode that kills its process and one that hangs end as errors; the others end as without them."""
    planned = [json.loads(line) for line in lines(alone)]
    dies, hangs = planned[2], planned[8]
    poison.write_text(f"die {dies['episode_seed']} hang {hangs['episode_seed']}")
    try:
        run = start(nodes, tmp_path / "run", "--ray-attempts", "1", "--ray-minutes", "0.15")
        said, _ = run.communicate(timeout=500)
    finally:
        poison.unlink()
    assert run.returncode == 1, said
    found = {line["index"]: line for line in map(json.loads, lines(tmp_path / "run"))}
    assert len(found) == len(lines(tmp_path / "run")) == 12
    for line in planned:
        ended = found[line["index"]]
        if line["episode_seed"] in (dies["episode_seed"], hangs["episode_seed"]):
            cause = "it died" if line["episode_seed"] == dies["episode_seed"] else "took longer than 0.15 min"
            assert (ended["outcome"], ended["reason"]) == ("error", "environment") and cause in ended["error"]
        else:
            assert (ended["outcome"], ended["steps"], ended["hashes"]) == (
                line["outcome"],
                line["steps"],
                line["hashes"],
            )


@pytest.mark.slow
def test_kill_9_in_a_suite(nodes, tmp_path):
    """A process is killed while two play the cells of a suite: every cell has the episodes of one process, once."""
    (tmp_path / "suite.toml").write_text(SUITE)
    command = ["matrix", str(tmp_path / "suite.toml"), "--out"]
    assert main([*command, str(tmp_path / "alone")], factories()) == 0
    flags = [str(tmp_path / "ray"), "--ray", nodes.address, "--ray-attempts", "9"]
    run = subprocess.Popen(
        [sys.executable, str(FAKES), *command, *flags],
        env=os.environ | nodes.token,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        for killed in range(2):
            begun = len(list((tmp_path / "ray").glob("*/*/*/*/episodes.jsonl")))

            def another(least=begun + 1):
                return len(list((tmp_path / "ray").glob("*/*/*/*/episodes.jsonl"))) >= least and nodes.actors()

            wait_for(another, "cell of another process", 300)
            os.kill(nodes.actors()[killed % len(nodes.actors())], 9)
        said, _ = run.communicate(timeout=500)
    finally:
        run.kill()
    assert run.returncode == 0, said
    assert said.count("is replaced: it died") == 2
    assert journals(tmp_path / "ray") == journals(tmp_path / "alone")
