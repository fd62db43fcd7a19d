"""Console output of a run besides the progress: its beginning, what broke, and its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from arena_newton.eval.folders.results import Results, RunRecord
from arena_newton.eval.folders.run_folder import BREAK_FILE, setting
from arena_newton.eval.plan.config import RunConfig
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.reports import report
from arena_newton.eval.reports.progress import duration, simulated
from arena_newton.eval.statistics import stats
from arena_newton.files.stored_json import JsonObject
from arena_newton.files.text import counted, plain_text

__all__ = ["announce", "broken", "environment", "failed", "result"]


def announce(config: RunConfig, folder: Path, waiting: Mapping[tuple[str, str, str], Sequence[Episode]]) -> None:
    """Print configuration and size of the run in two lines, or the configuration as a whole.

    `waiting` are the episodes to play, by the groups in which they run.
    """
    flags = config.flags
    if flags.verbose:
        print(f"configuration {config.hash}")
        for key, value in config.identity().items():
            print(f"  {key:<13} {setting(value)}")
    else:
        tasks = " ".join(flags.task) if len(flags.task) < 4 else f"{len(flags.task)} tasks"
        used = f"tracker{'s' if len(flags.tracker) > 1 else ''} {' '.join(flags.tracker)}"
        parts = (tasks, " ".join(flags.mode), used, f"policy {config.policy_label}")
        where = f"rules {flags.rules}, engine {flags.engine} on {config.device}"
        print(f"configuration {config.hash}: {', '.join(parts)}, {where}")
    planned, remain = counted(len(config.episodes), "episode"), sum(map(len, waiting.values()))
    if flags.keep is not None:
        planned = f"{flags.keep:,} successes to record of each task, tracker and mode"
        planned += f" in at most {len(config.episodes):,} attempts"
    rule = config.width_rule
    if rule is not None:
        planned = f"of each task, tracker and mode at most {counted(rule.most, 'episode')}, until the 95 % interval of "
        planned += f"its success rate is at most {100 * rule.width:g} points wide"
    if not remain:
        print(f"  {planned}, all finished -> {folder}", flush=True)
        return
    finished = len(config.episodes) - remain
    planned = planned if config.shard is None else f"shard {config.shard}: {planned} of {config.planned:,}"
    size = f"{planned}, {finished} finished, {remain} remain" if finished else planned
    size = size if flags.keep is None and rule is None else f"{planned}, {remain} due"
    worlds = min(flags.worlds, max(map(len, waiting.values())))
    most = simulated(sum(episode.max_steps for group in waiting.values() for episode in group))
    print(f"  {size}, {counted(worlds, 'world')} at once, {most} -> {folder}", flush=True)
    if config.worlds_matter and flags.worlds > 1:
        print(
            f"  the policy server does not declare that it honours seeds: if it draws random numbers, results "
            f"depend on --worlds {flags.worlds} and on timing; --worlds 1 is reproducible"
        )
    known = (config.policy_facts or {}).get("trackers") or []  # of its training, where it says them
    foreign = [name for name in flags.tracker if name not in known]
    if isinstance(known, list) and known and foreign:
        trained = plain_text(" ".join(map(str, known)), 200)
        print(
            f"  policy {config.policy_label} was trained through {trained}, and is played through {' '.join(foreign)}"
        )
    if "pd" in flags.tracker:
        print("  --tracker pd cannot balance: expect falls; for an evaluation: --tracker twist2")


def environment(group: str, facts: JsonObject) -> str:
    """Environment's own description, in one line."""
    listed = ", ".join(f"{key} {setting(value)}" for key, value in facts.items() if key != "tracker")
    return f"  {group}: {listed}, tracker {setting(facts.get('tracker'))}"


def broken(group: str, message: str, running: Sequence[Episode]) -> str:
    """Message about an environment that broke."""
    text = f"{group}: {message}"
    if "out of memory" in message.lower() or message.startswith("MemoryError"):
        text += " (fewer --worlds need less)"
    if running:
        seeds = " ".join(f"{e.mode}/s{e.group_seed}/r{e.repeat}" for e in running[:8])
        seeds += " ..." if len(running) > 8 else ""
        text += f"; running were {seeds}, which stay unplayed (--worlds 1 --skip-broken passes one that always breaks)"
    return f"{text}; trace in {BREAK_FILE}"


def failed(group: str, error: OSError) -> str:
    """Message about a file that could not be written or a connection that broke."""
    cause = plain_text(error.strerror or error)
    named = f"{plain_text(error.filename)}: {cause}" if error.filename else cause
    return f"{group}: {type(error).__name__}: {named}; running episodes stay unplayed; trace in {BREAK_FILE}"


def result(run: RunRecord, results: Results, resume: str, seconds: float) -> None:
    """Print the table, what a reader must know besides it, why episodes ended as errors, and the command to resume."""
    print(f"\n{report.table(results)}")
    for note in report.notes(run, results):
        print(note)
    reasons = stats.error_reasons(run.records)
    if reasons:
        print("Errors:")
        for cause in reasons:
            print(f"  {cause['count']:>4} x {cause['reason']}: {cause['message']}")
        print(f"Run them again with: {resume} --retry-errors")
    print(f"{counted(results['finished'], 'episode')}, this run took {duration(seconds)}")
    print(f"report: {run.folder / 'report.html'}")
