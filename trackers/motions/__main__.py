"""`python -m arena_newton.trackers.motions {convert,inspect,render,generate}`.

Argparse, not tyro: files and `--out` are required, and only argparse says in one line which of them is missing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from arena_newton.cli.command_line import exit_code, program
from arena_newton.cli.quiet import quiet_warp
from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.trackers.motions.formats import ReadOptions
    from arena_newton.trackers.motions.library import MotionLibrary

__all__ = ["main"]

PROG = program("trackers motions", "arena_newton.trackers.motions")
ROWS = 40
"""Clips that `inspect` lists unless asked for all."""


class _Parser(argparse.ArgumentParser):
    """Complains in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog=PROG, description="Motion clips and libraries of them.")
    commands = parser.add_subparsers(dest="command", required=True)

    reading = _Parser(add_help=False)
    reading.add_argument("files", nargs="+", type=Path, metavar="FILE", help="clips or libraries: .pkl, .csv, .npz")
    reading.add_argument("--fps", type=float, default=None, help="frame rate of .csv tables (default: 30)")
    reading.add_argument(
        "--quat-order",
        choices=("auto", "wxyz", "xyzw"),
        default="auto",
        help="order of quaternions in .csv tables (default: the one in which the robot is upright)",
    )
    reading.add_argument(
        "--joint-order",
        choices=("auto", "isaac", "mujoco"),
        default="auto",
        help="order of joints in BeyondMimic's .npz (default: the one that gives its body positions)",
    )
    reading.add_argument("--no-trim", action="store_true", help="keep motion capture jumps at the start")

    convert = commands.add_parser("convert", parents=[reading], help="read files of any known format into one library")
    convert.add_argument("--out", type=Path, required=True, help="library to write, .npz")
    convert.add_argument("--licence", default=None, help="licence of the clips, as MIT (libraries keep theirs)")
    convert.add_argument("--source", default=None, help="where the clips are from, as a link (libraries keep theirs)")
    convert.add_argument("--family", default="clips", help="kind of motion of the clips (libraries keep theirs)")
    convert.add_argument("--ground", action="store_true", help="shift each clip so that its soles are on the floor")
    convert.add_argument("--mirror", action="store_true", help="add every clip with left and right exchanged")

    measured = "print speed, heights, limits, jumps, slip per clip"
    inspect = commands.add_parser("inspect", parents=[reading], help=measured)
    inspect.add_argument("--all", action="store_true", help=f"list every clip, not the first {ROWS}")
    inspect.add_argument("--json", action="store_true", help="print the numbers as JSON")

    render = commands.add_parser("render", parents=[reading], help="write a film strip (.png) or a video (.mp4)")
    render.add_argument("--out", type=Path, default=Path("film.png"), help="picture or video to write")
    render.add_argument(
        "--clip", action="append", default=None, metavar="CLIP", help="name or number; repeat for more (default: 0)"
    )
    render.add_argument("--pictures", type=int, default=10, help="pictures per strip")
    render.add_argument("--width", type=int, default=180, help="width of a picture [px]")
    render.add_argument("--start", type=float, default=0.0, help="time of the first picture [s]")
    render.add_argument(
        "--end", type=float, default=None, help="time of the last picture [s] (default: the clip's end)"
    )

    generate = commands.add_parser("generate", help="make a library of random motions")
    generate.add_argument("--out", type=Path, required=True, help="library to write, .npz")
    generate.add_argument(
        "--family",
        action="append",
        default=None,
        metavar="NAME=CLIPS",
        help="number of clips of a kind of motion; repeat for more (default: all kinds, as trackers are trained on)",
    )
    generate.add_argument("--seconds", type=float, default=12.0, help="length of a clip [s]")
    generate.add_argument("--seed", type=int, default=0, help="seed of the random numbers")
    generate.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N")
    generate.add_argument("--mirror", action="store_true", help="add every clip with left and right exchanged")
    return parser


def _options(args: argparse.Namespace) -> ReadOptions:
    from arena_newton.trackers.motions.formats import ReadOptions

    return ReadOptions(args.fps, args.quat_order, args.joint_order, not args.no_trim)


def _write(library: MotionLibrary, out: Path) -> None:
    library.save(out)
    size = out.stat().st_size / 2**20
    print(f"{out}: {library.clips} clips, {library.seconds.sum():.1f} s, {size:.1f} MiB")


def _check_out(out: Path, *suffixes: str) -> None:
    if out.suffix.lower() not in suffixes:
        raise InputError(f"--out {out}: expected a name that ends in {' or '.join(suffixes)}")


def _convert(args: argparse.Namespace) -> None:
    from arena_newton.trackers.motions.formats import read_library
    from arena_newton.trackers.motions.library import UNKNOWN, MotionLibrary

    _check_out(args.out, ".npz")
    given = {"family": args.family, "licence": args.licence or UNKNOWN, "source": args.source or UNKNOWN}
    library, reports = read_library(args.files, _options(args), **given)
    for report in reports:
        print(report.line())
    if any(report.kind != "motion library" for report in reports) and not (args.licence and args.source):
        raise InputError("convert: a library keeps where its clips are from; state --licence and --source")
    if args.ground:
        from arena_newton.trackers.motions.measure import grounded

        library, shift = grounded(library)
        print(f"ground: clips shifted by {100 * shift.min():+.1f} to {100 * shift.max():+.1f} cm")
    if args.mirror:
        library = MotionLibrary.concatenate([library, library.mirrored()])
    _write(library, args.out)


def _inspect(args: argparse.Namespace) -> None:
    from arena_newton.trackers.motions import measure
    from arena_newton.trackers.motions.formats import read_library

    library, reports = read_library(args.files, _options(args))
    measures = measure.measure_clips(library)
    if args.json:
        import json

        print(json.dumps(measure.measures_summary(measures), indent=2, allow_nan=False))
        return
    for report in reports:
        if report.trimmed or report.notes:
            print(report.line())
    print(measure.measures_table(measures, None if args.all else ROWS))


def _render(args: argparse.Namespace) -> None:
    from arena_newton.trackers.motions import film
    from arena_newton.trackers.motions.formats import read_library

    _check_out(args.out, ".png", ".mp4")
    library, _ = read_library(args.files, _options(args))
    every = range(library.clips) if args.clip is None and len(args.files) == library.clips else None
    clips = list(every) if every is not None else [library.clip_index(name) for name in args.clip or ["0"]]
    span = {"width": args.width, "start": args.start, "end": args.end}
    if args.out.suffix.lower() == ".mp4":
        print(film.movie(library, clips, args.out, **span))
    else:
        print(film.film(library, clips, args.out, pictures=args.pictures, **span))


def _generate(args: argparse.Namespace) -> None:
    from arena_newton.physics.engines import resolve_engine
    from arena_newton.trackers.motions import programs
    from arena_newton.trackers.motions.library import MotionLibrary

    _check_out(args.out, ".npz")
    families = dict(programs.FAMILIES) if args.family is None else dict(map(_family, args.family))
    unknown = [name for name in families if name not in programs.FAMILIES]
    if unknown:
        raise InputError(f"--family {unknown[0]}: unknown, choose from {', '.join(programs.FAMILIES)}")
    if not 1.0 <= args.seconds <= 3600.0:
        raise InputError(f"--seconds {args.seconds:g}: expected 1 to 3600")
    if not 0 <= args.seed < 2**63:
        raise InputError(f"--seed {args.seed}: expected a number of at least 0")
    if args.device != "cpu":
        resolve_engine("warp", args.device)
    made = programs.random_clips(families, seconds=args.seconds, seed=args.seed, device=args.device)
    source = f"arena_newton.trackers.motions generate --seconds {args.seconds:g} --seed {args.seed}"
    library = MotionLibrary.from_random(made, source=source)
    if args.mirror:
        library = MotionLibrary.concatenate([library, library.mirrored()])
    _write(library, args.out)


def _family(text: str) -> tuple[str, int]:
    name, _, count = text.partition("=")
    if not name or not count.isdecimal() or int(count) < 1:
        raise InputError(f"--family {text}: expected a kind of motion and a number of clips, as walk=100")
    return name, int(count)


_COMMANDS = {"convert": _convert, "inspect": _inspect, "render": _render, "generate": _generate}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0 done, 2 bad input, 130 interrupted."""

    def work() -> None:
        args = _parser().parse_args(argv)
        if args.command in ("render", "generate"):
            quiet_warp()
        _COMMANDS[args.command](args)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
