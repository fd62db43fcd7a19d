"""`python -m arena_newton.eval merge`: shards become one results folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.cli.flags import shell_command
from arena_newton.errors import InputError
from arena_newton.files.text import counted, plain_text, unprintable

__all__ = ["RunMergeOptions", "run"]


@dataclass(frozen=True)
class RunMergeOptions:
    """Join the folders of shards into one results folder, as if one machine had played the plan.

    Recordings are copied, tables and report are written from the joined journal. Nothing in the shards changes.
    """

    out: str | None = None
    """Folder to write; it must be new."""
    partial: bool = False
    """Join what there is although shards are missing or unfinished; `resume <out>` plays the rest."""
    accept_versions: bool = False
    """Join shards that were played with other versions of the libraries; the folder then names all."""


def run(folders: Sequence[Path], options: RunMergeOptions) -> int:
    """Merge, and print the table.

    Returns:
        0: every planned episode is there, with another outcome than error. 1: some are missing or ended so.

    Raises:
        InputError: The folders cannot be joined, or --out cannot be written to.
        StorageError: The disk is full.
    """
    if options.out is None or not options.out.strip():
        raise InputError("merge: name a new folder with --out")
    if (reason := unprintable(options.out)) is not None:
        raise InputError(f"--out {plain_text(options.out)}: {reason}")
    from arena_newton.eval.reports import report
    from arena_newton.eval.workers.shard_merge import merge

    out = Path(options.out).expanduser()
    merged = merge(folders, out, partial=options.partial, accept_versions=options.accept_versions)
    print(report.table(merged.results))
    for note in (*report.notes(merged.run, merged.results), *merged.notes):
        print(note)
    whole = merged.results["complete"]
    if not whole:
        print(f"The rest: {shell_command('arena_newton.eval', 'resume', out)}")
    print(f"{counted(merged.results['finished'], 'episode')} of {counted(len(folders), 'folder')} -> {out}")
    print(f"report: {out / 'report.html'}")
    return 0 if whole and not any(record.outcome == "error" for record in merged.run.records) else 1
