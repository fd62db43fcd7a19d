"""Exact statistics of pictures from a histogram of their values, taken while they are recorded."""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["QUANTILES", "VALUES", "add_picture", "statistics"]

VALUES = 256
"""Values of a channel."""
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
"""Those that LeRobot's datasets hold."""


def add_picture(histogram: np.ndarray, picture: np.ndarray) -> None:
    """Count the pixels of one picture.

    Args:
        histogram: int64, shape [3, 256], added to.
        picture: uint8, shape [H, W, 3].
    """
    for channel in range(3):
        counts = cv2.calcHist([picture], [channel], None, [VALUES], [0, VALUES])
        histogram[channel] += counts.reshape(-1).astype(np.int64)  # OpenCV 5 gives [256], 4 gives [256, 1]


def statistics(histogram: np.ndarray, frames: int) -> dict[str, np.ndarray]:
    """Statistics per channel on the scale 0 to 255, by LeRobot's names.

    Args:
        histogram: int64, shape [3, 256].

    Returns:
        `min`, `max`, `mean`, `std` and `q01` ... `q99` of shape [3], and `count` of shape [1], the pictures.
    """
    histogram = np.asarray(histogram, dtype=np.int64)
    values = np.arange(VALUES, dtype=np.float64)
    total = histogram.sum(axis=1)
    mean = (histogram * values).sum(axis=1) / total
    spread = (histogram * (values - mean[:, None]) ** 2).sum(axis=1) / total
    below = np.cumsum(histogram, axis=1)
    found = {
        "min": (histogram > 0).argmax(axis=1).astype(np.float64),
        "max": (VALUES - 1 - (histogram[:, ::-1] > 0).argmax(axis=1)).astype(np.float64),
        "mean": mean,
        "std": np.sqrt(spread),
        "count": np.array([frames]),
    }
    for quantile in QUANTILES:
        found[f"q{round(100 * quantile):02d}"] = (below >= quantile * total[:, None]).argmax(axis=1).astype(np.float64)
    return found
