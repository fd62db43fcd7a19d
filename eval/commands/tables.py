"""`python -m arena_newton.eval tables` and `reproductions`: the paper's tables and numbers next to ours, as files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.cli.extras import require
from arena_newton.cli.flags import Several, shell_command, user_path
from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.eval.tables.evaluated_cells import CellSet

__all__ = ["BEGIN", "END", "ReproductionsOptions", "TablesOptions", "reproductions", "run"]

FORMATS = ("md", "tex", "csv", "png")
"""Forms in which tables are written."""
BEGIN, END = "<!-- findings: written by eval tables --findings -->", "<!-- end of findings -->"
"""Lines of a README.md between which the table of findings is written."""


@dataclass(frozen=True)
class TablesOptions:
    """Write the paper's tables filled with the episodes of suites and results folders, next to the paper's numbers."""

    out: str = "tables"
    """Folder to write: tables.md, tables.tex, cells.csv and one picture per table that has one."""
    format: Several[str] = FORMATS
    """Forms to write, one or several: md tex csv png (png needs the extra [plots])."""
    rules: str = "paper"
    """Rule set whose episodes count: paper or released."""
    findings: bool = False
    """Also test the paper's claims on these trainings: print them and write findings.md, and the table of findings
    between its marks in a README.md of the folder; of files cells.csv nothing else is made."""


def run(folders: Sequence[Path], options: TablesOptions) -> int:
    """Write the tables of all folders, and print where they are and what must be known besides them.

    Raises:
        InputError: A folder is unfit, or a flag.
        StorageError: A file cannot be written.
    """
    from arena_newton import rule_sets
    from arena_newton.eval.records.journal import StorageError, write_atomic
    from arena_newton.eval.tables import findings_text, paper_claims, table_text
    from arena_newton.eval.tables.evaluated_cells import read_cells
    from arena_newton.eval.tables.paper_numbers import paper_numbers
    from arena_newton.eval.tables.suite_tables import suite_tables

    unknown = [name for name in options.format if name not in FORMATS]
    if unknown or not options.format:
        raise InputError(f"--format {' '.join(unknown)}: known are {' '.join(FORMATS)}")
    rule_sets.get(options.rules)
    if "png" in options.format:
        require("plots", "eval tables --format png", ("matplotlib",))
    cells = read_cells(folders, options.rules)
    paper = paper_numbers()
    if options.findings and cells.changed:
        raise InputError(f"--findings: {' '.join(cells.changed)} No claim of the paper can be tested on it")
    tables = suite_tables(cells.cells, paper, cells.changed)
    if not tables and not options.findings:
        why = "policies through another tracker than that of their training, or with late chunks, alone"
        if not any(cell.records for cell in cells.cells):
            why = "counts alone, of which --findings can be made"
        raise InputError(f"{folders[0]}: holds no cell of any table ({why})")
    out = user_path(options.out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"--out {out}: cannot be made ({error.strerror})") from None
    written = []
    for form, name, text in (
        ("md", "tables.md", table_text.as_markdown(tables, cells.notes)),
        ("tex", "tables.tex", table_text.as_latex(tables, cells.notes)),
        ("csv", "cells.csv", table_text.as_csv(tables, bool(cells.changed))),
    ):
        if form in options.format and tables:
            write_atomic(out / name, text)
            written.append(name)
    if "png" in options.format and tables:
        from arena_newton.eval.tables import suite_figures

        written += suite_figures.write(out, tables)
    for note in cells.notes:
        print(note)
    if options.findings:
        found = paper_claims.findings(cells.cells, paper)
        text = findings_text.findings_text(found, _sources(folders, cells))
        write_atomic(out / "findings.md", text)
        written.append("findings.md")
        written += _into_page(out / "README.md", findings_text.findings_table(found))
        print(text, end="")
    if tables:
        print(f"tables: {', '.join(table.name for table in tables)}")
    print(f"written: {', '.join(str(out / name) for name in written)}")
    return 0


def _sources(folders: Sequence[Path], cells: CellSet) -> list[str]:
    """Sources of the findings, and the command that makes them."""
    return [f"Made by {shell_command('arena_newton.eval', 'tables', *folders, '--findings')}", *cells.notes]


def _into_page(page: Path, table: str) -> list[str]:
    """Write the findings between the marks of a page of results, where it has them; names of files that were written.

    Raises:
        StorageError: It cannot be read or written.
    """
    from arena_newton.eval.records.journal import StorageError, write_atomic

    try:
        text = page.read_text(encoding="utf-8") if page.is_file() else ""
    except (OSError, UnicodeDecodeError) as error:
        raise StorageError(f"{page}: cannot be read ({error})") from None
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        return []
    write_atomic(page, f"{before}{begin}\n\n{table}\n{end}{after}")
    return [page.name]


@dataclass(frozen=True)
class ReproductionsOptions:
    """Print every success rate of the paper next to ours, with the mark that the interval of their difference allows.

    Folders are suites, results folders, or files cells.csv of `eval tables`.
    """

    out: str | None = None
    """Folder for reproductions.md; without it the page is printed alone."""


def reproductions(folders: Sequence[Path], options: ReproductionsOptions) -> int:
    """Print the page, and write it.

    Raises:
        InputError: A folder is unfit.
        StorageError: The page cannot be written.
    """
    from arena_newton.eval.records.journal import write_atomic
    from arena_newton.eval.tables.evaluated_cells import read_cells
    from arena_newton.eval.tables.reproduced_numbers import reproductions_page

    cells = read_cells(folders)
    if cells.changed:
        raise InputError(f"reproductions: {' '.join(cells.changed)} No number of the paper can be compared with it")
    text = reproductions_page(cells.cells)
    print(text, end="")
    if options.out is not None:
        write_atomic(user_path(options.out) / "reproductions.md", text)
    return 0
