"""`python -m arena_newton.eval audit`: how far results folders can be believed."""

from __future__ import annotations

import math
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.eval.audit.folder_audit import Audit
    from arena_newton.eval.play.factories import Factories

__all__ = ["AuditOptions", "run"]


@dataclass(frozen=True)
class AuditOptions:
    """Check results folders: lines, links, actions, tables; episodes played again, their policy asked again.

    Four levels: self-reported (something contradicts), consistent, replayed, re-run (docs/howto/evaluate/auditing.md).
    Nothing in the folders is written. Exit code 1 where something contradicts, a line for each contradiction.
    """

    head: str | None = None
    """Head that was published with the numbers: the journal of the folder, or those of all folders, must have it."""
    replay: int = 0
    """Play so many episodes again, drawn over all runs together, on engine mujoco, from their actions alone: they must
    end as recorded, to the bit."""
    draw: int | None = None
    """Number of your own by which, with the head, they are drawn; without one a random one, which is printed."""
    all: bool = False
    """Play all episodes again."""
    policy: str | None = None
    """Policy to ask again at the queries of the episodes that are played again, as --policy of run takes it."""
    tolerance: float = 0.0
    """Largest difference of an action that is still the policy's: 0 compares bits; 1e-4 fits a network that answered on
    another processor."""
    tick_tolerance: float = 0.005
    """Largest distance of a body after a tick [m], where a run of engine warp kept its states (--record)
    and each tick is checked on engine mujoco; over a second differences may add up to four times as much."""
    velocity_tolerance: float = 1.0
    """Largest difference of a velocity then [m/s, rad/s]."""
    fresh: int = 0
    """Play so many new episodes of --policy for each task, tracker and mode, on a group seed drawn by --draw; an exact
    test compares their rate with the claimed one."""
    out: str | None = None
    """Folder for audit.json and audit.md; without it they are printed alone."""


def run(folders: Sequence[Path], options: AuditOptions, factories: Factories | None = None) -> int:
    """Audit, print, and write the pages.

    Returns:
        0: nothing contradicts. 1: something does.

    Raises:
        InputError: A folder holds no run, or cannot be read as one.
    """
    from arena_newton.eval.audit.draws import drawn
    from arena_newton.eval.audit.folder_audit import (
        audited,
        facts_of,
        print_findings,
        runs_in,
        sureness,
        write_pages,
    )
    from arena_newton.files.text import counted

    named = [inside for folder in folders for inside in runs_in(folder)]
    if options.replay < 0:
        raise InputError(f"--replay {options.replay}: expected a number of episodes")
    if options.fresh < 0:
        raise InputError(f"--fresh {options.fresh}: expected a number of episodes")
    for name in ("tolerance", "tick_tolerance", "velocity_tolerance"):
        if not 0 <= (value := getattr(options, name)) < math.inf:  # nothing contradicts a tolerance that is no number
            raise InputError(f"--{name.replace('_', '-')} {value:g}: expected a finite number of at least 0")
    if options.policy is not None and not (options.replay or options.all or options.fresh):
        raise InputError("--policy: asks at the queries of --replay or --all, or plays --fresh episodes; add one")
    if options.policy is None and (options.fresh or options.tolerance):
        raise InputError("--fresh and --tolerance: are of a --policy; name it")
    if options.replay and options.all:
        raise InputError("--replay and --all: both say which episodes are played again; drop one")
    if options.draw is not None and not (options.replay or options.fresh):
        raise InputError("--draw: draws the episodes of --replay or --fresh; add one of them")
    draw = secrets.randbelow(1 << 31) if options.draw is None else options.draw
    if options.draw is None and (options.replay or options.fresh):
        print(f"--draw {draw}: drawn at random, for the owner of the results cannot know it", flush=True)

    def said(some: Sequence[Audit]) -> str:
        return ", ".join(f"{name} {value}" for name, value in facts_of(some))

    audits = [audited(folder) for folder in named]
    if options.head not in (None, head := dict(facts_of(audits))["head"]):
        where = " ".join(map(str, folders))
        audits[0].faults.append(f"{where}: head is {head}, published was {options.head}")
    chosen = drawn(audits, None if options.all else options.replay, draw)
    for folder, one, records in zip(named, audits, chosen, strict=True):
        if options.replay or options.all:
            from arena_newton.eval.audit.action_replay import replay

            names = ("policy", "tolerance", "tick_tolerance", "velocity_tolerance")
            asked = {name: getattr(options, name) for name in names}
            one.draw = None if options.all else draw
            replay(one, records, factories, **asked)
        if options.fresh and options.policy is not None:
            from arena_newton.eval.audit.fresh_episodes import play_fresh

            play_fresh(one, options.policy, options.fresh, draw, factories)
        print(f"{folder}: {said([one])}")
        print_findings(one.faults, one.notes)
    if len(audits) > 1:
        print(f"{counted(len(audits), 'run')}: {said(audits)}")
    print_findings([], sureness(audits))
    if options.out is not None:
        out = Path(options.out).expanduser()
        write_pages(audits, out)
        print(f"audit: {out / 'audit.md'}")
    return int(any(one.faults for one in audits))
