"""Command line: ``python -m arena_newton.trackers.train [flags]``, with subcommands ``export`` and ``curves``."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence

import tyro

from arena_newton.cli.command_line import exit_code, program
from arena_newton.errors import InputError
from arena_newton.trackers.train.train_options import CurveOptions, ExportCommand, TrainOptions, check

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

    def work() -> None:
        if arguments and arguments[0] in ("export", "curves"):
            (_export if arguments[0] == "export" else _curves)(arguments[1:])
            return
        options = tyro.cli(TrainOptions, args=arguments, prog=PROG)
        check(options)  # before the libraries are loaded
        from arena_newton.cli.quiet import quiet_warp

        with without_wandb(options.logger):
            from arena_newton.trackers.train.session import train
        quiet_warp()
        train(options)

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


def _export(arguments: Sequence[str]) -> None:
    if not arguments:
        raise InputError(f"export: name the checkpoint: {PROG} export CHECKPOINT --out FILE.safetensors")
    options = tyro.cli(ExportCommand, args=list(arguments), prog=f"{PROG} export")
    from arena_newton.trackers.train.export import export

    out = export(options.checkpoint, options)
    print(f"wrote {out} ({out.stat().st_size / 2**20:.2f} MiB) and its card")


def _curves(arguments: Sequence[str]) -> None:
    options = tyro.cli(CurveOptions, args=list(arguments), prog=f"{PROG} curves")
    if not options.runs:
        raise InputError(f"curves: name the folders of trainings: {PROG} curves RUN [RUN ...] --out FILE.png")
    from arena_newton.trackers.train.curves import draw

    print(f"wrote {draw(options.runs, options.out)}")


if __name__ == "__main__":
    sys.exit(main())
