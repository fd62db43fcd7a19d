"""A picture of what a policy does at the points of a grid of placements. Needs the extra [plots]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import pyplot

from arena_newton.eval.studies.placement_axes import Axis
from arena_newton.eval.studies.placement_files import PointTally

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_grid"]

MOST_LABELLED = 13
"""Points along an axis up to which each cell says its successes."""
INCHES = 0.62
"""Width of a cell [inch], within limits."""


def draw_grid(
    axes: Sequence[Axis], grid: Sequence[Sequence[float]], points: Sequence[PointTally], title: str
) -> Figure:
    """Success rate and mean margin at each point, as two maps; with one axis, maps of one row.

    Args:
        axes: One or two; the first is horizontal.
        grid: Values along each axis.
        points: One per point; the last axis changes fastest.
    """
    horizontal = grid[0]
    vertical = grid[1] if len(grid) > 1 else (0.0,)
    shape = (len(horizontal), len(vertical))
    rate = np.array([one.rate for one in points]).reshape(shape).T
    margin = np.array([one.mean_margin for one in points]).reshape(shape).T
    labels = np.array([f"{one.successes}/{one.judged}" for one in points], dtype=object).reshape(shape).T
    width = min(max(3.2, INCHES * len(horizontal) + 1.4), 9.0)
    height = min(max(1.2, INCHES * len(vertical)), 8.0) + 1.5
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(2 * width, height), layout="constrained")
    reach = max(float(np.nanmax(np.abs(margin), initial=0.0, where=np.isfinite(margin))), 1e-3)
    for panel, values, name, colours, low, high in (
        (left, rate, "success rate", "viridis", 0.0, 1.0),
        (right, margin, "mean margin at the end [m]", "RdBu", -reach, reach),
    ):
        picture = panel.imshow(values, origin="lower", aspect="auto", cmap=colours, vmin=low, vmax=high)
        figure.colorbar(picture, ax=panel, shrink=0.9)
        panel.set_title(name)
        _label(panel, axes, horizontal, vertical if len(grid) > 1 else ())
    if max(shape) <= MOST_LABELLED:
        for row, column in np.ndindex(rate.shape):
            bright = rate[row, column] > 0.6
            left.text(column, row, labels[row, column], ha="center", va="center", color="black" if bright else "white")
    figure.suptitle(title)
    return figure


def _label(panel: Axes, axes: Sequence[Axis], horizontal: Sequence[float], vertical: Sequence[float]) -> None:
    def name(axis: Axis) -> str:
        return f"{axis.name} [{axis.unit}]" if axis.unit else axis.name

    def shown(values: Sequence[float]) -> list[int]:
        return list(range(0, len(values), max(1, (len(values) + 7) // 8)))

    panel.set_xlabel(name(axes[0]))
    panel.set_xticks(shown(horizontal), [f"{horizontal[k]:.3g}" for k in shown(horizontal)])
    if vertical:
        panel.set_ylabel(name(axes[1]))
    panel.set_yticks(shown(vertical), [f"{vertical[k]:.3g}" for k in shown(vertical)])
