"""Flags of the commands that make tables and maps of actions."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FORMATS", "TablesOptions", "TsneOptions"]

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
    """Also test the paper's claims on these episodes: print them and write findings.md."""


@dataclass(frozen=True)
class TsneOptions:
    """Map the actions that one policy predicts from the observations of two datasets, as the paper's t-SNE figures."""

    policy: str = ""
    """Policy that predicts, such as lerobot:<checkpoint>."""
    datasets: tuple[str, ...] = ()
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
