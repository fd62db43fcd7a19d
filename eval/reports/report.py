"""Tables and reports of a run, derived from its configuration and journal alone; no wall-clock time enters them."""

from __future__ import annotations

import json
from collections.abc import Sequence

from arena_newton.eval.folders.original_format import ORIGINAL, original_files, write_original
from arena_newton.eval.folders.results import Results, RunRecord, changed_conditions, results_json, width_rule
from arena_newton.eval.plan.rounds import LOOK_EVERY
from arena_newton.eval.records.identity import report_hash
from arena_newton.eval.records.journal import write_atomic
from arena_newton.eval.reports import html_report
from arena_newton.eval.reports.failure_text import failures_markdown
from arena_newton.eval.reports.wording import environment_facts, media_of, rules_that_ran, tasks_of
from arena_newton.eval.statistics.stats import ResultCell, Suite, error_reasons, outside_suites
from arena_newton.files.text import counted, plain
from arena_newton.pages.tables import Table, between, escaped, percent
from arena_newton.robot.g1 import TICK
from arena_newton.tasks.semantic_mode import semantic_notes

__all__ = ["derived_files", "metrics", "notes", "original_of", "table", "write_reports"]

_COLUMNS = """task tracker policy mode episodes successes falls startup_falls timeouts errors
    sr sr_seed_std ci95_low ci95_high afr mean_steps""".split()


def _cell_text(cell: ResultCell) -> list[str]:
    running = cell["falls"] - cell["startup_falls"]
    return [
        *map(plain, (cell["task"], cell["tracker"], cell["policy"], cell["mode"])),
        str(cell["episodes"]),
        f"{percent(cell['sr'])} ± {percent(cell['sr_seed_std'])}",
        between(cell["ci95"], 1),
        percent(cell["afr"]),
        f"{running} + {cell['startup_falls']}",
        str(cell["timeouts"]),
        str(cell["errors"]),
        "-" if cell["mean_steps"] is None else f"{cell['mean_steps']:.1f}",
    ]


_HEAD = ["task", "tracker", "policy", "mode", "n", "SR % ± seed std", "95 % CI", "AFR %"]
METRICS = ["task", "tracker", "policy", "mode", "metric", "n", "mean ± std", "range"]
_HEAD += ["falls running + at start", "timeouts", "errors", "mean steps"]


def _suite_text(suite: Suite) -> list[str]:
    return [
        *map(plain, (suite["suite"], suite["tracker"], suite["policy"], suite["mode"])),
        str(suite["episodes"]),
        f"{percent(suite['sr'])} ± {percent(suite['sr_std'])}",
        "",
        percent(suite["afr"]),
        str(suite["falls"]),
        "",
        str(suite["errors"]),
        "",
    ]


def _rows(results: Results) -> list[list[str]]:
    return [*map(_cell_text, results["cells"]), *map(_suite_text, results["suites"])]


def table(results: Results) -> str:
    """The result table as Markdown with aligned columns; it is also what the command line prints."""
    return Table(_HEAD, _rows(results), "llllr").markdown() + metrics(results["cells"])


def metrics(cells: Sequence[ResultCell]) -> str:
    """Table of recorders' metrics as Markdown below an empty line; an empty text where there are none."""
    rows = [
        [*map(plain, (cell["task"], cell["tracker"], cell["policy"], cell["mode"], name)), str(found["episodes"])]
        + [f"{found['mean']:.4g} ± {found['std']:.4g}", f"{found['least']:.4g} to {found['most']:.4g}"]
        for cell in cells
        for name, found in cell.get("extra", {}).items()
    ]
    return "\n" + Table(METRICS, rows, "lllllr").markdown() if rows else ""


def table_csv(results: Results) -> str:
    """The cells as CSV, rates as fractions."""
    rows = []
    for cell in results["cells"]:
        low, high = cell["ci95"] or (None, None)
        row = dict(cell) | {"ci95_low": low, "ci95_high": high}
        rows.append([plain(value) if isinstance(value := row.get(name), str) else value for name in _COLUMNS])
    return Table(_COLUMNS, rows).csv()


_STATES = {
    "started": "The run has not ended: it is going on, or it was killed.",
    "cancelled": "The run was cancelled.",
    "error": "The run ended with an error",
    "partial": "Joined from shards of which some were missing or unfinished.",
}


def notes(run: RunRecord, results: Results) -> list[str]:
    """Notes for a reader of the table."""
    found = []
    if run.status is not None and run.status["state"] != "success":
        found.append(_STATES[run.status["state"]] + (f": {run.status['error']}" if run.status["error"] else ""))
    if "shard" in results:
        plan = counted(run.document["planned"], "episode")
        found.append(f"Shard {results['shard']} of a plan of {plan}: no result before all are merged.")
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
    found += semantic_notes(cell["mode"] for cell in results["cells"])
    if "seed_range" in results["config"]:
        noise = " and disturbed execution" if results["config"].get("disturbance") else ""
        found.append(f"Demonstrations with seeds of their own range{noise}: no benchmark result.")
    rule = width_rule(results["config"])
    if rule is not None:
        found.append(
            f"Said before the first episode: a row ends when its interval is at most {100 * rule.width:g} points "
            f"wide, looked at every {LOOK_EVERY} episodes, or after {rule.most}."
        )
    late, replan = results["config"].get("latency_ticks", 0), results["config"].get("replan")
    if late:
        found.append(f"Each chunk starts {counted(late, 'tick')} ({1000 * late * TICK:g} ms) after the policy's query.")
    if replan:
        found.append(f"The policy is queried again after {counted(replan, 'action')} of each chunk.")
    if results["config"].get("ensemble"):
        found.append("At each tick the mean of all chunks that cover it is executed.")
    found += changed_conditions(run)
    return found + ([f"Head of the journal: {results['head']}"] if "head" in results else [])


def _code(text: object) -> str:
    """The same as code."""
    return f"`{plain(text).replace('`', "'")}`"


def _markdown(run: RunRecord, results: Results) -> str:
    lines = [f"# HumanoidArena results {escaped(results['config_hash'])}", ""]
    lines += [f"> {escaped(note)}" for note in notes(run, results)]
    lines += [f"> The scene is a variant: {escaped(text)}" for text in run.document.get("variant_changes", [])]
    lines += ["", table(results)]
    lines += [
        "SR is the success rate, ± the population standard deviation over group seeds (suite rows: over all task and",
        "seed rates pooled); the interval is Wilson's; AFR is falls per episode; falls at start are those",
        "of the start-up.",
        "",
    ]
    lines += failures_markdown(results.get("failures", []))
    reasons = error_reasons(run.records)
    if reasons:
        rows = [(r["reason"], r["message"], r["count"]) for r in reasons]
        errors = Table(("reason", "message", "episodes"), rows, "llr")
        lines += ["## Errors", "", *errors.compact(escaped, ("---", "---:"))]
        lines += ["", "Run them again, in this folder: `python -m arena_newton.eval resume . --retry-errors`", ""]
    strips = [(r, media_of(r)) for r in run.records if media_of(r)]
    if strips:
        lines += ["## Recordings", ""]
        strips.sort(key=lambda entry: entry[0].outcome == "success")
        lines += [
            f"- {escaped(r.task)} {escaped(r.mode)} seed {escaped(r.group_seed)} repeat "
            f"{escaped(r.repeat)} ({escaped(r.outcome)}): "
            + ", ".join(f"[{name}]({path})" for name, path in media.items())
            for r, media in strips
        ]
        lines += [""]
    for name, facts in run.document.get("environments", {}).items():
        lines += [f"## What ran: {escaped(name)}", ""]
        lines += [f"- {escaped(key)}: {_code(value)}" for key, value in environment_facts(facts)] + [""]
    lines += ["## Configuration", ""]
    lines += [f"- {escaped(key)}: {_code(value)}" for key, value in run.config.items()]
    tasks = tasks_of(run.config, run.records)
    lines += ["", f"## Rule set {_code(run.config['rules'])}", ""]
    lines += [f"- {escaped(item)}: {_code(text)}" for item, text in rules_that_ran(run.document["rule_set"], tasks)]
    return "\n".join(lines) + "\n"


def _html(run: RunRecord, results: Results) -> str:
    reasons = error_reasons(run.records)
    measured, rows = metrics(results["cells"]).lstrip(), _rows(results)
    found = notes(run, results)
    return html_report.page(run, results, notes=found, head=_HEAD, rows=rows, reasons=reasons, metrics=measured)


def write_reports(run: RunRecord) -> Results:
    """Write the derived files of a run into its folder.

    Returns:
        The content of results.json.
    """
    results = results_json(run)
    for name, text in derived_files(run, results).items():
        write_atomic(run.folder / name, text)
    write_original(run.folder / ORIGINAL, original_of(run))
    return results


def derived_files(run: RunRecord, results: Results) -> dict[str, str]:
    """Texts of results.json, which names the code that wrote them, table.md, table.csv, report.md and report.html."""
    return {
        "results.json": json.dumps(results | {"written_by": report_hash()}, indent=2) + "\n",
        "table.md": table(results) + (f"\nHead of the journal: {results['head']}\n" if "head" in results else ""),
        "table.csv": table_csv(results),
        "report.md": _markdown(run, results),
        "report.html": _html(run, results),
    }


def original_of(run: RunRecord) -> dict[str, str]:
    """Texts of the original's files of a run, by path below `original/`; none of demonstrations."""
    if "seed_range" in run.config:
        return {}
    config = run.config
    return original_files(run.records, run.document["gym_ids"], config["seeds"], config["repeats"])
