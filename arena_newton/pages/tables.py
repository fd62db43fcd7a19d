"""Tables of texts as Markdown, LaTeX and CSV, and figures as their cells. Text of others stays text in each."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from arena_newton.files.text import plain

__all__ = ["Table", "between", "csv_lines", "escaped", "latex_text", "percent", "points"]

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


def escaped(text: object) -> str:
    """Text of a file as Markdown that stays text, also where a backslash does not keep a tag shut."""
    shown = re.sub(r"([\\`*\[\]>|])", r"\\\1", re.sub(r"&(?=#?\w+;)", "&amp;", plain(text)))
    return re.sub(r"<(?=[A-Za-z/!?]|$)", "&lt;", shown)


def latex_text(text: object) -> str:
    """Text as LaTeX that stays text; characters beyond its standard fonts become a question mark."""
    shown = (LATEX.get(c, c if c.isascii() and c.isprintable() else "?") for c in plain(text))
    return "".join(shown)


def percent(value: float | None, digits: int = 1) -> str:
    """A fraction in per cent without the sign, such as `45.0`; `-` without one."""
    return "-" if value is None else f"{100 * value:.{digits}f}"


def between(ends: Sequence[float] | None, digits: int = 0) -> str:
    """An interval of fractions in per cent, such as `33 to 58`; `-` without one."""
    return "-" if ends is None else " to ".join(percent(end, digits) for end in ends)


def points(value: float) -> str:
    """A difference of fractions in percentage points, such as `−4.2`."""
    text = f"{100 * value:+.1f}"
    return "0.0" if text in ("+0.0", "-0.0") else text.replace("-", "−")


def csv_lines(rows: Iterable[Sequence[object]], end: str = "\n") -> str:
    """Lines of CSV with this end; cells as they are, None empty."""
    out = io.StringIO(newline="")
    csv.writer(out, lineterminator=end).writerows(rows)
    return out.getvalue()


@dataclass(frozen=True)
class Table:
    """Rows of cells under a head."""

    head: Sequence[str]
    rows: Sequence[Sequence[object]]
    align: str = "l"
    """`l` or `r` of each column, flush left or right; the last one holds for all that follow."""
    title: str = ""
    caption: str = ""
    name: str = ""
    """Name of its files."""
    groups: Sequence[int] = ()
    """Numbers of the rows that begin a group; LaTeX draws a rule above them."""

    @property
    def columns(self) -> str:
        """`l` or `r` of every column."""
        return self.align.ljust(len(self.head), self.align[-1])[: len(self.head)]

    def markdown(self) -> str:
        """Markdown with columns of even width; cells are texts and stay so."""
        lines = [list(self.head), *([escaped(text) for text in row] for row in self.rows)]
        widths = [max(len(line[column]) for line in lines) for column in range(len(self.head))]
        sides = list(zip(widths, self.columns, strict=True))
        rule = "|".join("-" * (w + 2) if side == "l" else "-" * (w + 1) + ":" for w, side in sides)
        padded = [
            [c.ljust(w) if side == "l" else c.rjust(w) for c, (w, side) in zip(line, sides, strict=True)]
            for line in lines
        ]
        first, *others = (f"| {' | '.join(cells)} |\n" for cells in padded)
        return "".join([first, f"|{rule}|\n", *others])

    def compact(self, cell: Callable[[object], str] = str, rule: tuple[str, str] = ("---", "--:")) -> list[str]:
        """Lines of Markdown with columns as wide as their cells.

        Args:
            cell: Makes Markdown of a cell; by default cells are Markdown.
            rule: Marks under the head of a column that is flush left or right.
        """
        head = "".join(f" {cell(name)} |" if name else " |" for name in self.head)
        marks = "|".join(rule[side == "r"] for side in self.columns)
        return [f"|{head}", f"|{marks}|", *(f"| {' | '.join(map(cell, row))} |" for row in self.rows)]

    def latex(self) -> str:
        """A `table` environment, by booktabs and adjustbox; cells are texts and stay so."""

        def line(cells: Sequence[object]) -> str:
            return "  " + " & ".join(map(latex_text, cells)) + r" \\"

        lines = [r"\begin{table}[p]", r"  \centering", rf"  \caption{{{latex_text(self.caption)}}}"]
        lines += [rf"  \label{{table:{re.sub('[^a-z0-9]', '-', self.name)}}}"]
        lines += [r"  \begin{adjustbox}{max width=\textwidth}", rf"  \begin{{tabular}}{{{self.columns}}}"]
        lines += [r"  \toprule", line(self.head)]
        for number, row in enumerate(self.rows):
            lines += [r"  \midrule", line(row)] if number in self.groups or number == 0 else [line(row)]
        lines += [r"  \bottomrule", r"  \end{tabular}", r"  \end{adjustbox}", r"\end{table}", r"\clearpage", ""]
        return "\n".join(lines)

    def csv(self) -> str:
        """CSV with a head; cells as they are, None empty."""
        return csv_lines([self.head, *self.rows])
