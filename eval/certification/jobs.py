"""Certification by several processes: each plays one check of one task into the folder that the page is made from."""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence

from arena_newton.eval.options import CertifyOptions

__all__ = ["flags", "play_ahead"]

Piece = tuple[str, str, tuple[str, ...]]
"""Check, task and trackers."""

FIRST = "solvable"
"""The check whose evaluations others compare with: it is played before them."""


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
    _work(options, recorded, say)
    _work(options, [(check, task, options.tracker) for check in checks if check != FIRST for task in tasks], say)


def _work(options: CertifyOptions, pieces: Sequence[Piece], say: Callable[[str], None]) -> None:
    """Play pieces (check, task, trackers) until none is left."""
    waiting: queue.SimpleQueue[Piece] = queue.SimpleQueue()
    for piece in pieces:
        waiting.put(piece)
    cores = sorted(os.sched_getaffinity(0))

    def work(slot: int) -> None:
        own = cores[slot :: options.jobs] or cores[slot % len(cores) :][:1]
        environment = {**os.environ, "OMP_NUM_THREADS": str(len(own))}
        while True:
            try:
                check, task, trackers = waiting.get_nowait()
            except queue.Empty:
                return
            command = [sys.executable, "-m", "arena_newton.eval", "certify", *flags(options, check, task, trackers)]
            process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            os.sched_setaffinity(process.pid, own)
            _, complaint = process.communicate()
            last = complaint.decode(errors="replace").strip().splitlines()[-1:]
            ended = "played" if process.returncode in (0, 1) else f"left to the end: {''.join(last)}"
            say(f"{check} {task} {' '.join(trackers)}: {ended}")

    threads = [threading.Thread(target=work, args=(slot,)) for slot in range(min(options.jobs, len(pieces)))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def flags(options: CertifyOptions, check: str, task: str, trackers: Sequence[str]) -> list[str]:
    """Command line of a process that plays one piece."""
    flags = ["--out", options.out, "--resume", "--jobs", "0", "--checks", check, "--task", task]
    flags += ["--tracker", *trackers, "--worlds", str(options.worlds), "--engine", options.engine]
    flags += ["--quick"] * options.quick
    flags += ["--episodes", str(options.episodes)] * (options.episodes is not None)
    flags += ["--device", str(options.device)] * (options.device is not None)
    return flags + ["--twist2-checkpoint", str(options.twist2_checkpoint)] * (options.twist2_checkpoint is not None)
