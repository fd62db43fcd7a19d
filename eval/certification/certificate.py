"""The certificate: what was found as text, JSON, Markdown and one page with its pictures inside.

A page begins with the verdict and the claims, in the order of a reader's questions; the evidence follows.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypedDict

from arena_newton.eval.certification.claims import CLAIMS, ClaimFinding, claimed, verdict_of
from arena_newton.eval.certification.finding import Check, CheckFinding, Picture
from arena_newton.eval.records.journal import write_atomic
from arena_newton.eval.reports.html_report import FOLDER
from arena_newton.files.stored_json import JsonObject
from arena_newton.files.text import counted
from arena_newton.pages.html import EMBEDDED, render
from arena_newton.pages.tables import Table, escaped

__all__ = ["FILE", "Facts", "document", "html", "markdown", "printed", "write"]

FILE = "certify.json"
FEW = 20
"""Number of episodes below which a cell is marked as having few."""
PAGE = 250
"""Lines of a page of evidence, at most."""
MEANING = {
    "pass": "holds",
    "fail": "does not hold",
    "note": "holds with what the notes say",
    "skip": "was not measured",
}
"""Verdict → what it says."""


class Facts(TypedDict):
    """Facts about the certified benchmark."""

    tasks: list[str]
    without_expert: list[str]
    """Tasks that no check could play."""
    trackers: list[str]
    episodes: int
    """Episodes of each cell."""
    quick: bool
    engine: str
    device: str
    code: str
    """Hash of the code that moves and judges."""
    planned: list[str]
    """Checks that were asked for; those that have not run yet are in no table."""
    command: str
    """The command line that makes this certificate."""
    cores: int
    """Cores of the CPU that this process may use."""
    versions: JsonObject


def write(folder: Path, facts: Facts, findings: Mapping[Check, CheckFinding]) -> None:
    """Write certify.json, certify.html, certify.md and its pages of evidence into a folder.

    Args:
        folder: The certification's.
    """
    write_atomic(folder / FILE, json.dumps(document(folder, facts, findings), indent=2) + "\n")
    for name, page in markdown(facts, findings).items():
        write_atomic(folder / name, page)
    write_atomic(folder / "certify.html", html(facts, findings))


def document(folder: Path, facts: Facts, findings: Mapping[Check, CheckFinding]) -> JsonObject:
    """The certificate as JSON; pictures by their path in the folder."""

    def entry(check: Check, finding: CheckFinding) -> JsonObject:
        return {
            "question": check.question,
            "verdict": finding.verdict,
            "summary": finding.summary,
            "tables": [_sheet(sheet) for sheet in finding.sheets],
            "notes": list(finding.notes),
            "pictures": [
                {"caption": picture.caption, "path": picture.path.relative_to(folder).as_posix()}
                for picture in finding.pictures
            ],
        }

    failed = [check.name for check, finding in findings.items() if finding.verdict == "fail"]
    complete = len(findings) == len(facts["planned"])
    certified: JsonObject = json.loads(json.dumps(facts))
    checks: JsonObject = {check.name: entry(check, finding) for check, finding in findings.items()}
    return {
        "verdict": verdict_of(findings, len(facts["planned"])),
        "claims": [
            {"claim": one.text, "verdict": one.verdict, "checks": [check.name for check, _ in one.findings]}
            for one in claimed(findings)
        ],
        "certified": certified,
        "complete": complete,
        "failed": list(failed),
        "checks": checks,
    }


def _sheet(sheet: Table) -> JsonObject:
    return {"title": sheet.title, "head": list(sheet.head), "rows": [list(map(str, row)) for row in sheet.rows]}


def _described(facts: Facts) -> list[tuple[str, str]]:
    """The facts as name and text."""
    lines = [
        ("made by", facts["command"]),
        ("tasks", " ".join(facts["tasks"])),
        ("policies", "the tasks' experts, privileged: they read the world itself"),
        ("trackers", " ".join(facts["trackers"])),
        ("episodes of each cell", str(facts["episodes"])),
        ("engine", f"{facts['engine']} on {facts['device']}, {counted(facts['cores'], 'CPU core')}"),
        ("arena-newton", f"{facts['versions'].get('arena-newton')}, code {facts['code']}"),
    ]
    if facts["without_expert"]:
        lines.insert(2, ("without an expert, not checked", " ".join(facts["without_expert"])))
    return lines


def _warnings(facts: Facts) -> list[str]:
    """Limits of the certificate as a whole."""
    found = []
    if facts["quick"]:
        found.append(f"--quick: {facts['episodes']} episodes of each cell, so the intervals are wide.")
    elif facts["episodes"] < FEW:
        found.append(f"{counted(facts['episodes'], 'episode')} of each cell, so the intervals are wide.")
    absent = [name for claim in CLAIMS for name in claim.checks if name not in facts["planned"]]
    if absent:
        found.append(f"Checks that were not asked for: {' '.join(absent)}.")
    return found


def _measured(one: ClaimFinding) -> list[tuple[str, str]]:
    """Names of a claim's checks, with what each measured."""
    skipped = {"skip": "not measured: "}
    return [(check.name, f"{skipped.get(finding.verdict, '')}{finding.summary}") for check, finding in one.findings]


def printed(facts: Facts, findings: Mapping[Check, CheckFinding]) -> str:
    """The first page as text for a terminal: the verdict, then every claim with what was measured."""
    lines = [verdict_of(findings, len(facts["planned"])), ""]
    for one in claimed(findings):
        lines.append(f"{one.verdict:<4}  {one.text}")
        lines += [f"      {name}: {text}" for name, text in _measured(one)]
    return "\n".join([*lines, "", *_warnings(facts)]).rstrip()


def markdown(facts: Facts, findings: Mapping[Check, CheckFinding]) -> dict[str, str]:
    """The certificate as Markdown, without pictures.

    Returns:
        File name → page: `certify.md` with the claims, and the evidence in pages of at most `PAGE` lines, longer only
        where that of one check is.
    """
    claims, rows = claimed(findings), []
    pages: list[list[str]] = []
    for one in claims:
        measured = []
        for (check, finding), (name, text) in zip(one.findings, _measured(one), strict=True):
            section = _section(check, finding)
            if not pages or len(pages[-1]) + len(section) > PAGE:
                pages.append([f"# Certificate: evidence, page {len(pages) + 1}", "", "[All claims](certify.md)"])
            pages[-1] += section
            measured.append(f"[{name}](certify_{len(pages)}.md#{name}-{finding.verdict}): {escaped(text)}")
        rows.append((escaped(one.text), one.verdict, "<br>".join(measured)))
    lines = ["# Certificate", "", f"**{escaped(verdict_of(findings, len(facts['planned'])))}**", ""]
    lines += [line for text in _warnings(facts) for line in (f"> {escaped(text)}", "")]
    lines += Table(("claim", "verdict", "measured"), rows).compact()
    lines += ["", "; ".join(f"{verdict}: {meaning}" for verdict, meaning in MEANING.items()) + ".", ""]
    lines += ["## What was certified", ""]
    lines += [f"- {name}: {escaped(text)}" for name, text in _described(facts)]
    written = {"certify.md": lines} | {f"certify_{number}.md": page for number, page in enumerate(pages, start=1)}
    return {name: "\n".join(page).rstrip() + "\n" for name, page in written.items()}


def _section(check: Check, finding: CheckFinding) -> list[str]:
    """A check's question, finding, tables and notes as lines of Markdown."""
    lines = ["", f"## {check.name}: {finding.verdict}", "", check.question, "", escaped(finding.summary)]
    for sheet in finding.sheets:
        lines += ["", f"{escaped(sheet.title)}:", "", *_joined(sheet).compact(escaped)]
    return lines + ([""] if finding.notes else []) + [f"- {escaped(note)}" for note in finding.notes]


def _joined(sheet: Table) -> Table:
    """A table whose rows that differ in task, tracker or rule set alone are one."""
    rows = [tuple(map(str, row)) for row in sheet.rows]
    for column in (number for number, name in enumerate(sheet.head) if name in ("task", "tracker", "rules")):
        alike: dict[tuple[str, ...], list[str]] = {}
        for row in rows:
            alike.setdefault(row[:column] + row[column + 1 :], []).append(row[column])
        rows = [(*key[:column], ", ".join(names), *key[column:]) for key, names in alike.items()]
    return replace(sheet, rows=rows)


def html(facts: Facts, findings: Mapping[Check, CheckFinding]) -> str:
    """The certificate as one page that needs no other file."""
    claims = claimed(findings)
    return render(
        FOLDER / "certify.html",
        styles=["report.css", "certify.css"],
        sources=EMBEDDED,
        verdict=verdict_of(findings, len(facts["planned"])),
        claims=[{"text": one.text, "verdict": one.verdict, "measured": _measured(one)} for one in claims],
        facts=_described(facts),
        warnings=_warnings(facts),
        meaning=MEANING,
        versions=facts["versions"].items(),
        checks=[
            {
                "name": check.name,
                "question": check.question,
                "finding": finding,
                "pictures": [(picture.caption, _embedded(picture)) for picture in finding.pictures],
            }
            for one in claims
            for check, finding in one.findings
        ],
    )


def _embedded(picture: Picture) -> str:
    """A picture's file as an address that holds it."""
    kind = {".jpg": "jpeg", ".png": "png"}[picture.path.suffix]
    return f"data:image/{kind};base64,{base64.b64encode(picture.path.read_bytes()).decode()}"
