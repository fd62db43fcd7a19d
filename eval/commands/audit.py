"""`python -m arena_newton.eval audit`: how far results folders can be believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.eval.play.run import Factories

__all__ = ["AuditOptions", "run"]


@dataclass(frozen=True)
class AuditOptions:
    """Check results folders: lines against themselves, plan, rules and hashes; links; actions; tables rebuilt.

    Four levels: self-reported (something contradicts), consistent, replayed, re-run (docs/auditing.md). Nothing in the
    folders is written. Exit code 1 where something contradicts, a line for each contradiction.
    """

    head: str | None = None
    """Head that was published with the numbers of the one folder; the journal must have it."""
    replay: int = 0
    """Play so many episodes again on engine mujoco, from their actions alone: they must end as recorded, to the bit."""
    draw: int = 0
    """Number of your own by which, with the head, they are drawn."""
    all: bool = False
    """Play all episodes again."""
    out: str | None = None
    """Folder for audit.json and audit.md; without it they are printed alone."""


def run(folders: Sequence[Path], options: AuditOptions, factories: Factories | None = None) -> int:
    """Audit, print, and write the pages.

    Returns:
        0: nothing contradicts. 1: something does.

    Raises:
        InputError: A folder holds no run, or cannot be read as one.
    """
    from arena_newton.eval.audit.folder_audit import audited, runs_in, write_pages
    from arena_newton.eval.records.chain import joint_head
    from arena_newton.files.text import counted

    named = [inside for folder in folders for inside in runs_in(folder)]
    if options.replay < 0:
        raise InputError(f"--replay {options.replay}: expected a number of episodes")
    if options.head is not None and len(named) > 1:
        raise InputError("--head: is of one folder")
    audits = []
    for folder in named:
        one = audited(folder, options.head)
        if options.replay or options.all:
            from arena_newton.eval.audit.action_replay import drawn, replay

            replay(one, drawn(one, None if options.all else options.replay, options.draw), factories)
        audits.append(one)
        print(f"{folder}: {', '.join(f'{name} {value}' for name, value in one.facts())}")
        for fault in one.faults:
            print(f"  contradiction: {fault}")
        for note in one.notes:
            print(f"  {note}")
    joint = joint_head([one.results.get("head") for one in audits])
    if len(audits) > 1 and joint is not None:
        print(f"Head of {counted(len(audits), 'journal')}: {joint}.")
    if options.out is not None:
        out = Path(options.out).expanduser()
        write_pages(audits, out)
        print(f"audit: {out / 'audit.md'}")
    return int(any(one.faults for one in audits))
