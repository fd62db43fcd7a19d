"""Does it matter who plays a plan: one process, shards that are merged, or a cluster that loses a process?"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from arena_newton.cli.extras import require
from arena_newton.cli.flags import words
from arena_newton.errors import InputError
from arena_newton.eval.certification.checks.same_files import contents, digest
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding, Verdict, skipped
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.eval.records.journal import JOURNAL_FILE
from arena_newton.eval.reports import report
from arena_newton.eval.workers import shard_merge
from arena_newton.files.own_processes import end, environment, start_module
from arena_newton.files.stored_json import Json, JsonObject
from arena_newton.files.text import counted, plain_text
from arena_newton.pages.tables import Table

__all__ = ["CHECKS", "RayRun", "compared", "play_by_ray", "plan_of"]

EPISODES = 6
"""Episodes of each task and tracker of the plan."""
QUICK_TASKS = 1
"""Tasks of the plan under --quick: the last one, whose episodes are short."""
SHARDS = 3
"""Parts of the plan. Each plays other numbers of worlds: as many as its number."""
ACTORS = 2
"""Processes of the cluster, a core each."""
RAY_WORLDS = 2
"""Episodes that each of them plays at once: so few that some have ended, and others not, when one of them is killed."""
RAY_MINUTES = 60.0
"""A run by the cluster that takes longer is stopped [min]."""
POLL = 0.2
"""The journal is looked at so often [s]."""
ENDING = 60.0
"""Time for the cluster to end after its stop is requested [s]."""
PROGRAM = "arena_newton.eval"
"""Module that plays on a cluster."""
ACTOR = b"ray::RayActor.play"
"""Title prefix of a process while it plays for a cluster."""
REPLACED = "left: a process"
"""Message of a run about a process that it lost with the episodes that it played."""
SHOWN = (CONFIG_FILE, JOURNAL_FILE, "results.json", "table.md", "table.csv", "report.md", "report.html")
"""Files that a page names; the others are counted."""
NAMED = 20
"""Files that differ of which the notes name so many."""
BITS = "bits are promised on engine mujoco alone"


@dataclass(frozen=True)
class RayRun:
    """Outcome of a run on a cluster."""

    code: int | None
    """Its exit code; None where it had to be stopped."""
    killed_after: int | None
    """Episodes that had ended when a process was killed; None where none was."""
    lost: int
    """Processes that the run says it replaced."""
    last_line: str
    """Last line that it printed."""


def plan_of(context: Context) -> RunOptions:
    """The plan that is played in several ways: tasks and trackers of the certification, a few episodes of each."""
    return RunOptions(
        task=context.tasks[-QUICK_TASKS:] if context.options.quick else context.tasks,
        tracker=context.sample,
        policy="expert",
        mode=("base",),
        seeds=(0,),
        repeats=EPISODES,
        engine="mujoco",
        device=context.options.device,
        worlds=min(context.options.worlds, EPISODES),
        out=str(context.folder / "runs" / "plan" / "alone"),
    )


def shards(context: Context) -> CheckFinding:
    """Play a plan in one process and in shards with other numbers of worlds, and compare what is merged."""
    if context.options.engine != "mujoco":
        return skipped(BITS)
    plan = plan_of(context)

    def measure() -> JsonObject:
        alone, parts = _alone(context, plan), []
        for number in range(1, SHARDS + 1):
            parts.append(Path(str(plan.out)).with_name(f"shard_{number}_of_{SHARDS}"))
            part = replace(plan, shard=f"{number}/{SHARDS}", worlds=number, out=str(parts[-1]))
            context.play(part, f"plan, shard {number} of {SHARDS}")
        with tempfile.TemporaryDirectory(dir=alone.parent) as kept:
            try:
                shard_merge.merge(parts, Path(kept) / "merged")
            except InputError as error:
                return {"refused": plain_text(error)}
            return compared(alone, Path(kept) / "merged")

    found = context.measured("shards", plan.task, plan.tracker, {"episodes": EPISODES}, measure)
    if "refused" in found:
        return CheckFinding("fail", f"shards are not merged: {found['refused']}")
    verdict, text, wrong = _judged(found, f"{SHARDS} merged shards")
    return CheckFinding(verdict, text, (_sheet(plan, found, f"{SHARDS} merged shards"),), wrong)


def ray(context: Context) -> CheckFinding:
    """Play the plan by a Ray cluster of this machine of which a process is killed, and compare."""
    try:
        require("ray", "not run")
    except InputError as error:
        return skipped(str(error))
    if context.options.engine != "mujoco":
        return skipped(BITS)
    plan = plan_of(context)

    def measure() -> JsonObject:
        alone = _alone(context, plan)
        numbers = (number for number in range(1, 10_000) if not alone.with_name(f"ray_{number}").exists())
        folder = alone.with_name(f"ray_{next(numbers)}")
        context.say(f"plan, by {ACTORS} Ray actors of which one is killed: {folder.name}")
        run = play_by_ray(plan, folder)
        facts: JsonObject = {
            "code": run.code,
            "killed_after": run.killed_after,
            "lost": run.lost,
            "said": run.last_line,
        }
        return facts | (compared(alone, folder) if run.code in (0, 1) else {})

    found = context.measured("ray", plan.task, plan.tracker, {"episodes": EPISODES}, measure)
    if found["code"] not in (0, 1):
        how = f"took longer than {RAY_MINUTES:g} min" if found["code"] is None else f"ended with code {found['code']}"
        return CheckFinding("fail", f"a run by a Ray cluster {how}: {found['said']}")
    verdict, text, wrong = _judged(found, f"{ACTORS} Ray actors")
    killed = found["killed_after"] is not None and bool(found["lost"])
    if not killed:
        verdict = "note" if verdict == "pass" else verdict
        wrong += ("No process was lost: all episodes had ended before one could be killed.",)
    else:
        text += f"; one actor was killed with SIGKILL after {counted(cast('int', found['killed_after']), 'episode')}"
    return CheckFinding(verdict, text, (_sheet(plan, found, "Ray cluster"),), wrong)


def _alone(context: Context, plan: RunOptions) -> Path:
    """Results folder of the plan that one process played; its reports are written by the present code, as all are."""
    context.play(plan, "plan, in one process")
    folder = Path(str(plan.out))
    report.write_reports(load_run(folder))
    return folder


def compared(alone: Path, other: Path) -> JsonObject:
    """Digests of the files of two results folders, and how many of the first one's episodes broke.

    Args:
        alone: What one process wrote.
        other: What others wrote of the same plan.
    """
    one, two = contents(alone), contents(other)
    records = load_run(alone).records
    files: list[Json] = [
        [name, *("missing" if name not in found else digest(found[name]) for found in (one, two))]
        for name in sorted(one.keys() | two.keys(), key=lambda name: (name not in SHOWN, name))
    ]
    errors = sum(record.outcome == "error" for record in records)
    return {"files": files, "episodes": len(records), "errors": errors}


def _judged(found: JsonObject, who: str) -> tuple[Verdict, str, tuple[str, ...]]:
    """Judgement of compared digests: the verdict, a sentence about those who played, and what is wrong."""
    files, episodes = cast("list[list[str]]", found["files"]), cast("int", found["episodes"])
    different = [name for name, one, two in files if one != two]
    wrong = tuple(f"{name} differs" for name in different[:NAMED])
    wrong += (f"{len(different) - NAMED} more files differ",) * (len(different) > NAMED)
    wrong += (f"{found['errors']} of {counted(episodes, 'episode')} ended as errors.",) * bool(found["errors"])
    alike = f"{len(files) - len(different)} of {len(files)} files"
    text = f"{alike} of {who} ({counted(episodes, 'episode')}) are those of one process, byte for byte"
    return "fail" if wrong else "pass", text, wrong


def _sheet(plan: RunOptions, found: JsonObject, other: str) -> Table:
    """The files that a reader knows, and the others together."""
    files = cast("list[list[str]]", found["files"])
    shown = [tuple(row) for row in files if row[0] in SHOWN]
    rest = [row for row in files if row[0] not in SHOWN]
    if rest:
        sums = (digest("".join(row[column] for row in rest).encode()) for column in (1, 2))
        shown.append((f"{len(rest)} more, together", *sums))
    cells = f"{counted(cast('int', found['episodes']), 'episode')} of {' '.join(plan.task)} through"
    title = f"SHA-256 of the files of {cells} {' '.join(plan.tracker)}, without the times at which they were played"
    return Table(("file", "one process", other), shown, title=title)


def play_by_ray(plan: RunOptions, folder: Path) -> RayRun:
    """Play a plan by a Ray cluster on this machine, and kill one of its processes when the first episode has ended.

    Args:
        folder: New results folder; what the run says is written next to it.
    """
    cluster = replace(plan, ray=(), ray_cpus=1, ray_actors=ACTORS, worlds=RAY_WORLDS, out=str(folder))
    folder.parent.mkdir(parents=True, exist_ok=True)
    log, code = folder.with_suffix(".log"), None
    with open(log, "wb") as output:
        to = output.fileno()
        process = start_module(PROGRAM, "run", *words(cluster), variables=environment(), output=to, errors=to)
        try:
            killed_after = _kill_one(process, folder)
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = process.wait(60.0 * RAY_MINUTES)
        finally:
            end(process, ENDING, signal.SIGTERM)  # it then ends its cluster
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    last = next((line for line in reversed(lines) if line.strip()), "")
    return RayRun(code, killed_after, sum(REPLACED in line for line in lines), plain_text(last, 300))


def _kill_one(process: subprocess.Popen[bytes], folder: Path) -> int | None:
    """Kill a process of the cluster as soon as an episode has ended; gives how many had, None where all were played."""
    journal, until = folder / JOURNAL_FILE, time.monotonic() + 60.0 * RAY_MINUTES
    while process.poll() is None and time.monotonic() < until:
        ended = journal.read_bytes().count(b"\n") if journal.is_file() else 0
        victims = _actors(process.pid) if ended else []
        if victims:
            with contextlib.suppress(ProcessLookupError):
                os.kill(victims[0], signal.SIGKILL)
                return ended
        time.sleep(POLL)
    return None


def _actors(pid: int) -> list[int]:
    """Processes below one that play for a cluster now, as Linux tells."""
    titles: dict[int, bytes] = {}
    children: dict[int, list[int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent = path.read_text(errors="replace").rpartition(") ")[2].split()[1]
            number = int(path.parent.name)
            titles[number] = path.with_name("cmdline").read_bytes()
            children.setdefault(int(parent), []).append(number)
    found, waiting = [], [pid]
    while waiting:
        below = sorted(children.get(waiting.pop(), ()))
        waiting += below
        found += [one for one in below if titles[one].startswith(ACTOR)]
    return found


CHECKS = (
    Check("shards", "Does a plan that several machines play in shards end in the files of one machine?", shards),
    Check("ray", "Does a plan that a cluster plays end in them too when one of its processes is killed?", ray),
)
"""This module's checks."""
