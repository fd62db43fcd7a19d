"""The report of a run as one HTML page: table, outcomes with intervals, film strips, episodes, configuration.

Whatever comes from a results folder is text to this page: its template (`page/report.html`) escapes every expression,
so nothing in a journal can become an element or an attribute; media are linked only as plain names in `videos/` and
`strips/`; and the page's Content-Security-Policy lets no other script run than its own, named by its hash.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.eval.folders.failure_rules import near_bars, stage_of, waits_in_view
from arena_newton.eval.folders.results import Results, RunRecord
from arena_newton.eval.records.document import Document, trackers_of
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.eval.reports.failure_text import SENTENCES, WAITS, stage_bars
from arena_newton.eval.reports.wording import (
    MEDIA,
    environment_facts,
    media_of,
    replay_command,
    rules_that_ran,
    tasks_of,
)
from arena_newton.eval.statistics.stats import ErrorReason, ResultCell
from arena_newton.files.text import plain
from arena_newton.pages.html import FILES, render
from arena_newton.pages.tables import percent
from arena_newton.robot.g1 import TICK

__all__ = ["FOLDER", "page"]

FOLDER = Path(__file__).resolve().parent / "page"
"""Templates and style sheets of pages."""
OUTCOMES = ("success", "timeout", "fall", "error")
"""Outcomes in the order of the bars."""
FAILURES_FIRST = ("fall", "timeout", "error", "success")
"""Outcomes in the order of the film strips."""
SHOWN_STRIPS = 12
"""Episodes whose strips are shown; those of the others are folded."""
SHOWN_SUCCESSES = 3
"""Number of them that are kept for successes."""
LONGEST_ERROR = 300
"""Characters of an episode's error message in the list of episodes."""
TICKS = (0, 25, 50, 75, 100)
"""Marks of the axis of rates [%]."""
SEED_SPACING = 9
"""Distance of the dots of group seeds with one rate [px]."""
FILTERED = ("outcome", "task", "tracker", "mode")
"""Columns of the list of episodes by whose values a reader can choose rows."""
SORTED = ("task", "tracker", "mode", "seed", "repeat", "outcome", "steps", "margin")
"""Columns of the list of episodes by which a reader can sort it."""
COLUMNS = (
    "task",
    "tracker",
    "mode",
    "seed",
    "repeat",
    "outcome",
    "reason",
    "steps",
    "margin",
    "pictures",
    "play it again",
)


def page(
    run: RunRecord,
    results: Results,
    *,
    notes: Sequence[str],
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    reasons: Sequence[ErrorReason],
    metrics: str = "",
) -> str:
    """The page as text, the same for the same content byte for byte.

    `head` and `rows` are the table, a row per cell, then a row per suite; `notes` what a reader must know besides it;
    `metrics` is the table of recorders' metrics.
    """
    document, records = run.document, run.records
    shown, folded = _strips(records)
    opening = _opening(records)
    # The policy's number of worlds is in the configuration only where its answers depend on it.
    command = functools.partial(replay_command, document["options"], worlds=document["config"].get("worlds"))
    return render(
        FOLDER / "report.html",
        styles=["report.css"],
        script="report.js",
        sources=FILES | {"media-src": FILES["img-src"]},
        results=results,
        facts=_facts(document, results),
        notes=notes,
        changes=document.get("variant_changes") or [],
        table=_table(head, rows, len(results["cells"])),
        outcomes=OUTCOMES,
        ticks=TICKS,
        cells=_bars(results["cells"]),
        stages=SENTENCES,
        failures=stage_bars(results.get("failures", [])),
        reasons=reasons,
        metrics=metrics,
        opening=[(_Episode(record), strip) for record, strip in opening],
        shown=[_Episode(record) for record in shown],
        folded=[_Episode(record) for record in folded],
        episodes=[_Episode(record, command(record=record)) for record in records],
        filters=[(n, dict.fromkeys(plain(getattr(r, n)) for r in records)) for n in FILTERED],
        columns=[(name, name if name in SORTED else None) for name in COLUMNS],
        folds=_folds(document, records),
    )


def _facts(document: Document, results: Results) -> list[tuple[str, str]]:
    """Facts at the top of the page, by name."""
    config = document["config"]
    found = [("episodes", f"{results['finished']} of {results['planned']}")]
    found += [(name, plain(config.get(name))) for name in ("policy", "rules") if name in config]
    for name in ("tracker", "task", "mode", "seeds"):
        values = trackers_of(config) if name == "tracker" else config.get(name)
        if isinstance(values, list):
            found.append((name + "s" if name != "seeds" and len(values) > 1 else name, " ".join(map(plain, values))))
    found.append(("repeats", plain(config["repeats"])))
    shared = [dict(environment_facts(facts)) for facts in document.get("environments", {}).values()]
    for name in ("engine", "physics", "drive", "start-up"):
        differing = list(dict.fromkeys(facts[name] for facts in shared if name in facts))
        if differing:
            found.append((name, " or ".join(differing)))
        elif name in config:
            found.append((name, plain(config.get(name))))
    return [*found, ("configuration", results["config_hash"])]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], cells: int) -> dict[str, object]:
    """The table; names that are the same in every row are shown once, above it."""
    same = {i for i in (1, 2, 3) if len({row[i] for row in rows}) == 1}
    kept = [i for i in range(len(head)) if i not in same]

    def cell(row: Sequence[str], i: int) -> dict[str, str]:
        style = "text title" if i == 0 else "text" if i < 4 else "figure"
        return {"class": style, "label": "" if i == 0 or not row[i] else head[i], "text": row[i]}

    return {
        "same": ", ".join(f"{head[i]} {rows[0][i]}" for i in sorted(same)),
        "class": "cards" if len(same) > 1 else "cards full",
        "head": [(head[i], "text" if i < 4 else None) for i in kept],
        "rows": [{"suite": n >= cells, "cells": [cell(row, i) for i in kept]} for n, row in enumerate(rows)],
    }


def _bars(cells: Sequence[ResultCell]) -> list[dict[str, object]]:
    """A bar of outcomes per cell; under it the success rate with its interval and the rates of the group seeds."""

    def names(cell: ResultCell) -> tuple[str, str, str]:
        return plain(cell["tracker"]), plain(cell["policy"]), plain(cell["mode"])

    differing = [i for i in range(3) if len({names(cell)[i] for cell in cells}) > 1]
    return [_bar(" ".join([plain(cell["task"]), *(names(cell)[i] for i in differing)]), cell) for cell in cells]


def _bar(title: str, cell: ResultCell) -> dict[str, object]:
    numbers = (cell["successes"], cell["timeouts"], cell["falls"], cell["errors"])
    counts = dict(zip(OUTCOMES, numbers, strict=True))
    parts, done = [], 0
    for outcome, count in counts.items():
        if count:
            x, width = (percent(number / cell["episodes"], 2) + "%" for number in (done, count))
            parts.append({"outcome": outcome, "count": count, "x": x, "width": width})
            done += count
    same: dict[float, int] = {}
    seeds = []
    for seed, rate in cell["sr_per_seed"].items():
        # Seeds of one rate are drawn next to each other.
        same[rate] = same.get(rate, -1) + 1
        towards = -SEED_SPACING if rate > 0.5 else SEED_SPACING
        seeds.append({"name": seed, "rate": percent(rate, 2) + "%", "cx": towards * same[rate]})
    return {
        "title": title,
        "episodes": cell["episodes"],
        "all": ", ".join(f"{count} {outcome}" for outcome, count in counts.items()),
        "counts": ", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count),
        "parts": parts,
        "interval": [percent(bound, 2) + "%" for bound in cell["ci95"]] if cell["ci95"] is not None else None,
        "rate": percent(cell["sr"] or 0.0, 2) + "%",
        "seeds": seeds,
    }


def _opening(records: Sequence[EpisodeRecord]) -> list[tuple[EpisodeRecord, dict[str, str]]]:
    """One film strip per task, that of its first success from outside; where none succeeded, of its first episode."""
    found: dict[str, tuple[EpisodeRecord, dict[str, str]]] = {}
    for record in records:
        strips = _Episode(record).strips
        task = plain(record.task)
        better = task not in found or (record.outcome == "success" and found[task][0].outcome != "success")
        if strips and better:
            found[task] = (record, strips[-1])
    return list(found.values())


def _strips(records: Sequence[EpisodeRecord]) -> tuple[list[EpisodeRecord], list[EpisodeRecord]]:
    """Episodes whose film strips are shown, failures first, and those that are folded."""
    filmed = [r for r in records if any(name.endswith("strip") for name in media_of(r))]

    def order(record: EpisodeRecord) -> int:
        return FAILURES_FIRST.index(record.outcome) if record.outcome in FAILURES_FIRST else 0

    ordered = sorted(filmed, key=order)  # stable: plan order within an outcome
    # One episode of every task, tracker and mode comes first, then the second ones.
    turns: dict[tuple[str, str, str, bool], int] = {}
    turn = {}
    for record in ordered:
        cell = (plain(record.task), plain(record.tracker), plain(record.mode), record.outcome == "success")
        turn[id(record)] = turns[cell] = turns.get(cell, -1) + 1
    wins = sorted((r for r in ordered if r.outcome == "success"), key=lambda r: turn[id(r)])
    failures = sorted((r for r in ordered if r.outcome != "success"), key=lambda r: turn[id(r)])
    shown = failures[: SHOWN_STRIPS - min(SHOWN_SUCCESSES, len(wins))]
    shown += wins[: SHOWN_STRIPS - len(shown)]
    shown.sort(key=order)
    chosen = set(map(id, shown))
    return shown, [record for record in ordered if id(record) not in chosen]


@dataclass(frozen=True)
class _Episode:
    """An episode as the page shows it."""

    record: EpisodeRecord
    command: str = ""
    """Plays it again."""

    @property
    def title(self) -> str:
        r = self.record
        cell = " ".join(map(plain, (r.task, r.tracker, r.mode)))
        return f"{cell}, seed {plain(r.group_seed)} repeat {plain(r.repeat)}"

    @property
    def short_title(self) -> str:
        """Task and tracker."""
        return f"{plain(self.record.task)}, {plain(self.record.tracker)}"

    @property
    def length(self) -> str:
        return f"{self.record.steps} steps, {self.record.steps * TICK:.1f} s"

    @property
    def why(self) -> str:
        reason = self.record.reason
        return f" ({plain(reason)})" if reason and reason != self.record.outcome else ""

    @property
    def stage(self) -> str:
        """Stage at which it failed, and how it ended; empty without one."""
        stage, near = stage_of(self.record), near_bars(self.record)
        if stage is None:
            return ""
        ending = f", {WAITS}" if waits_in_view(self.record) else ""
        return f"{stage}{ending}{f'; near its bar: {", ".join(near)}' if near else ''}"

    @property
    def error(self) -> str:
        message = plain(self.record.error or "")
        return message if len(message) <= LONGEST_ERROR else message[: LONGEST_ERROR - 1] + "…"

    @property
    def strips(self) -> list[dict[str, str]]:
        return self._links(" strip")

    @property
    def videos(self) -> list[dict[str, str]]:
        return self._links("")

    def _links(self, ending: str) -> list[dict[str, str]]:
        media = media_of(self.record)
        names = [(camera, camera + ending) for camera in ("ego", "world")]
        return [{"camera": c, "path": media[n], "shows": MEDIA[n]} for c, n in names if n in media]


def _folds(document: Document, records: Sequence[EpisodeRecord]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Folded tables, by title: what ran, the rules of the tasks that ran, configuration, versions."""
    config = document["config"]
    groups: dict[str, list[str]] = {}
    for name, facts in document.get("environments", {}).items():
        groups.setdefault(json.dumps(environment_facts(facts)), []).append(plain(name))
    folds = [
        ("What ran" if len(groups) == 1 else f"What ran: {', '.join(names)}", [(n, v) for n, v in json.loads(facts)])
        for facts, names in groups.items()
    ]
    ran = rules_that_ran(document["rule_set"], tasks_of(config, records))
    return [
        *folds,
        (f"Rule set {plain(config['rules'])}", ran),
        ("Configuration", _pairs(config)),
        ("Versions", _pairs(document.get("versions", {}))),
    ]


def _pairs(table: Mapping[str, object]) -> list[tuple[str, str]]:
    return [(plain(key), plain(value)) for key, value in table.items()]
