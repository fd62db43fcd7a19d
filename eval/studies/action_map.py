"""Distance between two sources of observations in a policy's answers: t-SNE, and numbers without it.

t-SNE shows, and its distances mean nothing beyond one map. The numbers that do: how often a linear classifier tells the
source of an action it has not seen, with all actions of an episode on one side of each split, and the same of the
observations themselves. Needs the extra [plots].
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import pyplot
from sklearn.decomposition import PCA
from sklearn.linear_model import LogisticRegression
from sklearn.manifold import TSNE
from sklearn.model_selection import GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from arena_newton.cli.intervals import Z95
from arena_newton.eval.tables.suite_figures import save
from arena_newton.robot.canonical import element_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["ActionMap", "Separation", "draw", "embed", "separation", "shifted"]

FOLDS = 5
"""Parts of the episodes, each of which is held out once."""
CONSTANT = 1e-6
"""Spread below which a channel counts as constant."""
COLOURS = {"sonic": "#1f77b4", "twist2": "#ff7f0e"}
"""The paper's: blue for SONIC, orange for TWIST2."""
LEAST_WIDTH, LETTER = 4.8, 0.1
"""Width of a figure that its legend needs, and of a letter of its title, a wide one [inch]."""
OTHERS = ("#2ca02c", "#9467bd")
"""Colours of other sources."""


@dataclass(frozen=True)
class Separation:
    """Separability of two sources by a linear classifier, over episodes that it was not fitted to."""

    accuracy: float
    """Mean over episodes of the fraction of their samples whose source is predicted; 0.5 is chance."""
    low: float
    """95 % interval of the mean over episodes."""
    high: float
    episodes: int


@dataclass(frozen=True)
class ActionMap:
    """Actions of one task in the plane."""

    task: str
    points: np.ndarray
    """float64, shape [n, 2]."""
    sources: np.ndarray
    """Source of each, 0 or 1, shape [n]."""
    names: tuple[str, str]
    actions: Separation
    observations: Separation


def embed(actions: np.ndarray, *, perplexity: float, seed: int) -> np.ndarray:
    """t-SNE of actions as they are (the paper's figures say of no scaling), shape [n, 2].

    van der Maaten, L. and Hinton, G. (2008): Visualizing data using t-SNE, JMLR 9; started from the first two principal
    components. The perplexity is lowered for few samples.
    """
    values = np.asarray(actions, dtype=np.float64)
    start = np.random.default_rng(seed).normal(0, 1e-4, (len(values), 2))
    if values.std(axis=0).max() > CONSTANT:
        main = PCA(n_components=2, random_state=seed).fit_transform(values)
        start = main / main[:, 0].std() * 1e-4
    most = max(1.0, (len(values) - 1) / 3)
    model = TSNE(perplexity=min(perplexity, most), init=start, random_state=seed, n_jobs=1)
    with threadpool_limits(1):  # sums in one order, whatever the machine
        found: np.ndarray = model.fit_transform(values)
    return found.astype(np.float64)


def separation(values: np.ndarray, sources: np.ndarray, episodes: np.ndarray) -> Separation | None:
    """Accuracy of a logistic regression on scaled values, cross-validated over whole episodes.

    Args:
        values: Shape [n, width].
        sources: 0 or 1, shape [n].
        episodes: Episode of each; episodes of the two sources have different numbers.

    Returns:
        None where a source has fewer than two episodes.
    """
    counts = [len(set(episodes[sources == k].tolist())) for k in (0, 1)]
    folds = min(FOLDS, *counts)
    if folds < 2:
        return None
    kept = values[:, values.std(axis=0) > CONSTANT]
    right = np.zeros(len(values), dtype=bool)
    # Folds within each source, so that both are in every part.
    parts = np.zeros(len(values), dtype=np.int64)
    for k in (0, 1):
        mine = np.flatnonzero(sources == k)
        for number, (_, held) in enumerate(GroupKFold(folds).split(mine, groups=episodes[mine])):
            parts[mine[held]] = number
    for number in range(folds):
        held = parts == number
        if kept.shape[1] == 0:
            right[held] = sources[held] == 0  # nothing varies, so one guess for all
            continue
        model = make_pipeline(StandardScaler(), LogisticRegression(max_iter=2000))
        model.fit(kept[~held], sources[~held])
        right[held] = model.predict(kept[held]) == sources[held]
    each = {k: [right[episodes == e].mean() for e in np.unique(episodes[sources == k])] for k in (0, 1)}
    means = [float(np.mean(each[k])) for k in (0, 1)]
    accuracy = sum(means) / 2
    variance = sum(float(np.var(each[k], ddof=1)) / len(each[k]) for k in (0, 1)) / 4
    half = Z95 * math.sqrt(variance)
    return Separation(accuracy, max(0.0, accuracy - half), min(1.0, accuracy + half), sum(counts))


def shifted(actions: np.ndarray, sources: np.ndarray, most: int = 5) -> list[tuple[str, float]]:
    """Numbers of the action whose means differ most between the sources, in units of their spread within a source.

    Positive: larger for the second source. A number that is constant within both sources has no such unit and counts
    as not moved.
    """
    first, second = actions[sources == 0].astype(np.float64), actions[sources == 1].astype(np.float64)
    spread = np.sqrt((first.var(axis=0) + second.var(axis=0)) / 2)
    moves = np.where(spread > CONSTANT, (second.mean(axis=0) - first.mean(axis=0)) / np.maximum(spread, CONSTANT), 0.0)
    order = np.argsort(-np.abs(moves), kind="stable")[:most]
    return [(element_name(int(k)), float(moves[k])) for k in order]


def draw(maps: Sequence[ActionMap], title: str, path: Path) -> None:
    """A panel per task, as the paper's figures."""
    columns = min(4, len(maps))
    rows = -(-len(maps) // columns)
    width = max(LEAST_WIDTH, 3.4 * columns)
    figure, all_axes = pyplot.subplots(
        rows, columns, figsize=(width, 0.9 + 3.4 * rows), squeeze=False, layout="constrained"
    )
    for axes in all_axes.flat[len(maps) :]:
        axes.set_axis_off()
    for axes, one in zip(all_axes.flat, maps, strict=False):
        _panel(axes, one)
    handles, labels = all_axes.flat[0].get_legend_handles_labels()
    figure.suptitle(textwrap.fill(title, int(width / LETTER)), fontsize=11)
    legend = figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1.0)
    save(figure, path)


def _panel(axes: Axes, one: ActionMap) -> None:
    colours = _colours(one.names)
    # Drawn in one mixed order: the source that is drawn last would hide the other.
    order = np.random.default_rng(0).permutation(len(one.points))
    for k in (0, 1):
        axes.scatter([], [], s=14, color=colours[one.names[k]], label=f"observations of {one.names[k]}")
    shades = [colours[one.names[k]] for k in one.sources[order]]
    axes.scatter(one.points[order, 0], one.points[order, 1], s=5, c=shades, alpha=0.55, linewidths=0)
    title = (
        f"source predicted: actions {100 * one.actions.accuracy:.0f} %, states {100 * one.observations.accuracy:.0f} %"
    )
    axes.set_title(f"{one.task}\n{title}", fontsize=9, loc="left")
    axes.set_xticks([])
    axes.set_yticks([])


def _colours(names: tuple[str, str]) -> Mapping[str, str]:
    free = iter(OTHERS)
    return {name: COLOURS.get(name) or next(free) for name in names}
