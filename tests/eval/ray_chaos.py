"""Ten times `kill -9` in runs by a Ray cluster of two machines on this one; then: is it what one process writes?

    python tests/eval/ray_chaos.py results/chaos --task boxing vis_navi --seeds 0 --repeats 12

Plays the plan once without Ray, then with it as often as it takes, while actors and the second machine are killed at
random moments; the machine, one of three times, comes back. Prints what was killed when, and compares every file.
"""

import argparse
import json
import os
import random
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from made_folders import contents
from ray_nodes import Nodes

from arena_newton.eval.workers.shard_merge import merge

EVAL = [sys.executable, "-m", "arena_newton.eval"]


def main():
    """Run; exit code 0 where every run has all episodes once, and the files of one process."""
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
    merge([options.out / "alone"], options.out / "merged_alone")
    draw, killed, good = random.Random(options.seed), Counter(), True
    while sum(killed.values()) < options.kills:
        number = len(list(options.out.glob("ray_*")))
        good &= one_run(options, plan, options.out / f"ray_{number}", draw, killed)
    print(f"killed: {dict(killed)}; {'all alike' if good else 'NOT ALIKE'}")
    return int(not good)


def one_run(options, plan, folder, draw, killed):
    """One run in which actors and a machine are killed; whether it is what one process writes."""
    nodes, journal = Nodes(options.out / "ray.log"), folder / "episodes.jsonl"

    def ended():
        return journal.read_bytes().count(b"\n") if journal.exists() else 0

    began = time.perf_counter()
    try:
        nodes.add()
        said = open(options.out / f"{folder.name}.txt", "wb")
        command = [*EVAL, *plan, str(folder), "--ray", nodes.address, "--worlds", "4"]
        run = subprocess.Popen(command, env=os.environ | nodes.token, stdout=said, stderr=said)
        while run.poll() is None and ended() == 0:
            time.sleep(0.5)
        while run.poll() is None and sum(killed.values()) < options.kills:
            time.sleep(draw.expovariate(1 / options.pause) + 1.0)
            actors, what = nodes.actors(), "machine" if draw.random() < 1 / 3 else "actor"
            if run.poll() is not None or not actors:
                continue
            lines = ended()
            if what == "machine":
                nodes.kill_machine(0)
                nodes.add()
            else:
                os.kill(draw.choice(actors), 9)
            killed[what] += 1
            print(f"{folder.name}, {time.perf_counter() - began:3.0f} s: kill -9 of {what}, {lines} ended", flush=True)
        code = run.wait()
    finally:
        nodes.stop()
    found = [json.loads(line)["index"] for line in journal.read_text().splitlines()]
    merge([folder], options.out / f"merged_{folder.name}")
    one, other = contents(options.out / "merged_alone"), contents(options.out / f"merged_{folder.name}")
    different = sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))
    lines = f"{len(found)} journal lines of {len(set(found))} episodes, {len(one)} files, different:"
    print(
        f"{folder.name}, {time.perf_counter() - began:.0f} s, exit code {code}: {lines} {different or 'none'}",
        flush=True,
    )
    return code == 0 and not different and len(found) == len(set(found))


if __name__ == "__main__":
    sys.exit(main())
