"""Tracker suite, which measures reference following: `python -m arena_newton.trackers.evaluate --help`.

One suite of references for any number of trackers, every rollout of a tracker in one batch of worlds; tables to
Markdown, JSON and CSV. Figures that have a bar are printed with their verdict.

The command line is argparse's: `--checkpoint` and `--label` belong to the `--tracker` before them, and tyro does not
keep the order of flags.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from arena_newton.cli.command_line import exit_code, program
from arena_newton.cli.flags import check_number
from arena_newton.cli.quiet import quiet_warp
from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.trackers.base import Tracker
    from arena_newton.trackers.evaluation.suite import Cell

__all__ = ["Entry", "main"]

PROG = program("trackers evaluate", "arena_newton.trackers.evaluate")
ROLLOUTS = {"full": 64, "quick": 8, "push": 16}
"""Rollouts per cell, unless --rollouts says otherwise."""
BOUNDS = {"rollouts": (1, 4096), "goals": (0, 4096), "threads": (1, 1024), "seed": (0, math.inf)}
"""Flag → least and largest number: all rollouts of a cell are worlds of one batch."""


@dataclass
class Entry:
    """A tracker on the command line: its name, checkpoint and label."""

    name: str
    checkpoint: str | None = None
    given_label: str | None = None

    @property
    def label(self) -> str:
        """Name in tables."""
        if self.given_label:
            return self.given_label
        return self.name if self.checkpoint is None else f"{self.name} {Path(self.checkpoint.split(',')[0]).stem}"

    @property
    def official(self) -> bool:
        """True if the weights are not ours, which are safetensors."""
        return self.checkpoint is not None and not self.checkpoint.endswith(".safetensors")

    def make(self) -> Tracker:
        """A new tracker, not bound yet."""
        from arena_newton.trackers.base import get, names, register

        module, _, factory = self.name.partition(":")
        if factory and module not in names():
            try:
                register(self.name, getattr(importlib.import_module(module), factory))
            except (ImportError, AttributeError) as error:
                raise InputError(f"--tracker {self.name}: {error}") from None
        return get(self.name, self.checkpoint)


class _AddTracker(argparse.Action):
    def __call__(self, _: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        namespace.trackers = [*(namespace.trackers or []), Entry(values)]


class _OfLastTracker(argparse.Action):
    def __call__(self, _: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        if not namespace.trackers:
            raise InputError(f"{option} {values}: name its --tracker first")
        setattr(namespace.trackers[-1], "checkpoint" if option == "--checkpoint" else "given_label", values)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog=PROG, description="Measure trackers on one suite of references.")
    add = parser.add_argument
    name = "tracker or tracker:argument, or module:factory of one that is not known; repeat to compare several"
    add("--tracker", dest="trackers", action=_AddTracker, metavar="NAME", help=name)
    add("--checkpoint", action=_OfLastTracker, metavar="PATH", help="weights of the --tracker before it")
    add("--label", action=_OfLastTracker, metavar="TEXT", help="what tables call the --tracker before it")
    add(
        "--suite",
        choices=tuple(ROLLOUTS),
        default="full",
        help="full: every cell; quick: a few; push: blows on a tour of 60 s",
    )
    add("--only", nargs="+", default=[], metavar="CELL", help="only cells or groups whose names contain one of these")
    add("--clips", nargs="+", default=[], type=Path, metavar="FILE", help="motion clips or libraries to add")
    add("--rollouts", type=int, default=None, metavar="N", help="rollouts per cell (64 full, 8 quick, 16 push)")
    add("--goals", type=int, default=None, metavar="N", help="goals in closed loop (20 full, 4 quick)")
    add("--seed", type=int, default=0, help="seed of goals and start perturbations")
    add("--engine", choices=("auto", "mujoco", "warp"), default="auto", help="physics engine")
    add("--device", default=None, help="cpu, cuda or cuda:N")
    add("--threads", type=int, default=None, metavar="N", help="CPU threads of engine mujoco")
    add("--fast-physics", action="store_true", help="each tracker's fast physics rate")
    add("--film", action="store_true", help="write film strips: a walk, a kick, a squat and a sit; blows")
    add("--no-bench", dest="bench", action="store_false", help="leave out the inference times")
    add("--list", dest="show", action="store_true", help="print the cells and stop")
    add("--out", type=Path, default=None, metavar="DIR", help="write evaluation.{md,json,csv,png} and films here")
    return parser


def _cells(args: argparse.Namespace) -> list[Cell]:
    from arena_newton.trackers.evaluation.cells import goals, suite
    from arena_newton.trackers.evaluation.suite import clip_cells

    cells = [cell for cell in suite(args.suite) if cell.goal is None or args.goals is None]
    if args.goals is not None:
        cells += goals(args.goals, args.seed)
    elif args.seed:
        count = sum(cell.goal is not None for cell in cells)
        cells = [cell for cell in cells if cell.goal is None] + goals(count, args.seed)
    cells += clip_cells(args.clips)
    if args.only:
        kept = {word: [c for c in cells if word in c.name or word == c.group] for word in args.only}
        for word, matches in kept.items():
            if not matches:
                raise InputError(f"--only {word}: no cell or group matches (see --list)")
        cells = [c for c in cells if any(c in matches for matches in kept.values())]
    return cells


def _check(args: argparse.Namespace) -> int:
    for name, bounds in BOUNDS.items():
        if (value := getattr(args, name)) is not None:
            check_number(f"--{name}", value, *bounds)
    if args.film and args.out is None:
        raise InputError("--film: name a folder with --out")
    return args.rollouts or ROLLOUTS[args.suite]


def _evaluate(args: argparse.Namespace) -> int:
    rollouts = _check(args)
    if args.show:
        for cell in _cells(args):
            print(f"{cell.group:14} {cell.name:36} {cell.seconds:5.1f} s")
        return 0
    if not args.trackers:
        raise InputError("name at least one --tracker")
    labels = [entry.label for entry in args.trackers]
    if len(set(labels)) < len(labels):
        raise InputError(f"two trackers are called {max(labels, key=labels.count)!r}: give each a --label")
    for entry in args.trackers:
        entry.make()  # refuses unfit files before anything is built

    from arena_newton.physics.engines import resolve_engine
    from arena_newton.trackers.evaluation import chart, push_suite, tracker_report
    from arena_newton.trackers.evaluation.figures import Result
    from arena_newton.trackers.evaluation.inference_times import inference
    from arena_newton.trackers.evaluation.parts import play_parts
    from arena_newton.trackers.evaluation.suite_rollout import make_plan, play
    from arena_newton.trackers.evaluation.tracker_film import film

    resolve_engine(args.engine, args.device)
    if args.out is not None:
        try:
            args.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {args.out}: cannot be created ({error.strerror})") from None
    played = make_plan(_cells(args), rollouts, args.seed)
    options = {"engine": args.engine, "device": args.device, "fast_physics": args.fast_physics, "threads": args.threads}
    results = []
    for entry in args.trackers:
        print(f"{entry.label}: {len(played.cells)} cells, {len(played.cell)} rollouts", file=sys.stderr, flush=True)
        tracker = entry.make()
        if args.suite == "push":
            outcome = play_parts(entry.make, entry.label, played, args.out, **options)
            push_suite.add_blow_measures(outcome, played)
        else:
            outcome = play(tracker, played, **options)
        times = inference(entry.make) if args.bench else {}
        facts = tracker.describe() | {"drive": tracker.drive.name}
        result = Result(entry.label, tracker.name, entry.official, facts, played, outcome, inference=times)
        results.append(result)
        print(f"{entry.label}: {outcome.rollout_s:.1f} s", file=sys.stderr, flush=True)
    resolved = {
        "suite": args.suite,
        "rollouts": rollouts,
        "seed": args.seed,
        "engine": results[0].outcome.engine,
        "device": results[0].outcome.device,
        "fast physics": args.fast_physics,
        "only": " ".join(args.only),
        "clips": " ".join(path.name for path in args.clips),
    }
    print(tracker_report.figure_table(results))
    if args.out is not None:
        for path in tracker_report.write(results, resolved, args.out):
            print(path, file=sys.stderr)
        picture = args.out / "evaluation.png"
        print(f"{picture}: {chart.missing()}" if chart.missing() else chart.chart(results, picture), file=sys.stderr)
        if args.film:
            for entry in args.trackers:
                for path in film(
                    entry.make(), entry.label, args.out, blows=args.suite == "push", seed=args.seed, **options
                ):
                    print(path, file=sys.stderr)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 done, 2 bad input, 130 interrupted."""

    def work() -> int:
        args = _parser().parse_args(argv)
        quiet_warp()
        return _evaluate(args)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
