"""Command line: ``python -m scene_builders [NAME ...]`` writes textures, robot, one scene per task, and the lab."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated

import tyro

from arena_newton import tasks
from arena_newton.cli.command_line import exit_code
from arena_newton.cli.flags import parse_flags
from arena_newton.errors import InputError
from arena_newton.tasks.base import SCENES

__all__ = ["LayerOptions", "build_all", "main", "parts"]

PROG = "python -m scene_builders"


@dataclass(frozen=True)
class LayerOptions:
    """Write the layers of `usd_scenes` from their builders."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Parts to write: `textures`, `patterns`, `g1`, `lab` or a task; all by default."""
    out: Path = SCENES
    """Folder to write into."""


def parts() -> tuple[str, ...]:
    """Parts that can be built, in order; without tasks that bring their own layer."""
    return ("textures", "patterns", "g1", *tasks.OWN, "lab")


def build_all(folder: Path = SCENES, names: Sequence[str] = ()) -> list[Path]:
    """Write the named parts (all by default) under `folder` and return their folders.

    Layers refer to each other by relative paths, so a build elsewhere must hold the robot and the textures too.

    Raises:
        InputError: A name is not a part.
    """
    for name in names:
        if name not in parts():
            raise InputError(f"unknown part {name!r}; parts are {', '.join(parts())}")
    written = []
    for name in names or parts():
        target = folder / name
        target.mkdir(parents=True, exist_ok=True)
        import_module(f"scene_builders.{name}").build(target)
        written.append(target)
    return written


def main(argv: Sequence[str] | None = None) -> int:
    """Write and print the paths; 0 when all is written, 2 for an unknown part or a folder that cannot be written."""

    def work() -> int:
        options = parse_flags(LayerOptions, list(sys.argv[1:] if argv is None else argv), PROG)
        try:
            print(*build_all(options.out, options.names), sep="\n")
        except OSError as error:
            raise InputError(f"--out {options.out}: cannot be written ({error.strerror})") from error
        return 0

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
