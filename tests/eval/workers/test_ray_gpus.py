"""A suite by a real Ray cluster that says it has two GPUs: each process sees its own, or its part of one."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from made_folders import SUITE, journals

from arena_newton.eval.suites.suite_records import read_suite
from tests.patience import wait_for

pytest.importorskip("ray", reason="needs the extra [ray]")
from ray_nodes import Nodes  # noqa: E402  # its psutil comes with Ray

FAKES = Path(__file__).parents[1] / "fakes_with_gpus.py"


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A machine that Ray takes for one with four cores and two GPUs, and the file of what processes see."""
    folder = tmp_path_factory.mktemp("gpus")
    environment = {"FAKE_GPUS": str(folder / "gpus.txt"), "FAKE_TICK_S": "0.1"}
    found = Nodes(folder / "log.txt", environment, cores=4, gpus=2)
    try:
        wait_for(lambda: "Ray runtime started" in (folder / "log.txt").read_text(), "cluster")
        yield found, folder
    finally:
        found.stop()


def play(cluster, out, *flags):
    """Number of processes per GPU that they see, and the episodes of a suite on engine warp."""
    nodes, folder = cluster
    (folder / "suite.toml").write_text(SUITE.replace('"mujoco"', '"warp"'))
    (folder / "gpus.txt").unlink(missing_ok=True)
    command = [sys.executable, str(FAKES), "matrix", str(folder / "suite.toml"), "--out", str(out)]
    environment = os.environ | nodes.token | {"FAKE_GPUS": str(folder / "gpus.txt")}
    done = subprocess.run([*command, *flags], env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    seen = dict(line.split(" ", 1) for line in (folder / "gpus.txt").read_text().splitlines())
    assert {cell.device for cell in read_suite(out).cells} == {"a GPU"}
    return Counter(seen.values()), journals(out)


CREW = """
import functools, ray
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.workers.ray_backend import RayBackend, in_cluster
from arena_newton.eval.workers.worker_pool import WorkerPool
ray.init = functools.partial(ray.init, num_cpus=4, num_gpus=2)
with in_cluster(()):
    for gpus, number in ((1, 2), (0.5, 4)):
        flags = RunOptions(ray=(), engine="warp", ray_cpus=1, ray_gpus=gpus)
        pool = WorkerPool(RayBackend(flags, resolve(flags).device), 8, None)
        while len(pool.idle()) < number:
            list(pool.messages())
        print(len(pool.workers), *sorted(worker.node.gpus for worker in pool.workers))
        pool.dismiss()
"""
"""A program that asks for processes and says which GPUs they see."""


@pytest.mark.release
def test_each_process_sees_its_gpu():
    """Processes with a GPU each see GPU 0 and GPU 1; with half a GPU each two of four see the same one."""
    done = subprocess.run([sys.executable, "-c", CREW], capture_output=True, text=True, timeout=500)
    assert done.stdout.splitlines() == ["2 0 1", "4 0 0 1 1"], done.stderr


@pytest.mark.slow
def test_a_suite_on_halves_of_gpus(cluster, tmp_path):
    """Four processes play a suite on two GPUs, two on each, with the episodes of one process."""
    ray = ["--ray", cluster[0].address, "--ray-cpus", "1", "--ray-gpus", "0.5"]
    halves, episodes = play(cluster, tmp_path / "a", *ray)
    assert halves == {"0": 2, "1": 2}
    assert episodes == play(cluster, tmp_path / "b")[1]
