"""``python -m arena_newton.trackers``: what there is, and `evaluate`, `train` and `motions` under one name."""

import sys
from collections.abc import Sequence

from arena_newton.__main__ import main as run

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one of the trackers' commands; without one, name them."""
    return run(["trackers", *(sys.argv[1:] if argv is None else argv)])


if __name__ == "__main__":
    sys.exit(main())
