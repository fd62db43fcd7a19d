"""Certification by several processes, which play into the folder that the page is made from.

Each plays one check of one task, through one tracker where the check measures trackers apart. The worker pool
cannot play them: it deals episodes of one run, and a check plays runs of many kinds and compares them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import BinaryIO

from arena_newton.cli.flags import shell_command, words
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks.agreement import BATCHED_TASKS
from arena_newton.files.own_processes import environment, how_it_ended, start_module
from arena_newton.physics.devices import resolve_engine
from arena_newton.tasks import get

__all__ = ["Piece", "command_line", "flags", "play_ahead"]


@dataclasses.dataclass(frozen=True)
class Piece:
    """Part that one process plays."""

    checks: tuple[str, ...]
    tasks: tuple[str, ...]
    trackers: tuple[str, ...]
    cores: bool = True
    """True if it keeps to cores of its own."""

    def __str__(self) -> str:
        """Names of checks, tasks and trackers."""
        return " ".join((*self.checks, *self.tasks, *self.trackers))


FIRST = "solvable"
"""The check whose evaluations others compare with: it is played before them."""
COMPARING = (
    FIRST,
    "journal",
    "tracker-inputs",
    "frozen-legs",
    "gliding-base",
    "semantic",
    "engines",
    "official",
    "swap",
)
"""It, and the checks that compare with its evaluations."""
BY_NAME = "engines"
"""The check that without CUDA is skipped unless it is named: a process that plays it for others would name it."""
BY_FIRST = ("visual", "execution", "dynamics", "modes", "visible", "policy-inputs", "rules")
"""Checks that play through the first tracker alone."""
BY_ALL = ("official", "swap")
"""Checks whose measurements of a task are not apart by tracker."""
ONE_PLAN = ("shards", "ray")
"""Checks that play the same plan of all tasks, by processes of their own."""
LONGEST = ("shards", "ray", "failures", "swap")
"""Checks that take longest: they are begun before others, so that none is left when the others have ended."""
WHOLE = ("physics", "camera")
"""Checks that are not divided: of some tasks they measure more than of the others."""
OF_FIRST_TASKS = {"batches": BATCHED_TASKS, "recording": 1, "policy-inputs": 1, "tracker-inputs": 1}
"""Checks that under --quick play the first tasks alone, and how many of them."""
PLAYS_NOTHING = ("statistics",)
"""Checks that are left to the end."""
POLL = 0.1
"""Processes are looked at so often [s]."""


def play_ahead(
    options: CertifyOptions, tasks: Sequence[str], checks: Sequence[str], say: Callable[[str], None]
) -> None:
    """Play what the checks need, `options.jobs` processes at a time, each on cores of its own.

    What a process could not play is played, or refused with its reason, by the checks themselves afterwards.

    Args:
        options: The flags of the certification.
        tasks: Tasks with an expert.
        checks: Names of the checks that will run.
        say: Prints a line about what is going on.
    """
    if options.quick:
        _work(options, _quick_pieces(options, tasks, checks), say)
        return
    apart: list[tuple[str, ...]] = [(tracker,) for tracker in options.tracker]
    recorded = [Piece((FIRST,), (task,), some) for task in tasks for some in apart]
    if set(checks) & set(COMPARING):
        _work(options, recorded, say)
    pieces, cuda = [], resolve_engine("warp", None)[1] != "cpu"
    together = tuple(check for check in checks if check in ONE_PLAN)
    if together:
        pieces.append(Piece(together, tuple(tasks), options.tracker, cores=False))
    for check in checks:
        if check in (FIRST, *ONE_PLAN, *PLAYS_NOTHING) or _unnamed(options, check, cuda):
            continue
        if check in WHOLE:
            pieces.append(Piece((check,), tuple(tasks), options.tracker))
            continue
        through = apart
        if check in BY_ALL:
            through = [options.tracker]
        elif check in BY_FIRST:
            through = apart[:1]
        pieces += [Piece((check,), (task,), some) for task in tasks for some in through]
    pieces.sort(key=lambda piece: piece.checks[0] not in LONGEST)
    _work(options, pieces, say)


def _unnamed(options: CertifyOptions, check: str, cuda: bool) -> bool:
    """A check that without CUDA plays less where nobody has named it."""
    return check == BY_NAME and not (cuda or check in options.checks)


def _quick_pieces(options: CertifyOptions, tasks: Sequence[str], checks: Sequence[str]) -> list[Piece]:
    """All checks of one task by one process: of a few episodes, a process's start is the longest part."""
    own = [check for check in checks if check not in (*ONE_PLAN, *WHOLE, *PLAYS_NOTHING)]
    if FIRST not in own and set(own) & set(COMPARING):
        own.insert(0, FIRST)
    pieces: list[Piece] = [
        Piece(some, tuple(tasks), options.tracker, cores=not set(some) <= set(ONE_PLAN))
        for some in (tuple(check for check in checks if check in kind) for kind in (set(ONE_PLAN), set(WHOLE)))
        if some
    ]
    for task in sorted(tasks, key=lambda name: -get(name).steps.paper):  # a long one is not begun last
        some = tuple(check for check in own if tasks.index(task) < OF_FIRST_TASKS.get(check, len(tasks)))
        pieces += [Piece(some, (task,), options.tracker)] * bool(some)
    return pieces


def _work(options: CertifyOptions, pieces: Sequence[Piece], say: Callable[[str], None]) -> None:
    """Play pieces until none is left."""
    waiting, cores = deque(pieces), sorted(os.sched_getaffinity(0))
    running: dict[int, tuple[Piece, subprocess.Popen[bytes], BinaryIO]] = {}
    try:
        while waiting or running:
            for slot in range(options.jobs):
                if waiting and slot not in running:
                    own = cores[slot :: options.jobs] or cores[slot % len(cores) :][:1]
                    running[slot] = _start(options, waiting.popleft(), own)
            time.sleep(POLL)
            for slot, (piece, process, errors) in list(running.items()):
                if process.poll() is not None:
                    del running[slot]
                    say(f"{piece}: {_ending(process, errors)}")
    finally:  # what was asked to stop keeps what it played
        for _, process, _ in running.values():
            process.terminate()
        for _, process, _ in running.values():
            process.wait()


def _start(
    options: CertifyOptions, piece: Piece, own: Sequence[int]
) -> tuple[Piece, subprocess.Popen[bytes], BinaryIO]:
    """A piece, its process with cores of its own, and the file of its errors."""
    variables, errors = environment() | {"OMP_NUM_THREADS": str(len(own))}, tempfile.TemporaryFile()
    command = ("arena_newton.eval", "certify", *flags(options, piece))
    process = start_module(*command, variables=variables, errors=errors.fileno(), apart=False)
    if piece.cores:
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(process.pid, own)
    return piece, process, errors


def _ending(process: subprocess.Popen[bytes], errors: BinaryIO) -> str:
    """Ending of a piece's process in words."""
    with errors:
        errors.seek(0)
        last = errors.read().decode(errors="replace").strip().splitlines()[-1:]
    if process.returncode in (0, 1):
        return "played"
    return f"left to the end: {''.join(last) or how_it_ended(process, 0.0)}"


def flags(options: CertifyOptions, piece: Piece) -> list[str]:
    """Command line of a process that plays one piece."""
    return words(
        dataclasses.replace(options, resume=True, jobs=0, checks=piece.checks, task=piece.tasks, tracker=piece.trackers)
    )


def command_line(options: CertifyOptions) -> str:
    """The command line that makes the certificate from nothing."""
    return shell_command("arena_newton.eval", "certify", *words(dataclasses.replace(options, resume=False)))
