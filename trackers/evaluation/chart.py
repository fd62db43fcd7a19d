"""The figures of an evaluation against their bars, as one picture."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError
from arena_newton.trackers.evaluation.figures import Figure, Result, figures

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["chart", "missing"]

_COLOURS = {"pass": "#8fcfa5", "MISS": "#f0a090", "": "#d0d0d0"}
"""Colour by verdict."""
_WIDEST = 2.0
"""Length at which a bar is cut off, as a multiple of the limit."""
_NARROWEST = 0.012
"""Least length of a bar: its colour stays visible."""


def missing() -> str:
    """Extra to install for charts; empty where they can be drawn."""
    if importlib.util.find_spec("matplotlib") is not None:
        return ""
    return "needs matplotlib: install `arena-newton[plots]`"


def chart(results: Sequence[Result], out: Path) -> Path:
    """Draw every figure of every tracker as a fraction of its limit: up to the line at 1 the bar is met.

    A bar's length is the figure's number over its limit, or the limit over the number where more is better; its colour
    is the verdict, which may ask for more than the number (no fall). Figures without a limit show their value alone.

    Raises:
        InputError: matplotlib is not installed.
    """
    if missing():
        raise InputError(f"{out.name}: {missing()}")
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    columns = [{f.name: f for f in figures(r, results)} for r in results]
    names = list(dict.fromkeys(name for column in columns for name in column))
    size = (4.2 + 4.4 * len(results), 1.2 + 0.34 * len(names))
    picture, axes = pyplot.subplots(1, len(results), figsize=size, sharey=True, squeeze=False, layout="constrained")
    for axis, result, column in zip(axes[0], results, columns, strict=True):
        for row, name in enumerate(names):
            _row(axis, row, column.get(name))
        axis.axvline(1.0, color="black", linewidth=1.0)
        axis.set(xlim=(0.0, _WIDEST), xticks=(0.0, 0.5, 1.0, 1.5, 2.0), ylim=(len(names) - 0.4, -0.6))
        axis.set_title(result.label, fontsize=11)
        axis.set_xlabel("fraction of the limit; up to 1 is met", fontsize=9)
        axis.spines[["top", "right"]].set_visible(False)
    limits = [next((c[name].bar for c in columns if name in c and c[name].bar), "") for name in names]
    labels = [f"{name}\n{limit}" if limit else name for name, limit in zip(names, limits, strict=True)]
    axes[0][0].set_yticks(range(len(names)), labels, fontsize=7)
    try:
        picture.savefig(out, dpi=120)
    finally:
        pyplot.close(picture)
    return out


def _row(axis: Axes, row: int, figure: Figure | None) -> None:
    if figure is not None and figure.ratio is not None:
        axis.barh(row, min(max(figure.ratio, _NARROWEST), _WIDEST), height=0.72, color=_COLOURS[figure.verdict])
    axis.text(0.02, row, "–" if figure is None else figure.value, va="center", fontsize=6.5)
