"""LeRobot's import without what nobody here uses of it: a sixth of a training's start."""

from __future__ import annotations

import importlib
import importlib.util
import sys

__all__ = ["import_lerobot"]

HEAVY = "lerobot.processor"
"""Module with which LeRobot imports transformers' classes for any model, and those their ways to generate text."""


def import_lerobot() -> None:
    """Import LeRobot's processors without scikit-learn, with which transformers judges an assistant's text.

    What is imported already stays; without transformers there is nothing to leave out.
    """
    if HEAVY in sys.modules or importlib.util.find_spec("transformers") is None:
        return
    utilities = vars(importlib.import_module("transformers.utils"))
    known = utilities["is_sklearn_available"]
    utilities["is_sklearn_available"] = lambda: False
    try:
        importlib.import_module(HEAVY)
    finally:
        utilities["is_sklearn_available"] = known
