"""Tables of several evaluations as Markdown, LaTeX and CSV. What a results folder says stays text in each of them."""

from __future__ import annotations

import csv
import dataclasses
import io
import re
from collections.abc import Sequence

from arena_newton.eval.reports.wording import escaped, markdown_table, plain
from arena_newton.eval.tables.table_entries import SuiteTable, TableEntry

__all__ = ["as_csv", "as_latex", "as_markdown", "latex_text"]

LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "%": r"\%",
    "&": r"\&",
    "_": r"\_",
    "#": r"\#",
    "$": r"\$",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"$<$",
    ">": r"$>$",
    "|": r"$|$",
    '"': r"''",
    "±": r"$\pm$",
    "−": r"$-$",
    "→": r"$\to$",
    "×": r"$\times$",
    "Δ": r"$\Delta$",
    "π": r"$\pi$",
    "—": "---",
    "–": "--",
    "…": r"\dots{}",
}
"""Characters that LaTeX reads otherwise, or that its standard fonts lack → what shows them."""
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
        parts.append(markdown_table(table.head, table.rows, table.left))
    if notes:
        parts.append("## Notes\n")
        parts.append("".join(f"- {escaped(note)}\n" for note in notes))
    return "\n".join(parts)


def latex_text(text: str) -> str:
    """Text as LaTeX that stays text; characters beyond its standard fonts become a question mark."""
    shown = (LATEX.get(c, c if c.isascii() and c.isprintable() else "?") for c in plain(text))
    return "".join(shown)


def as_latex(tables: Sequence[SuiteTable], notes: Sequence[str]) -> str:
    """A document with all tables, by booktabs; each `table` environment can be copied into another one."""
    parts = [PREAMBLE]
    for table in tables:
        columns = "l" * table.left + "r" * (len(table.head) - table.left)
        head = " & ".join(latex_text(text) for text in table.head)
        lines = [r"\begin{table}[p]", r"  \centering", rf"  \caption{{{latex_text(table.caption)}}}"]
        lines += [rf"  \label{{table:{re.sub('[^a-z0-9]', '-', table.name)}}}"]
        lines += [r"  \begin{adjustbox}{max width=\textwidth}", rf"  \begin{{tabular}}{{{columns}}}", r"  \toprule"]
        lines += [rf"  {head} \\"]
        for number, row in enumerate(table.rows):
            lines += [r"  \midrule"] if number in table.groups or number == 0 else []
            lines += ["  " + " & ".join(latex_text(text) for text in row) + r" \\"]
        lines += [r"  \bottomrule", r"  \end{tabular}", r"  \end{adjustbox}", r"\end{table}", r"\clearpage", ""]
        parts.append(f"\\section*{{{latex_text(table.title)}}}\n" + "\n".join(lines))
    if notes:
        items = "\n".join(rf"  \item {latex_text(note)}" for note in notes)
        parts.append("\\section*{Notes}\n\\begin{itemize}\n" + items + "\n\\end{itemize}\n")
    parts.append("\\end{document}\n")
    return "\n".join(parts)


def as_csv(tables: Sequence[SuiteTable]) -> str:
    """One line per number, fields of `TableEntry`; fractions in [0, 1], empty where a number is undefined."""
    out = io.StringIO(newline="")
    names = [field.name for field in dataclasses.fields(TableEntry)]
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    for table in tables:
        for entry in table.entries:
            writer.writerow([_field(getattr(entry, name)) for name in names])
    return out.getvalue()


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
