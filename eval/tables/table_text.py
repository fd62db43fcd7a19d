"""Tables of several evaluations as Markdown, LaTeX and CSV. What a results folder says stays text in each of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from arena_newton.eval.tables.table_entries import NO_RESULT, SuiteTable, TableEntry
from arena_newton.files.text import plain
from arena_newton.pages.tables import Table, escaped, latex_text

__all__ = ["as_csv", "as_latex", "as_markdown"]

PREAMBLE = r"""\documentclass{article}
\usepackage[T1]{fontenc}
\usepackage[utf8]{inputenc}
\usepackage[a3paper,landscape,margin=1.5cm]{geometry}
\usepackage{adjustbox}
\usepackage{booktabs}
\begin{document}
"""


def as_markdown(tables: Sequence[SuiteTable], notes: Sequence[str]) -> str:
    """All tables with their captions, and the notes at the end."""
    parts = ["# Results\n"]
    for table in tables:
        parts.append(f"## {table.title}\n")
        parts.append(f"{escaped(table.caption)}\n")
        parts.append(table.markdown())
    if notes:
        parts.append("## Notes\n")
        parts.append("".join(f"- {escaped(note)}\n" for note in notes))
    return "\n".join(parts)


def as_latex(tables: Sequence[SuiteTable], notes: Sequence[str]) -> str:
    """A document with all tables, by booktabs; each `table` environment can be copied into another one."""
    parts = [PREAMBLE]
    parts += [f"\\section*{{{latex_text(table.title)}}}\n{table.latex()}" for table in tables]
    if notes:
        items = "\n".join(rf"  \item {latex_text(note)}" for note in notes)
        parts.append("\\section*{Notes}\n\\begin{itemize}\n" + items + "\n\\end{itemize}\n")
    parts.append("\\end{document}\n")
    return "\n".join(parts)


def as_csv(tables: Sequence[SuiteTable], changed: bool = False) -> str:
    """One line per number, fields of `TableEntry`; fractions in [0, 1], empty where a number is undefined.

    Args:
        changed: Our episodes are no results of the benchmark, which their source says.
    """
    names = [field.name for field in dataclasses.fields(TableEntry)]
    entries = [entry for table in tables for entry in table.entries]
    if changed:
        entries = [dataclasses.replace(e, source=NO_RESULT) if e.source == "ours" else e for e in entries]
    return Table(names, [[_field(getattr(entry, name)) for name in names] for entry in entries]).csv()


def _field(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "1" if value else "0"
    if isinstance(value, float):
        return f"{value:.6g}"
    text = plain(value) if not isinstance(value, int) else str(value)
    # A spreadsheet must not take a name of a results folder as a formula.
    return f"'{text}" if isinstance(value, str) and text[:1] in ("=", "+", "-", "@") else text
