"""A trained policy by a real Ray: its checkpoint is loaded in the processes, its episodes are those of one process."""

import subprocess
import sys

import pytest
from made_folders import configuration, contents

from arena_newton.eval.suites.suite_records import read_suite
from arena_newton.eval.workers.shard_merge import merge
from benchmarks.policy_bench import random_checkpoint

pytest.importorskip("ray", reason="needs the extra [ray]")

SUITE = """
[defaults]
seeds = 0
repeats = 3
worlds = 2
max_steps = 45
engine = "mujoco"
actions = true
[matrix]
tasks = ["boxing", "vis_navi"]
[[policies]]
name = "act"
spec = "lerobot:checkpoint"
replan = 4
"""


@pytest.mark.slow
def test_the_same_bytes_of_a_checkpoint(tmp_path):
    """A small ACT of random weights: journals, reports and actions of a suite with --ray are those without."""
    random_checkpoint(tmp_path / "checkpoint", "small")
    (tmp_path / "suite.toml").write_text(SUITE)
    for out, flags in (("alone", []), ("ray", ["--ray", "--ray-cpus", "1", "--ray-actors", "1"])):
        command = [sys.executable, "-m", "arena_newton.eval", "matrix", "suite.toml", "--out", out, *flags]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=500)
        assert done.returncode == 0, done.stdout + done.stderr
        for cell in read_suite(tmp_path / out).cells:
            assert cell.status == "done"
            merge([tmp_path / out / cell.folder], tmp_path / f"{out}_merged" / cell.folder)
    for cell in read_suite(tmp_path / "ray").cells:
        alone, ray = tmp_path / "alone_merged" / cell.folder, tmp_path / "ray_merged" / cell.folder
        assert configuration(ray) == configuration(alone)
        files = contents(alone)
        assert contents(ray) == files and sum(name.startswith("actions/") for name in files) == 3
