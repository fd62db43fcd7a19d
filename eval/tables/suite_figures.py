"""Pictures of the tables: rates next to the paper's, perturbation profiles, retention. Needs the extra [plots]."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("agg")

from matplotlib import pyplot  # noqa: E402  # after the choice of what draws
from matplotlib.colors import LinearSegmentedColormap  # noqa: E402

from arena_newton.eval.records.journal import StorageError  # noqa: E402
from arena_newton.eval.statistics.stats import suites  # noqa: E402
from arena_newton.eval.tables.suite_tables import MODE_ORDER, tracker_order  # noqa: E402
from arena_newton.eval.tables.table_entries import PAPER_NAMES, SuiteTable, TableEntry  # noqa: E402
from arena_newton.files.own_files import replace_atomically  # noqa: E402
from arena_newton.pages.tables import percent  # noqa: E402

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "save", "write"]

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#000000")
"""Okabe and Ito's colours, which colour-blind readers distinguish too."""
DPI = 110
"""Resolution of the files [1/inch]."""
HALVES = ("HOI_AVG", "HSI_AVG")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG whose bytes depend on nothing but the figure and the version of matplotlib.

    Raises:
        StorageError: It cannot be written.
    """
    try:
        with replace_atomically(path, sync=True) as file:
            figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        pyplot.close(figure)


def write(out: Path, tables: Sequence[SuiteTable]) -> list[str]:
    """Draw every table that has a picture; names of the files."""
    drawn: dict[str, Callable[[SuiteTable], Figure | None]] = {
        "cross_gmt": _retention,
        "latency": _latency,
        "merge_all": lambda table: _bars(table, "trained_on"),
        "perturbation": _profiles,
    }
    names = []
    for table in tables:
        draw = drawn.get(table.name, _bars if table.name.startswith("in_gmt") else None)
        figure = draw(table) if draw is not None else None
        if figure is not None:
            save(figure, out / f"{table.name}.png")
            names.append(f"{table.name}.png")
    return names


def _policies(entries: Sequence[TableEntry]) -> list[tuple[str, str]]:
    """Policy and family of ours, in the order of the table."""
    return list(dict.fromkeys((e.policy, e.family) for e in entries if e.source == "ours"))


def _short(task: str) -> str:
    return {"HOI_AVG": "HOI\navg", "HSI_AVG": "HSI\navg", "pp_box": "P&P\nbox"}.get(task, task.replace("_", "\n"))


def _bars(table: SuiteTable, panel: str = "tracker") -> Figure | None:
    """A panel per tracker: bars with intervals per task and policy, the paper's rate as a diamond."""
    ours = [e for e in table.entries if e.source == "ours"]
    theirs = {(e.trained_on, e.family, e.task): e for e in table.entries if e.source == "paper"}
    order = (*suites()["HOI_AVG"], "HOI_AVG", *suites()["HSI_AVG"], "HSI_AVG")
    extra = sorted({e.task for e in ours} - set(order))
    tasks = [task for task in (*order, *extra) if any(e.task == task for e in ours)]
    panels = tracker_order({getattr(e, panel) for e in ours})
    policies = _policies(ours)
    figure, all_axes = pyplot.subplots(
        len(panels), 1, figsize=(2.2 + 1.15 * len(tasks), 0.6 + 2.9 * len(panels)), squeeze=False, layout="constrained"
    )
    width = 0.84 / len(policies)
    for axes, name in zip(all_axes[:, 0], panels, strict=True):
        for number, (policy, family) in enumerate(policies):
            colour = COLOURS[number % len(COLOURS)]
            labelled = False
            for column, task in enumerate(tasks):
                mine = [e for e in ours if (getattr(e, panel), e.policy, e.task) == (name, policy, task)]
                x = column - 0.42 + width * (number + 0.5)
                if mine and mine[0].sr is not None:
                    _bar(axes, x, width, mine[0], colour, label=None if labelled else policy)
                    labelled = True
                paper = theirs.get((name, family, task))
                if mine and paper is not None and paper.sr is not None:
                    _diamond(axes, x, paper)
        axes.set_title(name.replace("+", " + "), loc="left", fontsize=11)
        axes.set_xticks(range(len(tasks)), [_short(task) for task in tasks], fontsize=9)
        axes.set_xlim(-0.6, len(tasks) - 0.4)
        _percent_axis(axes)
        for column, task in enumerate(tasks):
            if task in HALVES:
                axes.axvspan(column - 0.5, column + 0.5, color="#f0f0f0", zorder=0)
    figure.suptitle(f"{table.title}: success rate in %, bars with 95 % intervals; diamonds: the paper", fontsize=11)
    _legend(figure, 6)
    return figure


def _legend(figure: Figure, columns: int) -> None:
    """One legend of all panels, below them."""
    found: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    most = min(columns, len(found))
    figure.legend(list(found.values()), list(found), loc="outside lower center", ncols=most, fontsize=9, frameon=False)


def _bar(axes: Axes, x: float, width: float, entry: TableEntry, colour: str, label: str | None) -> None:
    rate = 100 * (entry.sr or 0.0)
    axes.bar(x, rate, 0.92 * width, color=colour, label=label, zorder=2)
    if entry.low is not None and entry.high is not None:
        ends = [[max(0.0, rate - 100 * entry.low)], [max(0.0, 100 * entry.high - rate)]]
        axes.errorbar(x, rate, ends, fmt="none", ecolor="#222222", elinewidth=1, capsize=2, zorder=3)


def _diamond(axes: Axes, x: float, entry: TableEntry) -> None:
    """The paper's rate, and its derived interval where it has one."""
    rate = 100 * (entry.sr or 0.0)
    if entry.low is not None and entry.high is not None:
        axes.vlines(x, 100 * entry.low, 100 * entry.high, color="#888888", linewidth=0.8, linestyles=":", zorder=3)
    axes.plot(x, rate, "D", markersize=4, markerfacecolor="white", markeredgecolor="#222222", zorder=4)


def _percent_axis(axes: Axes) -> None:
    axes.set_ylim(0, 104)
    axes.set_yticks(range(0, 101, 20))
    axes.grid(axis="y", color="#dddddd", linewidth=0.7, zorder=1)
    axes.spines[["top", "right"]].set_visible(False)


def _profiles(table: SuiteTable) -> Figure | None:
    """A panel per tracker and suite: lines over modes, ours solid with intervals, the paper's dashed."""
    ours = [e for e in table.entries if e.source == "ours"]
    trackers = tracker_order({e.tracker for e in ours})
    policies = _policies(ours)
    modes = [mode for mode in MODE_ORDER if any(e.mode == mode for e in ours)]
    theirs = _paper_lines(table, modes)
    figure, all_axes = pyplot.subplots(
        len(trackers), 2, figsize=(8.6, 0.8 + 2.9 * len(trackers)), squeeze=False, sharey=True, layout="constrained"
    )
    for row, tracker in enumerate(trackers):
        for column, suite in enumerate(HALVES):
            axes = all_axes[row, column]
            for number, (policy, family) in enumerate(policies):
                colour = COLOURS[number % len(COLOURS)]
                mine = {e.mode: e for e in ours if (e.tracker, e.policy, e.task) == (tracker, policy, suite)}
                shift = 0.06 * (number - (len(policies) - 1) / 2)
                points = [(modes.index(m) + shift, mine[m]) for m in modes if m in mine]
                if points:
                    _line(axes, points, colour, policy)
                line = theirs.get((tracker, family, suite))
                if line is not None and points:
                    axes.plot(
                        [m + shift for m in range(len(modes))], line, "--D", color=colour, markersize=3.5, linewidth=1,
                        markerfacecolor="white", alpha=0.8, label=f"paper: {PAPER_NAMES.get(family, family)}",
                    )  # fmt: skip
            axes.set_title(f"{tracker}, {suite.removesuffix('_AVG')}", loc="left", fontsize=11)
            axes.set_xticks(range(len(modes)), modes, fontsize=9)
            _percent_axis(axes)
    figure.suptitle("Success rate in % by mode, 95 % intervals; dashed: the paper", fontsize=11)
    _legend(figure, 4)
    return figure


def _paper_lines(table: SuiteTable, modes: Sequence[str]) -> dict[tuple[str, str, str], list[float]]:
    """The paper's averages by tracker, family and suite [%]."""
    found: dict[tuple[str, str, str], dict[str, float]] = {}
    for e in table.entries:
        if e.source == "paper" and e.sr is not None:
            found.setdefault((e.tracker, e.family, e.task), {})[e.mode] = 100 * e.sr
    return {key: [line[m] for m in modes] for key, line in found.items() if set(modes) <= set(line)}


def _line(axes: Axes, points: Sequence[tuple[float, TableEntry]], colour: str, label: str) -> None:
    xs = [x for x, _ in points]
    rates = [100 * (e.sr or 0.0) for _, e in points]
    lows = [max(0.0, rate - 100 * (e.low or 0.0)) for rate, (_, e) in zip(rates, points, strict=True)]
    highs = [
        max(0.0, 100 * (1.0 if e.high is None else e.high) - rate) for rate, (_, e) in zip(rates, points, strict=True)
    ]
    axes.errorbar(
        xs, rates, [lows, highs], fmt="-o", color=colour, markersize=4.5, linewidth=1.6, capsize=2, label=label
    )


def _latency(table: SuiteTable) -> Figure | None:
    """A panel per tracker: rate over delay, a line per policy and task."""
    trackers = tracker_order({e.tracker for e in table.entries})
    figure, all_axes = pyplot.subplots(
        1, len(trackers), figsize=(1.4 + 4.0 * len(trackers), 3.8), squeeze=False, sharey=True, layout="constrained"
    )
    lines = list(dict.fromkeys((e.policy, e.task) for e in table.entries))
    for axes, tracker in zip(all_axes[0], trackers, strict=True):
        for number, (policy, task) in enumerate(lines):
            mine = [e for e in table.entries if (e.tracker, e.policy, e.task) == (tracker, policy, task)]
            if mine:
                points = [(20.0 * e.latency, e) for e in sorted(mine, key=lambda e: e.latency)]
                _line(axes, points, COLOURS[number % len(COLOURS)], f"{policy}, {task}")
        axes.set_title(tracker, loc="left", fontsize=11)
        axes.set_xlabel("each chunk starts late by [ms]", fontsize=9)
        _percent_axis(axes)
    figure.suptitle("Success rate in % by latency, 95 % intervals", fontsize=11)
    _legend(figure, 4)
    return figure


def _retention(table: SuiteTable) -> Figure | None:
    """Heat maps of retention: tasks x policies, a row per direction, ours and the paper's next to each other."""
    ours = [e for e in table.entries if e.source == "ours"]
    if not ours:
        return None
    directions = list(dict.fromkeys((e.trained_on, e.tracker) for e in ours))
    policies = _policies(ours)
    families = list(dict.fromkeys(f for _, f in policies if f in PAPER_NAMES))
    tasks = [t for t in suites()["ALL_AVG"] if any(e.task == t for e in ours)]
    tasks += sorted({e.task for e in ours} - set(tasks))
    widths = [len(policies), max(1, len(families))]
    size = (2.8 + 1.0 * sum(widths), 0.9 + 0.42 * len(tasks) * len(directions))
    figure, all_axes = pyplot.subplots(
        len(directions), 2, figsize=size, squeeze=False, layout="constrained", width_ratios=widths
    )
    for row, (a, b) in enumerate(directions):
        mine = {(e.policy, e.task): e for e in ours if (e.trained_on, e.tracker) == (a, b)}
        paper = {
            (e.family, e.task): e for e in table.entries if e.source == "paper" and (e.trained_on, e.tracker) == (a, b)
        }
        _map(all_axes[row, 0], mine, [p for p, _ in policies], tasks, f"{a} → {b}")
        _map(all_axes[row, 1], paper, families, tasks, "the paper", [PAPER_NAMES[f] for f in families])
        all_axes[row, 1].set_yticks([])
    figure.suptitle("Retention in %: swapped over matched success rate", fontsize=11)
    return figure


def _map(
    axes: Axes,
    cells: dict[tuple[str, str], TableEntry],
    columns: Sequence[str],
    tasks: Sequence[str],
    title: str,
    names: Sequence[str] | None = None,
) -> None:
    between = LinearSegmentedColormap.from_list("retention", ("#b2182b", "#f7f7f7", "#2166ac"))
    colours = between.with_extremes(bad="#e8e8e8")
    values = [[math.nan] * max(1, len(columns)) for _ in tasks]
    for y, task in enumerate(tasks):
        for x, column in enumerate(columns):
            cell = cells.get((column, task))
            if cell is None:
                continue
            kept = cell.retention
            values[y][x] = math.nan if kept is None else min(1.0, kept)
            strong = kept is not None and abs(min(1.0, kept) - 0.5) > 0.3
            text = "—" if kept is None else percent(kept, 0)
            axes.text(x, y, text, ha="center", va="center", fontsize=9, color="white" if strong else "black")
    axes.imshow(values, cmap=colours, vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(columns)), list(names or columns), fontsize=9)
    axes.set_yticks(range(len(tasks)), [task.replace("_", " ") for task in tasks], fontsize=9)
    axes.set_title(title, loc="left", fontsize=11)
    axes.tick_params(length=0)
