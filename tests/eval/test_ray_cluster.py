"""A real Ray cluster of two machines on this one: processes and machines that die lose nothing and repeat nothing."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import factories
from test_shard_merge import contents

from arena_newton.eval.__main__ import main
from arena_newton.eval.shard_merge import merge

ray = pytest.importorskip("ray", reason="needs the extra [ray]")
from ray_nodes import Nodes, wait_for  # noqa: E402  # its psutil comes with Ray

ROOT = Path(__file__).resolve().parents[2]
FAKES = Path(__file__).with_name("eval_fakes.py")
PLAN = ["--task", "football", "boxing", "--engine", "mujoco", "--seeds", "0", "1", "--repeats", "6", "--actions"]
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
    """What one process writes without Ray."""
    folder = tmp_path_factory.mktemp("alone")
    assert main(["run", *PLAN, "--out", str(folder / "run")], factories()) == 0
    merge([folder / "run"], folder / "merged")
    return folder / "merged"


def start(nodes, folder, *flags):
    """A run by the cluster, in a process of its own."""
    command = [sys.executable, str(FAKES), "run", *PLAN, "--ray", nodes.address, *flags, "--out", str(folder)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def lines(folder):
    """Journal lines so far."""
    path = folder / "episodes.jsonl"
    return path.read_text().splitlines() if path.exists() else []


def test_kill_9_of_a_process_and_of_a_machine(nodes, alone, tmp_path):
    """Whatever is killed, a journal line is there for each episode once, and all files are those of one process."""
    folder = tmp_path / "run"
    run = start(nodes, folder)
    wait_for(lambda: len(lines(folder)) >= 3 or run.poll() is not None)
    killed = nodes.actors()
    assert run.poll() is None and killed
    os.kill(killed[0], 9)
    wait_for(lambda: len(lines(folder)) >= 7 or run.poll() is not None)
    nodes.kill_machine(0)
    nodes.add()
    said, _ = run.communicate(timeout=240)
    assert run.returncode == 0, said
    assert sorted(json.loads(line)["index"] for line in lines(folder)) == list(range(24))
    assert "a process on" in said and "is replaced" in said
    merge([folder], tmp_path / "merged")
    assert contents(tmp_path / "merged") == contents(alone)


def test_poison_and_a_deadline(nodes, alone, poison, tmp_path):
    """An episode that kills its process and one that hangs end as errors; the others end as without them."""
    planned = [json.loads(line) for line in lines(alone)]
    dies, hangs = planned[4], planned[13]
    poison.write_text(f"die {dies['episode_seed']} hang {hangs['episode_seed']}")
    try:
        run = start(nodes, tmp_path / "run", "--ray-attempts", "1", "--ray-minutes", "0.1")
        said, _ = run.communicate(timeout=240)
    finally:
        poison.unlink()
    assert run.returncode == 1, said
    found = {line["index"]: line for line in map(json.loads, lines(tmp_path / "run"))}
    assert len(found) == len(lines(tmp_path / "run")) == 24
    for line in planned:
        ended = found[line["index"]]
        if line["episode_seed"] in (dies["episode_seed"], hangs["episode_seed"]):
            cause = "it died" if line["episode_seed"] == dies["episode_seed"] else "took longer than 0.1 min"
            assert (ended["outcome"], ended["reason"]) == ("error", "environment") and cause in ended["error"]
        else:
            assert (ended["outcome"], ended["steps"], ended["hashes"]) == (
                line["outcome"],
                line["steps"],
                line["hashes"],
            )


def test_the_batch_file_of_a_cluster(alone, tmp_path):
    """Under a scheduler that starts its tasks on this machine, the batch file makes a cluster, plays and ends it."""
    (tmp_path / "bin").mkdir()
    programs = {
        "python": f'[ "$1 $2" = "-m arena_newton.eval" ] && shift 2\nexec {sys.executable} {FAKES} "$@"',
        "ray": f'exec {Path(sys.executable).with_name("ray")} "$@"',
        "scontrol": 'echo "one"; echo "two"',
        "hostname": "echo 127.0.0.1",
        # It starts a task per machine, all of them here.
        "srun": 'while [[ $1 == --* ]]; do shift; done\nexec "$@"',
    }
    for name, text in programs.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    from ray_nodes import free_port

    environment = os.environ | {
        "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}",
        "SLURM_JOB_NODELIST": "n[1-2]",
        "SLURM_JOB_NUM_NODES": "2",
        "SLURM_CPUS_PER_TASK": "1",
        "RAY_PORT": str(free_port()),
    }
    command = ["bash", str(ROOT / "examples" / "ray.sbatch"), "out", *PLAN]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    merge([tmp_path / "out"], tmp_path / "merged")
    assert contents(tmp_path / "merged") == contents(alone)
