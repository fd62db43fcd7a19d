"""Tables and reports of a run, derived from its configuration and journal alone; no wall-clock time enters them."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arena_newton.eval.html_report import Page, environment_facts, media_of, page, plain, rules_that_ran, tasks_of
from arena_newton.eval.journal import read_journal, write_atomic
from arena_newton.eval.original_format import write_original
from arena_newton.eval.records import JOURNAL_FILE, check_plan, counted, read_document
from arena_newton.eval.stats import aggregate, error_reasons, outside_suites

__all__ = ["RunRecord", "load_run", "notes", "results_json", "table", "write_reports"]

_COLUMNS = (
    "task",
    "tracker",
    "policy",
    "mode",
    "episodes",
    "successes",
    "falls",
    "startup_falls",
    "timeouts",
    "errors",
    "sr",
    "sr_seed_std",
    "ci95_low",
    "ci95_high",
    "afr",
    "mean_steps",
)


@dataclass(frozen=True)
class RunRecord:
    """What a results folder holds."""

    folder: Path
    document: dict[str, Any]
    """Content of config.json."""
    records: list[dict[str, Any]]
    """Finished episodes in plan order; of an episode that was run twice the last."""

    @property
    def planned(self) -> int:
        """Number of episodes of the plan."""
        return self.document["planned"]

    @property
    def config(self) -> dict[str, Any]:
        """The run's identity."""
        return self.document["config"]


def in_plan_order(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Records by plan order; of two with the same index the later one in the journal counts."""
    latest = {record["index"]: record for record in records}
    return [latest[index] for index in sorted(latest)]


def load_run(folder: Path) -> RunRecord:
    """Read a results folder."""
    document = read_document(folder)
    records, _ = read_journal(folder / JOURNAL_FILE)
    check_plan(folder / JOURNAL_FILE, records, document)
    return RunRecord(folder, document, in_plan_order(records))


def results_json(run: RunRecord) -> dict[str, Any]:
    """Content of results.json."""
    return {
        "config_hash": run.document["config_hash"],
        "config": run.config,
        "planned": run.planned,
        "finished": len(run.records),
        "complete": len(run.records) == run.planned,
        **aggregate(run.records),
    }


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _cell_text(cell: dict[str, Any]) -> list[str]:
    low_high = "-" if cell["ci95"] is None else f"{100 * cell['ci95'][0]:.1f} to {100 * cell['ci95'][1]:.1f}"
    running = cell["falls"] - cell["startup_falls"]
    return [
        *(plain(cell[name]) for name in ("task", "tracker", "policy", "mode")),
        str(cell["episodes"]),
        f"{_percent(cell['sr'])} ± {_percent(cell['sr_seed_std'])}",
        low_high,
        _percent(cell["afr"]),
        f"{running} + {cell['startup_falls']}",
        str(cell["timeouts"]),
        str(cell["errors"]),
        "-" if cell["mean_steps"] is None else f"{cell['mean_steps']:.1f}",
    ]


_HEAD = ["task", "tracker", "policy", "mode", "n", "SR % ± seed std", "95 % CI", "AFR %"]
_HEAD += ["falls running + at start", "timeouts", "errors", "mean steps"]


def _suite_text(suite: dict[str, Any]) -> list[str]:
    return [
        *(plain(suite[name]) for name in ("suite", "tracker", "policy", "mode")),
        str(suite["episodes"]),
        f"{_percent(suite['sr'])} ± {_percent(suite['sr_std'])}",
        "",
        _percent(suite["afr"]),
        str(suite["falls"]),
        "",
        str(suite["errors"]),
        "",
    ]


def _rows(results: dict[str, Any]) -> list[list[str]]:
    return [_cell_text(cell) for cell in results["cells"]] + [_suite_text(suite) for suite in results["suites"]]


def table(results: dict[str, Any]) -> str:
    """The result table as Markdown with aligned columns; it is also what the command line prints."""
    rows = [_HEAD, *([_escaped(text) for text in row] for row in _rows(results))]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEAD))]

    def line(row: list[str]) -> str:
        cells = [row[i].ljust(widths[i]) if i < 4 else row[i].rjust(widths[i]) for i in range(len(row))]
        return "| " + " | ".join(cells) + " |"

    rule = "|" + "|".join("-" * (w + 2) if i < 4 else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return "\n".join([line(_HEAD), rule, *(line(row) for row in rows[1:])]) + "\n"


def table_csv(results: dict[str, Any]) -> str:
    """The cells as CSV, rates as fractions."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    for cell in results["cells"]:
        low, high = cell["ci95"] or (None, None)
        names = {name: plain(cell[name]) for name in ("task", "tracker", "policy", "mode")}
        writer.writerow(cell | names | {"ci95_low": low, "ci95_high": high})
    return text.getvalue()


def notes(results: dict[str, Any]) -> list[str]:
    """What a reader of the table must know besides it."""
    found = []
    if not results["complete"]:
        found.append(f"Incomplete: {results['finished']} of {results['planned']} episodes are finished.")
    errors = sum(cell["errors"] for cell in results["cells"])
    if errors:
        found.append(f"{counted(errors, 'episode')} ended with an error. They count as episodes without success.")
    overflows = sum(cell["overflows"] for cell in results["cells"])
    if overflows:
        found.append(f"In {counted(overflows, 'episode')} a contact or constraint buffer overflowed.")
    outside = outside_suites(cell["task"] for cell in results["cells"])
    if outside:
        found.append(f"The averages are those of the paper's seven tasks; not in them: {' '.join(outside)}.")
    cap = results["config"]["max_steps"]
    if cap is not None:
        found.append(f"--max-steps cut the step budgets to {cap} ticks ({cap * 0.02:g} s): no benchmark result.")
    return found


def _escaped(text: object) -> str:
    """Text of a results folder as Markdown that stays text."""
    return re.sub(r"([\\`*\[\]<>|])", r"\\\1", plain(text))


def _code(text: object) -> str:
    """The same as code."""
    return f"`{plain(text).replace('`', "'")}`"


def _markdown(run: RunRecord, results: dict[str, Any]) -> str:
    lines = [f"# HumanoidArena results {_escaped(results['config_hash'])}", ""]
    lines += [f"> {_escaped(note)}" for note in notes(results)]
    lines += [f"> The scene is a variant: {_escaped(text)}" for text in run.document.get("variant_changes") or []]
    lines += ["", table(results)]
    lines += [
        "SR is the success rate, ± the population standard deviation over group seeds (suite rows: over all task and",
        "seed rates pooled); the interval is Wilson's; AFR is falls per episode; falls at start happened while the",
        "tracker settled.",
        "",
    ]
    reasons = error_reasons(run.records)
    if reasons:
        lines += ["## Errors", "", "| reason | message | episodes |", "|---|---|---:|"]
        lines += [f"| {_escaped(r['reason'])} | {_escaped(r['message'])} | {r['count']} |" for r in reasons]
        lines += ["", "Run them again, in this folder: `python -m arena_newton.eval resume . --retry-errors`", ""]
    strips = [(r, media_of(r)) for r in run.records if media_of(r)]
    if strips:
        lines += ["## Recordings", ""]
        strips.sort(key=lambda entry: entry[0]["outcome"] == "success")
        lines += [
            f"- {_escaped(r['task'])} {_escaped(r['mode'])} seed {_escaped(r['group_seed'])} repeat "
            f"{_escaped(r['repeat'])} ({_escaped(r['outcome'])}): "
            + ", ".join(f"[{name}]({path})" for name, path in media.items())
            for r, media in strips
        ]
        lines += [""]
    for name, facts in (run.document.get("environments") or {}).items():
        lines += [f"## What ran: {_escaped(name)}", ""]
        lines += [f"- {_escaped(key)}: {_code(value)}" for key, value in environment_facts(facts)] + [""]
    lines += ["## Configuration", ""]
    lines += [f"- {_escaped(key)}: {_code(value)}" for key, value in run.config.items()]
    tasks = tasks_of(run.config, run.records)
    lines += ["", f"## Rule set {_code(run.config['rules'])}", ""]
    lines += [f"- {_escaped(item)}: {_code(text)}" for item, text in rules_that_ran(run.document["rule_set"], tasks)]
    return "\n".join(lines) + "\n"


def _html(run: RunRecord, results: dict[str, Any]) -> str:
    return page(
        Page(
            document=run.document,
            records=run.records,
            results=results,
            notes=notes(results),
            head=_HEAD,
            rows=_rows(results),
            reasons=error_reasons(run.records),
        )
    )


def write_reports(run: RunRecord) -> dict[str, Any]:
    """Write results.json, table.md, table.csv, report.md, report.html and original/ into the folder.

    Returns:
        The content of results.json.
    """
    results = results_json(run)
    write_atomic(run.folder / "results.json", json.dumps(results, indent=2) + "\n")
    write_atomic(run.folder / "table.md", table(results))
    write_atomic(run.folder / "table.csv", table_csv(results))
    write_atomic(run.folder / "report.md", _markdown(run, results))
    write_atomic(run.folder / "report.html", _html(run, results))
    write_original(
        run.folder / "original",
        run.records,
        gym_ids=run.document["gym_ids"],
        seeds=run.config["seeds"],
        repeats=run.config["repeats"],
    )
    return results
