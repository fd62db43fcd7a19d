"""``python -m benchmarks audit``: duration of an audit of a folder, and its probability to find a forged line."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from arena_newton.eval.audit.action_replay import replay
from arena_newton.eval.audit.draws import drawn, found_by
from arena_newton.eval.audit.folder_audit import audited
from arena_newton.eval.bench.timing import BenchFigure, cores
from benchmarks.bench_options import AuditTimeOptions

__all__ = ["audit_times"]

LINES, REPLAY = 2.0, 180.0
"""Bars: 1,000 episodes without the simulator, and 60 episodes played again on two cores [s]."""


def audit_times(options: AuditTimeOptions) -> Iterator[BenchFigure]:
    """Durations for 1,000 lines and 60 replays, in proportion to the folder's, and probabilities."""
    folder = Path(options.folder).expanduser()
    audited(folder)  # what is loaded once is not measured
    began = time.process_time()
    audit = audited(folder)
    seconds, count = time.process_time() - began, max(len(audit.run.records), 1)
    note = f"processor time; {count} episodes took {seconds:.2f} s"
    yield BenchFigure(
        "lines, links, actions and tables of 1,000 episodes", LINES, "s", True, 1000 * seconds / count, note
    )
    (chosen,) = drawn([audit], options.replay, 0)
    if chosen:
        with cores(2):
            clock, began = time.perf_counter(), time.process_time()
            replay(audit, chosen)
            elapsed, used = time.perf_counter() - clock, time.process_time() - began
        note = f"{len(chosen)} took {elapsed:.0f} s, {used:.0f} s of processor time; {len(audit.faults)} contradictions"
        yield BenchFigure("60 episodes played again on two cores", REPLAY, "s", True, 60 * elapsed / len(chosen), note)
    for number in (5, 10, 29, 59):
        yield BenchFigure(f"{number} episodes played again", None, "", False, None, f"find {found_by(number, count)}")
