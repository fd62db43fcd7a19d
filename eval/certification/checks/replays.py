"""Is what was written down what happened? Journals against themselves, recordings against a replay of their actions.

A replay has no policy in its loop: the 40 numbers of each tick go to the tracker of the recording, and nothing else may
act. An expert that moves things, a recorder that loses a tick and an outcome that was edited end otherwise there.
"""

from __future__ import annotations

import functools
import itertools
from pathlib import Path

import numpy as np

from arena_newton.errors import InputError
from arena_newton.eval.certification.context import CertifyCell, Context
from arena_newton.eval.certification.finding import Check, CheckFinding, score, skipped
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.folders.run_folder import EPISODES
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.eval.records.identity import config_hash
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.files.own_files import file_label
from arena_newton.files.stored_json import JsonObject
from arena_newton.files.text import counted, plain_text
from arena_newton.files.untrusted_files import read_arrays
from arena_newton.pages.tables import Table

__all__ = ["CHECKS", "SOLVED", "own_replay", "recorded"]

SOLVED = 0.9
"""Success rate that an expert must not be significantly below: the Wilson interval reaches it. Of 60 episodes 50 do,
of 4 three."""
ENDING = "outcome reason steps margin predicates progress events startup_fall overflow".split()
"""Keys of the journal by which two episodes are the same."""
RECORDED_TICKS = 200
"""Longest episode of the check `recording` [ticks]."""

PHASE = "arena_phase"
"""Array of a recording that a replay does not have: it knows no phases."""


def recorded(context: Context, task: str, tracker: str, rules: str = "paper") -> CertifyCell:
    """The expert's episodes in base mode, with their actions: what several checks compare with."""
    return CertifyCell(task, tracker, rules, actions=True)


def own_replay(
    context: Context, task: str, tracker: str, rules: str = "paper"
) -> tuple[list[EpisodeRecord], list[str]]:
    """Replay an expert's recordings through their own tracker.

    Returns:
        The episodes of the replay, and in which way they are not those of the recording: to the last bit on engine
        `mujoco`; on another one, where no bits are promised, by their successes.
    """
    cell = recorded(context, task, tracker, rules)
    records, where = context.evaluate(cell), f"{task} through {tracker} under {rules}"
    if not any(record.steps for record in records):
        return [], [f"{where}: nothing was recorded"]
    policy = f"replay:{context.path(cell) / 'actions'}"
    again = CertifyCell(task, tracker, rules, policy=policy, label=f"replay-of-{tracker}")
    replayed = context.evaluate(again)
    if context.options.engine != "mujoco":
        won = score(replayed)
        return replayed, [f"{where}: a replay succeeds in {won.successes} of {won.episodes}"] * (
            won.interval[1] < SOLVED
        )
    known = {record.episode_seed: record for record in records}
    gaps = [(one, _gap(known[one.episode_seed], one)) for one in replayed]
    return replayed, [
        f"{where}, seed {one.group_seed} repeat {one.repeat}: {gap}" for one, gap in gaps if gap is not None
    ]


def _gap(first: EpisodeRecord, second: EpisodeRecord) -> str | None:
    """The first key in which two endings differ, and how; None where they are the same."""
    for key in ENDING:
        one, other = (getattr(record, key) for record in (first, second))
        if repr(one) != repr(other):  # the bits of a number, and the order of keys
            return f"{key} {plain_text(one, 60)}, in the replay {plain_text(other, 60)}"
    return None


def journal(context: Context) -> CheckFinding:
    """Hold every journal of the folder to itself and to its plan, and the experts' to a replay of their actions."""
    wrong = _held(context)
    lines = replays = 0
    if not wrong:
        for task, tracker in itertools.product(context.tasks, context.sample):
            replayed, gaps = own_replay(context, task, tracker)
            replays, wrong = replays + len(replayed), wrong + gaps
        wrong += _held(context)
        for folder in _folders(context):
            lines += 0 if wrong else len(load_run(folder).records)
    summary = f"{counted(lines, 'line')} of {counted(len(_folders(context)), 'journal')} agree with themselves and "
    summary += f"their plans, {counted(replays, 'episode')} with a replay of the actions"
    return CheckFinding("fail" if wrong else "pass", wrong[0] if wrong else summary, notes=tuple(wrong))


def _folders(context: Context) -> list[Path]:
    return sorted(file.parent for file in (context.folder / "runs").rglob(CONFIG_FILE))


def _held(context: Context) -> list[str]:
    """Contradictions within the journals and configurations of the folder."""
    wrong = []
    for folder in _folders(context):
        try:
            run = load_run(folder)
            if config_hash(run.document["config"]) != run.document["config_hash"]:
                raise InputError(f"{folder / CONFIG_FILE}: is not what its hash is of; it was changed by hand")
        except InputError as error:
            wrong.append(plain_text(str(error).replace(f"{context.folder}/", ""), 300))
    return wrong


def recording(context: Context) -> CheckFinding:
    """Record episodes and their replays, and compare ticks, actions and every array."""
    if context.options.engine != "mujoco":
        return skipped("bits are promised on engine mujoco alone")
    rows, wrong = [], []
    for tracker, task in itertools.product(
        context.sample, context.tasks[:1] if context.options.quick else context.tasks
    ):
        measure = functools.partial(_record_twice, context, task, tracker)
        found = context.measured("recording", task, tracker, {"ticks": RECORDED_TICKS}, measure)
        rows.append((task, tracker, *(str(found[key]) for key in ("steps", "rows", "actions", "arrays"))))
        wrong += [f"{task} through {tracker}: {found['wrong']}"] * bool(found["wrong"])
    head = ("task", "tracker", "steps", "recorded rows", "recorded actions", "arrays compared with a replay's")
    summary = f"{len(rows) - len(wrong)} of {counted(len(rows), 'recording')} hold every tick, and a replay of the "
    summary += "actions gives the same arrays to the last bit"
    sheet = Table(head, rows, title=f"Recordings of an episode of at most {RECORDED_TICKS} ticks")
    return CheckFinding("fail" if wrong else "pass", wrong[0] if wrong else summary, (sheet,), tuple(wrong))


def _record_twice(context: Context, task: str, tracker: str) -> JsonObject:
    """Record an episode and its replay; gives counts, and what is wrong."""
    base = context.folder / "runs" / task / f"{tracker}_recording"
    files, records = [], []
    for name, policy in (("first", "expert"), ("again", f"replay:{base}_first/actions")):
        options = RunOptions(
            task=(task,),
            tracker=(tracker,),
            policy=policy,
            seeds=(0,),
            repeats=1,
            max_steps=RECORDED_TICKS,
            worlds=1,
            engine=context.options.engine,
            device=context.options.device,
            actions=True,
            record=True,
            record_cameras=(),
            out=f"{base}_{name}",
        )
        records += context.play(options, f"{task} {tracker} recording, {name}")
        label = f"{task}__{file_label(tracker)}__base__seed0__repeat0000.npz"
        files.append(read_arrays(Path(f"{base}_{name}") / EPISODES / label, where=label))
    actions = read_arrays(next(Path(f"{base}_first/actions").glob("*.npz")), ("action",), where="actions")["action"]
    rows, steps = len(files[0]["arena_action"]), records[0].steps
    numbers = {key: one for key, one in files[0].items() if one.dtype.kind in "fiub" and key != PHASE}
    differing = [key for key, one in numbers.items() if not _alike(one, files[1].get(key))]
    wrong = ""
    if not rows == len(actions) == steps:
        wrong = f"{rows} rows and {len(actions)} actions of {steps} steps"
    elif not np.array_equal(files[0]["arena_action"], actions):
        wrong = "the recorded actions are not those that were played"
    elif gap := _gap(records[0], records[1]):
        wrong = gap
    elif differing:
        wrong = f"{differing[0]} is not that of a replay"
    return {"steps": steps, "rows": rows, "actions": len(actions), "arrays": len(numbers), "wrong": wrong}


def _alike(one: np.ndarray, other: np.ndarray | None) -> bool:
    return other is not None and one.dtype == other.dtype and one.tobytes() == other.tobytes()


CHECKS = (
    Check("journal", "Does every journal agree with itself, its plan and a replay of the recorded actions?", journal),
    Check("recording", "Does a recording hold every tick, so that a replay gives it again to the last bit?", recording),
)
"""This module's checks."""
