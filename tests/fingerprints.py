"""Fingerprints of what the product computes, to show that a redesign changed no bit.

    python tests/fingerprints.py --root . --out after.txt
    python tests/fingerprints.py --root ../before --out before.txt    # another checkout, with the libraries of this one
    diff before.txt after.txt

Each line is one artefact: a name and the first 16 hexadecimal digits of a SHA-256. Journals count without times, hashes
of code and keys that only one of the two writes; tables, plans, scene files, recorded actions, clips, measures of
trackers and trained weights count whole.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

EPISODE = (
    "index task tracker policy mode rules engine group_seed repeat episode_seed object_seed max_steps outcome reason "
    "steps margin startup_fall overflow error"
).split()
"""Keys of a journal line that the machine's speed and the code's hash do not touch."""

RUNS = {
    "stand, all tasks, twist2": "--task all --policy stand --seeds 0 --repeats 3 --max-steps 90 --mode base execution",
    "stand, all tasks, sonic": "--task all --tracker sonic --policy stand --seeds 1 --repeats 2 --max-steps 60",
    "stand, released": "--task all --rules released --seeds 0 --repeats 2 --max-steps 80 --mode execution",
    "stand, semantic": "--task all --policy stand --seeds 0 --repeats 2 --max-steps 40 --mode semantic visual",
    "boxing expert, twist2": "--task boxing --policy expert --seeds 100 --repeats 5 --worlds 3",
    "boxing expert, sonic, released": "--task boxing --tracker sonic --policy expert --rules released --repeats 4",
    "vis_navi expert": "--task vis_navi --policy expert --seeds 100 --repeats 5 --worlds 3 --mode base execution",
    "warp, boxing": "--task boxing --policy expert --seeds 3 --repeats 3 --max-steps 50 --worlds 2 --engine warp",
    "warp, open_door": "--task open_door --policy stand --seeds 3 --repeats 2 --max-steps 20 --engine warp",
    "pd": "--task football double_desk --tracker pd --policy stand --seeds 0 --repeats 2 --max-steps 60",
    "fast physics": "--task football --tracker sonic --fast-physics --seeds 0 --repeats 2 --max-steps 60",
}
TRACKERS = ("twist2", "sonic")
CELLS = (
    "stand",
    "walk 0.6",
    "sit 0.42",
    "ball, walk through 0.6",
    "sill 0.07",
    "platform 0.06",
    "carry 1 kg a hand, walk 0.3",
    "chest 5 N, walk 0.35",
    "push 20 N·s, walk 0.3",
    "goal 1",
)


class Fingerprints:
    """One checkout, asked through its command line."""

    def __init__(self, root: Path, work: Path):
        self.root, self.work = root.resolve(), work
        imported = self.python("-c", "import arena_newton; print(arena_newton.__file__)").strip()
        if imported != str(self.root / "arena_newton" / "__init__.py"):
            raise SystemExit(f"--root {root}: is not a checkout, the package would be imported from {imported}")

    def call(self, module: str, *flags: str) -> str:
        """Standard output of a command of the checkout."""
        return self.python("-m", f"arena_newton.{module}", *flags)

    def python(self, *arguments: str) -> str:
        """Standard output of Python on the checkout's package; a failure ends the comparison."""
        environment = os.environ | {"PYTHONPATH": str(self.root), "COLUMNS": "150"}
        command = [sys.executable, *arguments]
        done = subprocess.run(command, cwd=self.work, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stderr[-3000:]}")
        return done.stdout

    def scenes(self) -> Iterator[tuple[str, str]]:
        """Files that the builders write."""
        inside = [] if (self.root / "scene_builders").is_dir() else ["arena_newton.usd_scenes", "build"]
        self.python("-m", *(inside or ["scene_builders"]), "--out", str(self.work / "scenes"))
        for file in sorted((self.work / "scenes").rglob("*")):
            if file.is_file():
                yield f"scene {file.relative_to(self.work / 'scenes')}", digest(file.read_bytes())

    def plans(self) -> Iterator[tuple[str, str]]:
        """Plans and rule sets as they are printed."""
        yield "list --json", digest(self.call("eval", "list", "--json", "--task", "all").encode())
        printed = self.call("__main__", "rules").splitlines()
        yield "rules", digest("\n".join(line for line in printed if "This page is generated" not in line).encode())

    def clips(self) -> Iterator[tuple[str, str]]:
        """Generated libraries, array by array."""
        from_each = ["--seconds", "8", "--seed", "3", "--mirror"]
        self.call("trackers.motions", "generate", "--out", "mix.npz", *from_each, *self.families(6))
        yield from arrays("clips", self.work / "mix.npz")

    def families(self, clips: int) -> list[str]:
        """Flags for some clips of every family that the checkout's generator knows."""
        names = self.python("-c", "from arena_newton.trackers.motions.programs import FAMILIES; print(*FAMILIES)")
        return [flag for name in names.split() for flag in ("--family", f"{name}={clips}")]

    def evaluations(self) -> Iterator[tuple[str, str]]:
        """Journals, tables and actions of `RUNS`."""
        for number, (name, flags) in enumerate(RUNS.items()):
            out = self.work / f"run{number}"
            engine = [] if "--engine" in flags else ["--engine", "mujoco"]
            self.call("eval", "run", *flags.split(), *engine, "--actions", "--out", str(out))
            lines = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
            kept = sorted(([line[key] for key in EPISODE] for line in lines), key=lambda row: row[0])
            yield f"journal, {name}", digest(json.dumps(kept).encode())
            for table in ("table.csv", "table.md"):
                text = (out / table).read_text()
                yield f"{table}, {name}", digest(re.sub(r"\nHead of the journal: .*\n", "", text).encode())
            for file in sorted((out / "actions").glob("*.npz")):
                yield from arrays(f"actions, {name}, {file.stem}", file, only=("action",))

    def trackers(self) -> Iterator[tuple[str, str]]:
        """Measures of the tracker suite."""
        for tracker in TRACKERS:
            out = self.work / f"suite_{tracker}"
            flags = ["--tracker", tracker, "--only", *CELLS, "--rollouts", "2", "--goals", "1", "--no-bench"]
            self.call("trackers.evaluate", *flags, "--suite", "full", "--engine", "mujoco", "--out", str(out))
            yield f"suite {tracker}", digest((out / "evaluation.csv").read_bytes())

    def trainings(self) -> Iterator[tuple[str, str]]:
        """Networks after two iterations of training."""
        for tracker in TRACKERS:
            log = self.work / f"train_{tracker}"
            flags = (
                "--worlds 6 --steps 6 --iterations 2 --families walk 2 squat 2 --device cpu --mirror-loss 0.1".split()
            )
            self.call("trackers.train", "--tracker", tracker, *flags, "--log-dir", str(log))
            newest = log / "model_last.pt"
            with zipfile.ZipFile(newest) as parts:
                data = sorted(name for name in parts.namelist() if "/data/" in name)
                yield f"training {tracker}", digest(b"".join(digest(parts.read(name)).encode() for name in data))


def digest(data: bytes) -> str:
    """First 16 hexadecimal digits of the SHA-256."""
    return hashlib.sha256(data).hexdigest()[:16]


def arrays(label: str, file: Path, only: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Each array of an NPZ file."""
    with zipfile.ZipFile(file) as parts:
        for name in sorted(parts.namelist()):
            stem = name.removesuffix(".npy")
            if not only or stem in only:
                yield f"{label}, {stem}", digest(parts.read(name))


def main() -> None:
    """Write the fingerprints of one checkout."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path("."), help="checkout to ask")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    parts = ("plans", "scenes", "clips", "trainings", "trackers", "evaluations")
    parser.add_argument("--only", nargs="*", choices=parts, default=parts, help="kinds of artefacts")
    options = parser.parse_args()
    out = options.out.resolve()
    with tempfile.TemporaryDirectory() as work, out.open("w", encoding="utf-8") as file:
        asked = Fingerprints(options.root, Path(work))
        for part in options.only:
            for name, value in getattr(asked, part)():
                print(f"{value}  {name}", file=file, flush=True)


if __name__ == "__main__":
    main()
