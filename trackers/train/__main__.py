"""Command line: ``python -m arena_newton.trackers.train [flags]``, with subcommands ``export`` and ``curves``."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from arena_newton.cli.command_line import INTERRUPTED, exit_code, program
from arena_newton.cli.command_table import HELP
from arena_newton.cli.flags import folders_named, parse_flags
from arena_newton.trackers.train.train_options import CurveOptions, ExportOptions, TrainOptions, check

__all__ = ["main"]

PROG = program("trackers train", "arena_newton.trackers.train")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; those of the process by default.

    Returns:
        Exit code: 0 done, 1 training failed, 2 bad input, 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)

    def work() -> int:
        if arguments and arguments[0] in ("export", "curves"):
            (_export if arguments[0] == "export" else _curves)(arguments[1:])
            return 0
        options = parse_flags(TrainOptions, arguments, PROG)
        check(options)  # before the libraries are loaded
        from arena_newton.cli.quiet import quiet_warp

        with without_wandb(options.logger):
            from arena_newton.trackers.train.session import train
        quiet_warp()
        return INTERRUPTED if train(options).interrupted else 0

    return exit_code(work)


@contextlib.contextmanager
def without_wandb(logger: str) -> Iterator[None]:
    """Import rsl_rl without the package wandb, an eighth of the imports, unless it is the logger or there already."""
    hidden = logger != "wandb" and "wandb" not in sys.modules
    if hidden:
        sys.modules["wandb"] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        if hidden:
            del sys.modules["wandb"]


def _export(arguments: list[str]) -> None:
    files, options = _named(
        ExportOptions, arguments, "export", "the checkpoint", "CHECKPOINT --out FILE.safetensors", 1
    )
    from arena_newton.trackers.train.export import export

    out = export(files[0], options)
    print(f"wrote {out} ({out.stat().st_size / 2**20:.2f} MiB) and its card")


def _curves(arguments: list[str]) -> None:
    shown = "RUN [RUN ...] --out FILE.png"
    runs, options = _named(CurveOptions, arguments, "curves", "folders of trainings", shown)
    from arena_newton.trackers.train.curves import draw

    print(f"wrote {draw(runs, options.out)}")


def _named[T](
    kind: type[T], arguments: list[str], command: str, noun: str, shown: str, most: int | None = None
) -> tuple[list[Path], T]:
    """Files that a subcommand is given, and its flags."""
    if any(argument in HELP for argument in arguments):
        parse_flags(kind, ["--help"], f"{PROG} {command} {shown}")
    files = folders_named(arguments, command, PROG, noun=noun, shown=shown, most=most)
    return files, parse_flags(kind, arguments, f"{PROG} {command}")


if __name__ == "__main__":
    sys.exit(main())
