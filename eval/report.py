"""Tables and reports of a run, derived from its configuration and journal alone; no wall-clock time enters them."""

from __future__ import annotations

import csv
import html
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arena_newton.eval.journal import read_journal, write_atomic
from arena_newton.eval.original_format import write_original
from arena_newton.eval.records import check_plan, counted, read_document
from arena_newton.eval.stats import aggregate, outside_suites

__all__ = ["RunRecord", "load_run", "notes", "results_json", "table", "write_reports"]

CONFIG_FILE = "config.json"
JOURNAL_FILE = "episodes.jsonl"

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

_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:72rem;padding:0 1rem;color:#1c2430;background:#fff}
h1{font-size:1.5rem;margin-bottom:.2rem}h2{font-size:1.1rem;margin-top:2rem}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{padding:.35rem .6rem;border-bottom:1px solid #dde3ea;text-align:right;white-space:nowrap}
th:first-child,td:first-child,td.text,th.text{text-align:left}thead th{border-bottom:2px solid #1c2430}
.bar{display:inline-block;width:6rem;height:.7rem;background:#e6ebf1;vertical-align:middle;margin-right:.5rem}
.bar i{display:block;height:100%;background:#2f7d5b}.note{color:#5b6775}.warn{color:#a33}
code{font-size:.92em}.scroll{overflow-x:auto}
@media(prefers-color-scheme:dark){body{color:#e4e9ef;background:#14181d}th,td{border-color:#2c343d}
thead th{border-color:#e4e9ef}.bar{background:#2c343d}.note{color:#93a0ae}a{color:#7db7ff}}
"""


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


def read_config(folder: Path) -> dict[str, Any]:
    """Read a results folder's config.json.

    Raises:
        InputError: the folder holds no run.
    """
    return read_document(folder)


def in_plan_order(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Records by plan order; of two with the same index the later one in the journal counts."""
    latest = {record["index"]: record for record in records}
    return [latest[index] for index in sorted(latest)]


def load_run(folder: Path) -> RunRecord:
    """Read a results folder."""
    document = read_config(folder)
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
        cell["task"],
        cell["tracker"],
        cell["policy"],
        cell["mode"],
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
        suite["suite"],
        suite["tracker"],
        suite["policy"],
        suite["mode"],
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
    rows = [_HEAD, *_rows(results)]
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
        writer.writerow(cell | {"ci95_low": low, "ci95_high": high})
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


def _markdown(run: RunRecord, results: dict[str, Any]) -> str:
    lines = [f"# HumanoidArena results {results['config_hash']}", ""]
    lines += [f"> {note}" for note in notes(results)] + [""]
    lines += [table(results)]
    lines += [
        "SR is the success rate, ± the population standard deviation over group seeds (suite rows: over all task and",
        "seed rates pooled); the interval is Wilson's; AFR is falls per episode; falls at start happened while the",
        "tracker settled.",
        "",
        "## Configuration",
        "",
    ]
    lines += [f"- {key}: `{_plain(value)}`" for key, value in run.config.items()]
    lines += ["", f"## Rule set `{run.config['rules']}`", ""]
    lines += [f"- {key}: `{_plain(value)}`" for key, value in run.document["rule_set"].items()]
    media = _media(run)
    if media:
        lines += ["", "## Recordings", ""]
        lines += [f"- {title}: " + ", ".join(f"[{name}]({path})" for name, path in links) for title, links in media]
    return "\n".join(lines) + "\n"


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _media(run: RunRecord) -> list[tuple[str, list[tuple[str, str]]]]:
    found = []
    for record in run.records:
        links = sorted((record.get("media") or {}).items())
        if links:
            title = (
                f"{record['task']} {record['mode']} seed {record['group_seed']} repeat {record['repeat']}"
                f" ({record['outcome']})"
            )
            found.append((title, links))
    return found


def _html(run: RunRecord, results: dict[str, Any]) -> str:
    escape = html.escape
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        f"<title>HumanoidArena results {results['config_hash']}</title><style>{_STYLE}</style></head><body>",
        f"<h1>HumanoidArena results</h1><p class='note'>configuration <code>{results['config_hash']}</code>, "
        f"{results['finished']} of {results['planned']} episodes</p>",
    ]
    parts += [f"<p class='warn'>{escape(note)}</p>" for note in notes(results)]
    parts.append("<div class='scroll'><table><thead><tr>")
    parts += [f"<th{' class=text' if i < 4 else ''}>{escape(name)}</th>" for i, name in enumerate(_HEAD)]
    parts.append("</tr></thead><tbody>")
    entries = [(c["sr"], _cell_text(c)) for c in results["cells"]]
    entries += [(s["sr"], _suite_text(s)) for s in results["suites"]]
    for rate, row in entries:
        parts.append("<tr>")
        for i, text in enumerate(row):
            bar = f"<span class='bar'><i style='width:{100 * (rate or 0):.1f}%'></i></span>" if i == 5 else ""
            parts.append(f"<td{' class=text' if i < 4 else ''}>{bar}{escape(text)}</td>")
        parts.append("</tr>")
    parts.append("</tbody></table></div>")
    parts.append(
        "<p class='note'>SR: success rate ± population standard deviation over group seeds (suite rows: over all task "
        "and seed rates pooled). CI: Wilson. AFR: falls per episode. Falls at start happened while the tracker settled."
        "</p>"
    )
    sections = {"Configuration": run.config, f"Rule set {run.config['rules']}": run.document["rule_set"]}
    for title, content in sections.items():
        parts.append(f"<h2>{escape(title)}</h2><div class='scroll'><table><tbody>")
        parts += [
            f"<tr><td>{escape(key)}</td><td class='text'><code>{escape(_plain(value))}</code></td></tr>"
            for key, value in content.items()
        ]
        parts.append("</tbody></table></div>")
    media = _media(run)
    if media:
        parts.append("<h2>Recordings</h2><ul>")
        for title, links in media:
            anchors = ", ".join(f"<a href='{escape(path, quote=True)}'>{escape(name)}</a>" for name, path in links)
            parts.append(f"<li>{escape(title)}: {anchors}</li>")
        parts.append("</ul>")
    parts.append("</body></html>\n")
    return "".join(parts)


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
