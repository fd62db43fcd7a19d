"""The report of a loop: time per stage, the training's curve, success rates with intervals, a success and a failure.

Markdown and one HTML page; what comes from the folder is text to both, pictures are linked as plain names.
"""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

from arena_newton.data.recording.episode import VIDEO_FOLDER
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, load_run
from arena_newton.eval.records.journal import EpisodeRecord, write_atomic
from arena_newton.eval.reports.html_report import FOLDER
from arena_newton.eval.reports.progress import duration
from arena_newton.eval.reports.wording import media_of
from arena_newton.eval.statistics.stats import wilson
from arena_newton.files.text import counted, plain
from arena_newton.pages.html import FILES, render
from arena_newton.pages.tables import Table, between, escaped
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts

__all__ = [
    "DATASET",
    "EVALUATION",
    "RECORDINGS",
    "TRAINING",
    "LoopRecord",
    "StageRecord",
    "lines",
    "read",
    "write",
]

RECORDINGS, DATASET, TRAINING, EVALUATION = "demonstrations", "dataset", "training", "evaluation"
"""Folders of the stages."""
PROGRESS = "progress.csv"
"""Log of a training: a row each so many steps, with `step`, `minutes`, `loss` and perhaps `held_out_loss`."""
WIDTH, HEIGHT = 640, 180
"""Size of the curve [px]."""
MOST_POINTS = 400
"""Points of a curve; of more, every second, third ... is drawn."""
MAX_BYTES = 1 << 20
"""Largest loop.json that is read."""
STAGES = {
    "record": "record demonstrations",
    "build": "build the dataset",
    "train": "train",
    "evaluate": "evaluate",
}


@dataclass
class StageRecord:
    """One stage of a loop."""

    finished: bool = False
    seconds: float = 0.0
    """Time of all attempts that were not killed [s]."""
    attempts: int = 0
    code: int = 0
    """Exit code of the finished stage."""
    checkpoint: str | None = None
    """Of the training: its last checkpoint, relative to the loop's folder."""


@dataclass
class LoopRecord:
    """Content of loop.json."""

    options: Mapping[str, object]
    """The flags, with everything filled in."""
    stages: dict[str, StageRecord] = field(default_factory=dict)


def read(path: Path, version: int) -> LoopRecord:
    """Read loop.json.

    Raises:
        InputError: It is not one of this version.
    """
    try:
        content = json.loads(path.read_bytes()[: MAX_BYTES + 1])
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON ({plain(str(error))[:200]})") from None
    if not isinstance(content, dict) or content.get("format") != version:
        raise InputError(f"{path}: expected an object with format {version}")
    options, stages = content.get("options"), content.get("stages")
    if not isinstance(options, dict) or not isinstance(stages, dict):
        raise InputError(f"{path}: expected objects named options and stages")
    known = {one.name for one in fields(StageRecord)}
    found = {}
    for name, values in stages.items():
        if name not in STAGES or not isinstance(values, dict) or not set(values) <= known:
            raise InputError(f"{path}: stages: {plain(name)[:80]} is no stage with {', '.join(sorted(known))}")
        stage = StageRecord(**values)
        right = isinstance(stage.finished, bool) and all(
            isinstance(number, int | float) and not isinstance(number, bool) and 0 <= number < math.inf
            for number in (stage.seconds, stage.attempts, stage.code)
        )
        inside = stage.checkpoint is None or (
            isinstance(stage.checkpoint, str)
            and not Path(stage.checkpoint).is_absolute()
            and ".." not in Path(stage.checkpoint).parts
        )
        if not right or not inside:
            raise InputError(f"{path}: stages: {name} has a value that no stage has")
        found[name] = stage
    return LoopRecord(options, found)


def curve(folder: Path) -> dict[str, list[tuple[float, float]]]:
    """Loss by step from a training's log, training and held out; rows that are damaged are left out."""
    found: dict[str, list[tuple[float, float]]] = {"loss": [], "held_out_loss": []}
    path = folder / PROGRESS
    if not path.is_file():
        return found
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        for row in csv.DictReader(file):
            for name, points in found.items():
                try:
                    point = float(row.get("step") or "nan"), float(row.get(name) or "nan")
                except ValueError:
                    continue
                if all(map(math.isfinite, point)):
                    points.append(point)
    return {name: points[:: max(1, math.ceil(len(points) / MOST_POINTS))] for name, points in found.items()}


def _paths(curves: Mapping[str, Sequence[tuple[float, float]]]) -> dict[str, object] | None:
    """The curves as lines of an SVG with a logarithmic axis of losses; None where there is nothing to draw."""
    drawn = {name: [(x, y) for x, y in points if y > 0] for name, points in curves.items()}
    every = [point for points in drawn.values() for point in points]
    if not every:
        return None
    last = max(x for x, _ in every) or 1.0
    low, high = (math.log10(pick(y for _, y in every)) for pick in (min, max))
    span = max(high - low, 0.1)

    def line(points: Sequence[tuple[float, float]]) -> str:
        at = ((WIDTH * x / last, HEIGHT * (1.0 - (math.log10(y) - low) / span)) for x, y in points)
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in at)

    return {
        "width": WIDTH,
        "height": HEIGHT,
        "last": f"{last:,.0f}",
        "low": f"{10**low:.3g}",
        "high": f"{10 ** (low + span):.3g}",
        "lines": {name: line(points) for name, points in drawn.items() if points},
        "ends": {name: f"{points[-1][1]:.4g}" for name, points in drawn.items() if points},
    }


def _films(run: RunRecord) -> list[tuple[EpisodeRecord, list[str]]]:
    """Per task one success and one typical failure: the one whose length is the middle of the failures'."""
    found = []
    for task in dict.fromkeys(record.task for record in run.records):
        own = [record for record in run.records if record.task == task and media_of(record)]
        won = [record for record in own if record.outcome == "success"]
        lost = sorted((r for r in own if r.outcome != "success"), key=lambda r: (r.steps, r.index))
        for record in (*won[:1], *lost[len(lost) // 2 :][:1]):
            strips = [path for name, path in media_of(record).items() if name.endswith("strip")]
            found.append((record, [f"{EVALUATION}/{path}" for path in strips]))
    return [(record, strips) for record, strips in found if strips]


def _stage_rows(loop: LoopRecord) -> list[list[str]]:
    rows = []
    for name, words in STAGES.items():
        if name in loop.stages:
            stage = loop.stages[name]
            again = f", in {stage.attempts} attempts" if stage.attempts > 1 else ""
            rows.append([words, f"{stage.seconds:.1f}", ("finished" if stage.finished else "not finished") + again])
    total = sum(stage.seconds for stage in loop.stages.values())
    return [*rows, ["all", f"{total:.1f}", duration(total)]]


def _rate_rows(run: RunRecord) -> list[list[str]]:
    rows = []
    for cell in dict.fromkeys((r.task, r.tracker, r.mode) for r in run.records):
        own = [r for r in run.records if (r.task, r.tracker, r.mode) == cell]
        ends = Counter(r.outcome for r in own)
        rates = [f"{100 * ends['success'] / len(own):.1f}", between(wilson(ends["success"], len(own)))]
        rows.append(
            [*map(plain, cell), f"{ends['success']}/{len(own)}", *rates]
            + [str(ends[outcome]) for outcome in ("fall", "timeout", "error")]
        )
    return rows


RATE_HEAD = ["task", "tracker", "mode", "successes", "SR %", "95 % Wilson", "falls", "timeouts", "errors"]


def _facts(out: Path, loop: LoopRecord) -> list[tuple[str, str]]:
    """Recording and training in words."""
    found = []
    if (out / RECORDINGS / "config.json").is_file():
        recorded = load_run(out / RECORDINGS).records
        won = sum(record.outcome == "success" for record in recorded)
        found.append(("recorded", f"{counted(len(recorded), 'attempt')}, {won:,} of them successes"))
        found.append(("world-ticks recorded", f"{sum(record.steps for record in recorded):,}"))
        videos = sum(f.stat().st_size for f in (out / RECORDINGS / "episodes" / VIDEO_FOLDER).glob("*.mp4"))
        found.append(("pictures", f"{videos / 1e6:,.1f} MB of video"))
    stage = loop.stages.get("train")
    if stage is not None and stage.checkpoint is not None:
        facts = CheckpointFacts.read(out / stage.checkpoint)
        if facts is not None:
            trained = f"{facts.family}, recipe {facts.recipe}, {facts.steps:,} steps in {facts.minutes:.2f} min"
            found.append(("trained", f"{trained} on {facts.device or 'an unnamed device'}, labels {facts.labels}"))
        found.append(("checkpoint", stage.checkpoint))
        weights = out / stage.checkpoint / "model.safetensors"
        if weights.is_file():
            found.append(("weights", f"{weights.stat().st_size / 1e6:,.1f} MB"))
    return [(name, plain(value)) for name, value in found]


def lines(out: Path, loop: LoopRecord) -> list[str]:
    """Last lines of the command: times and rates."""
    times = ", ".join(f"{name} {duration(stage.seconds)}" for name, stage in loop.stages.items())
    found = [f"time: {times}; together {duration(sum(stage.seconds for stage in loop.stages.values()))}"]
    for row in _rate_rows(load_run(out / EVALUATION)):
        found.append(f"{row[0]} through {row[1]}: {row[3]} successes, {row[4]} % (95 % Wilson {row[5]})")
    return found


def write(out: Path, loop: LoopRecord, command: str) -> Path:
    """Write `loop.md` and `loop.html`.

    Returns:
        The page.
    """
    run = load_run(out / EVALUATION)
    drawn, films, facts = _paths(curve(out / TRAINING)), _films(run), _facts(out, loop)
    rates, stages = _rate_rows(run), _stage_rows(loop)
    notes = ["A small loop, which tries the machinery: no result."] if loop.options.get("small") is True else []
    text = [f"# The loop of {escaped(' '.join(map(str, _listed(loop.options.get('task')))))}", ""]
    text += [f"`{plain(command).replace('`', '')}`", "", "## Result", "", Table(RATE_HEAD, rates, "lllr").markdown()]
    text += [f"> {note}" for note in notes] + [
        "",
        "## Time",
        "",
        Table(["stage", "seconds", ""], stages, "lr").markdown(),
        "## What was made",
        "",
    ]
    text += [f"- {escaped(name)}: {escaped(value)}" for name, value in facts]
    if drawn is not None:
        ends = drawn["ends"]
        assert isinstance(ends, dict)
        said = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in ends.items())
        text += [f"- last {said} at step {drawn['last']} (curve: loop.html)"]
    text += ["", "## A success and a failure", ""]
    for record, strips in films:
        title = f"{record.task} {record.mode} seed {record.group_seed} repeat {record.repeat}"
        text += [f"{escaped(title)}: {escaped(record.outcome)} after {record.steps} ticks", ""]
        text += [f"![{escaped(title)}]({path})" for path in strips] + [""]
    write_atomic(out / "loop.md", "\n".join(text).rstrip() + "\n")
    page = render(
        FOLDER / "loop.html",
        styles=["report.css"],
        sources=FILES,
        title=" ".join(map(str, _listed(loop.options.get("task")))),
        command=command,
        head=RATE_HEAD,
        rates=rates,
        stages=stages,
        facts=facts,
        curve=drawn,
        films=films,
        notes=notes,
    )
    write_atomic(out / "loop.html", page)
    return out / "loop.html"


def _listed(value: object) -> Sequence[object]:
    return value if isinstance(value, list | tuple) else [value]
