"""The report of a loop: time per stage, the training's curve, success rates with intervals, a success and a failure.

Markdown and one HTML page; what comes from the folder is text to both, pictures are linked as plain names.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import cast

from arena_newton.data.recording.episode import VIDEO_FOLDER
from arena_newton.eval.folders.results import RunRecord, load_run
from arena_newton.eval.loop.loop_options import LoopOptions
from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.eval.records.journal import EpisodeRecord, write_atomic
from arena_newton.eval.reports.html_report import FOLDER
from arena_newton.eval.reports.progress import duration
from arena_newton.eval.reports.wording import media_of
from arena_newton.eval.statistics.stats import aggregate
from arena_newton.files.text import counted, plain
from arena_newton.pages.html import FILES, render
from arena_newton.pages.tables import Table, between, escaped
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts

__all__ = ["DATASET", "EVALUATION", "RECORDINGS", "TRAINING", "curve", "worked_seconds", "write"]

RECORDINGS, DATASET, TRAINING, EVALUATION = "demonstrations", "dataset", "training", "evaluation"
"""Folders of the stages."""
PROGRESS = "progress.csv"
"""Log of a training: a row each so many steps, with `step`, `minutes`, `loss` and perhaps `held_out_loss`."""
WIDTH, HEIGHT = 640, 180
"""Size of the curve [px]."""
MOST_POINTS = 400
"""Points of a curve; of more, every second, third ... is drawn."""
RATE_HEAD = ["task", "tracker", "mode", "successes", "SR %", "95 % Wilson", "falls", "timeouts", "errors"]


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


def _time(text: str) -> float:
    """A stored time in seconds; 0 where it is none."""
    try:
        return datetime.fromisoformat(text).timestamp()
    except ValueError:
        return 0.0


def worked_seconds(run: RunRecord) -> float:
    """Time in which the last call for a run worked or episodes of earlier ones were played, without pauses [s]."""
    spans = [(record.started_at, record.finished_at) for record in run.records]
    if run.status is not None:
        spans.append((run.status["started_at"], run.status["finished_at"]))
    total = until = 0.0
    for begin, end in sorted((_time(str(first)), _time(str(last))) for first, last in spans):
        total += max(0.0, end - max(begin, until))
        until = max(until, end)
    return total


def _rate_rows(run: RunRecord) -> list[list[str]]:
    rows = []
    for cell in aggregate(run.records)["cells"]:
        rates = [f"{100 * (cell['sr'] or 0.0):.1f}", between(cell["ci95"])]
        names = [plain(name) for name in (cell["task"], cell["tracker"], cell["mode"])]
        ends = [str(cell[ending]) for ending in ("falls", "timeouts", "errors")]
        rows.append([*names, f"{cell['successes']}/{cell['episodes']}", *rates, *ends])
    return rows


def write(out: Path, options: LoopOptions, command: str) -> list[str]:
    """Write `loop.md` and `loop.html`; stages whose folders are gone are left out.

    Returns:
        Lines for the terminal: times, rates, the page.
    """
    run = load_run(out / EVALUATION)
    drawn, films, rates = _paths(curve(out / TRAINING)), _films(run), _rate_rows(run)
    times: dict[str, float] = {}
    facts: list[tuple[str, str]] = []
    if (out / RECORDINGS / CONFIG_FILE).is_file():
        recorded = load_run(out / RECORDINGS)
        times["record demonstrations"] = worked_seconds(recorded)
        won = sum(record.outcome == "success" for record in recorded.records)
        facts.append(("recorded", f"{counted(len(recorded.records), 'attempt')}, {won:,} of them successes"))
        facts.append(("world-ticks recorded", f"{sum(record.steps for record in recorded.records):,}"))
        videos = sum(f.stat().st_size for f in (out / RECORDINGS / "episodes" / VIDEO_FOLDER).glob("*.mp4"))
        facts.append(("pictures", f"{videos / 1e6:,.1f} MB of video"))
        if (out / DATASET).is_dir() and recorded.status is not None:
            written = max((f.stat().st_mtime for f in (out / DATASET).rglob("*") if f.is_file()), default=0.0)
            times["build the dataset"] = max(0.0, written - _time(str(recorded.status["finished_at"])))
    checkpoint = out / TRAINING / "checkpoints/last/pretrained_model"
    if (trained := CheckpointFacts.read(checkpoint)) is not None:
        times["train"] = 60.0 * trained.minutes
        words = f"{trained.family}, recipe {trained.recipe}, {trained.steps:,} steps in {trained.minutes:.2f} min"
        facts.append(("trained", f"{words} on {trained.device or 'an unnamed device'}, labels {trained.labels}"))
        facts.append(("checkpoint", str(checkpoint.relative_to(out))))
        weights = sum(file.stat().st_size for file in checkpoint.glob("model.safetensors"))
        facts.append(("weights", f"{weights / 1e6:,.1f} MB"))
    times["evaluate"] = worked_seconds(run)
    times["all"] = sum(times.values())
    stages = [[name, f"{seconds:.1f}"] for name, seconds in times.items()]
    notes = ["A small loop, which tries the machinery: no result."] if options.small else []
    title = " ".join(options.task)
    text = [f"# The loop of {escaped(title)}", "", f"`{plain(command).replace('`', '')}`", ""]
    text += ["## Result", "", Table(RATE_HEAD, rates, "lllr").markdown(), *(f"> {note}" for note in notes), ""]
    text += ["## Time", "", Table(["stage", "seconds"], stages, "lr").markdown(), "## What was made", ""]
    text += [f"- {escaped(name)}: {escaped(value)}" for name, value in facts]
    if drawn is not None:
        ends = ", ".join(
            f"{name.replace('_', ' ')} {value}" for name, value in cast("dict[str, str]", drawn["ends"]).items()
        )
        text += [f"- last {ends} at step {drawn['last']} (curve: loop.html)"]
    text += ["", "## A success and a failure", ""]
    for record, strips in films:
        named = escaped(f"{record.task} {record.mode} seed {record.group_seed} repeat {record.repeat}")
        text += [f"{named}: {escaped(record.outcome)} after {record.steps} ticks", ""]
        text += [f"![{named}]({path})" for path in strips] + [""]
    write_atomic(out / "loop.md", "\n".join(text).rstrip() + "\n")
    page = render(
        FOLDER / "loop.html",
        styles=["report.css"],
        sources=FILES,
        title=title,
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
    lines = ["time: " + ", ".join(f"{name} {duration(seconds)}" for name, seconds in times.items())]
    lines += [f"{row[0]} through {row[1]}: {row[3]} successes, {row[4]} % (95 % Wilson {row[5]})" for row in rates]
    return [*lines, f"report: {out / 'loop.html'}"]
