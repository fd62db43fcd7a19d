"""Statistics of the rows of an episode, by LeRobot's names: exact, in double precision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from arena_newton.data.recording.image_statistics import QUANTILES

__all__ = ["HAND_NAME", "aggregated", "row_statistics"]

HAND_NAME = "action.hand_binary."
"""Beginning of the names of the two hands, which are 0 or 1."""


def quantile_name(quantile: float) -> str:
    """LeRobot's name of a quantile, such as `q01`."""
    return f"q{round(100 * quantile):02d}"


def row_statistics(rows: np.ndarray, names: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Statistics per column.

    LeRobot's own are made in single precision, in which the deviation of a nearly constant number is noise, and its
    quantiles are read from bins. A quantile here is the least value of which so large a fraction is not larger.

    Args:
        rows: Numbers, shape [T] or [T, width].
        names: Names of the columns. Those of the hands (`HAND_NAME`) have the quantiles of a hand that is open in one
            half of the rows and closed in the other: of one that never moves they would be equal, and a policy that
            normalizes by them would divide by zero.

    Returns:
        `min`, `max`, `mean`, `std` and `q01` ... `q99` of shape [width], or [1] for one column; `count` of shape [1].
    """
    table = np.asarray(rows, dtype=np.float64)
    count = len(table)
    table = table.reshape(count, -1)
    mean = table.mean(axis=0)
    found = {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": mean,
        "std": np.sqrt(((table - mean) ** 2).mean(axis=0)),
        "count": np.array([count]),
    }
    ordered = np.sort(table, axis=0)
    hands = [number for number, name in enumerate(names) if name.startswith(HAND_NAME)]
    for quantile in QUANTILES:
        # A product such as 0.1 * 30 is a little more than 3, which is meant.
        values = ordered[max(0, int(np.ceil(quantile * count - 1e-9)) - 1)].copy()
        if quantile != 0.5:
            values[hands] = float(quantile > 0.5)
        found[quantile_name(quantile)] = values
    return found


def aggregated(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Statistics of several episodes as one, as LeRobot joins them.

    Mean and deviation are those of all rows; quantiles are averages of the episodes' quantiles, weighted by rows.
    """
    counts = np.array([np.asarray(part["count"]).reshape(()) for part in parts], dtype=np.float64)
    weights = counts / counts.sum()

    def average(values: np.ndarray) -> np.ndarray:
        total: np.ndarray = np.tensordot(weights, values, axes=1)
        return total

    stacked = {name: np.stack([np.asarray(part[name], np.float64) for part in parts]) for name in parts[0]}
    mean = average(stacked["mean"])
    found = {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(average(stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)),
        "count": np.array([int(counts.sum())]),
    }
    names = [quantile_name(quantile) for quantile in QUANTILES]
    return found | {name: average(stacked[name]) for name in names if name in stacked}
