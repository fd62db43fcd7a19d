"""Compare two runs: which episodes only one of them wins, and whether that can be luck.

Shows: results folders read from Python. Two runs over the same seeds are paired: an exact sign test over the episodes
that they end differently says more than two success rates do. Without folders it makes two small runs first.

    python examples/compare_runs.py results/a results/b
"""

import argparse
import math
from pathlib import Path

from arena_newton.eval.__main__ import main as evaluate
from arena_newton.eval.folders.results import load_run


def won(folder: Path) -> dict[tuple[str, str, int, int], bool]:
    """True for each episode of a run that is a success, by task, mode, group seed and repeat."""
    return {(r.task, r.mode, r.group_seed, r.repeat): r.outcome == "success" for r in load_run(folder).records}


def sign_test(a: int, b: int) -> float:
    """Probability that a fair coin splits a + b episodes at least as unevenly."""
    tail: float = sum(math.comb(a + b, k) for k in range(min(a, b) + 1)) / 2 ** (a + b)
    return min(1.0, 2.0 * tail)


def main() -> None:
    """Compare two folders."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path, help="two results folders over the same seeds")
    parser.add_argument("--out", default="compare_runs", type=Path, help="folder of the runs that it makes itself")
    parser.add_argument("--max-steps", default="400", help="step budget of those runs [ticks of 0.02 s]")
    args = parser.parse_args()
    runs = args.runs
    if not runs:
        runs = [args.out / policy for policy in ("expert", "stand")]
        for run in runs:
            flags = f"--task boxing --tracker twist2 --policy {run.name} --seeds 0 --repeats 4 --engine mujoco"
            evaluate([*flags.split(), "--max-steps", args.max_steps, "--out", str(run)])
    if len(runs) != 2:
        parser.error("name two results folders, or none")

    first, second = map(won, runs)
    shared = sorted(first.keys() & second.keys())
    only = [[key for key in shared if a[key] and not b[key]] for a, b in ((first, second), (second, first))]
    for run, outcomes, mine in zip(runs, (first, second), only, strict=True):
        print(f"{run}: {sum(outcomes[key] for key in shared)} of {len(shared)}, {len(mine)} that the other loses")
        for task, mode, seed, repeat in mine[:5]:
            print(f"    {task} {mode} seed {seed} repeat {repeat}")
    print(f"probability of such a split by luck: {sign_test(len(only[0]), len(only[1])):.3g}")


if __name__ == "__main__":
    main()
