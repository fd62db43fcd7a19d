"""Ten times `kill -9` in one run by a Ray cluster of two machines on this one; then: is it what one process writes?

    python tests/eval/ray_chaos.py results/chaos --task boxing vis_navi --seeds 0 --repeats 12

Plays the plan once without Ray and once with it, while actors and the second machine are killed at random moments, one
of three times the machine, which comes back a little later. Prints what was killed when, and compares every file.
"""

import argparse
import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

from ray_nodes import Nodes
from test_shard_merge import contents

from arena_newton.eval.shard_merge import merge

EVAL = [sys.executable, "-m", "arena_newton.eval"]


def main():
    """Run; exit code 0 where both folders are alike and every kill found something to kill."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--pause", type=float, default=20.0, help="mean time between two [s]")
    parser.add_argument("--seed", type=int, default=0)
    options, flags = parser.parse_known_args()
    options.out.mkdir(parents=True, exist_ok=True)
    plan = ["run", *flags, "--engine", "mujoco", "--out"]
    if not (options.out / "alone").exists():
        began = time.perf_counter()
        subprocess.run([*EVAL, *plan, str(options.out / "alone")], check=True, stdout=subprocess.DEVNULL)
        print(f"one process: {time.perf_counter() - began:.0f} s", flush=True)
    nodes, draw = Nodes(options.out / "ray.log"), random.Random(options.seed)
    try:
        nodes.add()
        began = time.perf_counter()
        said = open(options.out / "said.txt", "wb")
        run = subprocess.Popen(
            [*EVAL, *plan, str(options.out / "ray"), "--ray", nodes.address, "--worlds", "4"],
            env=os.environ | nodes.token,
            stdout=said,
            stderr=said,
        )
        killed = {"process": 0, "machine": 0}
        journal = options.out / "ray" / "episodes.jsonl"
        while run.poll() is None and sum(killed.values()) < options.kills:
            time.sleep(draw.expovariate(1 / options.pause) + 1.0)
            actors = nodes.actors()
            if run.poll() is not None or not actors:
                continue
            what = "machine" if nodes.others and draw.random() < 1 / 3 else "process"
            ended = journal.read_bytes().count(b"\n") if journal.exists() else 0
            if what == "machine":
                nodes.kill_machine(0)
            else:
                os.kill(draw.choice(actors), 9)
            killed[what] += 1
            print(f"{time.perf_counter() - began:5.0f} s: kill -9 of a {what}, {ended} episodes had ended", flush=True)
            if what == "machine":
                time.sleep(draw.uniform(0.0, 10.0))
                nodes.add()
        code = run.wait()
        print(f"by Ray: {time.perf_counter() - began:.0f} s, exit code {code}, killed {killed}", flush=True)
    finally:
        nodes.stop()
    found = [json.loads(line)["index"] for line in journal.read_text().splitlines()]
    print(f"{len(found)} journal lines of {len(set(found))} episodes")
    for name in ("alone", "ray"):
        merge([options.out / name], options.out / f"merged_{name}")
    one, other = (contents(options.out / f"merged_{name}") for name in ("alone", "ray"))
    different = sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))
    print(f"{len(one)} files, different: {' '.join(different) or 'none'}")
    return int(bool(different) or code != 0 or sum(killed.values()) < options.kills or len(found) != len(set(found)))


if __name__ == "__main__":
    sys.exit(main())
