"""Command line: ``python -m arena_newton.trackers.train [flags]`` and ``... export CHECKPOINT --out FILE``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from arena_newton.errors import ArenaError, InputError
from arena_newton.trackers.train.config import TrainOptions

__all__ = ["main"]

PROG = "python -m arena_newton.trackers.train"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; those of the process by default.

    Returns:
        Exit code: 0 done, 1 training failed, 2 bad input, 130 interrupted.
    """
    import tyro

    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        if arguments and arguments[0] == "export":
            from arena_newton.trackers.train.export import ExportOptions, export

            if arguments[1:] in (["-h"], ["--help"]):
                tyro.cli(ExportOptions, args=["--help"], prog=f"{PROG} export CHECKPOINT")
            if len(arguments) < 2 or arguments[1].startswith("-"):
                raise InputError(f"export: name the checkpoint: {PROG} export CHECKPOINT --out FILE.safetensors")
            out = export(Path(arguments[1]), tyro.cli(ExportOptions, args=arguments[2:], prog=f"{PROG} export"))
            print(f"wrote {out} ({out.stat().st_size / 2**20:.2f} MiB) and its card")
            return 0
        options = tyro.cli(TrainOptions, args=arguments, prog=PROG)
        from arena_newton.quiet import quiet_warp
        from arena_newton.trackers.train.session import train

        quiet_warp()
        train(options)
        return 0
    except InputError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except ArenaError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
