"""Curves of trainings as one picture, from their `progress.jsonl`."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arena_newton.errors import InputError

__all__ = ["PANELS", "draw", "read"]

PANELS: tuple[tuple[str, str, bool], ...] = (
    ("Train/reward_per_s", "reward per second", False),
    ("Train/seconds_between_ends", "time between early ends [s]", True),
    ("Error/legs_rad", "leg joints, RMS error [rad]", False),
    ("Error/velocity_m_s", "root velocity error [m/s]", False),
    ("std", "standard deviation of the action noise", False),
    ("learning_rate", "learning rate", True),
)
"""Drawn curves: name in the log, title, logarithmic or not."""
_SMOOTH = 15
"""Points of the running mean."""


def read(folder: Path) -> list[dict[str, Any]]:
    """Logged iterations of a training.

    Raises:
        InputError: The folder holds no readable log.
    """
    path = folder if folder.suffix == ".jsonl" else folder / "progress.jsonl"
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise InputError(f"curves {path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"curves {path}: not a text file") from None
    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            rows.append(json.loads(line))
        except (ValueError, RecursionError):
            if number < len(lines):
                raise InputError(f"curves {path}: line {number} is not JSON") from None
    needed = ("seconds", *(name for name, _, _ in PANELS))
    for row in rows:
        missing = needed if not isinstance(row, dict) else [name for name in needed if name not in row]
        if missing:
            raise InputError(f"curves {path}: a logged iteration lacks {missing[0]}")
        wrong = [name for name in ("iteration", *needed) if not isinstance(row.get(name, 0), int | float)]
        if wrong:
            raise InputError(f"curves {path}: {wrong[0]} of a logged iteration is not a number")
    if not rows:
        raise InputError(f"curves {path}: no logged iterations")
    # A training that was resumed from an older checkpoint logged some iterations twice: the later ones count.
    kept: list[dict[str, Any]] = []
    for row in rows:
        while kept and kept[-1].get("iteration", 0) >= row.get("iteration", 1):
            kept.pop()
        kept.append(row)
    return kept


def draw(folders: Sequence[Path], out: Path) -> Path:
    """Draw folders or log files over each other: thin what was logged, thick its running mean.

    Raises:
        InputError: A log or the picture's path does not fit.
    """
    if out.suffix not in (".png", ".svg", ".pdf"):
        raise InputError(f"--out {out}: expected .png, .svg or .pdf")
    names = [folder.stem if folder.suffix == ".jsonl" else folder.resolve().name for folder in folders]
    unique = len(set(names)) == len(names)
    runs = [(name if unique else str(folder), read(folder)) for name, folder in zip(names, folders, strict=True)]
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError("curves: needs matplotlib: install `arena-newton[plots]`")
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 3, figsize=(13.0, 6.5), layout="constrained")
    for axis, (name, title, logarithmic) in zip(axes.flat, PANELS, strict=True):
        for k, (label, rows) in enumerate(runs):
            minutes = np.array([row["seconds"] for row in rows]) / 60.0
            values = np.array([row[name] for row in rows])
            weights = np.ones(min(_SMOOTH, len(values)))
            mean = np.convolve(values, weights, "same") / np.convolve(np.ones_like(values), weights, "same")
            axis.plot(minutes, values, color=f"C{k}", alpha=0.25, linewidth=0.8)
            axis.plot(minutes, mean, color=f"C{k}", label=label)
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.3)
        if logarithmic:
            axis.set_yscale("log")
    for axis in axes[1]:
        axis.set_xlabel("minutes of training")
    axes[0, 0].legend()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=110)
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror})") from error
    finally:
        pyplot.close(figure)
    return out
