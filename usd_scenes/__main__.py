"""`python -m arena_newton.usd_scenes {new,validate,list,preview}`.

Argparse, not tyro: `--spawn`, `--no-spawn` and neither are three cases, for which tyro would ask `--spawn True`, and it
draws its complaints as a box.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from arena_newton.cli.command_line import exit_code
from arena_newton.cli.quiet import quiet_warp


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m arena_newton.usd_scenes", description="Begin, check and look at USD scenes."
    )
    commands = parser.add_subparsers(dest="command", required=True)

    new = commands.add_parser("new", help="write the skeleton of a variant of a task's scene")
    new.set_defaults(run=_new)
    new.add_argument("task", metavar="TASK", help="the task")
    new.add_argument("file", type=Path, metavar="FILE", help="the .usda file to write, anywhere")

    validate = commands.add_parser("validate", help="name everything wrong with scene or variant files")
    validate.set_defaults(run=_validate)
    validate.add_argument("files", nargs="*", metavar="FILE", help="USD layers or task names; all scenes by default")
    validate.add_argument("--task", default=None, help="judge the files as this task's (default: from their folders)")
    validate.add_argument(
        "--spawn",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="reset an episode of each mode and name what starts inside something else (default: for files of yours)",
    )

    commands.add_parser("list", help="tasks, their scene files and variants").set_defaults(run=_list)

    preview = commands.add_parser("preview", help="render a contact sheet (world and ego camera)")
    preview.set_defaults(run=_preview)
    preview.add_argument("targets", nargs="*", metavar="TARGET", help="task names or USD layers; all tasks by default")
    preview.add_argument("--out", type=Path, default=Path("preview.png"), help="PNG to write")
    preview.add_argument("--size", type=int, default=320, help="width of one picture [px]")
    preview.add_argument("--mode", nargs="+", default=[], help="looks of test modes (default: base), or all")
    return parser


def _new(args: argparse.Namespace) -> None:
    from arena_newton.usd_scenes.skeleton import write

    print(write(args.task, args.file))


def _validate(args: argparse.Namespace) -> int:
    from arena_newton import tasks
    from arena_newton.usd_scenes.validate import differences, task_of, validate

    files = args.files or [spec.name for spec in tasks.specs() if spec.layer.is_file()]
    for spec in tasks.specs():
        if spec.name in files:
            files += sorted(str(path) for path in (spec.layer.parent / "variants").glob("*.usda"))
    wrong = 0
    for name in files:
        own_task = name if name in tasks.names() else None
        path = tasks.get(name).layer if own_task else Path(name)
        problems, notes = validate(path, args.task or own_task), []
        task = args.task or (None if problems else task_of(path))
        own = path.resolve().is_relative_to(tasks.base.SCENES.resolve())
        if not problems and task is not None:
            if not own:
                notes = [f"{path}: changed: {sentence}" for sentence in differences(path, task)]
            if args.spawn or (args.spawn is None and not own):
                quiet_warp()
                from arena_newton.usd_scenes.spawn import penetrations

                problems, known = penetrations(path, task)
                notes += [f"{problem} (in the task's own scene too)" for problem in known]
        wrong += len(problems)
        for line in (*problems, *notes):
            print(line)
        if not problems:
            print(f"{path}: ok")
    return 2 if wrong else 0


def _list(args: argparse.Namespace) -> None:
    from arena_newton import tasks

    for spec in tasks.specs():
        path = spec.layer
        variants = sorted(p.stem for p in (path.parent / "variants").glob("*.usda"))
        state = path if path.is_file() else "not built"
        print(f"{spec.name:12} {', '.join(['base', *variants]):36} {state}")


def _preview(args: argparse.Namespace) -> None:
    quiet_warp()
    from arena_newton import tasks
    from arena_newton.usd_scenes.dependencies import check_files
    from arena_newton.usd_scenes.preview import preview

    for target in args.targets:
        if target not in tasks.names():
            check_files(target)
    print(preview(args.targets or [spec.name for spec in tasks.specs()], args.out, args.size, *args.mode))


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; 0 when all is well, 2 for bad input, 130 interrupted."""
    args = _parser().parse_args(argv)
    return exit_code(lambda: args.run(args))


if __name__ == "__main__":
    sys.exit(main())
