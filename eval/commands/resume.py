"""`python -m arena_newton.eval resume`: a run goes on in its folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError
from arena_newton.eval.commands.run import run as evaluate
from arena_newton.eval.plan.options import RunOptions

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["defaults", "run"]

PROGRAM = "process:"
"""Beginning of a policy that is a program."""


def defaults(folders: Sequence[Path]) -> RunOptions:
    """Flags with which the run was begun, but for a program of `--policy process:`, which no folder starts by itself.

    Raises:
        InputError: The folder is none of a run, or damaged.
    """
    from arena_newton.eval.folders.run_folder import stored_options

    stored = stored_options(folders[0])
    return dataclasses.replace(stored, policy=PROGRAM) if stored.policy.startswith(PROGRAM) else stored


def run(folders: Sequence[Path], options: RunOptions, factories: Factories | None = None) -> int:
    """Play what is left.

    Raises:
        InputError: A flag is not that of the run.
    """
    (folder,), stored = folders, defaults(folders)
    if options.policy == PROGRAM:
        raise InputError(f"resume {folder}: a program played it, which a folder does not start; name it by --policy")
    if stored.until_width is not None and options.max != stored.max:
        raise InputError(f"--max was {stored.max}, now {options.max}: it was fixed before the first episode")
    if options.out != str(folder):
        raise InputError(f"resume {folder}: continues in that folder; drop --out {options.out}")
    return evaluate(options, factories)
