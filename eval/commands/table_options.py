"""Flags of the commands that make tables and maps of actions."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import Several

__all__ = ["FORMATS", "CompareOptions", "TablesOptions", "TsneOptions"]

FORMATS = ("md", "tex", "csv", "png")
"""Forms in which tables are written."""


@dataclass(frozen=True)
class TablesOptions:
    """Write the paper's tables filled with the episodes of suites and results folders, next to the paper's numbers."""

    out: str = "tables"
    """Folder to write: tables.md, tables.tex, cells.csv and one picture per table that has one."""
    format: tuple[str, ...] = FORMATS
    """Forms to write, one or several: md tex csv png (png needs the extra [plots])."""
    rules: str = "paper"
    """Rule set whose episodes count: paper or released."""
    findings: bool = False
    """Also test the paper's claims on these trainings: print them and write findings.md, and the table of findings
    between its marks in a README.md of the folder; of files cells.csv nothing else is made."""


@dataclass(frozen=True)
class CompareOptions:
    """Compare policies over the episodes that they share: exact tests, intervals, letters, and who won which episode.

    Results folders are one policy each; a suite has all of its own. Episodes are paired by task, tracker, mode and
    episode seed; runs of other seeds are compared unpaired. Where each has one tracker, trackers may differ.
    """

    out: str = "comparison"
    """Folder to write: compare.html, compare.md, compare.json and compare.csv."""
    only: Several[str] = ()
    """Names of those to compare, as the command prints them; all when none is named."""
    differ: Several[str] = ()
    """What may differ between them, because it is what is compared: rules engine max_steps variant fast_physics."""
    per_tracker: bool = False
    """Each tracker of a folder is compared as one of its own, and against the others."""


@dataclass(frozen=True)
class TsneOptions:
    """Map the actions that one policy predicts from the observations of two datasets, as the paper's t-SNE figures."""

    policy: str = ""
    """Policy that predicts, such as lerobot:<checkpoint>."""
    datasets: Several[str] = ()
    """Two LeRobot datasets of the same tasks, such as one recorded through each tracker."""
    samples: int = 1000
    """Observations of each dataset and task."""
    frames: int = 10
    """Uniformly spaced observations of each episode."""
    out: str = "tsne"
    """Folder to write: tsne.json, and one picture per task."""
    seed: int = 0
    """Of the embedding and of the policy's noise."""
    perplexity: float = 30.0
    """Of the embedding."""
    batch: int = 50
    """Observations that the policy is given at once."""
