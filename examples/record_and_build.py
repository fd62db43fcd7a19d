"""Record and build: demonstrations of an expert become a dataset that LeRobot loads.

Shows: recording (state, action, head camera at 50 Hz; seeds that no evaluation has), building and verifying a LeRobot
v3.0 dataset, and what a training sees. Needs the extra [data]. The flags of each step: --help behind its command.

    python examples/record_and_build.py --task boxing --episodes 4 --out record_and_build
"""

import argparse
import sys
from pathlib import Path

from arena_newton.data.__main__ import main as data
from arena_newton.eval.__main__ import main as evaluate


def step(command: str, code: int) -> None:
    """Stop where a command failed; its own error says why."""
    if code:
        sys.exit(f"{command} ended with code {code}")


def main() -> None:
    """Record, build, verify, load."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="boxing", help="football double_desk pp_box open_door sit_sofa boxing ...")
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--size", default="224x224", help="pictures [px]")
    parser.add_argument("--max-steps", default="1000", help="ticks of 0.02 s")
    parser.add_argument("--out", default="record_and_build", type=Path)
    args = parser.parse_args()

    recordings, dataset = str(args.out / "recordings"), str(args.out / "dataset")
    flags = f"--task {args.task} --tracker twist2 --policy expert --episodes {args.episodes} --size {args.size}"
    step("eval record", evaluate(["record", *flags.split(), "--max-steps", args.max_steps, "--out", recordings]))
    step("data build", data(["build", recordings, "--out", dataset]))
    step("data verify", data(["verify", dataset, "--recordings", recordings]))

    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # takes seconds: only where it is needed

    loaded = LeRobotDataset("local/record_and_build", root=dataset)
    row = loaded[0]
    print(f"{loaded.num_episodes} episodes, {loaded.num_frames} rows at {loaded.fps} per second: {row['task']}")
    for name in sorted(key for key in row if key.startswith("observation.") or key == "action"):
        print(f"  {name}  {list(row[name].shape)}")


if __name__ == "__main__":
    main()
