"""The page of a study of placements: its grid, the slopes of one episode, or both, from what their folder holds."""

from __future__ import annotations

import csv
from pathlib import Path

from arena_newton.eval.records.journal import write_atomic
from arena_newton.eval.reports.html_report import FOLDER
from arena_newton.eval.studies.adjoint_slopes import HOLDS, KINDS, VOID
from arena_newton.files.stored_json import read_object
from arena_newton.pages.html import FILES, render

__all__ = ["write_page"]

PAGE = "sensitivity.html"
SHOWN = ("rules", "engine", "seed", "repeats", "max_steps", "fast_physics")
"""Flags that the page names."""
MOST_BYTES = 1 << 28


def write_page(folder: Path, title: str) -> Path:
    """Write the page of a folder and return its path; the same bytes for the same files.

    Args:
        folder: It holds sensitivity.json, slopes.json or both, with their tables and picture.
        title: Policy, tracker, task and mode.
    """
    found = {
        name: read_object(folder / f"{name}.json", MOST_BYTES)
        for name in ("slopes", "sensitivity")
        if (folder / f"{name}.json").exists()
    }
    flags = next(iter(found.values()))["flags"]
    content = render(
        FOLDER / "placements.html",
        styles=["report.css", "certify.css"],
        sources=FILES,
        title=title,
        facts=[(name.replace("_", " "), flags[name]) for name in SHOWN if flags.get(name) is not None],
        parts={name: {"summary": one["summary"], "rows": _rows(folder / f"{name}.csv")} for name, one in found.items()},
        classes={worth: _class(kind, worth) for worth, kind in KINDS.items()},
    )
    write_atomic(folder / PAGE, content)
    return folder / PAGE


def _class(kind: str, worth: str) -> str:
    if worth == HOLDS:
        return "pass"
    return "fail" if kind == KINDS[VOID] else "skip"


def _rows(path: Path) -> list[list[str]]:
    """Rows of a table, its head first."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))
