"""Certification by several processes: each plays one check of one task into the folder that the page is made from."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import queue
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence

from arena_newton.eval.options import CertifyOptions

__all__ = ["command_line", "flags", "play_ahead"]

Piece = tuple[str, str, tuple[str, ...]]
"""Check, task and trackers."""

FIRST = "solvable"
"""The check whose evaluations others compare with: it is played before them."""
COMPARING = (FIRST, "frozen-legs", "gliding-base", "semantic", "engines", "official", "swap")
"""It, and the checks that compare with its evaluations."""
BY_NAME = "engines"
"""The check that means more when it is named: a process that plays it for others would name it."""

UNDIVIDED = ("statistics", "shards", "ray")
"""Checks that play nothing, or one plan of all tasks."""


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
    trackers = [options.tracker] if options.quick else [(tracker,) for tracker in options.tracker]
    recorded = [(FIRST, task, some) for task in tasks for some in trackers]
    if set(checks) & set(COMPARING):
        _work(options, recorded, say)
    rest = [check for check in checks if check not in (FIRST, *UNDIVIDED)]
    rest = [check for check in rest if check != BY_NAME or check in options.checks]
    _work(options, [(check, task, options.tracker) for check in rest for task in tasks], say)


def _work(options: CertifyOptions, pieces: Sequence[Piece], say: Callable[[str], None]) -> None:
    """Play pieces (check, task, trackers) until none is left."""
    waiting: queue.SimpleQueue[Piece] = queue.SimpleQueue()
    for piece in pieces:
        waiting.put(piece)
    cores = sorted(os.sched_getaffinity(0))
    running: set[subprocess.Popen[bytes]] = set()
    stopped = threading.Event()

    def work(slot: int) -> None:
        own = cores[slot :: options.jobs] or cores[slot % len(cores) :][:1]
        environment = {**os.environ, "OMP_NUM_THREADS": str(len(own))}
        while not stopped.is_set():
            try:
                check, task, trackers = waiting.get_nowait()
            except queue.Empty:
                return
            command = [sys.executable, "-m", "arena_newton.eval", "certify", *flags(options, check, task, trackers)]
            process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            running.add(process)
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(process.pid, own)
            _, complaint = process.communicate()
            running.discard(process)
            last = complaint.decode(errors="replace").strip().splitlines()[-1:]
            ended = "played" if process.returncode in (0, 1) else f"left to the end: {''.join(last)}"
            if not stopped.is_set():
                say(f"{check} {task} {' '.join(trackers)}: {ended}")

    threads = [threading.Thread(target=work, args=(slot,)) for slot in range(min(options.jobs, len(pieces)))]
    for thread in threads:
        thread.start()
    try:
        while any(thread.is_alive() for thread in threads):
            time.sleep(0.1)  # an interrupt gets through here, but not through a join
    except BaseException:
        # What was asked to stop keeps what it played; nobody takes another piece.
        stopped.set()
        for process in list(running):
            process.terminate()
        for thread in threads:
            thread.join()
        raise


def flags(options: CertifyOptions, check: str, task: str, trackers: Sequence[str]) -> list[str]:
    """Command line of a process that plays one piece."""
    piece = dataclasses.replace(options, resume=True, jobs=0, checks=(check,), task=(task,), tracker=tuple(trackers))
    return _written(piece)


def command_line(options: CertifyOptions) -> str:
    """The command line that makes the certificate from nothing."""
    program = ("python", "-m", "arena_newton.eval", "certify")
    return shlex.join([*program, *_written(dataclasses.replace(options, resume=False))])


def _written(options: CertifyOptions) -> list[str]:
    """Options as flags: those that differ from the default."""
    given = []
    for one in dataclasses.fields(CertifyOptions):
        value, flag = getattr(options, one.name), f"--{one.name.replace('_', '-')}"
        if value == one.default:
            continue
        given.append(flag)
        if not isinstance(value, bool):
            given += map(str, value) if isinstance(value, tuple) else [str(value)]
    return given
