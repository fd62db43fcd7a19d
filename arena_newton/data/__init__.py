"""Episodes as files: what a demonstration holds, how one is recorded and read, and datasets made of them.

`Frames` reads the pictures of a dataset in any order; it is imported when it is asked for.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from arena_newton.cli.extras import require

if TYPE_CHECKING:
    from arena_newton.data.readers.frame_reader import Frames

__all__ = ["Frames"]


def __getattr__(name: str) -> object:
    """`Frames`, whose module imports PyAV and pyarrow."""
    if name != "Frames":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("data", "data.Frames", ("pyarrow",))
    return importlib.import_module("arena_newton.data.readers.frame_reader").Frames
