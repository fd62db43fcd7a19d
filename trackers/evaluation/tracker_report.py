"""Tables of an evaluation: figures with bars, groups, cells; as Markdown, JSON and CSV."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arena_newton.cli.intervals import wilson
from arena_newton.pages.tables import Table, csv_lines
from arena_newton.trackers.evaluation.figures import Figure, Result, figures

__all__ = ["COLUMNS", "cell_rows", "document", "figure_table", "markdown", "write"]

COLUMNS: dict[str, tuple[str, str]] = {
    "joint_rmse": ("joint RMSE [rad]", ".3f"),
    "leg_rmse": ("legs", ".3f"),
    "arm_rmse": ("arms", ".3f"),
    "mpjpe": ("MPJPE [m]", ".3f"),
    "velocity_error": ("root velocity error [m/s]", ".3f"),
    "height_error": ("root height error [m]", ".3f"),
    "drift_10s": ("drift per 10 s [m]", ".2f"),
    "heading_error": ("heading error [deg]", ".1f"),
    "foot_slip": ("foot slip [m/s]", ".3f"),
    "action_rate": ("action rate [rad/s]", ".2f"),
    "torque": ("torque [of limit]", ".3f"),
}
"""Measures of the printed tables: heading and format; JSON and CSV hold all of them."""
PUSH_COLUMNS: dict[str, tuple[str, str]] = {
    "survival": ("survival [s]", ".1f"),
    "recovery": ("recovery [s]", ".2f"),
    "recovered": ("recovered", ".0%"),
}
"""Further measures, in tables of cells that have them."""
RULE = (" --- ", " --: ")
"""Marks under the heads of the tables."""


def _means(result: Result, rows: np.ndarray) -> dict[str, float | None]:
    measured = {name: values[rows].astype(float) for name, values in result.outcome.measures.items() if name != "fell"}
    finite = {name: values[np.isfinite(values)] for name, values in measured.items()}
    return {name: float(values.mean()) if len(values) else None for name, values in finite.items()}


def _entry(result: Result, name: str, group: str, rows: np.ndarray) -> dict[str, Any]:
    fell, count = int(result.outcome.measures["fell"][rows].sum()), int(rows.sum())
    low, high = wilson(fell, count)
    return {
        "tracker": result.label,
        "cell": name,
        "group": group,
        "rollouts": count,
        "falls": fell,
        "fall_rate": fell / count,
        "fall_rate_low": low,
        "fall_rate_high": high,
        **_means(result, rows),
    }


def cell_rows(result: Result) -> list[dict[str, Any]]:
    """Falls and means of every cell."""
    return [_entry(result, cell.name, cell.group, result.plan.cell == i) for i, cell in enumerate(result.plan.cells)]


def group_rows(result: Result) -> list[dict[str, Any]]:
    """Falls and means of every group and of the whole suite."""
    groups = dict.fromkeys(cell.group for cell in result.plan.cells)
    rows = [_entry(result, "", group, result.rows(group)) for group in groups]
    return [*rows, _entry(result, "", "all", result.rows())]


def document(results: Sequence[Result], options: dict[str, Any]) -> dict[str, Any]:
    """Content of the JSON file."""
    return {
        "options": options,
        "trackers": [
            {
                "label": r.label,
                **r.tracker,
                "figures": [
                    {"name": f.name, "value": f.value, "bar": f.bar, "verdict": f.verdict} for f in figures(r, results)
                ],
                "groups": group_rows(r),
                "cells": cell_rows(r),
                "inference_ms": r.inference,
                "overflows": r.outcome.overflows,
                "ticks": r.outcome.ticks,
                "rollout_physics": {"dt": r.outcome.rate.dt, "substeps": r.outcome.rate.substeps},
                "setup_s": r.outcome.setup_s,
                "rollout_s": r.outcome.rollout_s,
            }
            for r in results
        ],
    }


def figure_table(results: Sequence[Result]) -> str:
    """Figures of all trackers, one column each, Markdown."""
    columns = [{f.name: f for f in figures(r, results)} for r in results]
    names = list(dict.fromkeys(name for column in columns for name in column))
    rows = []
    for name in names:
        found = [column.get(name) for column in columns]
        bars = list(dict.fromkeys(f.bar for f in found if f is not None and f.bar))
        rows.append((name, " / ".join(bars), *map(_shown, found)))
    return "\n".join(Table(("figure", "bar", *(r.label for r in results)), rows).compact(rule=RULE))


def _shown(figure: Figure | None) -> str:
    if figure is None:
        return "–"
    return f"{figure.value} **{figure.verdict}**" if figure.verdict else figure.value


def _table(entries: Sequence[dict[str, Any]], key: str) -> str:
    struck = any("survival" in entry for entry in entries)
    columns, rows = (PUSH_COLUMNS if struck else {}) | COLUMNS, []
    for entry in entries:
        numbers = [
            "–" if entry.get(name) is None else format(entry[name], pattern) for name, (_, pattern) in columns.items()
        ]
        interval = f"[{100 * entry['fall_rate_low']:.1f}, {100 * entry['fall_rate_high']:.1f}] %"
        rows.append((entry[key], entry["tracker"], f"{entry['falls']}/{entry['rollouts']}", interval, *numbers))
    head = (key, "tracker", "falls", "[95 %]", *(title for title, _ in columns.values()))
    return "\n".join(Table(head, rows).compact(rule=RULE))


def _interleaved(tables: Sequence[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Rows of all trackers, the same row of each next to one another."""
    return [entry for rows in zip(*tables, strict=True) for entry in rows]


def markdown(results: Sequence[Result], options: dict[str, Any]) -> str:
    """The report."""
    shown = ", ".join(f"{name} {value}" for name, value in options.items() if value not in (None, "", []))
    worlds = len(results[0].plan.cell)
    parts = [
        "# Tracker evaluation",
        f"{shown}; {len(results[0].plan.cells)} cells, {worlds} rollouts a tracker.",
        "## Figures",
        figure_table(results),
        "## Groups",
        _table(_interleaved([group_rows(r) for r in results]), "group"),
        "## Cells",
        _table(_interleaved([cell_rows(r) for r in results]), "cell"),
        "## Trackers",
        "\n".join(
            f"- **{r.label}**: checkpoint {r.tracker['checkpoint_hash']}, drive {r.tracker['drive']}, physics "
            f"{1000 * r.outcome.rate.dt:g} ms x {r.outcome.rate.substeps}; does not see: "
            f"{', '.join(r.tracker['ignores']) or 'nothing is ignored'}; {r.outcome.ticks} ticks in "
            f"{r.outcome.rollout_s:.1f} s (set-up {r.outcome.setup_s:.1f} s), contact buffers overflowed in "
            f"{r.outcome.overflows} worlds"
            for r in results
        ),
    ]
    return "\n\n".join(parts) + "\n"


def write(results: Sequence[Result], options: dict[str, Any], out: Path) -> list[Path]:
    """Write `evaluation.md`, `evaluation.json` and `evaluation.csv` (one row per tracker and cell) into `out`."""
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / f"evaluation.{kind}" for kind in ("md", "json", "csv")]
    paths[0].write_text(markdown(results, options), encoding="utf-8")
    paths[1].write_text(json.dumps(document(results, options), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    entries = [entry for result in results for entry in cell_rows(result)]
    names = list(dict.fromkeys(name for entry in entries for name in entry))
    rows = [[entry.get(name, "") for name in names] for entry in entries]
    paths[2].write_text(csv_lines([names, *rows], "\r\n"), encoding="utf-8", newline="")
    return paths
